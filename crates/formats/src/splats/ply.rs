//! Splats as PLY, in the layout of the Inria 3DGS code (Kerbl et al. 2023, `save_ply` of its `gaussian_model.py`):
//! `x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3`, little-endian floats. `f_rest` is channel-major:
//! all of red's coefficients, then green's, then blue's. `rot` is `w x y z`; scales are ln, opacity is a logit.
//!
//! Files have the dataset's coordinates. If these are far from the origin, `x y z` are doubles, since at 500 km in millimetres
//! neighbouring floats are centimetres apart; a comment then holds [`GaussianCloud::world_from_dataset`], with which reading returns to
//! floats. Doubles of other programs that are as far away get a world whose origin is their mean.
//!
//! Nerfstudio's export without harmonics has the colours `red green blue` in place of `f_dc_*`.

use crate::ply::{Column, MAX_HEADER_BYTES, Ply, Rows, name_of};
use crate::splats::compressed_ply;
use crate::splats::rows::{SPLATS_PER_TASK, decode_splats};
use crate::{FormatError, Malformed};
use glam::DVec3;
use irradia_scene::{ExtraColumn, GaussianCloud, Scalar, Similarity, sh};
use rayon::prelude::*;
use std::fs::File;
use std::io::{self, Read, Write};
use std::path::Path;

/// The comment that stores [`GaussianCloud::antialiased`], for which the layout has no property.
const ANTIALIASED_COMMENT: &str = "antialiased 1";
/// The comment that stores [`GaussianCloud::world_from_dataset`]: scale and centre.
const WORLD_COMMENT: &str = "world_from_dataset";
/// Highest degree supported.
const MAX_DEGREE: u32 = 4;

/// The properties of a splat file that every splat needs.
const POSITION_PROPERTIES: [&str; 3] = ["x", "y", "z"];
const DC_PROPERTIES: [&str; 3] = ["f_dc_0", "f_dc_1", "f_dc_2"];
/// Bytes of colour, if there are no harmonics at all.
const COLOR_PROPERTIES: [&str; 3] = ["red", "green", "blue"];
const SCALE_PROPERTIES: [&str; 3] = ["scale_0", "scale_1", "scale_2"];
const ROTATION_PROPERTIES: [&str; 4] = ["rot_0", "rot_1", "rot_2", "rot_3"];

/// Parses a splat PLY, compressed or not: any encoding, any order of properties, SH degree 0 to 4 by the number of `f_rest`. Other scalar
/// properties of splats become [`GaussianCloud::extra`]; other content of the file is skipped. Floats are preserved bit for bit.
///
/// # Errors
/// When the header is invalid, properties are missing (all are named), or the file is shorter than the header declares.
pub fn parse_splat_ply(bytes: &[u8]) -> Result<GaussianCloud, Malformed> {
    let ply = Ply::parse(bytes)?;
    if ply.has(compressed_ply::CHUNK_ELEMENT) {
        return compressed_ply::parse(&ply);
    }
    let (sh_degree, are_colors) = check_properties(&ply)?;
    let rows = ply.rows("vertex")?;
    let columns = Columns::find(&rows, sh_degree, are_colors)?;

    let declared = parse_world(&ply)?;
    let world = declared.or_else(|| world_of_doubles(&rows, &columns));
    let mut cloud = decode(&rows, &columns, sh_degree, world.unwrap_or_default());
    if declared.is_none() && world.is_some() && !super::exceeds_f32_precision(&cloud) {
        cloud = decode(&rows, &columns, sh_degree, Similarity::IDENTITY);
    }
    cloud.antialiased = ply.comments.iter().any(|comment| comment.trim() == ANTIALIASED_COMMENT);
    cloud.extra = extra_columns(&rows, &columns);
    Ok(cloud)
}

/// The splats in the world of `world_from_dataset`.
fn decode(rows: &Rows, columns: &Columns, sh_degree: u32, world_from_dataset: Similarity) -> GaussianCloud {
    let (has_world, log_scale) = (!world_from_dataset.is_identity(), world_from_dataset.scale.ln());
    let cloud = decode_splats(rows.len(), sh_degree, |i, splat| {
        let row = rows.row(i);
        *splat.mean = columns.position.map(|c| c.f32(row));
        *splat.quat = columns.rotation.map(|c| c.f32(row));
        *splat.log_scale = columns.scale.map(|c| c.f32(row));
        if has_world {
            let position = DVec3::from(columns.position.map(|c| c.f64(row)));
            *splat.mean = world_from_dataset.apply(position).as_vec3().to_array();
            *splat.log_scale = splat.log_scale.map(|scale| (f64::from(scale) + log_scale) as f32);
        }
        *splat.opacity_logit = columns.opacity.f32(row);
        for (value, column) in splat.sh.iter_mut().zip(&columns.sh) {
            *value = column.f32(row);
        }
        if columns.are_colors {
            splat.sh.iter_mut().for_each(|v| *v = sh::dc_from_color(*v / 255.0));
        }
    });
    GaussianCloud {
        world_from_dataset,
        ..cloud
    }
}

