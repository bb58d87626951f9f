//! Known depths, as the reference of a loss: of the points that a view is known to see, and of depth maps given with photographs, from a
//! sensor or a network.
//!
//! What a network estimates is depth or inverse depth, up to a scale and a shift that differ from photograph to photograph. The points that
//! a view is known to see determine all three: per view, a line is fitted robustly through the values at its points, once to their depths
//! and once to their inverses, and the maps are taken for what fits the views better (Kerbl et al., "Hierarchical 3D Gaussians", 2024, fit
//! the inverse depths of one network in this way). Fitted depths are in world units. Without points, maps are taken for depths, and the
//! loss itself fits scale and shift to each frame.

use crate::photos::caught;
use crate::recipe::Param;
use crate::robust::median;
use crate::schedule::StepPlan;
use crate::trainer::Trainer;
use irradia_measure::{DepthKind, DepthSample};
use irradia_scene::{Camera, Dataset, DepthGrid, View};
use rayon::prelude::*;

/// Minimum number of points of a view to which its map is fitted.
const MIN_POINTS: usize = 16;
/// Median relative error of the fitted depths at a view's points from which its map is not used: it shows something else.
const MAX_FIT_ERROR: f64 = 0.2;
/// Rounds of reweighted least squares.
const FIT_ITERATIONS: usize = 10;
/// Relative residual below which pairs have the same weight.
const MIN_RESIDUAL: f64 = 1e-3;
/// Depths outside the range of a view's points by more than this factor are extrapolated, and are not used.
const MAX_EXTRAPOLATION: f32 = 3.0;

/// The maps of a dataset's training views.
#[derive(Default)]
pub(crate) struct DepthMaps {
    /// By view.
    by_view: Vec<Option<UsableMap>>,
    /// What was found, one line.
    pub summary: String,
}

/// The map of a view, as the loss uses it.
struct UsableMap {
    grid: DepthGrid,
    kind: DepthKind,
}

/// The meaning of a map's values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ValueKind {
    Depths,
    Inverses,
}

impl ValueKind {
    const BOTH: [Self; 2] = [Self::Depths, Self::Inverses];
}

/// `scale * value + shift` is the depth, or its inverse.
#[derive(Clone, Copy, Debug)]
struct Line {
    scale: f64,
    shift: f64,
    /// Median relative error of the depths.
    error: f64,
}

/// The map of a view, with its values and the depths of points at the same places.
struct LoadedMap {
    grid: DepthGrid,
    pairs: Vec<[f64; 2]>,
    /// Lines through the pairs, in the order of [`ValueKind::BOTH`]; `None` if there are too few pairs.
    lines: Option<[Line; 2]>,
}

impl DepthMaps {
    /// Whether any training view has a map.
    pub fn are_given(dataset: &Dataset) -> bool {
        dataset
            .train
            .iter()
            .any(|view| dataset.views[*view].depth_map.is_some())
    }

    /// Reads the maps of the training views and fits them to the points that these see.
    pub fn read(dataset: &Dataset) -> Self {
        let read = |view: &usize| {
            let view = &dataset.views[*view];
            let source = view.depth_map.as_ref()?;
            let grid = caught(&view.name, || source.load());
            Some(grid.map(|grid| {
                let pairs = pairs(dataset, view, &grid);
                let enough = pairs.len() >= MIN_POINTS;
                LoadedMap {
                    lines: enough.then(|| ValueKind::BOTH.map(|values| Line::fit(&pairs, values))),
                    pairs,
                    grid,
                }
            }))
        };
        let maps: Vec<_> = dataset.train.par_iter().map(read).collect();
        let given = maps.iter().flatten().count();
        let unreadable = maps.iter().flatten().find_map(|map| map.as_ref().err());
        let broken = unreadable.map(|error| format!("; {error}")).unwrap_or_default();
        let lines: Vec<[Line; 2]> = maps.iter().flatten().flatten().filter_map(|map| map.lines).collect();
        let errors = [0, 1].map(|i| lines.iter().map(|lines| lines[i].error).collect::<Vec<f64>>());
        let fitted = (!lines.is_empty()).then(|| errors.map(median));
        let values = match fitted {
            Some([of_depths, of_inverses]) if of_inverses < of_depths => ValueKind::Inverses,
            _ => ValueKind::Depths,
        };
        let mut by_view: Vec<Option<UsableMap>> = dataset.views.iter().map(|_| None).collect();
        for (view, map) in dataset.train.iter().zip(maps) {
            let Some(Ok(map)) = map else { continue };
            by_view[*view] = match map.lines {
                Some(lines) => {
                    let line = lines[values as usize];
                    line.is_accurate().then(|| map.in_world(&line, values))
                }
                // Without points, only depths can be used.
                None => (values == ValueKind::Depths).then_some(UsableMap {
                    grid: map.grid,
                    kind: DepthKind::Relative,
                }),
            };
        }
        let used = by_view.iter().flatten().count();
        let kind = match values {
            ValueKind::Depths => "depths",
            ValueKind::Inverses => "inverse depths",
        };
        let fit = match fitted {
            Some(errors) => format!(
                "{kind}, within {:.1} % of the points in the median",
                100.0 * errors[values as usize]
            ),
            None => "taken for depths, up to scale and shift".to_owned(),
        };
        Self {
            by_view,
            summary: format!("{used} of {given} given maps of depth are used ({fit}){broken}"),
        }
    }

