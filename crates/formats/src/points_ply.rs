use crate::dataset::DeclaredPoints;
use crate::error::read_and_parse;
use crate::ply::{Column, Ply, Rows};
use crate::{FormatError, Malformed, write_atomic};
use glam::DVec3;
use irradia_scene::{PointCloud, Similarity};
use std::path::Path;

/// Reads a point cloud from a PLY file: ASCII or binary of either byte order; `x y z` of any type; `red green blue`
/// (or `r g b`, `diffuse_red ..`) as bytes, or as floats in \[0, 1\] or in 0..255; white if there is no colour.
///
/// Other properties and elements are skipped, and so are points that are not finite.
///
/// # Errors
/// When the file cannot be read, is not a PLY, lacks a coordinate, or is shorter than its header declares.
pub fn read_points_ply(path: &Path) -> Result<PointCloud, FormatError> {
    read_and_parse(path, parse_points_ply)
}

/// [`read_points_ply`] on bytes.
///
/// # Errors
/// The same, without the file's name.
///
/// [`read_points_ply`]: crate::read_points_ply
pub fn parse_points_ply(bytes: &[u8]) -> Result<PointCloud, Malformed> {
    Ok(parse_declared(bytes)?.in_world(&Similarity::IDENTITY))
}

/// [`read_points_ply`] with the coordinates of the file.
pub(crate) fn read_declared_points(path: &Path) -> Result<DeclaredPoints, FormatError> {
    read_and_parse(path, parse_declared)
}

fn parse_declared(bytes: &[u8]) -> Result<DeclaredPoints, Malformed> {
    let ply = Ply::parse(bytes)?;
    let rows = ply.rows("vertex")?;
    let [x, y, z] = rows.columns(["x", "y", "z"])?;
    let color = [
        ["red", "green", "blue"],
        ["r", "g", "b"],
        ["diffuse_red", "diffuse_green", "diffuse_blue"],
    ]
    .into_iter()
    .find_map(|names| rows.columns(names).ok());
    let color_scale = color.map_or(1.0, |columns| color_scale(&rows, columns));

    let mut points = DeclaredPoints::default();
    for index in 0..rows.len() {
        let row = rows.row(index);
        // `as u8` saturates, and maps NaN to 0.
        let color = color.map_or([255; 3], |columns| {
            columns.map(|c| (c.f64(row) * color_scale).round() as u8)
        });
        points.push(DVec3::new(x.f64(row), y.f64(row), z.f64(row)), color);
    }
    Ok(points)
}

/// Writes a binary PLY of coloured points, atomically.
///
/// # Errors
/// When the file cannot be written.
pub fn write_points_ply(path: &Path, points: &PointCloud) -> Result<(), FormatError> {
    write_atomic(path, |out| out.write_all(&encode_points(points)))
}

/// The bytes of [`write_points_ply`].
pub(crate) fn encode_points(points: &PointCloud) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        points.len()
    )
    .into_bytes();
    for (position, color) in points.positions.iter().zip(&points.colors) {
        position.to_array().iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(color);
    }
    bytes
}

