//! Parameters that depend on the data, decided before the first step.
//!
//! - **Known space.** A scene that begins with splats at random positions needs pressure on opacities, since floaters in front of the
//!   cameras fade only under it. Where points show the surfaces, or alpha or masks show what is empty, the same pressure makes surfaces
//!   transparent.
//! - **Cut-outs.** Masks leave out pixels: of people, of a watermark, or of everything but an object. In the last case nothing says that
//!   the space around the object is empty, and floaters there are in front of it in other photographs.
//! - **Skies.** Photographs taken on many days have skies that one scene cannot show; splats explain them by fog around everything in front
//!   of the sky.
//! - **Many large photographs.** The time of a step is proportional to their pixels: what is visible at half and quarter size is learned at
//!   these sizes.
//! - **Wide lenses.** In a fisheye photograph that keeps its distortion, pixels cover other angles than in the views that are rendered
//!   later: splats must look the same at all of them.
//! - **Depth and normal maps.** They are read, and have a weight only if some of them can be used.
//! - **Sparse photographs.** A few photographs do not determine what they show: steps beyond those that the scene takes to appear only fit
//!   splats to single photographs.

use crate::depth_maps::DepthMaps;
use crate::first_splats::has_points;
use crate::normal_maps::NormalMaps;
use crate::photos::caught;
use crate::recipe::{Param, Params};
use crate::robust::median;
use crate::schedule::Clock;
use crate::trainer::{TrainError, Trainer};
use glam::Vec3;
use irradia_scene::{Photo, View};

/// Maximum number of training photographs that are examined, evenly spaced.
const MAX_EXAMINED_PHOTOS: usize = 24;
/// Longer side at which they are read, pixels.
const SAMPLE_SIDE: u32 = 96;
/// Minimum fraction of the photographs that are cut-outs, or have a sky.
const MIN_PHOTO_FRACTION: f64 = 0.75;
/// Maximum fraction of a cut-out's pixels that its mask keeps, and minimum fraction of its outermost pixels that the mask leaves out.
const MAX_KEPT_FRACTION: f64 = 0.5;
const MIN_BORDER_FRACTION: f64 = 0.6;
/// Minimum fraction of its bounding box that a mask keeps if it keeps an upright rectangle, allowing for undistortion.
const MIN_RECTANGLE_FILL: f64 = 0.95;
/// Minimum fraction of a photograph that a sky covers.
const MIN_SKY_FRACTION: f64 = 0.1;
/// Minimum cosine of the angle between a photograph's up direction and the mean of all for its upper edge to show a sky: a panorama's face
/// that looks down has the floor there.
const MIN_UP_COSINE: f32 = 0.5;
/// Maximum difference of a channel between adjacent pixels of a sky, out of 255.
const MAX_SKY_STEP: u8 = 8;
/// Minimum standard deviation between photographs, both of their skies' colours and of these colours relative to their brightness, at which
/// each photograph needs its own sky. Measured: a statue by 135 cameras 0.19 and 0.19; eleven captures of one camera, with walls and
/// ceilings for skies, at most 0.11 and 0.08; fox with random exposures and white balances 0.19 and 0.10.
const MIN_SKY_SPREAD: f64 = 0.14;

/// Mean number of pixels of the training photographs above which they are large, and their minimum number: a few photographs are each seen
/// often in any case, and their quarters mislead. Held-out PSNR at 1600x758, 120 s of one thread: an object in 17 photographs 40.27 without
/// and 36.78 dB with `large`; captures of 62 to 148 photographs gain 0.3 to 0.7 dB.
const MIN_LARGE_PIXELS: f64 = 0.8e6;
const MIN_LARGE_PHOTOS: usize = 50;