/// A world whose origin is the mean of the positions, if they are doubles.
fn world_of_doubles(rows: &Rows, columns: &Columns) -> Option<Similarity> {
    let are_doubles = columns.position.iter().all(|column| column.scalar == Scalar::F64);
    let positions = (0..rows.len()).map(|i| DVec3::from(columns.position.map(|column| column.f64(rows.row(i)))));
    let finite = || positions.clone().filter(|position| position.is_finite());
    let mean = finite().sum::<DVec3>() / finite().count() as f64;
    (are_doubles && mean.is_finite()).then_some(Similarity {
        scale: 1.0,
        center: mean.round(),
    })
}

/// Scalar properties of splats that are not ours; if a name occurs twice, the first.
fn extra_columns(rows: &Rows, columns: &Columns) -> Vec<ExtraColumn> {
    let mut found: Vec<(&str, Column)> = Vec::new();
    for (name, column) in rows.named_columns() {
        let is_read = is_known(name) || columns.are_colors && COLOR_PROPERTIES.contains(&name);
        if !is_read && found.iter().all(|(other, _)| *other != name) {
            found.push((name, column));
        }
    }
    let read = |(name, column): (&str, Column)| {
        let mut bytes = Vec::with_capacity(rows.len() * column.scalar.size());
        (0..rows.len()).for_each(|i| column.append_to(&mut bytes, rows.row(i)));
        ExtraColumn {
            name: name.to_owned(),
            scalar: column.scalar,
            bytes,
        }
    };
    found.into_par_iter().map(read).collect()
}

/// Whether a property is one of ours, among them the normals that everybody writes and nobody uses.
fn is_known(name: &str) -> bool {
    let known = [
        &POSITION_PROPERTIES[..],
        &DC_PROPERTIES,
        &SCALE_PROPERTIES,
        &ROTATION_PROPERTIES,
        &["nx", "ny", "nz", "opacity"],
    ];
    known.into_iter().flatten().any(|known| *known == name) || name.starts_with("f_rest_")
}

/// The world of the file's splats, if the file gives one.
fn parse_world(ply: &Ply) -> Result<Option<Similarity>, Malformed> {
    let Some(numbers) = ply
        .comments
        .iter()
        .find_map(|comment| comment.trim().strip_prefix(WORLD_COMMENT))
    else {
        return Ok(None);
    };
    let numbers: Vec<f64> = numbers
        .split_whitespace()
        .map_while(|number| number.parse().ok())
        .collect();
    let world = match numbers[..] {
        [scale, x, y, z] => Similarity {
            scale,
            center: DVec3::new(x, y, z),
        },
        _ => Similarity::default(),
    };
    if numbers.len() == 4 && world.is_valid() {
        return Ok(Some(world));
    }
    Err(Malformed(format!(
        "the comment {WORLD_COMMENT} does not hold a positive scale and three coordinates; remove it to read the file as it is"
    )))
}

/// The properties of the splats that are neither ours nor kept: lists, and additional properties of a compressed file.
pub(crate) fn unread_properties(bytes: &[u8]) -> Vec<String> {
    let Ok(ply) = Ply::parse(bytes) else { return Vec::new() };
    let keeps_extra = !ply.has(compressed_ply::CHUNK_ELEMENT);
    let is_read = |name: &str| is_known(name) || name.starts_with("packed_");
    let properties = ply.properties("vertex").into_iter().flatten();
    properties
        .filter(|(name, is_list)| !is_read(name) && (*is_list || !keeps_extra))
        .map(|(name, _)| name.to_owned())
        .collect()
}

/// Whether a PLY has PlayCanvas's compressed layout.
pub(crate) fn is_compressed(bytes: &[u8]) -> bool {
    Ply::parse(bytes).is_ok_and(|ply| ply.has(compressed_ply::CHUNK_ELEMENT))
}