/// The factor that converts the file's colours to 0..=255. Float colours are in \[0, 1\] by convention, but some writers keep
/// 0..255: only the values themselves tell.
fn color_scale(rows: &Rows, columns: [Column; 3]) -> f64 {
    match columns[0].scalar {
        scalar if scalar.is_float() => {
            let exceeds_one = (0..rows.len()).any(|index| columns.iter().any(|c| c.f64(rows.row(index)) > 1.0));
            if exceeds_one { 1.0 } else { 255.0 }
        }
        scalar if scalar.size() == 2 => 255.0 / 65535.0,
        _ => 1.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn ascii_with_lists_other_elements_and_float_colours() {
        let text = "ply\nformat ascii 1.0\ncomment made by hand\nelement camera 1\nproperty list uchar int ids\n\
            element vertex 3\nproperty double x\nproperty list uchar float extra\nproperty float y\nproperty float z\n\
            property float red\nproperty float green\nproperty float blue\nelement face 1\n\
            property list uchar int vertex_indices\nend_header\n2 7 8\n\
            1 0 2 3 1 0.5 0\n-1e2 2 9 9 5 6 0 0 0.2\nnan 0 0 0 0 0 0\n3 0 1 2\n";
        let points = parse_points_ply(text.as_bytes()).unwrap();
        assert_eq!(
            points.positions,
            [Vec3::new(1.0, 2.0, 3.0), Vec3::new(-100.0, 5.0, 6.0)]
        );
        assert_eq!(points.colors, [[255, 128, 0], [0, 0, 51]]);
    }

    #[test]
    fn comments_may_be_in_any_encoding() {
        let mut bytes = b"ply\nformat ascii 1.0\ncomment made from C:\\B\xfcro \nelement vertex 1\n".to_vec();
        bytes.extend(b"property float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n");
        assert_eq!(parse_points_ply(&bytes).unwrap().positions, [Vec3::new(1.0, 2.0, 3.0)]);
    }

    #[test]
    fn binary_in_both_byte_orders_with_a_list_before_the_vertices() {
        for big in [false, true] {
            let f = |v: f32| if big { v.to_be_bytes() } else { v.to_le_bytes() };
            let d = |v: f64| if big { v.to_be_bytes() } else { v.to_le_bytes() };
            let u = |v: u32| if big { v.to_be_bytes() } else { v.to_le_bytes() };
            let mut bytes = format!(
                "ply\r\nformat binary_{}_endian 1.0\r\nelement face 1\r\nproperty list uint float weights\r\n\
                 element vertex 2\r\nproperty uchar red\r\nproperty uchar green\r\nproperty uchar blue\r\n\
                 property double x\r\nproperty float y\r\nproperty float z\r\nend_header\r\n",
                if big { "big" } else { "little" }
            )
            .into_bytes();
            bytes.extend(u(2));
            bytes.extend(f(0.5));
            bytes.extend(f(0.25));
            for (color, x) in [([1u8, 2, 3], 0.125), ([4, 5, 6], -8.0)] {
                bytes.extend(color);
                bytes.extend(d(x));
                bytes.extend(f(2.0));
                bytes.extend(f(3.0));
            }
            let points = parse_points_ply(&bytes).unwrap();
            assert_eq!(
                points.positions,
                [Vec3::new(0.125, 2.0, 3.0), Vec3::new(-8.0, 2.0, 3.0)]
            );
            assert_eq!(points.colors, [[1, 2, 3], [4, 5, 6]]);
            let error = parse_points_ply(&bytes[..bytes.len() - 1]).unwrap_err().to_string();
            assert!(
                error.contains("declares 2 rows") && error.contains("37 left"),
                "{error}"
            );
        }
    }

    #[test]
    fn headers_that_declare_absurd_sizes_are_rejected_before_any_allocation() {
        for (body, expected) in [
            (
                "element vertex 18446744073709551615\nproperty float x\nproperty float y\nproperty float z\n",
                "declares",
            ),
            (
                "element vertex 99999999999999999999\nproperty float x\n",
                "not understood",
            ),
            ("element vertex 3\n", "no properties"),
            (
                "element edge 18446744073709551615\nelement vertex 0\nproperty float x\nproperty float y\n",
                "lack the properties z",
            ),
            ("property float x\n", "not understood"),
        ] {
            for format in ["ascii", "binary_little_endian"] {
                let text = format!("ply\nformat {format} 1.0\n{body}end_header\n");
                let error = parse_points_ply(text.as_bytes()).unwrap_err().to_string();
                assert!(error.contains(expected), "{error}");
            }
        }
        assert!(parse_points_ply(b"ply\nformat ascii 1.0\nelement vertex 0\n").is_err());
        assert!(parse_points_ply(b"PNG").is_err());
    }
}