    /// Whether no map can be used.
    pub fn is_empty(&self) -> bool {
        self.by_view.iter().all(Option::is_none)
    }

    /// The depths of `view` at the pixels of `camera`, and their kind.
    pub fn samples(&self, view: usize, camera: &Camera) -> Option<(Vec<DepthSample>, DepthKind)> {
        let UsableMap { grid, kind } = self.by_view.get(view)?.as_ref()?;
        let k = &camera.intrinsics;
        let known = grid.pixels(k.width, k.height).filter(|(_, depth)| is_known(**depth));
        let samples = known.map(|([x, y], depth)| DepthSample {
            pixel: y * k.width + x,
            depth: *depth,
            // Errors count relative to the depth.
            weight: 1.0 / depth,
        });
        Some((samples.collect(), *kind))
    }
}

impl LoadedMap {
    /// The map with depths in world units; 0 where they are unknown or extrapolated.
    fn in_world(mut self, line: &Line, values: ValueKind) -> UsableMap {
        let depths = self.pairs.iter().map(|[_, depth]| *depth as f32);
        let (nearest, farthest) = depths.fold((f32::INFINITY, 0f32), |(near, far), z| (near.min(z), far.max(z)));
        let range = nearest / MAX_EXTRAPOLATION..=farthest * MAX_EXTRAPOLATION;
        for value in &mut self.grid.values {
            let depth = line.depth(f64::from(*value), values) as f32;
            *value = if is_known(*value) && range.contains(&depth) {
                depth
            } else {
                0.0
            };
        }
        UsableMap {
            grid: self.grid,
            kind: DepthKind::Metric,
        }
    }
}

impl Line {
    /// The line through `[value, depth]` with the least absolute errors, relative to the depth. Its error is infinite if its scale is not
    /// positive.
    fn fit(pairs: &[[f64; 2]], values: ValueKind) -> Self {
        let target = |z: f64| match values {
            ValueKind::Depths => z,
            ValueKind::Inverses => 1.0 / z,
        };
        let mut line = Self::theil_sen(pairs.iter().map(|[value, z]| [*value, target(*z)]).collect());
        for _ in 0..FIT_ITERATIONS {
            let (mut w, mut x, mut y, mut xx, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
            for [value, z] in pairs {
                let t = target(*z);
                let residual = (line.scale * value + line.shift) / t - 1.0;
                let weight = 1.0 / (residual.abs().max(MIN_RESIDUAL) * t * t);
                (w, x, y) = (w + weight, x + weight * value, y + weight * t);
                (xx, xy) = (xx + weight * value * value, xy + weight * value * t);
            }
            let determinant = w * xx - x * x;
            if determinant <= 1e-12 * w * xx {
                break;
            }
            line.scale = (w * xy - x * y) / determinant;
            line.shift = (y - line.scale * x) / w;
        }
        let error = |[value, z]: &[f64; 2]| match line.depth(*value, values) {
            depth if depth > 0.0 => (depth / z - 1.0).abs(),
            _ => f64::INFINITY,
        };
        if line.scale > 0.0 {
            line.error = median(pairs.iter().map(error).collect());
        }
        line
    }

    /// A line that is robust to wrong pairs, up to a quarter of all: the median of the slopes between values of the lower half and those of
    /// the upper half (Theil 1950, Sen 1968), and the median shift.
    fn theil_sen(mut pairs: Vec<[f64; 2]>) -> Self {
        pairs.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let (lower, upper) = pairs.split_at(pairs.len() / 2);
        let rises = lower.iter().zip(upper).filter(|(a, b)| b[0] > a[0]);
        let slopes: Vec<f64> = rises.map(|(a, b)| (b[1] - a[1]) / (b[0] - a[0])).collect();
        let scale = if slopes.is_empty() { 0.0 } else { median(slopes) };
        Self {
            scale,
            shift: median(pairs.iter().map(|[value, t]| t - scale * value).collect()),
            error: f64::INFINITY,
        }
    }

    fn depth(&self, value: f64, values: ValueKind) -> f64 {
        let on_line = self.scale * value + self.shift;
        match values {
            ValueKind::Depths => on_line,
            ValueKind::Inverses => 1.0 / on_line,
        }
    }

    fn is_accurate(&self) -> bool {
        self.error < MAX_FIT_ERROR
    }
}

impl Trainer {
    /// Depths of the points that view `view` is known to see, if the plan uses them.
    pub(crate) fn known_depths(&self, view: usize, camera: &Camera, plan: &StepPlan) -> Vec<DepthSample> {
        let Some(points) = self
            .dataset
            .points
            .as_ref()
            .filter(|_| plan.value(Param::DepthWeight) > 0.0)
        else {
            return Vec::new();
        };
        let seen = &self.dataset.views[view].points_seen;
        seen.iter()
            .filter_map(|i| {
                let (pixel, depth) = camera.project(*points.positions.get(*i as usize)?)?;
                let [column, row] = [pixel.x.floor(), pixel.y.floor()];
                let k = &camera.intrinsics;
                let inside = (0.0..k.width as f32).contains(&column) && (0.0..k.height as f32).contains(&row);
                inside.then(|| DepthSample {
                    pixel: row as u32 * k.width + column as u32,
                    depth,
                    weight: 1.0,
                })
            })
            .collect()
    }

