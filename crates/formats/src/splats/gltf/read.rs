use super::accessor::{Buffers, Values, buffer_view_bytes};
use super::document::{Document, Primitive};
use super::{BIN_CHUNK, EXTENSION, GLB_MAGIC, JSON_CHUNK, SPZ_EXTENSIONS, sh_attribute};
use crate::bytes::ByteReader;
use crate::splats::axes::{Affine, Signs};
use crate::splats::quantize::logit;
use crate::splats::rows::{decode_splats, plausible_count};
use crate::splats::spz;
use crate::{Malformed, zip};
use irradia_scene::{GaussianCloud, base64, sh, srgb_from_linear, srgb_slope};
use rayon::prelude::*;
use std::borrow::Cow;

/// Extensions that a document may require.
const SUPPORTED_EXTENSIONS: [&str; 2] = [EXTENSION, "KHR_mesh_quantization"];

/// Parses a `.glb` file.
///
/// # Errors
/// When it is damaged, requires an unknown extension, has no splats, or refers to something that it does not contain.
pub fn parse_glb(bytes: &[u8]) -> Result<GaussianCloud, Malformed> {
    let mut rest = ByteReader::new(bytes);
    if rest.u32()? != GLB_MAGIC {
        return Err(Malformed("not a .glb file: it does not begin with glTF".into()));
    }
    let (version, length) = (rest.u32()?, rest.u32()? as usize);
    if version != 2 || length > bytes.len() {
        return Err(Malformed(format!(
            "declares version {version} and {length} bytes, and has {}; expected version 2 and a complete file",
            bytes.len()
        )));
    }
    // What follows the declared length is ignored.
    let mut rest = ByteReader::new(&bytes[12.min(length)..length]);
    let (mut text, mut binary) = (None, None);
    while !rest.is_empty() {
        let (length, kind) = (rest.u32()?, rest.u32()?);
        let chunk = rest.take(length as usize)?;
        match kind {
            JSON_CHUNK => text = Some(chunk),
            BIN_CHUNK => binary = binary.or(Some(chunk)),
            _ => {}
        }
    }
    let text = text.ok_or_else(|| Malformed("the .glb file has no JSON".into()))?;
    parse(text, binary, bytes.len(), &|name| {
        Err(Malformed(format!(
            "its buffer {} is in another file; convert it to a .glb that contains its buffers",
            zip::printable(name)
        )))
    })
}

/// Parses a `.gltf` file; `read` provides the files beside it that it refers to.
pub(crate) fn parse_gltf(
    text: &[u8],
    read: &dyn Fn(&str) -> Result<Vec<u8>, Malformed>,
) -> Result<GaussianCloud, Malformed> {
    parse(text, None, text.len(), read)
}

