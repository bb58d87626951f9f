//! From declarations to a dataset: reads image headers, skips unusable views, adapts cameras to the actual image sizes,
//! undistorts them or cuts them into faces, and downscales them.

use super::declared::{DeclaredDataset, DeclaredView};
use super::panoramas;
use super::readout;
use super::split;
use super::visible::find_points_seen;
use super::world::world_from_dataset;
use super::{DEFAULT_MAX_SIDE, DatasetOptions, Lenses};
use crate::FormatError;
use crate::faces::{PinholeImages, image_circle};
use crate::image_file::{Header, read_header};
use crate::map_file::MapFile;
use crate::photo::PhotoFile;
use crate::undistort::Undistortion;
use crate::valid_region::ValidRegion;
use glam::DQuat;
use image::metadata::Orientation;
use irradia_scene::{Camera, Dataset, Intrinsics, Lens, PointCloud, RollingShutter, Similarity, View};
use rayon::prelude::*;
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Minimum number of views of a scene.
const MIN_VIEWS: usize = 3;
/// Minimum ratio between the aspect ratios of a photograph and its camera for them to count as different; small copies are rounded.
const ASPECT_RATIO_TOLERANCE: f64 = 1.03;
/// Maximum number of names in a warning.
const MAX_NAMES: usize = 20;
/// Number of photographs of a camera in which its image circle is searched.
const CIRCLE_SAMPLES: usize = 4;

/// Why a view was skipped; each reason is one warning.
#[derive(Clone, Copy, PartialEq, Eq)]
enum SkipReason {
    MissingImage,
    UnreadableImage,
    NoPose,
    NoCamera,
}

impl SkipReason {
    const ALL: [Self; 4] = [Self::MissingImage, Self::UnreadableImage, Self::NoPose, Self::NoCamera];

    fn description(self) -> &'static str {
        match self {
            Self::MissingImage => "have no image file (--images names the folder of the photographs)",
            Self::UnreadableImage => "have an image file that cannot be read",
            Self::NoPose => "have a pose that is not finite or not a rotation",
            Self::NoCamera => "have intrinsics that are not finite, not positive or leave no image after undistortion",
        }
    }
}

/// A view with a readable image file.
struct ProbedView {
    orientation: Orientation,
    jpeg: bool,
    /// At the actual size of the upright image, lens included.
    source: Intrinsics,
    /// Set for distorted cameras by [`plan_pinhole_images`], unless photographs are kept as they are.
    pinholes: Option<PinholeImages>,
    /// The usable part of a photograph that is kept as it is; `None` if all of it is usable.
    valid_region: Option<ValidRegion>,
}

impl ProbedView {
    /// The undistorted camera of the photograph at its actual size, or that of its largest face.
    fn undistorted(&self) -> Intrinsics {
        match &self.pinholes {
            None => self.source,
            Some(PinholeImages::Single(plan)) => plan.pinhole(),
            Some(PinholeImages::Faces(faces)) => {
                let cameras = faces.iter().map(|(_, plan)| plan.pinhole());
                let largest = cameras.max_by_key(|k| u64::from(k.width) * u64::from(k.height));
                largest.expect("a cut has faces")
            }
        }
    }

    fn is_cut_into_faces(&self) -> bool {
        matches!(self.pinholes, Some(PinholeImages::Faces(_)))
    }
}