    /// Depths of the map given with the photograph of view `view`, if the plan uses them.
    pub(crate) fn given_depths(
        &mut self,
        view: usize,
        camera: &Camera,
        plan: &StepPlan,
    ) -> Option<(Vec<DepthSample>, DepthKind)> {
        if plan.value(Param::DepthMapWeight) <= 0.0 {
            return None;
        }
        // A resumed run reads them again.
        let maps = self.depth_maps.get_or_insert_with(|| DepthMaps::read(&self.dataset));
        maps.samples(view, camera)
    }
}

/// Whether a value of a map is known.
fn is_known(value: f32) -> bool {
    value > 0.0 && value.is_finite()
}

/// `[value, depth]` at each point that `view` sees.
fn pairs(dataset: &Dataset, view: &View, grid: &DepthGrid) -> Vec<[f64; 2]> {
    let Some(points) = &dataset.points else {
        return Vec::new();
    };
    let k = &view.camera.intrinsics;
    let cell = |at: f32, side: u32, cells: u32| {
        let index = (at / side as f32 * cells as f32).floor();
        (0.0..cells as f32).contains(&index).then_some(index as usize)
    };
    let pair = |point: &u32| {
        let (pixel, depth) = view.camera.project(*points.positions.get(*point as usize)?)?;
        let column = cell(pixel.x, k.width, grid.columns)?;
        let value = grid.values[cell(pixel.y, k.height, grid.rows)? * grid.columns as usize + column];
        (is_known(value) && depth > view.camera.near).then_some([f64::from(value), f64::from(depth)])
    };
    view.points_seen.iter().filter_map(pair).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};
    use irradia_scene::{GridSource, Intrinsics, LoadError, Photo, PointCloud, Pose, Rng};
    use std::sync::Arc;

    const CELLS: u32 = 32;

    struct Broken;

    impl GridSource<f32> for Broken {
        fn load(&self) -> Result<DepthGrid, LoadError> {
            Err(LoadError("depths/b.png: ends too early".into()))
        }
    }

    /// A source whose decoder has a bug.
    struct Panicking;

    impl GridSource<f32> for Panicking {
        fn load(&self) -> Result<DepthGrid, LoadError> {
            panic!("a decoder's bug")
        }
    }

    /// Depth of a slanted floor that the camera at the origin sees at these fractions of its image.
    fn floor(x: f32, y: f32) -> f32 {
        2.0 + 3.0 * x + 5.0 * y * y
    }

    fn camera() -> Camera {
        let pose = Pose {
            rotation: Quat::IDENTITY,
            position: Vec3::ZERO,
        };
        Camera::new(pose, Intrinsics::from_fov_x(64, 64, 1.0))
    }

    /// Views with these maps of the floor, of which all but those in `blind` see its points.
    fn dataset(maps: Vec<Option<Arc<dyn GridSource<f32>>>>, blind: &[usize]) -> Dataset {
        let (camera, mut rng) = (camera(), Rng::new(3, 3));
        let mut positions = Vec::new();
        for i in 0..200 {
            let [x, y] = [rng.uniform(), rng.uniform()];
            // One in ten points is wrong.
            let z = if i % 10 == 0 { 20.0 } else { floor(x, y) };
            let k = &camera.intrinsics;
            let ray = Vec3::new((64.0 * x - k.cx) / k.fx, (64.0 * y - k.cy) / k.fy, 1.0);
            positions.push(ray * z);
        }
        let photo = Photo {
            width: 64,
            height: 64,
            channels: 3,
            data: vec![0; 3 * 64 * 64],
            mask: None,
        };
        let view = |(i, depth_map): (usize, Option<Arc<dyn GridSource<f32>>>)| View {
            points_seen: if blind.contains(&i) { vec![] } else { (0..200).collect() },
            depth_map,
            ..View::new(format!("{i}.png"), camera, Arc::new(photo.clone()))
        };
        let views: Vec<View> = maps.into_iter().enumerate().map(view).collect();
        Dataset {
            train: (0..views.len()).collect(),
            views,
            points: Some(PointCloud {
                colors: vec![[0; 3]; positions.len()],
                positions,
            }),
            ..Dataset::default()
        }
    }