fn parse(
    text: &[u8],
    binary: Option<&[u8]>,
    file_bytes: usize,
    read: &dyn Fn(&str) -> Result<Vec<u8>, Malformed>,
) -> Result<GaussianCloud, Malformed> {
    let document: Document = serde_json::from_slice(text)
        .map_err(|error| Malformed(format!("its JSON is not that of glTF 2.0: {error}")))?;
    let is_supported =
        |name: &&String| SUPPORTED_EXTENSIONS.contains(&name.as_str()) || SPZ_EXTENSIONS.contains(&name.as_str());
    if let Some(unknown) = document.extensions_required.iter().find(|name| !is_supported(name)) {
        return Err(Malformed(format!(
            "requires the extension {}, which is not supported",
            zip::printable(unknown)
        )));
    }
    let mut buffers: Vec<Cow<[u8]>> = Vec::new();
    for (i, buffer) in document.buffers.iter().enumerate() {
        let content: Cow<[u8]> = match (&buffer.uri, binary) {
            (None, Some(binary)) if i == 0 => Cow::Borrowed(binary),
            (None, _) => return Err(Malformed(format!("its buffer {i} has no content"))),
            (Some(uri), _) => Cow::Owned(match uri.strip_prefix("data:") {
                Some(data) => data
                    .split_once(";base64,")
                    .and_then(|(_, data)| base64::decode(data))
                    .ok_or_else(|| Malformed(format!("its buffer {i} is not valid base64")))?,
                None => read(uri)?,
            }),
        };
        if (content.len() as u64) < buffer.byte_length {
            return Err(Malformed(format!(
                "its buffer {i} declares {} bytes and has {}; the file is truncated, copy it again",
                buffer.byte_length,
                content.len()
            )));
        }
        buffers.push(content);
    }
    let total = buffers.iter().map(|buffer| buffer.len()).sum::<usize>().max(file_bytes);
    let mut parts = Vec::new();
    let mut splats = 0;
    for (primitive, transform) in placed_primitives(&document)? {
        let mut cloud = decode(&document, &buffers, primitive)?;
        if primitive.is_linear() {
            encode_srgb(&mut cloud);
        }
        transform.apply(&mut cloud).ok_or_else(|| {
            Malformed("a node mirrors its splats or scales them to zero, which splats do not support".into())
        })?;
        splats += cloud.len() as u64;
        // A mesh may be placed many times.
        plausible_count(splats, total)?;
        parts.push(cloud);
    }
    if parts.is_empty() {
        return Err(Malformed(format!(
            "contains no splats: no mesh in its scene has the extension {EXTENSION}"
        )));
    }
    let mut cloud = concatenate(parts);
    Signs::HALF_TURN_Z.apply(&mut cloud);
    Ok(cloud)
}

/// The primitives with splats in the document's scene, in the order of its nodes, and their transforms.
fn placed_primitives(document: &Document) -> Result<Vec<(&Primitive, Affine)>, Malformed> {
    let all: Vec<usize>;
    let roots = match document.scenes.get(document.scene.unwrap_or(0)) {
        Some(scene) => &scene.nodes,
        // Without a scene, every node that has no parent is a root.
        None => {
            let mut is_child = vec![false; document.nodes.len()];
            for child in document.nodes.iter().flat_map(|node| &node.children) {
                if let Some(is_child) = is_child.get_mut(*child) {
                    *is_child = true;
                }
            }
            all = (0..document.nodes.len()).filter(|i| !is_child[*i]).collect();
            &all
        }
    };
    let mut stack: Vec<(usize, Affine)> = roots.iter().rev().map(|root| (*root, Affine::IDENTITY)).collect();
    let mut visited = vec![false; document.nodes.len()];
    let mut placed = Vec::new();
    while let Some((index, parent)) = stack.pop() {
        let node = document.nodes.get(index);
        let node = node.ok_or_else(|| Malformed(format!("its node {index} does not exist")))?;
        if std::mem::replace(&mut visited[index], true) {
            return Err(Malformed(format!(
                "its node {index} has two parents; nodes form a tree"
            )));
        }
        let transform = parent.after(node.transform());
        if let Some(mesh) = node.mesh {
            let mesh = document.meshes.get(mesh);
            let mesh = mesh.ok_or_else(|| Malformed(format!("the mesh of its node {index} does not exist")))?;
            let splats = mesh.primitives.iter().filter(|primitive| primitive.has_splats());
            placed.extend(splats.map(|primitive| (primitive, transform)));
        }
        stack.extend(node.children.iter().rev().map(|child| (*child, transform)));
    }
    Ok(placed)
}

