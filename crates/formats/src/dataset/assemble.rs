//! From what the files declare to a dataset: image headers are read, unusable views dropped, cameras brought to the real
//! image sizes, undistorted and made smaller.

use super::declared::{Declared, DeclaredView};
use super::split;
use super::{DatasetOptions, USUAL_MAX_SIDE};
use crate::FormatError;
use crate::image_file::{Header, read_header};
use crate::photo::PhotoFile;
use crate::undistort::Undistortion;
use image::metadata::Orientation;
use irradia_scene::{Camera, Dataset, Intrinsics, Lens, View};
use rayon::prelude::*;
use std::sync::Arc;

/// Fewer views than this make no scene.
const FEWEST_VIEWS: usize = 3;
/// Names that a warning lists.
const NAMES_TOLD: usize = 20;

/// Why a view was left out; each is one warning.
#[derive(Clone, Copy, PartialEq, Eq)]
enum LeftOut {
    MissingImage,
    UnreadableImage,
    NoPose,
    NoCamera,
}

impl LeftOut {
    const ALL: [Self; 4] = [Self::MissingImage, Self::UnreadableImage, Self::NoPose, Self::NoCamera];

    fn because(self) -> &'static str {
        match self {
            Self::MissingImage => "have no image file",
            Self::UnreadableImage => "have an image file that cannot be read",
            Self::NoPose => "have a pose that is not finite or no rotation",
            Self::NoCamera => {
                "have intrinsics that are not finite, not positive or leave no picture after undistortion"
            }
        }
    }
}

/// A view whose image file is there and readable.
struct Probed {
    orientation: Orientation,
    /// At the real size of the turned image, lens included.
    source: Intrinsics,
    /// Set for distorted cameras by [`plan_undistortion`].
    undistortion: Option<Undistortion>,
}

impl Probed {
    /// The camera of the photograph as it is trained on, at its real size.
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

    let mut probed: Vec<Result<Probed, LeftOut>> = views.par_iter().map(|view| probe(view, ignores_exif)).collect();
    plan_undistortion(&mut probed);
    let reasons = tell_left_out(&views, &probed);
    let usable: Vec<(DeclaredView, Probed)> = views
        .into_iter()
        .zip(probed)
        .filter_map(|(view, probed)| Some((view, probed.ok()?)))
        .collect();
    if usable.len() < FEWEST_VIEWS {
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
    if max_side == Some(USUAL_MAX_SIDE) {
        warnings.extend(tell_scaled(&usable));
    }

    let views = usable
        .into_iter()
        .filter_map(|(view, probed)| finish(view, &probed, downscale, max_side))
        .collect();
    Ok(Dataset {
        views,
        train: indices.train,
        test: indices.test,
        points: points.filter(|points| !points.is_empty()),
        kind: kind.to_owned(),
        warnings,
    })
}

fn probe(view: &DeclaredView, ignores_exif: bool) -> Result<Probed, LeftOut> {
    let image = view.image.as_deref().ok_or(LeftOut::MissingImage)?;
    if view.pose.is_none() {
        return Err(LeftOut::NoPose);
    }
    let header = read_header(image).map_err(|_| LeftOut::UnreadableImage)?;
    let orientation = orientation_to_apply(&header, view.camera.size, ignores_exif);
    let (width, height) = turned(&header, orientation);
    let source = view.camera.at_size(width, height);
    if !source.is_valid() || !lens_is_finite(&source.lens) {
        return Err(LeftOut::NoCamera);
    }
    Ok(Probed {
        orientation,
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

/// Plans the undistortion of every distinct distorted camera once, for all the views that share it.
fn plan_undistortion(probed: &mut [Result<Probed, LeftOut>]) {
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
                None => *view = Err(LeftOut::NoCamera),
            }
        }
    }
}

/// Bounds that say something: finite, in front of the camera, and in order.
fn usable_bounds([near, far]: [f64; 2]) -> Option<[f32; 2]> {
    let bounds = [near as f32, far as f32];
    (bounds[0] > 0.0 && bounds[1] > bounds[0] && bounds[1].is_finite()).then_some(bounds)
}

/// What is scaled though nobody may have asked for it.
fn tell_scaled(usable: &[(DeclaredView, Probed)]) -> Option<String> {
    let sizes = usable.iter().map(|(_, probed)| probed.undistorted());
    let large: Vec<Intrinsics> = sizes.filter(|k| k.width.max(k.height) > USUAL_MAX_SIDE).collect();
    let largest = large.iter().max_by_key(|k| u64::from(k.width) * u64::from(k.height))?;
    Some(format!(
        "{} of {} photographs, of up to {}x{} pixels, are scaled to {USUAL_MAX_SIDE} on the longer side, as 3DGS does; ask \
         for the full size or another one where that is not wanted",
        large.len(),
        usable.len(),
        largest.width,
        largest.height
    ))
}

fn finish(view: DeclaredView, probed: &Probed, downscale: f32, max_side: Option<u32>) -> Option<View> {
    let undistorted = probed.undistorted();
    let longer = undistorted.width.max(undistorted.height) as f32;
    let smaller = max_side.map_or(downscale, |side| downscale.max(longer / side as f32));
    let intrinsics = undistorted.scaled(1.0 / smaller);
    let photo = PhotoFile {
        image: view.image?,
        mask: view.mask,
        orientation: probed.orientation,
        turned: (probed.source.width, probed.source.height),
        undistortion: probed.undistortion,
        size: (intrinsics.width, intrinsics.height),
    };
    Some(View {
        name: view.name,
        camera: Camera::new(view.pose?, intrinsics),
        photo: Arc::new(photo),
        depth_bounds: view.depth_bounds.and_then(usable_bounds),
        time: view.time,
        points_seen: view.points_seen,
    })
}

/// See [`super::read_dataset`] for the rule.
fn orientation_to_apply(header: &Header, declared: Option<[f64; 2]>, ignores_exif: bool) -> Orientation {
    let upright = turned(header, header.orientation);
    let stored = (header.width, header.height);
    // Shapes, not sizes: the images may be a smaller copy of those that the poses were made from.
    let misfit = |(w, h): (u32, u32), [dw, dh]: [f64; 2]| (f64::from(w) / f64::from(h)).ln() - (dw / dh).ln();
    let turn = match declared {
        Some(size) if upright != stored => misfit(upright, size).abs() <= misfit(stored, size).abs(),
        _ => !ignores_exif,
    };
    if turn {
        header.orientation
    } else {
        Orientation::NoTransforms
    }
}

fn turned(header: &Header, orientation: Orientation) -> (u32, u32) {
    use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
    match orientation {
        Rotate90 | Rotate90FlipH | Rotate270 | Rotate270FlipH => (header.height, header.width),
        _ => (header.width, header.height),
    }
}

/// One line a reason, with the count and the first names.
fn tell_left_out(views: &[DeclaredView], probed: &[Result<Probed, LeftOut>]) -> Vec<String> {
    let line = |reason: LeftOut| {
        let pairs = views.iter().zip(probed);
        let names: Vec<&str> = pairs
            .filter(|(_, p)| p.as_ref().err() == Some(&reason))
            .map(|(view, _)| view.name.as_str())
            .collect();
        let told = names.iter().take(NAMES_TOLD).copied().collect::<Vec<_>>().join(", ");
        let more = match names.len().saturating_sub(NAMES_TOLD) {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        (!names.is_empty()).then(|| {
            format!(
                "{} of {} views {} and are left out: {told}{more}",
                names.len(),
                views.len(),
                reason.because()
            )
        })
    };
    LeftOut::ALL.into_iter().filter_map(line).collect()
}
