//! From declarations to a dataset: reads image headers, skips unusable views, adapts cameras to the actual image sizes,
//! undistorts and downscales them.

use super::declared::{Declared, DeclaredView};
use super::split;
use super::world::world_from_dataset;
use super::{DEFAULT_MAX_SIDE, DatasetOptions};
use crate::FormatError;
use crate::image_file::{Header, read_header};
use crate::photo::PhotoFile;
use crate::undistort::Undistortion;
use image::metadata::Orientation;
use irradia_scene::{Camera, Dataset, Intrinsics, Lens, Similarity, View};
use rayon::prelude::*;
use std::sync::Arc;

/// Minimum number of views of a scene.
const MIN_VIEWS: usize = 3;
/// Maximum number of names in a warning.
const MAX_NAMES: usize = 20;

/// Why a view was skipped; each reason is one warning.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Skipped {
    MissingImage,
    UnreadableImage,
    NoPose,
    NoCamera,
}

impl Skipped {
    const ALL: [Self; 4] = [Self::MissingImage, Self::UnreadableImage, Self::NoPose, Self::NoCamera];

    fn because(self) -> &'static str {
        match self {
            Self::MissingImage => "have no image file",
            Self::UnreadableImage => "have an image file that cannot be read",
            Self::NoPose => "have a pose that is not finite or not a rotation",
            Self::NoCamera => "have intrinsics that are not finite, not positive or leave no image after undistortion",
        }
    }
}

/// A view with a readable image file.
struct Probed {
    orientation: Orientation,
    jpeg: bool,
    /// At the actual size of the upright image, lens included.
    source: Intrinsics,
    /// Set for distorted cameras by [`plan_undistortion`].
    undistortion: Option<Undistortion>,
}

impl Probed {
    /// The undistorted camera of the photograph, at its actual size.
    fn undistorted(&self) -> Intrinsics {
        self.undistortion.map_or(self.source, |plan| plan.pinhole())
    }
}

pub(super) fn assemble(declared: Declared, options: &DatasetOptions) -> Result<Dataset, FormatError> {
    let Declared {
        kind,
        root,
        mut views,
        points,
        ignores_exif,
        downscale,
        mut warnings,
    } = declared;
    views.sort_by(|a, b| a.name.cmp(&b.name));
    let named = views.len();

    let mut probed: Vec<Result<Probed, Skipped>> = views.par_iter().map(|view| probe(view, ignores_exif)).collect();
    plan_undistortion(&mut probed);
    let reasons = skipped_warnings(&views, &probed);
    let usable: Vec<(DeclaredView, Probed)> = views
        .into_iter()
        .zip(probed)
        .filter_map(|(view, probed)| Some((view, probed.ok()?)))
        .collect();
    if usable.len() < MIN_VIEWS {
        return Err(FormatError::TooFewViews {
            path: root,
            usable: usable.len(),
            declared: named,
            reasons: reasons.iter().map(|reason| format!("; {reason}")).collect(),
        });
    }
    let names: Vec<String> = usable.iter().map(|(view, _)| view.name.clone()).collect();
    let splits: Vec<_> = usable.iter().map(|(view, _)| view.split).collect();
    let indices = split::split(&options.holdout, &root, &names, splits)?;
    if indices.train.is_empty() {
        return Err(FormatError::NothingToTrainOn {
            path: root,
            held_out: indices.test.len(),
            reasons: reasons.iter().map(|reason| format!("; {reason}")).collect(),
        });
    }
    warnings.extend(reasons);
    warnings.extend(indices.warning);
    let max_side = options.max_side;
    if max_side == Some(DEFAULT_MAX_SIDE) {
        warnings.extend(scaled_warning(&usable));
    }

    let positions: Vec<_> = usable
        .iter()
        .filter_map(|(view, _)| Some(view.pose?.position))
        .collect();
    let world = world_from_dataset(&positions);
    let views = usable
        .into_iter()
        .filter_map(|(view, probed)| finish(view, &probed, downscale, max_side, &world))
        .collect();
    Ok(Dataset {
        views,
        train: indices.train,
        test: indices.test,
        points: points
            .map(|points| points.in_world(&world))
            .filter(|points| !points.is_empty()),
        world_from_dataset: world,
        kind: kind.to_owned(),
        warnings,
    })
}

fn probe(view: &DeclaredView, ignores_exif: bool) -> Result<Probed, Skipped> {
    let image = view.image.as_deref().ok_or(Skipped::MissingImage)?;
    if view.pose.is_none() {
        return Err(Skipped::NoPose);
    }
    let header = read_header(image).map_err(|_| Skipped::UnreadableImage)?;
    let orientation = orientation_to_apply(&header, view.camera.size, ignores_exif);
    let (width, height) = oriented_size(&header, orientation);
    let source = view.camera.at_size(width, height);
    if !source.is_valid() || !lens_is_finite(&source.lens) {
        return Err(Skipped::NoCamera);
    }
    Ok(Probed {
        orientation,
        jpeg: header.jpeg,
        source,
        undistortion: None,
    })
}

fn lens_is_finite(lens: &Lens) -> bool {
    match lens {
        Lens::Pinhole => true,
        Lens::Opencv { k, p } => k.iter().chain(p).all(|v| v.is_finite()),
        Lens::Fisheye { k } => k.iter().all(|v| v.is_finite()),
    }
}