/// Minimum angle between adjacent photographs, degrees, at which they are sparse. Held-out PSNR of `fast` at 240 pixels with the usual
/// 3,000 steps and with 1,200 and `depth_weight` 0.5: fox, 12 photographs 13 degrees apart, 28.2 and 28.7; 6, 29 degrees apart, 24.1 and
/// 24.9; cup, 12, 27 degrees apart, 26.4 and 26.6. With 750 steps: fox, 24 photographs 7 degrees apart, 32.7 and 31.6; lund_door, 6
/// photographs 5 degrees apart, 35.3 and 34.3; fern, 6 photographs 2 degrees apart, 27.7 and 26.7. With 90 steps per photograph, 480
/// pixels: a book on a table, 6 photographs 9.4 degrees apart, 18.4 and 21.3; toys, 7 photographs 8.1 degrees apart, 24.0 and 24.2.
pub(crate) const SPARSE_ANGLE_DEGREES: f64 = 8.0;
/// For closer photographs, the limit on the steps of each is inversely proportional to the angle between them, and never below the usual
/// number of steps. `fast` at 320 pixels with 1,000, 2,000, 4,000 and 8,000 steps: a bust, 22 photographs 6.5 degrees apart, 25.77, 25.46,
/// 24.35, 23.83; a locomotive, 18, 4.5 degrees, 23.86, 24.23, 24.10, 23.45; a toy, 17, 3.3 degrees, 30.27, 31.42, 31.16, 30.93; fern, 17,
/// 2.1 degrees, 30.20, 30.65, 30.52, 30.23; but a drone's film, 17, 0.56 degrees, 26.38, 26.62, 26.74, 26.79; a corridor, 16, 0.06 degrees,
/// 37.41, 38.44 with the last two. At this angle, degrees, the limit stops growing: it is too high to matter.
const MIN_SPACING_DEGREES: f64 = 0.01;

/// Whether the mask of `photo` leaves out all but an object. A mask that keeps an upright rectangle does not count: that is an image
/// between bars.
fn is_cut_out(photo: &Photo) -> bool {
    let Some(mask) = &photo.mask else { return false };
    let width = photo.width as usize;
    let (mut kept, [mut left, mut top, mut right, mut bottom]) = (0, [usize::MAX, usize::MAX, 0, 0]);
    for at in (0..mask.len()).filter(|at| mask[*at] != 0) {
        let (x, y) = (at % width, at / width);
        kept += 1;
        (left, right) = (left.min(x), right.max(x + 1));
        (top, bottom) = (top.min(y), bottom.max(y + 1));
    }
    if kept == 0 {
        return false;
    }
    let (kept, rectangle) = (f64::from(kept), ((right - left) * (bottom - top)) as f64);
    kept < MIN_RECTANGLE_FILL * rectangle
        && kept <= MAX_KEPT_FRACTION * mask.len() as f64
        && photo.border_left_out() >= MIN_BORDER_FRACTION
}

/// The mean colour, in \[0, 1\], of the smooth region at the upper edge of `photo`, if it is large enough for a sky.
fn sky_color(photo: &Photo) -> Option<[f64; 3]> {
    let (width, height, channels) = (photo.width as usize, photo.height as usize, photo.channels as usize);
    let color = |at: usize| &photo.data[channels * at..channels * at + 3];
    let counts = |at: usize| photo.mask.as_ref().is_none_or(|mask| mask[at] != 0);
    let mut seen: Vec<bool> = (0..width * height).map(|at| at < width && counts(at)).collect();
    let mut edge: Vec<usize> = (0..width).filter(|at| seen[*at]).collect();
    let (mut sum, mut count) = ([0u64; 3], 0u64);
    while let Some(at) = edge.pop() {
        for (sum, value) in sum.iter_mut().zip(color(at)) {
            *sum += u64::from(*value);
        }
        count += 1;
        let (x, y) = (at % width, at / width);
        let adjacent = [
            (x > 0).then(|| at - 1),
            (x + 1 < width).then_some(at + 1),
            (y > 0).then(|| at - width),
            (y + 1 < height).then_some(at + width),
        ];
        for next in adjacent.into_iter().flatten() {
            let mut steps = color(at).iter().zip(color(next)).map(|(a, b)| a.abs_diff(*b));
            if !seen[next] && counts(next) && steps.all(|step| step <= MAX_SKY_STEP) {
                seen[next] = true;
                edge.push(next);
            }
        }
    }
    let covers = count as f64 >= MIN_SKY_FRACTION * (width * height) as f64;
    covers.then(|| sum.map(|sum| sum as f64 / (255 * count) as f64))
}