/// Whether a PLY contains splats rather than a point cloud, by the names of its properties; reads its header only.
pub(crate) fn has_splats(path: &Path) -> Result<bool, FormatError> {
    let mut header = Vec::new();
    let read = File::open(path).and_then(|file| file.take(MAX_HEADER_BYTES as u64).read_to_end(&mut header));
    read.map_err(|source| FormatError::Read {
        path: path.to_owned(),
        source,
    })?;
    let is_of_splats = |name: &str| {
        ["f_dc_", "packed_", "rot_"]
            .iter()
            .any(|prefix| name.starts_with(prefix))
    };
    let found = Ply::parse(&header).and_then(|ply| Ok(ply.property_names("vertex")?.any(is_of_splats)));
    found.map_err(|source| FormatError::Malformed {
        path: path.to_owned(),
        source,
    })
}

struct Columns {
    position: [Column; 3],
    rotation: [Column; 4],
    scale: [Column; 3],
    opacity: Column,
    /// In the order of [`GaussianCloud::sh`].
    sh: Vec<Column>,
    /// Whether `sh` are colours from 0 to 255.
    are_colors: bool,
}

impl Columns {
    fn find(rows: &Rows, sh_degree: u32, are_colors: bool) -> Result<Self, Malformed> {
        let mut sh = rows
            .columns(if are_colors { COLOR_PROPERTIES } else { DC_PROPERTIES })?
            .to_vec();
        let rest = sh::coefficients(sh_degree) - 1;
        for coefficient in 0..rest {
            for channel in 0..3 {
                let name = format!("f_rest_{}", channel * rest + coefficient);
                sh.extend(rows.columns([name.as_str()])?);
            }
        }
        Ok(Self {
            position: rows.columns(POSITION_PROPERTIES)?,
            rotation: rows.columns(ROTATION_PROPERTIES)?,
            scale: rows.columns(SCALE_PROPERTIES)?,
            opacity: rows.columns(["opacity"])?[0],
            sh,
            are_colors,
        })
    }
}

/// Checks, before the body is read, that no property is missing, naming all that are; returns the SH degree, and whether
/// there are colours in place of harmonics.
fn check_properties(ply: &Ply) -> Result<(u32, bool), Malformed> {
    let names: Vec<&str> = ply.property_names("vertex")?.collect();
    let rest = names.iter().filter(|name| name.starts_with("f_rest_")).count();
    let has = |name: &str| names.contains(&name);
    let are_colors =
        rest == 0 && !DC_PROPERTIES.iter().any(|name| has(name)) && COLOR_PROPERTIES.iter().all(|name| has(name));
    let needed = POSITION_PROPERTIES
        .iter()
        .chain(if are_colors { &COLOR_PROPERTIES } else { &DC_PROPERTIES })
        .chain(&["opacity"])
        .chain(&SCALE_PROPERTIES)
        .chain(&ROTATION_PROPERTIES);
    let missing: Vec<&str> = needed.copied().filter(|name| !has(name)).collect();
    if !missing.is_empty() {
        let hint = if ROTATION_PROPERTIES.iter().all(|name| missing.contains(name)) {
            "; it is a point cloud or a mesh, not a splat scene"
        } else {
            ""
        };
        return Err(Malformed(format!(
            "the splats lack the properties {}{hint}",
            missing.join(", ")
        )));
    }
    (0..=MAX_DEGREE)
        .find(|degree| 3 * (sh::coefficients(*degree) - 1) == rest)
        .map(|degree| (degree, are_colors))
        .ok_or_else(|| {
            Malformed(format!(
                "{rest} f_rest properties match no spherical-harmonics degree; expected 0, 9, 24, 45 or 72"
            ))
        })
}

