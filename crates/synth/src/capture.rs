//! The views of a scene: cameras, frames, and points such as structure from motion produces.

use crate::cameras::{Split, cameras};
use crate::lens::SynthLens;
use crate::scene::SynthScene;
use crate::scenes::SceneName;
use crate::shape::Ray;
use crate::trace::{SynthFrame, depth_per_distance, pixel_ray};
use glam::{Vec2, Vec3};
use irradia_scene::{Camera, Dataset, FirstSide, Photo, PointCloud, Rng, RollingShutter, View};
use std::sync::Arc;

/// Maximum number of samples per pixel.
const MAX_SAMPLES: u32 = 16;
/// Number of points over all training views.
const POINT_COUNT: u32 = 6000;
/// Standard deviation of a point's error as a fraction of its distance, as for structure from motion on good photographs.
const POINT_ERROR: f32 = 0.001;

/// Pixels on each side of a point in the patch in which structure from motion looks for contrast.
const PATCH_RADIUS: u32 = 2;
/// Depth beyond which points are not triangulated, world units: cameras a few metres apart see no parallax.
const MAX_POINT_DEPTH: f32 = 100.0;
/// Minimum contrast of such a patch, the largest minus the smallest green in \[0, 1\]: a plain wall has less.
const MIN_CONTRAST: f32 = 0.06;

/// Options of a dataset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SynthOptions {
    /// The scene.
    pub scene: SceneName,
    /// Training views, 3 to 1000; one more in eight is held out, one more in twenty is for validation.
    pub views: u32,
    /// Width in pixels, 8 to 4096.
    pub width: u32,
    /// Height in pixels, 8 to 4096.
    pub height: u32,
    /// Random seed of cameras, samples and points, and of layout and colours of all scenes but the demo: equal seeds give equal
    /// views.
    pub seed: u64,
    /// The lens of the training and validation views. Held-out views always have a pinhole, so that lenses can be compared, and a size that
    /// gives them the same number of pixels per angle.
    pub lens: SynthLens,
    /// Angle by which the camera of a training or validation view turns during the readout from top to bottom, radians. It also moves, by
    /// one world unit per radian; each view has its own directions. The camera of a held-out view is at rest.
    pub turn: f32,
}

impl Default for SynthOptions {
    /// The demo scene, 40 views of 256 x 256 by a pinhole, seed 0.
    fn default() -> Self {
        Self {
            scene: SceneName::Demo,
            views: 40,
            width: 256,
            height: 256,
            seed: 0,
            lens: SynthLens::Pinhole,
            turn: 0.0,
        }
    }
}

/// Invalid options, in one line.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SynthError {
    /// Too few or too many views.
    #[error("{0} views: must be 3 to 1000")]
    Views(u32),
    /// Too small or too large.
    #[error("size {0}x{1}: each side must be 8 to 4096 pixels")]
    Size(u32, u32),
    /// Too fast, or not a number; radians.
    #[error(
        "a turn of {:.1} degrees during the readout: must be 0 to {:.1}",
        .0.to_degrees(),
        RollingShutter::MOST_TURNED.to_degrees()
    )]
    Turn(f32),
}

/// A view to trace.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// The split of the dataset to which it belongs.
    pub split: Split,
    /// Index among the views of its split.
    pub number: u32,
    /// The camera.
    pub camera: Camera,
    /// Seed of the samples. It differs between views, so that the noise does not form a pattern fixed to the image.
    seed: u64,
}

impl Shot {
    /// Name without extension, such as `train/r_007`.
    pub fn name(&self) -> String {
        format!("{}/r_{:03}", self.split.name(), self.number)
    }
}

/// A scene with its cameras.
#[derive(Clone, Debug)]
pub struct Capture {
    scene: SynthScene,
    options: SynthOptions,
    shots: Vec<Shot>,
    fov_x: f32,
}