/// Whether the `colors` of skies found in `photographs` photographs are too different for one scene.
fn skies_differ(colors: &[[f64; 3]], photographs: usize) -> bool {
    if colors.len() < 2 || (colors.len() as f64) < MIN_PHOTO_FRACTION * photographs as f64 {
        return false;
    }
    // The largest of the channels' standard deviations.
    let spread = |of: &dyn Fn(&[f64; 3]) -> [f64; 3]| {
        let values: Vec<[f64; 3]> = colors.iter().map(of).collect();
        let deviation = |c: usize| {
            let mean = values.iter().map(|v| v[c]).sum::<f64>() / values.len() as f64;
            let variance = values.iter().map(|v| (v[c] - mean).powi(2)).sum::<f64>() / values.len() as f64;
            variance.sqrt()
        };
        (0..3).map(deviation).fold(0.0, f64::max)
    };
    let balance = |color: &[f64; 3]| {
        let brightness = color.iter().sum::<f64>() / 3.0;
        color.map(|v| v / brightness.max(0.05))
    };
    spread(&|color| *color) >= MIN_SKY_SPREAD && spread(&balance) >= MIN_SKY_SPREAD
}

impl Trainer {
    /// Adds one line to what the run reports about its data at the start: [`Event::Decided`](crate::event::Event::Decided).
    pub fn add_decision(&mut self, decision: String) {
        self.decisions.push(decision);
    }

    /// Puts the recipe's parameters into effect for the conditions that the data meet. They are changed in the recipe, so that a resumed
    /// run has the same values.
    pub(crate) fn apply_data_conditions(&mut self) -> Result<(), TrainError> {
        let [large, mut skies, known_space, cut_out] = [
            std::mem::take(&mut self.recipe.large),
            std::mem::take(&mut self.recipe.skies),
            std::mem::take(&mut self.recipe.known_space),
            std::mem::take(&mut self.recipe.cut_out),
        ];
        let (mut cut_outs, mut photographs) = (0usize, 0usize);
        let (mut sky_colors, mut upright) = (Vec::new(), 0usize);
        if !(skies.is_empty() && cut_out.is_empty()) {
            let every = self.dataset.train.len().div_ceil(MAX_EXAMINED_PHOTOS);
            let up = |view: &View| view.camera.pose.rotation * Vec3::NEG_Y;
            let train = self.dataset.train.iter().map(|view| &self.dataset.views[*view]);
            let mean_up = train.clone().map(up).sum::<Vec3>().normalize_or_zero();
            for view in train.step_by(every) {
                let k = &view.camera.intrinsics;
                let small = k.scaled((SAMPLE_SIDE as f32 / k.width.max(k.height) as f32).min(1.0));
                // A photograph that cannot be read makes the first step fail, from which the run can be resumed.
                let Ok(photo) = caught(&view.name, || view.photo.load_at(small.width, small.height)) else {
                    continue;
                };
                photographs += 1;
                // The mask of a wide lens is that of its image circle.
                cut_outs += usize::from(!k.lens.is_wide() && is_cut_out(&photo));
                if up(view).dot(mean_up) >= MIN_UP_COSINE {
                    upright += 1;
                    sky_colors.extend(sky_color(&photo).filter(|_| photo.channels == 3));
                }
            }
        }
        let are_cut_out = photographs > 0 && cut_outs as f64 >= MIN_PHOTO_FRACTION * photographs as f64;
        let known = if has_points(&self.dataset) {
            Some("points show the surfaces")
        } else if are_cut_out {
            Some("masks show the empty space")
        } else if !known_space.is_empty() && self.transparent()? {
            Some("alpha shows the empty space")
        } else {
            None
        };
        if !are_cut_out && skies_differ(&sky_colors, upright) {
            // What is known about the space takes precedence.
            skies.retain(|param, _| known.is_none() || !known_space.contains_key(param));
            self.apply_params("the sky differs from photograph to photograph", "skies", skies);
        }
        if let Some(why) = known {
            self.apply_params(why, "known_space", known_space);
        }
        if are_cut_out {
            self.apply_params("masks leave out all but an object", "cut_out", cut_out);
        }
        // With wide lenses even large photographs have few pixels per angle.
        if self.pixels > MIN_LARGE_PIXELS && self.dataset.train.len() >= MIN_LARGE_PHOTOS && !self.has_wide_lenses() {
            self.apply_params("photographs are large", "large", large);
        }
        self.adapt_to_wide_lenses();
        self.report_shutters();
        self.limit_sparse_steps();
        self.prepare_maps();
        // The clock carries the values of parameters from stage to stage, and must start with the new ones.
        self.clock = Clock::new(&self.recipe);
        Ok(())
    }