/// Writes `cloud` in the Inria layout, in the dataset's coordinates, with zero normals; `3 ((degree + 1)^2 - 1)` values of `f_rest`. Extra
/// values follow.
pub(crate) fn write_splat_ply(out: &mut dyn Write, cloud: &GaussianCloud) -> io::Result<()> {
    let rest = cloud.sh_coefficients() - 1;
    let mut names: Vec<String> = POSITION_PROPERTIES
        .iter()
        .chain(&["nx", "ny", "nz"])
        .chain(&DC_PROPERTIES)
        .map(|n| n.to_string())
        .collect();
    names.extend((0..3 * rest).map(|i| format!("f_rest_{i}")));
    names.extend(
        ["opacity"]
            .iter()
            .chain(&SCALE_PROPERTIES)
            .chain(&ROTATION_PROPERTIES)
            .map(|n| n.to_string()),
    );

    writeln!(out, "ply\nformat binary_little_endian 1.0\ncomment written by Irradia")?;
    if cloud.antialiased {
        writeln!(out, "comment {ANTIALIASED_COMMENT}")?;
    }
    let world = cloud.world_from_dataset;
    if !world.is_identity() {
        let [x, y, z] = world.center.to_array();
        writeln!(out, "comment {WORLD_COMMENT} {} {x} {y} {z}", world.scale)?;
    }
    let doubles = super::exceeds_f32_precision(cloud);
    writeln!(out, "element vertex {}", cloud.len())?;
    for name in &names {
        let scalar = if doubles && POSITION_PROPERTIES.contains(&name.as_str()) {
            "double"
        } else {
            "float"
        };
        writeln!(out, "property {scalar} {name}")?;
    }
    for column in &cloud.extra {
        writeln!(out, "property {} {}", name_of(column.scalar), column.name)?;
    }
    writeln!(out, "end_header")?;

    let (sh_values, log_scale) = (3 * (rest + 1), world.scale.ln());
    let extra_bytes: usize = cloud.extra.iter().map(|column| column.scalar.size()).sum();
    let chunk_bytes = |chunk: usize| {
        let first = chunk * SPLATS_PER_TASK;
        let last = (first + SPLATS_PER_TASK).min(cloud.len());
        let mut bytes = Vec::with_capacity((last - first) * (names.len() * 4 + 12 + extra_bytes));
        for i in first..last {
            let sh = &cloud.sh[i * sh_values..(i + 1) * sh_values];
            let position = world.invert(DVec3::from(cloud.means[i].map(f64::from)));
            if doubles {
                let coordinates = position.to_array().map(f64::to_le_bytes);
                bytes.extend_from_slice(coordinates.as_flattened());
            }
            let mut put = |value: f32| bytes.extend_from_slice(&value.to_le_bytes());
            if world.is_identity() {
                // Not through `f64`, which would change the bits of a NaN.
                cloud.means[i].into_iter().for_each(&mut put);
            } else if !doubles {
                position.as_vec3().to_array().into_iter().for_each(&mut put);
            }
            [0.0; 3].into_iter().for_each(&mut put);
            sh[..3].iter().copied().for_each(&mut put);
            for channel in 0..3 {
                (1..=rest).for_each(|coefficient| put(sh[3 * coefficient + channel]));
            }
            put(cloud.opacity_logits[i]);
            if world.is_identity() {
                cloud.log_scales[i].into_iter().for_each(&mut put);
            } else {
                let scales = cloud.log_scales[i].map(|scale| (f64::from(scale) - log_scale) as f32);
                scales.into_iter().for_each(&mut put);
            }
            cloud.quats[i].into_iter().for_each(&mut put);
            for column in &cloud.extra {
                bytes.extend_from_slice(column.get(i));
            }
        }
        bytes
    };
    // A few chunks per thread at a time: parallel, without the whole file in memory.
    let chunks = cloud.len().div_ceil(SPLATS_PER_TASK);
    let batch = 2 * rayon::current_num_threads();
    for first in (0..chunks).step_by(batch) {
        let parts: Vec<Vec<u8>> = (first..(first + batch).min(chunks))
            .into_par_iter()
            .map(chunk_bytes)
            .collect();
        parts.iter().try_for_each(|part| out.write_all(part))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::{Rng, Scalar};

    fn random_cloud(count: usize, sh_degree: u32, antialiased: bool) -> GaussianCloud {
        let mut rng = Rng::new(3, u64::from(sh_degree));
        let mut f = || f32::from_bits(rng.next_u32());
        GaussianCloud {
            means: (0..count).map(|_| [f(), f(), f()]).collect(),
            quats: (0..count).map(|_| [f(), f(), f(), f()]).collect(),
            log_scales: (0..count).map(|_| [f(), f(), f()]).collect(),
            opacity_logits: (0..count).map(|_| f()).collect(),
            sh: (0..count * 3 * sh::coefficients(sh_degree)).map(|_| f()).collect(),
            sh_degree,
            antialiased,
            ..GaussianCloud::default()
        }
    }

    fn bits(cloud: &GaussianCloud) -> Vec<u32> {
        let columns = [
            cloud.means.as_flattened(),
            cloud.quats.as_flattened(),
            cloud.log_scales.as_flattened(),
            &cloud.opacity_logits,
            &cloud.sh,
        ];
        columns.concat().iter().map(|v| v.to_bits()).collect()
    }

    #[test]
    fn every_bit_round_trips_including_nans_for_every_degree() {
        for degree in 0..=4 {
            for count in [0, 1, 3, SPLATS_PER_TASK + 7] {
                let cloud = random_cloud(count, degree, degree % 2 == 0);
                let mut bytes = Vec::new();
                write_splat_ply(&mut bytes, &cloud).unwrap();
                let back = parse_splat_ply(&bytes).unwrap();
                assert_eq!((back.sh_degree, back.antialiased), (degree, degree % 2 == 0));
                assert_eq!(bits(&back), bits(&cloud));
            }
        }
    }

    #[test]
    fn files_far_from_the_origin_hold_doubles_of_the_datasets_coordinates() {
        let mut cloud = random_cloud(0, 0, false);
        cloud.means = vec![[1.5, -2.25, 0.25]];
        cloud.quats = vec![[1.0, 0.0, 0.0, 0.0]];
        (cloud.log_scales, cloud.opacity_logits, cloud.sh) = (vec![[-3.0; 3]], vec![0.0], vec![0.0; 3]);
        for (center, scalar) in [(DVec3::new(5e8, 0.125, -5e8), "double"), (DVec3::ZERO, "float")] {
            cloud.world_from_dataset = Similarity { scale: 1e-3, center };
            let mut bytes = Vec::new();
            write_splat_ply(&mut bytes, &cloud).unwrap();
            let ply = Ply::parse(&bytes).unwrap();
            let rows = ply.rows("vertex").unwrap();
            let row = rows.row(0);
            let position = DVec3::from(rows.columns(POSITION_PROPERTIES).unwrap().map(|column| column.f64(row)));
            let expected = center + DVec3::new(1500.0, -2250.0, 250.0);
            assert!((position - expected).length() < 1e-4, "{position}");
            let scale = rows.columns(SCALE_PROPERTIES).unwrap()[0].f64(row);
            assert!((scale - (1000f64.ln() - 3.0)).abs() < 1e-6);
            assert!(String::from_utf8_lossy(&bytes).contains(&format!("property {scalar} x\n")));
            assert_eq!(parse_splat_ply(&bytes).unwrap(), cloud);
        }
        let broken = b"ply\nformat ascii 1.0\ncomment world_from_dataset 0 1 2 3\nelement vertex 0\n";
        let properties: String = POSITION_PROPERTIES
            .iter()
            .chain(&DC_PROPERTIES)
            .chain(&["opacity"])
            .chain(&SCALE_PROPERTIES)
            .chain(&ROTATION_PROPERTIES)
            .map(|name| format!("property float {name}\n"))
            .collect();
        let bytes = [&broken[..], properties.as_bytes(), b"end_header\n"].concat();
        assert!(
            parse_splat_ply(&bytes)
                .unwrap_err()
                .to_string()
                .contains("world_from_dataset")
        );
    }

    #[test]
    fn the_layout_is_inrias() {
        let mut cloud = random_cloud(1, 3, false);
        cloud.sh = (0..48).map(|i| i as f32).collect();
        let mut bytes = Vec::new();
        write_splat_ply(&mut bytes, &cloud).unwrap();
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = String::from_utf8(bytes[..end].to_vec()).unwrap();
        let names: Vec<&str> = header
            .lines()
            .filter_map(|l| l.strip_prefix("property float "))
            .collect();
        assert_eq!(names.len(), 62);
        assert_eq!(
            names[..10],
            [
                "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0"
            ]
        );
        assert_eq!(
            names[53..],
            [
                "f_rest_44",
                "opacity",
                "scale_0",
                "scale_1",
                "scale_2",
                "rot_0",
                "rot_1",
                "rot_2",
                "rot_3"
            ]
        );
        let value = |i: usize| f32::from_le_bytes(bytes[end + 4 * i..end + 4 * i + 4].try_into().unwrap());
        // Channel-major: f_rest_0 and f_rest_1 are red's first two, f_rest_15 is green's first.
        assert_eq!([value(6), value(7), value(8)], [0.0, 1.0, 2.0]);
        assert_eq!([value(9), value(10), value(24), value(39)], [3.0, 6.0, 4.0, 5.0]);
        assert_eq!(bytes.len(), end + 62 * 4);
    }

    #[test]
    fn big_endian_shuffled_and_with_extras() {
        let order = [
            "rot_3", "rot_0", "opacity", "extra", "x", "z", "y", "f_dc_2", "f_dc_1", "f_dc_0", "rot_1", "rot_2",
            "scale_2", "scale_0", "scale_1",
        ];
        let mut bytes = b"ply\nformat binary_big_endian 1.0\nelement vertex 1\n".to_vec();
        for name in order {
            bytes.extend(format!("property {} {name}\n", if name == "extra" { "ushort" } else { "float" }).bytes());
        }
        bytes.extend(b"end_header\n");
        for (i, name) in order.into_iter().enumerate() {
            match name {
                "extra" => bytes.extend(0x0102u16.to_be_bytes()),
                _ => bytes.extend((i as f32).to_be_bytes()),
            }
        }
        let cloud = parse_splat_ply(&bytes).unwrap();
        assert_eq!(cloud.means, [[4.0, 6.0, 5.0]]);
        assert_eq!(cloud.quats, [[1.0, 10.0, 11.0, 0.0]]);
        assert_eq!(cloud.log_scales, [[13.0, 14.0, 12.0]]);
        assert_eq!((cloud.opacity_logits[0], &cloud.sh[..]), (2.0, &[9.0, 8.0, 7.0][..]));
        let extra = ExtraColumn {
            name: "extra".into(),
            scalar: Scalar::U16,
            bytes: vec![2, 1],
        };
        assert_eq!(cloud.extra, [extra]);
        assert!(unread_properties(&bytes).is_empty());
    }

    #[test]
    fn what_others_add_is_kept_to_the_bit_and_lists_are_named() {
        let mut cloud = random_cloud(3, 0, false);
        let column = |name: &str, scalar: Scalar, bytes: Vec<u8>| ExtraColumn {
            name: name.into(),
            scalar,
            bytes,
        };
        cloud.extra = vec![
            column("label", Scalar::U8, vec![1, 2, 255]),
            column("weight", Scalar::F64, (0..24).map(|i| 11 * i).collect()),
            column(
                "time",
                Scalar::F32,
                [f32::NAN, -0.0, 1e-40].iter().flat_map(|v| v.to_le_bytes()).collect(),
            ),
        ];
        let mut bytes = Vec::new();
        write_splat_ply(&mut bytes, &cloud).unwrap();
        let back = parse_splat_ply(&bytes).unwrap();
        assert_eq!(back.extra, cloud.extra);
        assert_eq!(bits(&back), bits(&cloud));
        // A second column of a name, and one that does not fit a row, cannot be kept.
        let header = "ply\nformat ascii 1.0\nelement vertex 1\n";
        let names = [
            &POSITION_PROPERTIES[..],
            &DC_PROPERTIES,
            &SCALE_PROPERTIES,
            &ROTATION_PROPERTIES,
            &["opacity", "label", "label"],
        ]
        .concat();
        let lines: String = names.iter().map(|name| format!("property float {name}\n")).collect();
        let text = format!(
            "{header}{lines}property list uchar int faces\nend_header\n{}5 6 2 7 8\n",
            "1 ".repeat(14)
        );
        let cloud = parse_splat_ply(text.as_bytes()).unwrap();
        assert_eq!(cloud.extra, [column("label", Scalar::F32, 5f32.to_le_bytes().to_vec())]);
        assert_eq!(unread_properties(text.as_bytes()), ["faces"]);
    }

    #[test]
    fn missing_properties_are_named() {
        let header = |properties: &str| {
            let lines: String = properties.split(' ').map(|p| format!("property float {p}\n")).collect();
            format!("ply\nformat binary_little_endian 1.0\nelement vertex 0\n{lines}end_header\n")
        };
        let error = |properties: &str| parse_splat_ply(header(properties).as_bytes()).unwrap_err().to_string();
        let all = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
        assert!(error("x y z red green blue").contains("point cloud"));
        assert!(
            error(&all.replace("opacity ", "").replace(" rot_2", "")).contains("lack the properties opacity, rot_2")
        );
        assert!(error(&format!("{all} f_rest_0 f_rest_1")).contains("2 f_rest"));
        let gap: String = (1..10).map(|i| format!(" f_rest_{i}")).collect();
        assert!(error(&format!("{all}{gap}")).contains("f_rest_0"));
    }
}