impl Capture {
    /// Places the cameras; nothing is traced yet.
    ///
    /// # Errors
    /// When a value of `options` is out of range.
    pub fn new(options: &SynthOptions) -> Result<Self, SynthError> {
        let SynthOptions {
            scene,
            views,
            width,
            height,
            seed,
            lens,
            turn,
        } = *options;
        if !(3..=1000).contains(&views) {
            return Err(SynthError::Views(views));
        }
        if ![width, height].iter().all(|side| (8..=4096).contains(side)) {
            return Err(SynthError::Size(width, height));
        }
        if !(0.0..=RollingShutter::MOST_TURNED).contains(&turn) {
            return Err(SynthError::Turn(turn));
        }
        let (scene, rig) = scene.build(seed);
        let mut shots: Vec<Shot> = Vec::new();
        for split in Split::ALL {
            let cameras = cameras(&rig, split, Self::count(views, split), width, height, seed);
            for (number, mut camera) in (0..).zip(cameras) {
                let wide = lens.intrinsics(camera.intrinsics);
                camera.intrinsics = match split {
                    Split::Train | Split::Val => wide,
                    Split::Test => camera.intrinsics.scaled(wide.fx / camera.intrinsics.fx),
                };
                if turn > 0.0 && split != Split::Test {
                    camera.shutter = Some(moving(turn, &mut Rng::new(seed, 2000 + shots.len() as u64)));
                }
                let seed = seed.wrapping_mul(1_000_003).wrapping_add(shots.len() as u64);
                shots.push(Shot {
                    split,
                    number,
                    camera,
                    seed,
                });
            }
        }
        Ok(Self {
            scene,
            options: *options,
            shots,
            fov_x: rig.fov_x,
        })
    }

    fn count(views: u32, split: Split) -> u32 {
        match split {
            Split::Train => views,
            Split::Val => (views / 20).max(1),
            Split::Test => (views / 8).max(2),
        }
    }

    /// The options it was made with.
    pub fn options(&self) -> &SynthOptions {
        &self.options
    }

    /// Horizontal field of view, radians.
    pub fn fov_x(&self) -> f32 {
        self.fov_x
    }

    /// All views, split by split: training, validation, held out.
    pub fn shots(&self) -> &[Shot] {
        &self.shots
    }

    /// Traces one view, with its depth and normals.
    pub fn trace(&self, shot: &Shot) -> SynthFrame {
        self.scene.trace(&shot.camera, MAX_SAMPLES, shot.seed)
    }

    /// Simulated structure-from-motion points of the `frame` of a training view; none for other views. Except in the demo scene,
    /// whose points are spread evenly, only places with contrast have points, and the sky has none.
    pub fn points(&self, shot: &Shot, frame: &SynthFrame) -> PointCloud {
        let mut points = PointCloud::default();
        if shot.split == Split::Train {
            let count = (POINT_COUNT / self.options.views).max(1);
            let mut rng = Rng::new(self.options.seed, 1000 + u64::from(shot.number));
            for _ in 0..count {
                let (x, y) = (rng.below(frame.color.width), rng.below(frame.color.height));
                if self.options.scene == SceneName::Demo || self.is_distinct(&shot.camera, frame, x, y) {
                    add_point(&mut points, &shot.camera, frame, [x, y], &mut rng);
                }
            }
        }
        points
    }