/// The splats of a primitive, in its own space.
fn decode(document: &Document, buffers: &Buffers, primitive: &Primitive) -> Result<GaussianCloud, Malformed> {
    if let Some(index) = primitive.spz() {
        let index = usize::try_from(index).unwrap_or(usize::MAX);
        let mut cloud = spz::parse(buffer_view_bytes(document, buffers, index)?)?;
        Signs::HALF_TURN_Z.apply(&mut cloud);
        return Ok(cloud);
    }
    let attribute = |name: &str, width: usize| match primitive.attributes.get(name) {
        Some(accessor) => {
            let values = Values::find(document, buffers, *accessor, width);
            values.map_err(|error| Malformed(format!("{name}: {error}")))
        }
        None => Err(Malformed(format!("its splats lack the attribute {name}"))),
    };
    let attribute_name = |name: &str| format!("{EXTENSION}:{name}");
    let positions = attribute("POSITION", 3)?;
    let rotations = attribute(&attribute_name("ROTATION"), 4)?;
    let scales = attribute(&attribute_name("SCALE"), 3)?;
    let opacities = attribute(&attribute_name("OPACITY"), 1)?;
    let has_degree = |degree: &u32| {
        primitive
            .attributes
            .contains_key(&sh_attribute(sh::coefficients(*degree) - 1))
    };
    let degree = (0..=3).rev().find(has_degree).unwrap_or(0);
    let harmonics = (0..sh::coefficients(degree))
        .map(|coefficient| attribute(&sh_attribute(coefficient), 3))
        .collect::<Result<Vec<_>, _>>()?;
    let count = positions.count;
    let others = [&rotations, &scales, &opacities];
    if others.into_iter().chain(&harmonics).any(|values| values.count != count) {
        return Err(Malformed(format!(
            "one of its attributes does not have as many rows as its {count} positions"
        )));
    }
    plausible_count(count as u64, buffers.iter().map(|buffer| buffer.len()).sum())?;
    // A negative scale, which the extension forbids, marks a file of an earlier draft, which stored ln.
    let is_log_scale = (0..count)
        .into_par_iter()
        .any(|i| scales.row::<3>(i).iter().any(|scale| *scale < 0.0));
    Ok(decode_splats(count, degree, |i, splat| {
        *splat.mean = positions.row(i);
        let [x, y, z, w] = rotations.row(i);
        *splat.quat = [w, x, y, z];
        let scale: [f32; 3] = scales.row(i);
        *splat.log_scale = if is_log_scale { scale } else { scale.map(f32::ln) };
        let [opacity] = opacities.row(i);
        *splat.opacity_logit = logit(opacity);
        for (to, values) in splat.sh.chunks_exact_mut(3).zip(&harmonics) {
            to.copy_from_slice(&values.row::<3>(i));
        }
    }))
}

/// From colours in linear light to sRGB-encoded ones: exact for the colour of degree 0, and to first order for variations about it.
fn encode_srgb(cloud: &mut GaussianCloud) {
    let width = 3 * cloud.sh_coefficients();
    cloud.sh.par_chunks_mut(width).for_each(|values| {
        for c in 0..3 {
            let linear = sh::color_from_dc(values[c]);
            values[c] = sh::dc_from_color(srgb_from_linear(linear));
            let slope = srgb_slope(linear);
            values[3..]
                .iter_mut()
                .skip(c)
                .step_by(3)
                .for_each(|value| *value *= slope);
        }
    });
}

/// All splats, with the highest degree among them.
fn concatenate(mut parts: Vec<GaussianCloud>) -> GaussianCloud {
    if parts.len() == 1 {
        return parts.remove(0);
    }
    let sh_degree = parts.iter().map(|part| part.sh_degree).max().unwrap_or(0);
    let mut all = GaussianCloud {
        sh_degree,
        ..GaussianCloud::default()
    };
    let width = 3 * all.sh_coefficients();
    for part in parts {
        for sh in part.sh.chunks_exact(3 * part.sh_coefficients()) {
            all.sh.extend_from_slice(sh);
            all.sh.resize(all.sh.len() + width - sh.len(), 0.0);
        }
        all.means.extend(part.means);
        all.quats.extend(part.quats);
        all.log_scales.extend(part.log_scales);
        all.opacity_logits.extend(part.opacity_logits);
        all.antialiased |= part.antialiased;
    }
    all
}