    /// Reads the depth and normal maps if the recipe gives them a weight. If none can be used, the weight is removed: frames then need no
    /// depth for them.
    fn prepare_maps(&mut self) {
        if DepthMaps::are_given(&self.dataset) && self.recipe.uses(Param::DepthMapWeight) {
            let maps = DepthMaps::read(&self.dataset);
            self.decisions.push(maps.summary.clone());
            self.depth_maps = Some(maps).filter(|maps| !maps.is_empty());
        }
        if self.depth_maps.is_none() {
            self.recipe.params.remove(&Param::DepthMapWeight);
        }
        if NormalMaps::are_given(&self.dataset) && self.recipe.uses(Param::NormalMapWeight) {
            let maps = NormalMaps::read(&self.dataset);
            self.decisions.push(maps.summary.clone());
            self.normal_maps = Some(maps).filter(|maps| !maps.is_empty());
        }
        if self.normal_maps.is_none() {
            self.recipe.params.remove(&Param::NormalMapWeight);
        }
    }

    fn adapt_to_wide_lenses(&mut self) {
        if self.has_wide_lenses() && !self.recipe.render.antialias {
            self.recipe.render.antialias = true;
            self.decisions
                .push("photographs of wide lenses keep their distortion: splats are antialiased".into());
        }
    }

    /// Reports how fast cameras move, so that velocities in a wrong unit are noticed.
    fn report_shutters(&mut self) {
        let (train, views) = (&self.dataset.train, &self.dataset.views);
        let shutters = train.iter().filter_map(|view| views[*view].camera.shutter);
        let turns: Vec<f64> = shutters.map(|shutter| f64::from(shutter.rotation.length())).collect();
        if !turns.is_empty() {
            self.decisions.push(format!(
                "{} of {} cameras move while their rows are exposed (rolling shutter), and turn by a median of {:.2} degrees",
                turns.len(),
                train.len(),
                median(turns).to_degrees()
            ));
        }
    }

    /// Whether some training photographs were taken with wide lenses and are not cut into faces.
    fn has_wide_lenses(&self) -> bool {
        let mut train = self.dataset.train.iter();
        train.any(|view| self.dataset.views[*view].camera.intrinsics.lens.is_wide())
    }