    /// Whether structure from motion would find the surface under a pixel.
    fn is_distinct(&self, camera: &Camera, frame: &SynthFrame, x: u32, y: u32) -> bool {
        let around = |at: u32, side: u32| at.saturating_sub(PATCH_RADIUS)..=(at + PATCH_RADIUS).min(side - 1);
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        for row in around(y, frame.color.height) {
            for column in around(x, frame.color.width) {
                let green = frame.color.pixel(column, row)[1];
                (low, high) = (low.min(green), high.max(green));
            }
        }
        let ray = pixel_ray(camera, Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
        let hit = ray.and_then(|ray| self.scene.hit(&ray, camera.near));
        frame.depth.pixel(x, y)[0] < MAX_POINT_DEPTH
            && high - low >= MIN_CONTRAST
            && hit.is_some_and(|hit| !hit.object.material.texture.is_emissive())
    }
}

/// Traces the training and held-out views in memory: the same dataset as the one read from its files.
///
/// # Errors
/// When a value of `options` is out of range.
pub fn dataset(options: &SynthOptions) -> Result<Dataset, SynthError> {
    let capture = Capture::new(options)?;
    let mut dataset = Dataset {
        kind: "ray traced".into(),
        ..Dataset::default()
    };
    let mut points = PointCloud::default();
    for shot in capture.shots().iter().filter(|shot| shot.split != Split::Val) {
        let frame = capture.trace(shot);
        let found = capture.points(shot, &frame);
        points.positions.extend(found.positions);
        points.colors.extend(found.colors);
        let photo = Photo {
            width: frame.color.width,
            height: frame.color.height,
            channels: 4,
            data: frame.rgba(),
            mask: None,
        };
        dataset
            .views
            .push(View::new(format!("{}.png", shot.name()), shot.camera, Arc::new(photo)));
    }
    dataset.views.sort_by(|a, b| a.name.cmp(&b.name));
    let held_out = format!("{}/", Split::Test.name());
    (dataset.test, dataset.train) =
        (0..dataset.views.len()).partition(|i| dataset.views[*i].name.starts_with(&held_out));
    dataset.points = Some(points);
    Ok(dataset)
}

/// A camera that turns by `turn` and moves during the readout, both in random directions.
fn moving(turn: f32, rng: &mut Rng) -> RollingShutter {
    let mut direction = || Vec3::new(rng.normal(), rng.normal(), rng.normal()).normalize_or(Vec3::X);
    RollingShutter {
        first: FirstSide::Top,
        translation: turn * direction(),
        rotation: turn * direction(),
    }
}

/// Adds the surface point under a pixel, with noise.
fn add_point(points: &mut PointCloud, camera: &Camera, frame: &SynthFrame, [x, y]: [u32; 2], rng: &mut Rng) {
    let Some(Ray { origin, direction }) = pixel_ray(camera, Vec2::new(x as f32 + 0.5, y as f32 + 0.5)) else {
        return;
    };
    let depth = frame.depth.pixel(x, y)[0];
    let distance = depth / depth_per_distance(camera, direction);
    let error = Vec3::new(rng.normal(), rng.normal(), rng.normal()) * (POINT_ERROR * distance);
    points.positions.push(origin + direction * distance + error);
    let color = frame.color.pixel(x, y);
    points.colors.push([0, 1, 2].map(|c| (color[c] * 255.0).round() as u8));
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: SynthOptions = SynthOptions {
        scene: SceneName::Demo,
        views: 4,
        width: 32,
        height: 32,
        seed: 5,
        lens: SynthLens::Pinhole,
        turn: 0.0,
    };

    #[test]
    fn points_lie_on_visible_surfaces() {
        let capture = Capture::new(&SMALL).expect("options");
        let shot = capture.shots()[0];
        let frame = capture.trace(&shot);
        let points = capture.points(&shot, &frame);
        assert_eq!(points.len(), 1500);
        for point in points.positions.iter().take(50) {
            let (pixel, depth) = shot.camera.project(*point).expect("in front");
            let seen = frame.depth.pixel((pixel.x as u32).min(31), (pixel.y as u32).min(31))[0];
            // Five standard deviations, with tolerance for points displaced across an edge to the neighbouring pixel.
            assert!((seen - depth).abs() < 5.0 * POINT_ERROR * depth + 0.5, "{seen} {depth}");
        }
    }

    #[test]
    fn a_dataset_has_each_part_once_and_depends_only_on_the_seed() {
        let [a, b] = [dataset(&SMALL).expect("options"), dataset(&SMALL).expect("options")];
        assert_eq!((a.views.len(), a.train.len(), a.test.len()), (6, 4, 2));
        assert!(a.train.iter().all(|i| a.views[*i].name.starts_with("train/")));
        assert_eq!(a.points, b.points);
        assert_eq!(a.points.as_ref().map(PointCloud::len), Some(6000));
        for (a, b) in a.views.iter().zip(&b.views) {
            assert!(a.photo.load().expect("in memory") == b.photo.load().expect("in memory"));
        }
    }

    #[test]
    fn options_out_of_range_are_rejected_in_one_line() {
        let cases = [
            (SynthOptions { views: 2, ..SMALL }, "2 views: must be 3 to 1000"),
            (
                SynthOptions { width: 0, ..SMALL },
                "size 0x32: each side must be 8 to 4096 pixels",
            ),
            (
                SynthOptions { height: 5000, ..SMALL },
                "size 32x5000: each side must be 8 to 4096 pixels",
            ),
            (
                SynthOptions {
                    turn: 45f32.to_radians(),
                    ..SMALL
                },
                "a turn of 45.0 degrees during the readout: must be 0 to 28.6",
            ),
        ];
        for (options, line) in cases {
            assert_eq!(
                Capture::new(&options).err().map(|e| e.to_string()).as_deref(),
                Some(line)
            );
        }
    }
}
