use super::{BIN_CHUNK, EXTENSION, GLB_MAGIC, JSON_CHUNK, SPZ_EXTENSIONS, sh_attribute};
use crate::splats::axes::Signs;
use crate::splats::quantize::{normalized, sigmoid};
use crate::splats::rows::{SPLATS_PER_TASK, bounds, encode_rows};
use crate::splats::{Quality, SpzVersion, spz};
use irradia_scene::{GaussianCloud, base64, sh};
use serde_json::{Map, Value, json};
use std::io::{self, Write};

/// glTF's codes of a component type and of a buffer view's target.
const FLOAT_COMPONENT: u32 = 5126;
const ARRAY_BUFFER: u32 = 34962;

/// Writes the numbers of a splat.
type Values<'a> = Box<dyn Fn(usize, &mut [f32]) + Sync + 'a>;

/// An attribute: name, type, numbers per splat, and the function that writes those of one splat.
struct Attribute<'a> {
    name: String,
    kind: &'static str,
    width: usize,
    values: Values<'a>,
}

/// The attributes in glTF's axes and activations.
fn attributes(cloud: &GaussianCloud) -> Vec<Attribute<'_>> {
    let signs = Signs::HALF_TURN_Z;
    let width = 3 * cloud.sh_coefficients();
    let attribute = |name: String, kind, width, values| Attribute {
        name,
        kind,
        width,
        values,
    };
    let attribute_name = |name: &str| format!("{EXTENSION}:{name}");
    let mut all = vec![
        attribute(
            "POSITION".into(),
            "VEC3",
            3,
            Box::new(move |i, to: &mut [f32]| {
                to.copy_from_slice(&signs.position(cloud.means[i]));
            }) as Values,
        ),
        attribute(
            attribute_name("ROTATION"),
            "VEC4",
            4,
            Box::new(move |i, to: &mut [f32]| {
                let [w, x, y, z] = signs.quat(normalized(cloud.quats[i]));
                to.copy_from_slice(&[x, y, z, w]);
            }),
        ),
        attribute(
            attribute_name("SCALE"),
            "VEC3",
            3,
            Box::new(move |i, to: &mut [f32]| {
                to.copy_from_slice(&cloud.log_scales[i].map(f32::exp));
            }),
        ),
        attribute(
            attribute_name("OPACITY"),
            "SCALAR",
            1,
            Box::new(move |i, to: &mut [f32]| {
                to[0] = sigmoid(cloud.opacity_logits[i]);
            }),
        ),
    ];
    // The extension stops at degree 3.
    for coefficient in 0..sh::coefficients(cloud.sh_degree.min(3)) {
        let sign = coefficient.checked_sub(1).map_or(1.0, |rest| signs.bands()[rest]);
        let values = Box::new(move |i: usize, to: &mut [f32]| {
            let from = &cloud.sh[i * width + 3 * coefficient..];
            to.iter_mut().zip(from).for_each(|(to, from)| *to = from * sign);
        });
        all.push(attribute(sh_attribute(coefficient), "VEC3", 3, values));
    }
    all
}

/// The document of one mesh whose primitive is `primitive`.
fn document(primitive: Value, extensions: &[&str], required: &[&str], buffer: Value, buffer_views: &[Value]) -> Value {
    let mut document = json!({
        "asset": { "version": "2.0", "generator": "Irradia" },
        "extensionsUsed": extensions,
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [primitive] }],
        "buffers": [buffer],
        "bufferViews": buffer_views,
    });
    if !required.is_empty() {
        document["extensionsRequired"] = json!(required);
    }
    document
}

fn extension_json() -> Value {
    json!({
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    })
}