pub(super) fn assemble(declared: DeclaredDataset, options: &DatasetOptions) -> Result<Dataset, FormatError> {
    let DeclaredDataset {
        kind,
        root,
        mut views,
        points,
        downscale,
        mut warnings,
    } = declared;
    if options.lenses != Lenses::Undistorted {
        views = panoramas::merge_faces(views, &root);
    }
    views.sort_by(|a, b| a.name.cmp(&b.name));
    let declared = views.len();
    views = without_duplicates(views);
    let unique = views.len();
    if unique < declared {
        warnings.push(format!(
            "{} of {declared} views are left out: other views use the same photographs",
            declared - unique
        ));
    }
    if let Some(readout) = &options.readout {
        let moving = readout::estimate_shutters(&mut views, readout);
        if moving < unique {
            warnings.push(format!(
                "{} of {unique} photographs are taken as if exposed at once: their names have no frame numbers, no neighbour has a pose, or \
                 they would rotate by more than half a radian",
                unique - moving
            ));
        }
    }

    let mut probed: Vec<Result<ProbedView, SkipReason>> = views.par_iter().map(probe).collect();
    plan_pinhole_images(&views, &mut probed, options.lenses);
    let reasons = skipped_warnings(&views, &probed);
    let usable: Vec<(DeclaredView, ProbedView)> = views
        .into_iter()
        .zip(probed)
        .filter_map(|(view, probed)| Some((view, probed.ok()?)))
        .collect();
    if usable.len() < MIN_VIEWS {
        return Err(FormatError::TooFewViews {
            path: root,
            usable: usable.len(),
            declared: unique,
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
    warnings.extend(aspect_ratio_warning(&usable));
    let max_side = options.max_side;
    if max_side == Some(DEFAULT_MAX_SIDE) {
        warnings.extend(downscale_warning(&usable));
    }

    let positions: Vec<_> = usable
        .iter()
        .filter_map(|(view, _)| Some(view.pose?.position))
        .collect();
    let world = world_from_dataset(&positions);
    let points = points
        .map(|points| points.in_world(&world))
        .filter(|points| !points.is_empty());
    warnings.extend(faces_warning(&usable));
    let builder = ViewBuilder {
        downscale,
        max_side,
        world_from_dataset: &world,
        points: points.as_ref(),
        keeps_alpha: kind == "Blender",
    };
    // Photograph by photograph, so that the faces of one are held out together.
    let mut views = Vec::with_capacity(usable.len());
    let mut views_of = Vec::with_capacity(usable.len());
    for (view, probed) in usable {
        let first = views.len();
        views.extend(builder.views(view, &probed));
        views_of.push(first..views.len());
    }
    find_points_seen(&mut views, points.as_ref());
    let views_of = |photographs: Vec<usize>| photographs.into_iter().flat_map(|i| views_of[i].clone()).collect();
    Ok(Dataset {
        views,
        train: views_of(indices.train),
        test: views_of(indices.test),
        points,
        world_from_dataset: world,
        kind: kind.to_owned(),
        warnings,
    })
}

/// One view of each photograph: the first whose name fits the photograph's path best. Otherwise a copy of a held-out view might be
/// trained on.
fn without_duplicates(views: Vec<DeclaredView>) -> Vec<DeclaredView> {
    let mut view_of: HashMap<&Path, usize> = HashMap::new();
    for (i, view) in views.iter().enumerate() {
        let Some(image) = view.image.as_deref() else { continue };
        let fit = |view: &DeclaredView| (image.ends_with(&view.name), image.ends_with(view.name_without_folder()));
        let kept = view_of.entry(image).or_insert(i);
        if fit(view) > fit(&views[*kept]) {
            *kept = i;
        }
    }
    let kept: HashSet<usize> = view_of.into_values().collect();
    let views = views.into_iter().enumerate();
    views
        .filter(|(i, view)| view.image.is_none() || kept.contains(i))
        .map(|(_, view)| view)
        .collect()
}

fn probe(view: &DeclaredView) -> Result<ProbedView, SkipReason> {
    let image = view.image.as_deref().ok_or(SkipReason::MissingImage)?;
    if view.pose.is_none() {
        return Err(SkipReason::NoPose);
    }
    let header = read_header(image).map_err(|_| SkipReason::UnreadableImage)?;
    let orientation = orientation_to_apply(&header, view.camera.size);
    let (width, height) = oriented_size(&header, orientation);
    let source = view.camera.at_size(width, height);
    if !source.is_valid() || !source.lens.is_finite() {
        return Err(SkipReason::NoCamera);
    }
    Ok(ProbedView {
        orientation,
        jpeg: header.jpeg,
        source,
        pinholes: None,
        valid_region: None,
    })
}

/// Plans once for every distinct distorted camera, for all views that share it, its pinhole images, or the usable part of photographs
/// that are kept as they are.
fn plan_pinhole_images(views: &[DeclaredView], probed: &mut [Result<ProbedView, SkipReason>], lenses: Lenses) {
    let mut distinct: Vec<Intrinsics> = Vec::new();
    for view in probed.iter().flatten() {
        if view.source.lens != Lens::Pinhole && !distinct.contains(&view.source) {
            distinct.push(view.source);
        }
    }
    let find_circle = |source: &Intrinsics| {
        let mut photographs: Vec<(&Path, Orientation)> = Vec::new();
        for (view, probed) in views.iter().zip(probed.iter()) {
            if let (Some(image), Ok(probed)) = (&view.image, probed)
                && probed.source == *source
            {
                photographs.push((image, probed.orientation));
            }
        }
        let stride = photographs.len().div_ceil(CIRCLE_SAMPLES).max(1);
        // A photograph that cannot be decoded is reported where it is loaded.
        image_circle(source, photographs.into_iter().step_by(stride))
            .ok()
            .flatten()
    };
    let plans: Vec<Plan> = distinct
        .par_iter()
        .map(|source| {
            let keep_distorted = || Plan::KeepDistorted(ValidRegion::of(source, || find_circle(source)));
            if lenses == Lenses::Distorted {
                return keep_distorted();
            }
            match PinholeImages::plan(source, || find_circle(source)) {
                Some(PinholeImages::Faces(_)) if lenses == Lenses::Whole => keep_distorted(),
                pinholes => pinholes.map_or(Plan::Impossible, Plan::Undistort),
            }
        })
        .collect();
    for view in probed {
        let Ok(usable) = view else { continue };
        if let Some(camera) = distinct.iter().position(|source| *source == usable.source) {
            match &plans[camera] {
                Plan::Undistort(pinholes) => usable.pinholes = Some(pinholes.clone()),
                Plan::KeepDistorted(valid_region) => usable.valid_region = *valid_region,
                Plan::Impossible => *view = Err(SkipReason::NoCamera),
            }
        }
    }
}

/// How the photographs of a distorted camera are used.
enum Plan {
    Undistort(PinholeImages),
    KeepDistorted(Option<ValidRegion>),
    /// The lens leaves no image.
    Impossible,
}

/// Valid bounds: finite, in front of the camera, and in order.
fn usable_bounds([near, far]: [f64; 2]) -> Option<[f32; 2]> {
    let bounds = [near as f32, far as f32];
    (bounds[0] > 0.0 && bounds[1] > bounds[0] && bounds[1].is_finite()).then_some(bounds)
}

/// The warning about photographs whose aspect ratio is not their camera's; its focal lengths are stretched with the image.
fn aspect_ratio_warning(usable: &[(DeclaredView, ProbedView)]) -> Option<String> {
    let is_mismatched = |(view, probed): &&(DeclaredView, ProbedView)| {
        let (width, height) = (f64::from(probed.source.width), f64::from(probed.source.height));
        let declared = view.camera.size.map_or(1.0, |[w, h]| w * height / (h * width));
        !(1.0 / ASPECT_RATIO_TOLERANCE..=ASPECT_RATIO_TOLERANCE).contains(&declared)
    };
    let mut mismatched = usable.iter().filter(is_mismatched);
    let (view, probed) = mismatched.next()?;
    let [width, height] = view.camera.size?;
    let (count, total) = (1 + mismatched.count(), usable.len());
    Some(format!(
        "{count} of {total} photographs do not have the aspect ratio of their cameras, such as {}, of {}x{} pixels for {width}x{height}: they \
         were cropped or rotated, or width and height are exchanged; poses will not fit unless they were stretched",
        view.name, probed.source.width, probed.source.height
    ))
}

/// The warning about photographs downscaled by default.
fn downscale_warning(usable: &[(DeclaredView, ProbedView)]) -> Option<String> {
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

/// The warning about photographs that are cut into faces.
fn faces_warning(usable: &[(DeclaredView, ProbedView)]) -> Option<String> {
    let cut = usable.iter().filter(|(_, probed)| probed.is_cut_into_faces()).count();
    (cut > 0).then(|| {
        format!(
            "{cut} of {} photographs show more than one pinhole image can: each is cut into the faces of a cube, which are views of their \
             own, such as NAME/front (--lenses whole keeps them, on the CPU)",
            usable.len()
        )
    })
}

/// What is needed to turn declared views into views.
struct ViewBuilder<'a> {
    downscale: f32,
    max_side: Option<u32>,
    world_from_dataset: &'a Similarity,
    points: Option<&'a PointCloud>,
    /// Whether photographs have alpha even if it is opaque everywhere.
    keeps_alpha: bool,
}

impl ViewBuilder<'_> {
    /// The view of a photograph, or one for each of its faces.
    fn views(&self, view: DeclaredView, probed: &ProbedView) -> Vec<View> {
        match &probed.pinholes {
            None => self.view(&view, probed, None).into_iter().collect(),
            Some(PinholeImages::Single(plan)) => self.view(&view, probed, Some(**plan)).into_iter().collect(),
            Some(PinholeImages::Faces(faces)) => faces
                .iter()
                .filter_map(|(name, plan)| {
                    let mut face = self.view(&view, probed, Some(*plan))?;
                    face.name = format!("{}/{name}", view.name);
                    // Depths, normals and motion are in the axes of the photograph, not of the face.
                    face.depth_bounds = None;
                    face.camera.shutter = None;
                    face.depth_map = None;
                    face.normal_map = None;
                    face.points_seen.retain(|point| self.is_seen(&face.camera, *point));
                    Some(face)
                })
                .collect(),
        }
    }

    fn is_seen(&self, camera: &Camera, point: u32) -> bool {
        let position = self.points.and_then(|points| points.positions.get(point as usize));
        position.and_then(|position| camera.sees(*position)).is_some()
    }

    /// The view of a photograph undistorted by `plan`.
    fn view(&self, view: &DeclaredView, probed: &ProbedView, plan: Option<Undistortion>) -> Option<View> {
        let undistorted = plan.map_or(probed.source, |plan| plan.pinhole());
        let longer_side = undistorted.width.max(undistorted.height) as f32;
        let downscale = self
            .max_side
            .map_or(self.downscale, |side| self.downscale.max(longer_side / side as f32));
        let intrinsics = undistorted.scaled(1.0 / downscale);
        let photo = PhotoFile {
            image: view.image.clone()?,
            mask: view.mask.clone(),
            orientation: probed.orientation,
            jpeg: probed.jpeg,
            upright_size: (probed.source.width, probed.source.height),
            undistortion: plan,
            valid_region: probed.valid_region,
            size: (intrinsics.width, intrinsics.height),
            keeps_alpha: self.keeps_alpha,
        };
        let map = |path: &Option<PathBuf>| {
            // Maps of a fisheye may hold depths along the axis or distances.
            path.clone().filter(|_| !intrinsics.lens.is_wide()).map(|path| {
                Arc::new(MapFile {
                    path,
                    orientation: probed.orientation,
                    upright_size: (probed.source.width, probed.source.height),
                    undistortion: plan,
                })
            })
        };
        let mut pose = view.pose?;
        pose.rotation *= plan.map_or(DQuat::IDENTITY, |plan| plan.rotation());
        let camera = Camera::new(pose.in_world(self.world_from_dataset), intrinsics);
        let shutter = view.shutter.map(|shutter| RollingShutter {
            translation: shutter.translation * self.world_from_dataset.scale as f32,
            ..shutter
        });
        Some(View {
            name: view.name.clone(),
            camera: Camera { shutter, ..camera },
            photo: Arc::new(photo),
            depth_bounds: view
                .depth_bounds
                .and_then(|bounds| usable_bounds(bounds.map(|depth| depth * self.world_from_dataset.scale))),
            time: view.time,
            points_seen: view.points_seen.clone(),
            depth_map: map(&view.depth).map(|map| map as _),
            normal_map: map(&view.normals).map(|map| map as _),
        })
    }
}

/// See [`super::read_dataset`] for the rule.
fn orientation_to_apply(header: &Header, declared: Option<[f64; 2]>) -> Orientation {
    let upright = oriented_size(header, header.orientation);
    let stored = (header.width, header.height);
    // Aspects, not sizes: the images may be smaller copies of those from which the poses were made.
    let mismatch = |(w, h): (u32, u32), [dw, dh]: [f64; 2]| (f64::from(w) / f64::from(h)).ln() - (dw / dh).ln();
    let apply_exif = match declared {
        Some(size) if upright != stored => mismatch(upright, size).abs() <= mismatch(stored, size).abs(),
        _ => false,
    };
    if apply_exif {
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

/// The orientation that [`super::read_dataset`] applies to a photograph of a COLMAP model whose camera has the upright size, and the up
/// direction in the resulting image, `[right, down]`, if that is not its top. Half turns and square images stay as stored.
pub(crate) fn colmap_orientation(header: &Header) -> (Orientation, Option<[i8; 2]>) {
    use Orientation::{FlipVertical, Rotate90, Rotate90FlipH, Rotate180, Rotate270, Rotate270FlipH};
    let (width, height) = oriented_size(header, header.orientation);
    let applied = orientation_to_apply(header, Some([f64::from(width), f64::from(height)]));
    let up = match header.orientation {
        orientation if orientation == applied => None,
        Rotate180 | FlipVertical => Some([0, 1]),
        Rotate90 | Rotate90FlipH => Some([-1, 0]),
        Rotate270 | Rotate270FlipH => Some([1, 0]),
        _ => None,
    };
    (applied, up)
}

/// One line per reason, with the count and the first names.
fn skipped_warnings(views: &[DeclaredView], probed: &[Result<ProbedView, SkipReason>]) -> Vec<String> {
    let line = |reason: SkipReason| {
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
                reason.description()
            )
        })
    };
    SkipReason::ALL.into_iter().filter_map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::super::declared::DeclaredCamera;
    use super::*;

    #[test]
    fn of_views_with_the_same_photograph_the_one_named_like_it_is_kept() {
        let kept = |declared: &[(&str, Option<&str>)]| {
            let view = |(name, image): &(&str, Option<&str>)| DeclaredView {
                image: image.map(PathBuf::from),
                ..DeclaredView::posed(Path::new(""), name, None, None, DeclaredCamera::panorama())
            };
            let views = without_duplicates(declared.iter().map(view).collect());
            views.into_iter().map(|view| view.name).collect::<Vec<_>>()
        };
        let rig = [
            ("images/cam0/1.jpg", Some("photos/cam1/1.jpg")),
            ("images/cam0/2.jpg", Some("photos/2.jpg")),
            ("images/cam1/1.jpg", Some("photos/cam1/1.jpg")),
            ("images/cam1/2.jpg", Some("photos/2.jpg")),
            ("images/cam1/3.jpg", None),
            ("images/cam2/3.jpg", None),
        ];
        let expected = [
            "images/cam0/2.jpg",
            "images/cam1/1.jpg",
            "images/cam1/3.jpg",
            "images/cam2/3.jpg",
        ];
        assert_eq!(kept(&rig), expected);
    }
}
