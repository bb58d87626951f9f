//! Writes COLMAP's binary models, with keypoints and tracks.

use super::{CAMERA_MODELS, ColmapCamera, ColmapImage, ColmapPoint};
use crate::{FormatError, write_atomic};
use std::io::{self, Write};
use std::path::Path;

/// A reconstruction in COLMAP's terms.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ColmapModel {
    /// Cameras, each with its id.
    pub cameras: Vec<ColmapCamera>,
    /// Images; the one at index `i` gets the id `i + 1`.
    pub images: Vec<PosedImage>,
    /// Points.
    pub points: Vec<TrackedPoint>,
}

/// An image with its keypoints.
#[derive(Clone, Debug, PartialEq)]
pub struct PosedImage {
    /// Pose, camera and name; its `points` are not written.
    pub image: ColmapImage,
    /// Keypoints, px, and the [`ColmapPoint::id`] of the point each one shows.
    pub keypoints: Vec<([f64; 2], Option<u64>)>,
}

/// A point with its track.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackedPoint {
    /// Position and colour.
    pub point: ColmapPoint,
    /// Mean reprojection error, px.
    pub error: f64,
    /// Where it is seen: an index of [`ColmapModel::images`] and of that image's keypoints.
    pub track: Vec<[u32; 2]>,
}

/// Writes `cameras.bin`, `points3D.bin` and, last, `images.bin` into `folder`, which exists: a folder that holds all three is
/// complete.
///
/// # Errors
/// When a camera's model is unknown or its number of parameters is wrong, or a file cannot be written.
pub fn write_colmap(folder: &Path, model: &ColmapModel) -> Result<(), FormatError> {
    let numbers: Vec<u32> = model
        .cameras
        .iter()
        .map(|camera| {
            let is_model = |(name, count): &(&str, usize)| *name == camera.model && *count == camera.params.len();
            let found = CAMERA_MODELS.iter().position(is_model);
            found.map(|number| number as u32).ok_or_else(|| {
                FormatError::Option(format!(
                    "camera {}: {} with {} parameters is not a COLMAP model",
                    camera.id,
                    camera.model,
                    camera.params.len()
                ))
            })
        })
        .collect::<Result<_, _>>()?;
    write_atomic(&folder.join("cameras.bin"), |out| {
        write_u64(out, model.cameras.len() as u64)?;
        for (camera, number) in model.cameras.iter().zip(&numbers) {
            out.write_all(&camera.id.to_le_bytes())?;
            out.write_all(&number.to_le_bytes())?;
            write_u64(out, camera.width)?;
            write_u64(out, camera.height)?;
            write_f64s(out, &camera.params)?;
        }
        Ok(())
    })?;
    write_atomic(&folder.join("points3D.bin"), |out| {
        write_u64(out, model.points.len() as u64)?;
        for TrackedPoint { point, error, track } in &model.points {
            write_u64(out, point.id)?;
            write_f64s(out, &point.position)?;
            out.write_all(&point.color)?;
            write_f64s(out, &[*error])?;
            write_u64(out, track.len() as u64)?;
            for [image, keypoint] in track {
                out.write_all(&(image + 1).to_le_bytes())?;
                out.write_all(&keypoint.to_le_bytes())?;
            }
        }
        Ok(())
    })?;
    write_atomic(&folder.join("images.bin"), |out| {
        write_u64(out, model.images.len() as u64)?;
        for (id, PosedImage { image, keypoints }) in (1u32..).zip(&model.images) {
            out.write_all(&id.to_le_bytes())?;
            write_f64s(out, &image.rotation)?;
            write_f64s(out, &image.translation)?;
            out.write_all(&image.camera_id.to_le_bytes())?;
            out.write_all(image.name.as_bytes())?;
            out.write_all(&[0])?;
            write_u64(out, keypoints.len() as u64)?;
            for (position, point) in keypoints {
                write_f64s(out, position)?;
                write_u64(out, point.unwrap_or(super::binary::NO_POINT))?;
            }
        }
        Ok(())
    })
}

fn write_u64(out: &mut dyn Write, value: u64) -> io::Result<()> {
    out.write_all(&value.to_le_bytes())
}

fn write_f64s(out: &mut dyn Write, values: &[f64]) -> io::Result<()> {
    values.iter().try_for_each(|value| out.write_all(&value.to_le_bytes()))
}

#[cfg(test)]
mod tests {
    use super::super::binary::{parse_cameras, parse_images, parse_points};
    use super::*;

    fn model() -> ColmapModel {
        let image = |name: &str, points: &[u64]| ColmapImage {
            rotation: [0.5, 0.5, -0.5, 0.5],
            translation: [1.0, -2.0, 3.5],
            camera_id: 4,
            name: name.into(),
            points: points.to_vec(),
        };
        ColmapModel {
            cameras: vec![ColmapCamera {
                id: 4,
                model: "OPENCV".into(),
                width: 640,
                height: 480,
                params: (1..=8).map(f64::from).collect(),
            }],
            images: vec![
                PosedImage {
                    image: image("a.jpg", &[9]),
                    keypoints: vec![([1.5, 2.5], None), ([3.0, 4.0], Some(9))],
                },
                PosedImage {
                    image: image("folder/b.jpg", &[]),
                    keypoints: Vec::new(),
                },
            ],
            points: vec![TrackedPoint {
                point: ColmapPoint {
                    id: 9,
                    position: [0.25, -1.0, 7.0],
                    color: [1, 2, 255],
                },
                error: 0.5,
                track: vec![[0, 1]],
            }],
        }
    }

    #[test]
    fn what_is_written_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let model = model();
        write_colmap(folder.path(), &model).unwrap();
        let read = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
        assert_eq!(parse_cameras(&read("cameras.bin")).unwrap(), model.cameras);
        let images: Vec<ColmapImage> = model.images.iter().map(|posed| posed.image.clone()).collect();
        assert_eq!(parse_images(&read("images.bin")).unwrap(), images);
        let points: Vec<ColmapPoint> = model.points.iter().map(|tracked| tracked.point.clone()).collect();
        let bytes = read("points3D.bin");
        assert_eq!(parse_points(&bytes).unwrap(), points);
        // The track names the image by its id.
        assert_eq!(bytes[bytes.len() - 8..], [1, 0, 0, 0, 1, 0, 0, 0]);
    }

    #[test]
    fn an_unknown_camera_is_refused_before_anything_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let mut model = model();
        model.cameras[0].params.pop();
        let error = write_colmap(folder.path(), &model).unwrap_err().to_string();
        assert!(error.contains("OPENCV with 7 parameters"), "{error}");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
