//! COLMAP's `cameras.bin`, `images.bin` and `points3D.bin`, all little-endian.

use super::{CAMERA_MODELS, ColmapCamera, ColmapImage, ColmapPoint};
use crate::Malformed;
use crate::bytes::ByteReader;

/// The id that means "no point".
pub(super) const NO_POINT: u64 = u64::MAX;

/// Parses `cameras.bin`.
///
/// # Errors
/// When it is truncated, or a model's number is unknown, and therefore the length of its row.
pub fn parse_cameras(bytes: &[u8]) -> Result<Vec<ColmapCamera>, Malformed> {
    let mut bytes = ByteReader::new(bytes);
    let count = bytes.count(24, "cameras")?;
    let mut cameras = Vec::with_capacity(count);
    for _ in 0..count {
        let (id, model) = (bytes.u32()?, bytes.u32()?);
        let Some((name, params)) = CAMERA_MODELS.get(model as usize) else {
            return Err(Malformed(format!(
                "camera {id} has the model number {model}, which is not supported; run COLMAP's image_undistorter, or \
                 calibrate with OPENCV, FULL_OPENCV or OPENCV_FISHEYE"
            )));
        };
        cameras.push(ColmapCamera {
            id,
            model: (*name).to_owned(),
            width: bytes.u64()?,
            height: bytes.u64()?,
            params: (0..*params).map(|_| bytes.f64()).collect::<Result<_, _>>()?,
        });
    }
    Ok(cameras)
}

/// Parses `images.bin`.
///
/// # Errors
/// When it is truncated.
pub fn parse_images(bytes: &[u8]) -> Result<Vec<ColmapImage>, Malformed> {
    let mut bytes = ByteReader::new(bytes);
    let count = bytes.count(4 + 7 * 8 + 4 + 1 + 8, "images")?;
    let mut images = Vec::with_capacity(count);
    for _ in 0..count {
        bytes.u32()?;
        let (rotation, translation) = (bytes.f64s()?, bytes.f64s()?);
        let (camera_id, name) = (bytes.u32()?, bytes.text()?);
        let observations = bytes.count(24, "observations of an image")?;
        let records = bytes.take(observations * 24)?.chunks_exact(24);
        let ids = records.map(|record| u64::from_le_bytes(record[16..].try_into().expect("8 bytes")));
        images.push(ColmapImage {
            rotation,
            translation,
            camera_id,
            name,
            points: ids.filter(|id| *id != NO_POINT).collect(),
        });
    }
    Ok(images)
}

/// Parses `points3D.bin`.
///
/// # Errors
/// When it is truncated.
pub fn parse_points(bytes: &[u8]) -> Result<Vec<ColmapPoint>, Malformed> {
    let mut bytes = ByteReader::new(bytes);
    let count = bytes.count(8 + 3 * 8 + 3 + 8 + 8, "points")?;
    let mut points = Vec::with_capacity(count);
    for _ in 0..count {
        points.push(ColmapPoint {
            id: bytes.u64()?,
            position: bytes.f64s()?,
            color: [bytes.u8()?, bytes.u8()?, bytes.u8()?],
        });
        bytes.f64()?; // reprojection error
        let track = bytes.count(8, "observations of a point")?;
        bytes.take(track * 8)?;
    }
    Ok(points)
}