    /// Maximum number of steps per training photograph in a run without a given number of steps, 0 for no limit: the recipe's
    /// `sparse_visits`, and more for closer photographs.
    pub(crate) fn max_visits(&self) -> u64 {
        let (visits, spacing) = (self.recipe.sparse_visits, self.spacing.to_degrees());
        if visits == 0 || spacing >= SPARSE_ANGLE_DEGREES {
            return visits;
        }
        let own = self
            .recipe
            .total_steps()
            .div_ceil(self.dataset.train.len().max(1) as u64);
        own.max((visits as f64 * SPARSE_ANGLE_DEGREES / spacing.max(MIN_SPACING_DEGREES)) as u64)
    }

    fn limit_sparse_steps(&mut self) {
        let spacing = self.spacing.to_degrees();
        if self.recipe.sparse_visits == 0 || spacing < SPARSE_ANGLE_DEGREES {
            return;
        }
        let (total, min_pace) = (self.total_steps(), self.min_pace());
        if self.options.steps.is_none() && min_pace > self.pace {
            self.pace = min_pace;
            self.decisions.push(format!(
                "adjacent photographs are {spacing:.0} degrees apart: at most {} steps instead of {total}, since more would only fit single photographs (--steps sets another number)",
                self.total_steps()
            ));
        }
    }

    fn apply_params(&mut self, why: &str, table: &str, params: Params) {
        if params.is_empty() {
            return;
        }
        let names: Vec<&str> = params.keys().map(|param| param.name()).collect();
        self.decisions
            .push(format!("{why}: {} as in [{table}] of the recipe", names.join(", ")));
        self.recipe.params.extend(params);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::Recipe;
    use crate::recipe::Knob;
    use crate::trainer::{TrainOptions, Trainer};
    use glam::Vec3;
    use irradia_scene::{
        Camera, Dataset, DepthGrid, GridSource, Intrinsics, Lens, LoadError, Photo, PointCloud, Pose, View,
    };
    use std::sync::Arc;

    /// One grey photograph of `channels` channels, with or without points.
    pub(crate) fn dataset(channels: u32, points: bool) -> Arc<Dataset> {
        let view = View::new(
            "a",
            Camera::new(
                Pose::look_at(Vec3::NEG_Z, Vec3::ZERO, Vec3::NEG_Y),
                Intrinsics::from_fov_x(8, 8, 1.0),
            ),
            Arc::new(Photo {
                width: 8,
                height: 8,
                channels,
                data: vec![128; 64 * channels as usize],
                mask: None,
            }),
        );
        let positions: Vec<Vec3> = (0..12).map(|i| Vec3::new(0.1 * i as f32, 0.0, 1.0)).collect();
        Arc::new(Dataset {
            views: vec![view],
            train: vec![0],
            points: points.then(|| PointCloud {
                colors: vec![[128; 3]; positions.len()],
                positions,
            }),
            ..Dataset::default()
        })
    }

    #[test]
    fn parameters_for_known_space_hold_where_points_or_alpha_show_it() {
        let trained = |channels, points, set: &[&str]| {
            let set: Vec<String> = set.iter().map(|s| (*s).to_owned()).collect();
            let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &set).unwrap();
            let usual = recipe.params[&Param::OpacityReg].clone();
            let given = recipe.known_space.get(&Param::OpacityReg).cloned();
            let trainer = Trainer::new(dataset(channels, points), recipe, TrainOptions::default()).unwrap();
            assert!(trainer.recipe.known_space.is_empty(), "settled");
            let reported = trainer.decisions.iter().any(|line| line.contains("opacity_reg"));
            let value = trainer.recipe.params[&Param::OpacityReg].clone();
            assert_eq!(reported, value != usual);
            (value, usual, given)
        };
        for (channels, points) in [(3, true), (4, false), (4, true)] {
            let (value, _, given) = trained(channels, points, &[]);
            assert_eq!(Some(value), given, "{channels} {points}");
        }
        let (value, usual, _) = trained(3, false, &[]);
        assert_eq!(value, usual);
        for set in ["params.opacity_reg=0.5", "params.opacity_reg = 0.5"] {
            let (value, ..) = trained(3, true, &[set]);
            assert_eq!(value, Knob::Const(0.5), "what is set prevails");
        }
        let (value, ..) = trained(3, true, &["known_space.opacity_reg=0.3"]);
        assert_eq!(value, Knob::Const(0.3));
    }

