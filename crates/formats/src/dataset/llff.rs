//! LLFF's `poses_bounds.npy` (Mildenhall et al. 2019): a row of 17 numbers per image, in the order of the images'
//! names. Fifteen are a 3x5 matrix whose columns are the camera's axes *down, right, backwards* in the world, its centre,
//! and height, width and focal length in pixels of the original images; two are the nearest and farthest depth.

use super::declared::{DeclaredCamera, DeclaredDataset, DeclaredView, Focal, pose_from_axes};
use super::files::{choose_image_folder, list_images, relative_name};
use super::npy::parse_table;
use super::sibling_folder::SiblingFolder;
use crate::error::read_and_parse;
use crate::{FormatError, Malformed};
use glam::DVec3;
use irradia_scene::Lens;
use std::path::Path;

/// A row of `poses_bounds.npy`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LlffPose {
    /// Camera axes in the world: down.
    pub down: DVec3,
    /// Camera axes in the world: right.
    pub right: DVec3,
    /// Camera axes in the world: backwards.
    pub backwards: DVec3,
    /// Camera centre, world.
    pub position: DVec3,
    /// Height, width and focal length of the original image, pixels.
    pub height_width_focal: [f64; 3],
    /// Depth of the nearest and of the farthest content, world units.
    pub bounds: [f64; 2],
}

/// Parses a `poses_bounds.npy`.
///
/// # Errors
/// When it is not an `.npy` file, is truncated, or does not have 17 columns.
pub fn parse_poses_bounds(bytes: &[u8]) -> Result<Vec<LlffPose>, Malformed> {
    let table = parse_table(bytes)?;
    if table.columns != 17 {
        return Err(Malformed(format!(
            "has rows of {} numbers; LLFF's have 17 (a 3x5 matrix and two depths)",
            table.columns
        )));
    }
    let poses = table.values.chunks_exact(17).take(table.rows).map(|row| {
        let column = |c: usize| [row[c], row[5 + c], row[10 + c]];
        LlffPose {
            down: column(0).into(),
            right: column(1).into(),
            backwards: column(2).into(),
            position: column(3).into(),
            height_width_focal: column(4),
            bounds: [row[15], row[16]],
        }
    });
    Ok(poses.collect())
}

pub(super) fn read(root: &Path, downscale: f32) -> Result<DeclaredDataset, FormatError> {
    let file = root.join("poses_bounds.npy");
    let poses = read_and_parse(&file, parse_poses_bounds)?;
    let Some(folder) = choose_image_folder(root, downscale) else {
        return Err(FormatError::NotADataset {
            path: root.to_owned(),
            expected: "a folder `images`, or `images_N` with smaller ones, beside poses_bounds.npy".into(),
        });
    };
    let images = list_images(&root.join(&folder.name))?;
    if images.len() != poses.len() {
        return Err(FormatError::malformed(
            &file,
            format!(
                "has {} poses and `{}` has {} images; they are matched in the order of names, so add or remove what \
                 differs",
                poses.len(),
                folder.name,
                images.len()
            ),
        ));
    }
    let masks = SiblingFolder::masks(root, &folder.name);
    let views: Vec<DeclaredView> = poses
        .iter()
        .zip(images)
        .map(|(pose, image)| {
            let [height, width, focal] = pose.height_width_focal;
            let has_size = height >= 1.0 && width >= 1.0;
            DeclaredView {
                name: relative_name(root, &image),
                mask: masks
                    .as_ref()
                    .and_then(|masks| masks.file_of(&relative_name(&root.join(&folder.name), &image))),
                image: Some(image),
                pose: pose_from_axes(pose.right, pose.down, -pose.backwards, pose.position),
                camera: DeclaredCamera {
                    size: has_size.then_some([width, height]),
                    focal: Focal::Pixels([focal, focal]),
                    center: None,
                    lens: Lens::Pinhole,
                },
                depth_bounds: Some(pose.bounds),
                time: None,
                points_seen: Vec::new(),
                shutter: None,
                split: None,
                depth: None,
                normals: None,
            }
        })
        .collect();
    let mut warnings: Vec<String> = folder.warning.into_iter().collect();
    let masked = views.iter().filter(|view| view.mask.is_some()).count();
    warnings.extend(masks.and_then(|masks| masks.mask_warning(views.len(), masked)));
    Ok(DeclaredDataset {
        kind: "LLFF",
        root: root.to_owned(),
        views,
        points: None,
        downscale: folder.downscale,
        warnings,
    })
}