    /// A map whose values are those of the floor changed by `of`.
    fn map(of: impl Fn(f32) -> f32) -> Option<Arc<dyn GridSource<f32>>> {
        let place = |at: u32| (at as f32 + 0.5) / CELLS as f32;
        let cells = (0..CELLS * CELLS).map(|i| floor(place(i % CELLS), place(i / CELLS)));
        Some(Arc::new(DepthGrid {
            columns: CELLS,
            rows: CELLS,
            values: cells.map(of).collect(),
        }))
    }

    /// Largest relative error of the depths of `view`.
    fn worst(maps: &DepthMaps, view: usize) -> f32 {
        let (samples, kind) = maps.samples(view, &camera()).unwrap();
        assert_eq!(
            (samples.len(), kind),
            (CELLS as usize * CELLS as usize, DepthKind::Metric)
        );
        let error = |sample: &DepthSample| {
            let place = |at: u32| (at as f32) / 64.0;
            let wanted = floor(place(sample.pixel % 64), place(sample.pixel / 64));
            (sample.depth / wanted - 1.0).abs()
        };
        samples.iter().map(error).fold(0.0, f32::max)
    }

    #[test]
    fn maps_of_depth_and_of_its_inverse_are_told_apart_and_fitted_to_the_points() {
        let depths = DepthMaps::read(&dataset(vec![map(|z| 40.0 * z + 30.0), map(|z| 9.0 * z)], &[]));
        let inverses = DepthMaps::read(&dataset(vec![map(|z| 200.0 / z + 11.0), map(|z| 9.0 / z - 0.5)], &[]));
        for (maps, kind) in [(depths, "(depths, within"), (inverses, "(inverse depths, within")] {
            assert!(
                maps.summary.starts_with("2 of 2 given maps") && maps.summary.contains(kind),
                "{}",
                maps.summary
            );
            // Points are between the centres of cells, which are 1/32 of the image apart; over this distance depths change by up to a
            // fifth.
            assert!(
                worst(&maps, 0) < 0.05 && worst(&maps, 1) < 0.05,
                "{} {}",
                worst(&maps, 0),
                worst(&maps, 1)
            );
        }
    }

    #[test]
    fn maps_that_cannot_be_read_or_show_something_else_do_not_count() {
        let mut rng = Rng::new(1, 1);
        let noise: Vec<f32> = (0..CELLS * CELLS).map(|_| rng.range(1.0, 9.0)).collect();
        let noise = DepthGrid {
            columns: CELLS,
            rows: CELLS,
            values: noise,
        };
        let given = vec![
            map(|z| z),
            Some(Arc::new(Broken) as _),
            Some(Arc::new(noise) as _),
            None,
        ];
        let maps = DepthMaps::read(&dataset(given, &[]));
        assert!(maps.summary.starts_with("1 of 3 given maps"), "{}", maps.summary);
        assert!(
            maps.summary.ends_with("depths/b.png: ends too early"),
            "{}",
            maps.summary
        );
        let counts = |view| maps.samples(view, &camera()).is_some();
        assert_eq!([0, 1, 2, 3].map(counts), [true, false, false, false]);
    }

    #[test]
    fn a_map_on_which_the_decoder_panics_is_one_that_cannot_be_read() {
        let maps = DepthMaps::read(&dataset(vec![map(|z| z), Some(Arc::new(Panicking))], &[]));
        assert!(maps.summary.starts_with("1 of 2 given maps"), "{}", maps.summary);
        assert!(
            maps.summary.contains("1.png: the image decoder failed"),
            "{}",
            maps.summary
        );
    }

    #[test]
    fn without_points_maps_are_depths_up_to_scale_and_shift() {
        let maps = DepthMaps::read(&dataset(vec![map(|z| 7.0 * z), map(|_| 0.0)], &[0, 1]));
        let (samples, kind) = maps.samples(0, &camera()).unwrap();
        assert_eq!((samples.len(), kind), (1024, DepthKind::Relative));
        assert!(maps.samples(1, &camera()).unwrap().0.is_empty(), "nothing is known");
        // If the other maps are inverse depths, a map without points is not used.
        let maps = DepthMaps::read(&dataset(vec![map(|z| 1.0 / z), map(|z| 1.0 / z)], &[1]));
        assert!(maps.samples(0, &camera()).is_some() && maps.samples(1, &camera()).is_none());
    }
}