    #[test]
    fn large_photographs_are_learned_from_smaller_ones_first() {
        let scales = |count: usize, [width, height]: [u32; 2], lens: Lens, set: &[String]| {
            let mut data = (*dataset(3, true)).clone();
            let intrinsics = &mut data.views[0].camera.intrinsics;
            *intrinsics = Intrinsics {
                lens,
                ..Intrinsics::from_fov_x(width, height, 1.0)
            };
            data.views = vec![data.views[0].clone(); count];
            data.train = (0..count).collect();
            let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), set).unwrap();
            let large = recipe.large.get(&Param::ImageScale).cloned();
            let trainer = Trainer::new(Arc::new(data), recipe, TrainOptions::default()).unwrap();
            let reported = trainer.decisions.iter().any(|line| line.contains("[large]"));
            let scales = trainer.recipe.params[&Param::ImageScale].clone();
            assert_eq!(reported, Some(&scales) == large.as_ref());
            (reported, scales)
        };
        assert!(scales(50, [1200, 900], Lens::Pinhole, &[]).0);
        assert!(!scales(50, [800, 800], Lens::Pinhole, &[]).0);
        assert!(!scales(49, [1200, 900], Lens::Pinhole, &[]).0);
        assert!(
            !scales(50, [1600, 1600], Lens::fisheye([0.0; 4]), &[]).0,
            "few pixels per angle"
        );
        let set = ["params.image_scale=0.75".to_owned()];
        assert_eq!(scales(50, [1200, 900], Lens::Pinhole, &set), (false, Knob::Const(0.75)));
    }

    #[test]
    fn maps_of_depth_are_weighed_only_where_some_can_be_used() {
        struct Broken;
        impl GridSource<f32> for Broken {
            fn load(&self) -> Result<DepthGrid, LoadError> {
                Err(LoadError("depths/a.png: ends too early".into()))
            }
        }
        let settled = |map: Option<Arc<dyn GridSource<f32>>>| {
            let mut data = (*dataset(3, true)).clone();
            data.views[0].depth_map = map;
            let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &[]).unwrap();
            let trainer = Trainer::new(Arc::new(data), recipe, TrainOptions::default()).unwrap();
            let reported = trainer
                .decisions
                .iter()
                .find(|line| line.contains("maps of depth"))
                .cloned();
            (reported, trainer.recipe.params.contains_key(&Param::DepthMapWeight))
        };
        assert_eq!(settled(None), (None, false));
        let (reported, weighed) = settled(Some(Arc::new(Broken)));
        assert!(reported.unwrap().starts_with("0 of 1") && !weighed);
        let (reported, weighed) = settled(Some(Arc::new(DepthGrid {
            columns: 2,
            rows: 1,
            values: vec![1.0, 2.0],
        })));
        assert!(reported.unwrap().starts_with("1 of 1") && weighed);
    }

    #[test]
    fn a_run_of_sparse_photographs_is_shorter_unless_its_length_is_given() {
        let around = |count: usize| {
            let mut data = (*dataset(3, true)).clone();
            let view = data.views[0].clone();
            let place = |i: usize| {
                let angle = std::f32::consts::TAU * i as f32 / count as f32;
                let eye = glam::Vec3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 0.0);
                let mut view = view.clone();
                view.camera.pose = irradia_scene::Pose::look_at(eye, glam::Vec3::ZERO, glam::Vec3::Z);
                view
            };
            data.views = (0..count).map(place).collect();
            data.train = (0..count).collect();
            Arc::new(data)
        };
        let trainer = |count, steps| {
            let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &[]).unwrap();
            let options = TrainOptions {
                steps,
                ..TrainOptions::default()
            };
            Trainer::new(around(count), recipe, options).unwrap()
        };
        let sparse = trainer(12, None);
        assert_eq!(sparse.total_steps(), 1080);
        assert!(
            sparse
                .decisions
                .iter()
                .any(|line| line.contains("30 degrees") && line.contains("1080 steps"))
        );
        // At least a fifth of the recipe's length.
        assert_eq!(trainer(4, None).total_steps(), 600);
        assert_eq!(trainer(12, Some(2000)).total_steps(), 2000);
        // Closer photographs have at least the recipe's length, and with a budget as many steps as their limit allows: 60 are 6 degrees
        // apart.
        let close = trainer(60, None);
        assert_eq!(close.total_steps(), 3000);
        assert!((3000.0 / close.min_pace() / (60.0 * 90.0 * 8.0 / 6.0) - 1.0).abs() < 0.02);
        let few = trainer(48, None);
        assert!((3000.0 / few.min_pace() / (48.0 * 90.0 * 8.0 / 7.5) - 1.0).abs() < 0.02);
    }

    #[test]
    fn splats_in_photographs_of_a_fisheye_are_antialiased() {
        let antialiased = |lens: Lens| {
            let mut data = (*dataset(3, true)).clone();
            data.views[0].camera.intrinsics.lens = lens;
            let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &[]).unwrap();
            let trainer = Trainer::new(Arc::new(data), recipe, TrainOptions::default()).unwrap();
            let reported = trainer.decisions.iter().any(|line| line.contains("antialiased"));
            assert_eq!(reported, trainer.recipe.render.antialias);
            reported
        };
        assert!(antialiased(Lens::fisheye([0.0; 4])));
        assert!(!antialiased(Lens::Pinhole) && !antialiased(Lens::Fov { omega: 0.5 }));
    }

    /// A photograph of `width` x `height` with a colour for each pixel, and what its mask keeps.
    fn photo(
        [width, height]: [u32; 2],
        color: impl Fn(u32, u32) -> [u8; 3],
        kept: Option<&dyn Fn(u32, u32) -> bool>,
    ) -> Photo {
        let pixels = || (0..width * height).map(|i| (i % width, i / width));
        Photo {
            width,
            height,
            channels: 3,
            data: pixels().flat_map(|(x, y)| color(x, y)).collect(),
            mask: kept.map(|kept| pixels().map(|(x, y)| if kept(x, y) { 255 } else { 0 }).collect()),
        }
    }

    #[test]
    fn masks_of_objects_are_told_from_those_of_people_and_borders() {
        let masked = |kept: &dyn Fn(u32, u32) -> bool| is_cut_out(&photo([60, 90], |_, _| [99; 3], Some(kept)));
        // A statue that reaches the lower edge.
        assert!(masked(&|x, y| x.abs_diff(30) < y / 6 && y > 10));
        assert!(
            !masked(&|x, y| !((20..40).contains(&x) && y > 40)),
            "a person is left out"
        );
        assert!(
            !masked(&|x, y| (3..57).contains(&x) && (3..87).contains(&y)),
            "a border"
        );
        assert!(!masked(&|_, y| y > 40), "a sky");
        assert!(!masked(&|x, _| (20..40).contains(&x)), "bars on both sides");
        assert!(!masked(&|_, _| false), "nothing is kept");
        assert!(!is_cut_out(&photo([60, 90], |_, _| [99; 3], None)));
    }

    #[test]
    fn a_sky_is_what_is_smooth_at_the_upper_edge() {
        let sky = |x: u32, y: u32| [100 + y as u8, 150, 200 + (x / 9) as u8];
        let ground = |x: u32, y: u32| [(37 * x % 90) as u8, (53 * y % 90) as u8, 20];
        let horizon = |at: u32| {
            photo(
                [60, 80],
                move |x, y| if y < at { sky(x, y) } else { ground(x, y) },
                None,
            )
        };
        let [r, g, b] = sky_color(&horizon(41)).unwrap();
        assert!((r - 120.0 / 255.0).abs() < 0.01 && (g - 150.0 / 255.0).abs() < 1e-6 && (b - 0.797).abs() < 0.01);
        assert_eq!(sky_color(&horizon(5)), None);
        let hidden = photo([60, 80], sky, Some(&|_, y| y > 60));
        assert_eq!(sky_color(&hidden), None, "a masked sky does not count");
    }

    #[test]
    fn skies_of_other_days_differ_and_those_of_another_exposure_do_not() {
        let days = [
            [0.2, 0.4, 0.9],
            [0.5; 3],
            [0.9, 0.9, 0.85],
            [0.1, 0.3, 0.6],
            [0.8, 0.6, 0.5],
        ];
        assert!(skies_differ(&days, 5) && skies_differ(&days, 6) && !skies_differ(&days, 10));
        let exposures = [0.4, 0.7, 1.0, 1.3].map(|gain| [0.3 * gain, 0.45 * gain, 0.7 * gain]);
        assert!(
            !skies_differ(&exposures, 4),
            "colours relative to brightness are the same"
        );
        let dark = [[0.02, 0.03, 0.06], [0.06, 0.03, 0.03], [0.03, 0.06, 0.03]];
        assert!(!skies_differ(&dark, 3), "hues of what is nearly black");
        assert!(!skies_differ(&[], 0));
    }

    #[test]
    fn a_parameter_is_said_to_be_as_in_the_table_that_prevails() {
        let mut data = (*dataset(3, true)).clone();
        let days = [[50, 100, 230], [128; 3], [230, 230, 215], [25, 75, 150]];
        let view = |(i, color): (usize, [u8; 3])| {
            let mut view = data.views[0].clone();
            let eye = Vec3::new(0.3 * i as f32, 0.0, -1.0);
            view.camera.pose = Pose::look_at(eye, Vec3::ZERO, Vec3::NEG_Y);
            view.photo = Arc::new(Photo {
                width: 8,
                height: 8,
                channels: 3,
                data: color.repeat(64),
                mask: None,
            });
            view
        };
        data.views = days.into_iter().enumerate().map(view).collect();
        data.train = (0..4).collect();
        let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &[]).unwrap();
        let prevails = recipe.known_space[&Param::OpacityReg].clone();
        let trainer = Trainer::new(Arc::new(data), recipe, TrainOptions::default()).unwrap();
        assert_eq!(trainer.recipe.params[&Param::OpacityReg], prevails);
        let says = |table: &str| {
            let line = trainer.decisions.iter().find(|line| line.contains(table));
            line.expect("the table takes effect").contains("opacity_reg")
        };
        assert_eq!([says("[skies]"), says("[known_space]")], [false, true]);
    }

    #[test]
    fn masks_that_leave_out_all_but_an_object_take_effect_and_are_told() {
        let mut data = Dataset::clone(&dataset(3, true));
        let cut = |kept: &dyn Fn(u32, u32) -> bool| Arc::new(photo([8, 8], |_, _| [128; 3], Some(kept)));
        for (kept, cut_out) in [
            (
                &(|x: u32, y: u32| x.abs_diff(3) + y.abs_diff(4) < 3) as &dyn Fn(u32, u32) -> bool,
                true,
            ),
            (&|x, _| x != 3, false),
        ] {
            data.views[0].photo = cut(kept);
            let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &[]).unwrap();
            let mut trainer = Trainer::new(Arc::new(data.clone()), recipe, TrainOptions::default()).unwrap();
            assert_eq!(trainer.recipe.params.contains_key(&Param::MaskWeight), cut_out);
            assert_eq!(trainer.decisions.iter().any(|line| line.contains("[cut_out]")), cut_out);
            trainer.step(&mut Vec::new()).unwrap();
        }
    }
}