/// The document of plain attributes one after another in `buffer`.
fn plain_document(cloud: &GaussianCloud, attributes: &[Attribute], mut buffer: Value) -> Value {
    let count = cloud.len();
    let (low, high) = bounds(&cloud.means);
    let [a, b] = [low, high].map(|corner| Signs::HALF_TURN_Z.position(corner));
    let (mut views, mut accessors, mut names) = (Vec::new(), Vec::new(), Map::new());
    let mut offset = 0;
    for (i, attribute) in attributes.iter().enumerate() {
        let length = 4 * attribute.width * count;
        views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": length, "target": ARRAY_BUFFER }));
        let mut accessor =
            json!({ "bufferView": i, "componentType": FLOAT_COMPONENT, "count": count, "type": attribute.kind });
        if i == 0 {
            let corner = |pick: fn(f32, f32) -> f32| [0, 1, 2].map(|c| pick(a[c], b[c]));
            accessor["min"] = json!(corner(f32::min));
            accessor["max"] = json!(corner(f32::max));
        }
        accessors.push(accessor);
        names.insert(attribute.name.clone(), json!(i));
        offset += length;
    }
    buffer["byteLength"] = json!(offset);
    let primitive = json!({ "attributes": names, "mode": 0, "extensions": { EXTENSION: extension_json() } });
    let mut document = document(primitive, &[EXTENSION], &[], buffer, &views);
    document["accessors"] = json!(accessors);
    document
}

/// Passes the bytes of the attributes to `out`, a part at a time.
fn write_attributes(out: &mut dyn Write, count: usize, attributes: &[Attribute]) -> io::Result<()> {
    for attribute in attributes {
        let row = 4 * attribute.width;
        for first in (0..count).step_by(16 * SPLATS_PER_TASK) {
            let bytes = encode_rows((count - first).min(16 * SPLATS_PER_TASK), row, |i, row| {
                let mut values = [0.0; 4];
                (attribute.values)(first + i, &mut values[..attribute.width]);
                for (to, value) in row.chunks_exact_mut(4).zip(values) {
                    to.copy_from_slice(&value.to_le_bytes());
                }
            });
            out.write_all(&bytes)?;
        }
    }
    Ok(())
}

/// Header, JSON chunk and the head of the binary chunk of a `.glb` file with `binary` bytes, a multiple of four.
fn write_glb_header(out: &mut dyn Write, document: &Value, binary: usize) -> io::Result<()> {
    let mut text = serde_json::to_vec(document)?;
    text.resize(text.len().next_multiple_of(4), b' ');
    let total = u32::try_from(28 + text.len() + binary)
        .map_err(|_| io::Error::other("a .glb file holds at most 4 GiB; choose another format"))?;
    for word in [GLB_MAGIC, 2, total, text.len() as u32, JSON_CHUNK] {
        out.write_all(&word.to_le_bytes())?;
    }
    out.write_all(&text)?;
    out.write_all(&(binary as u32).to_le_bytes())?;
    out.write_all(&BIN_CHUNK.to_le_bytes())
}

/// Writes `cloud` as floats.
pub(crate) fn write_glb(out: &mut dyn Write, cloud: &GaussianCloud) -> io::Result<()> {
    let attributes = attributes(cloud);
    let document = plain_document(cloud, &attributes, json!({}));
    let floats: usize = attributes.iter().map(|attribute| attribute.width).sum();
    write_glb_header(out, &document, 4 * floats * cloud.len())?;
    write_attributes(out, cloud.len(), &attributes)
}

/// Writes `cloud` as floats, in text with the buffer in base64.
pub(crate) fn write_gltf(out: &mut dyn Write, cloud: &GaussianCloud) -> io::Result<()> {
    let attributes = attributes(cloud);
    let mut bytes = Vec::new();
    write_attributes(&mut bytes, cloud.len(), &attributes)?;
    let uri = format!("data:application/octet-stream;base64,{}", base64::encode(&bytes));
    let document = plain_document(cloud, &attributes, json!({ "uri": uri }));
    out.write_all(&serde_json::to_vec(&document)?)
}

/// Writes `cloud` as an SPZ file of version 2, which the extension requires, in a `.glb`.
pub(crate) fn write_glb_spz(out: &mut dyn Write, cloud: &GaussianCloud, quality: Quality) -> io::Result<()> {
    let mut packed = spz::encode(cloud, quality, SpzVersion::V2);
    let mut extension = extension_json();
    extension["extensions"] = json!({ SPZ_EXTENSIONS[0]: { "bufferView": 0 } });
    let primitive = json!({ "attributes": {}, "mode": 0, "extensions": { EXTENSION: extension } });
    let used = [EXTENSION, SPZ_EXTENSIONS[0]];
    let views = [json!({ "buffer": 0, "byteLength": packed.len() })];
    let document = document(primitive, &used, &used, json!({ "byteLength": packed.len() }), &views);
    packed.resize(packed.len().next_multiple_of(4), 0);
    write_glb_header(out, &document, packed.len())?;
    out.write_all(&packed)
}