/// Plans the undistortion of every distinct distorted camera once, for all views that share it.
fn plan_undistortion(probed: &mut [Result<Probed, Skipped>]) {
    let mut distinct: Vec<Intrinsics> = Vec::new();
    for view in probed.iter().flatten() {
        if view.source.lens != Lens::Pinhole && !distinct.contains(&view.source) {
            distinct.push(view.source);
        }
    }
    let plans: Vec<Option<Undistortion>> = distinct.par_iter().map(Undistortion::plan).collect();
    for view in probed {
        let Ok(known) = view else { continue };
        if let Some(camera) = distinct.iter().position(|source| *source == known.source) {
            match plans[camera] {
                Some(plan) => known.undistortion = Some(plan),
                None => *view = Err(Skipped::NoCamera),
            }
        }
    }
}

/// Valid bounds: finite, in front of the camera, and in order.
fn usable_bounds([near, far]: [f64; 2]) -> Option<[f32; 2]> {
    let bounds = [near as f32, far as f32];
    (bounds[0] > 0.0 && bounds[1] > bounds[0] && bounds[1].is_finite()).then_some(bounds)
}

/// The warning about photographs downscaled by default.
fn scaled_warning(usable: &[(DeclaredView, Probed)]) -> Option<String> {
    let sizes = usable.iter().map(|(_, probed)| probed.undistorted());
    let large: Vec<Intrinsics> = sizes.filter(|k| k.width.max(k.height) > DEFAULT_MAX_SIDE).collect();
    let largest = large.iter().max_by_key(|k| u64::from(k.width) * u64::from(k.height))?;
    Some(format!(
        "{} of {} photographs, of up to {}x{} pixels, are scaled to {DEFAULT_MAX_SIDE} on the longer side, as 3DGS does; request \
         the full size or another one to change that",
        large.len(),
        usable.len(),
        largest.width,
        largest.height
    ))
}

fn finish(
    view: DeclaredView,
    probed: &Probed,
    downscale: f32,
    max_side: Option<u32>,
    world_from_dataset: &Similarity,
) -> Option<View> {
    let undistorted = probed.undistorted();
    let longer = undistorted.width.max(undistorted.height) as f32;
    let smaller = max_side.map_or(downscale, |side| downscale.max(longer / side as f32));
    let intrinsics = undistorted.scaled(1.0 / smaller);
    let photo = PhotoFile {
        image: view.image?,
        mask: view.mask,
        orientation: probed.orientation,
        jpeg: probed.jpeg,
        upright: (probed.source.width, probed.source.height),
        undistortion: probed.undistortion,
        size: (intrinsics.width, intrinsics.height),
    };
    Some(View {
        name: view.name,
        camera: Camera::new(view.pose?.in_world(world_from_dataset), intrinsics),
        photo: Arc::new(photo),
        depth_bounds: view
            .depth_bounds
            .and_then(|bounds| usable_bounds(bounds.map(|depth| depth * world_from_dataset.scale))),
        time: view.time,
        points_seen: view.points_seen,
    })
}

/// See [`super::read_dataset`] for the rule.
fn orientation_to_apply(header: &Header, declared: Option<[f64; 2]>, ignores_exif: bool) -> Orientation {
    let upright = oriented_size(header, header.orientation);
    let stored = (header.width, header.height);
    // Aspects, not sizes: the images may be smaller copies of those from which the poses were made.
    let mismatch = |(w, h): (u32, u32), [dw, dh]: [f64; 2]| (f64::from(w) / f64::from(h)).ln() - (dw / dh).ln();
    let turn = match declared {
        Some(size) if upright != stored => mismatch(upright, size).abs() <= mismatch(stored, size).abs(),
        _ => !ignores_exif,
    };
    if turn {
        header.orientation
    } else {
        Orientation::NoTransforms
    }
}

pub(crate) fn oriented_size(header: &Header, orientation: Orientation) -> (u32, u32) {
    use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
    match orientation {
        Rotate90 | Rotate90FlipH | Rotate270 | Rotate270FlipH => (header.height, header.width),
        _ => (header.width, header.height),
    }
}

/// The orientation that [`super::read_dataset`] applies to a photograph of a COLMAP model whose camera has the upright size, and where
/// up is then in the picture: `[right, down]`. Half turns and square pictures are not turned.
pub(crate) fn turned_as_stored(header: &Header) -> (Orientation, [i8; 2]) {
    use Orientation::{FlipVertical, Rotate90, Rotate90FlipH, Rotate180, Rotate270, Rotate270FlipH};
    let (width, height) = oriented_size(header, header.orientation);
    let applied = orientation_to_apply(header, Some([f64::from(width), f64::from(height)]), true);
    let up = match header.orientation {
        orientation if orientation == applied => [0, -1],
        Rotate180 | FlipVertical => [0, 1],
        Rotate90 | Rotate90FlipH => [-1, 0],
        Rotate270 | Rotate270FlipH => [1, 0],
        _ => [0, -1],
    };
    (applied, up)
}

/// One line per reason, with the count and the first names.
fn skipped_warnings(views: &[DeclaredView], probed: &[Result<Probed, Skipped>]) -> Vec<String> {
    let line = |reason: Skipped| {
        let pairs = views.iter().zip(probed);
        let names: Vec<&str> = pairs
            .filter(|(_, p)| p.as_ref().err() == Some(&reason))
            .map(|(view, _)| view.name.as_str())
            .collect();
        let listed = names.iter().take(MAX_NAMES).copied().collect::<Vec<_>>().join(", ");
        let more = match names.len().saturating_sub(MAX_NAMES) {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        (!names.is_empty()).then(|| {
            format!(
                "{} of {} views {} and are skipped: {listed}{more}",
                names.len(),
                views.len(),
                reason.because()
            )
        })
    };
    Skipped::ALL.into_iter().filter_map(line).collect()
}
