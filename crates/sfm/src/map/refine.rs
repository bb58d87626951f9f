//! Bundle adjustment of a growing model.

use super::covering::covering;
use super::focal::{FocalSource, are_far_apart};
use super::model::GrowingModel;
use super::types::MapOptions;
use crate::adjust::{
    AdjustOptions, AdjustReport, AdjustedCamera, Focal, Freedom, Loss, Observation, Prior, Problem, View,
};
use crate::geometry::camera::DCamera;
use crate::geometry::pose::DPose;
use glam::DVec2;
use std::ops::Range;

/// Focal lengths, in long sides, that an adjustment may find whatever it began with: of 7 to 360 mm for a frame of 35 mm film.
const USUAL_FOCALS: Range<f64> = 0.2..10.0;
/// Ratios to the initial focal length that it may always find.
const NEAR_INITIAL: Range<f64> = 0.5..2.0;
/// The loss while the model grows and poses may be far off, and the final one, which gives wrong matches less weight.
const GROWING_LOSS: Loss = Loss::SoftL1(1.0);
const FINAL_LOSS: Loss = Loss::Cauchy(1.0);
/// Number of observations of a photograph, from long tracks, that are enough for an adjustment while the model grows.
const MIN_PHOTO_OBSERVATIONS: usize = 300;

/// Minimum number of registered photographs to adjust the focal length of every camera, even of one with a single photograph.
const MIN_ANCHORED_PHOTOS: usize = 5;

/// Cost of one standard deviation of an intrinsic parameter, as a squared error, px^2: that of ten observations that are off by one
/// pixel.
const PRIOR_COST: f64 = 10.0;

/// Which parts of the model an adjustment changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Extent {
    /// While growing: few points, focal length and one radial coefficient.
    Growing,
    /// All points, the full lens, and the principal point where that is free.
    Full,
    /// Like `Full`, until convergence.
    Final,
}

impl GrowingModel<'_> {
    /// Adjusts everything.
    pub fn adjust_all(&mut self, extent: Extent) -> AdjustReport {
        let points = self.triangulated_tracks();
        let chosen = if extent == Extent::Growing {
            self.covering_tracks(&points)
        } else {
            points.clone()
        };
        let mut problem = Problem::default();
        let mut view_of = vec![None; self.poses.len()];
        let reference_photos: Vec<usize> = self.reference_photos().collect();
        for reference in &reference_photos {
            self.add_views(&mut problem, *reference, self.held_poses[*reference], &mut view_of);
        }
        for group in 0..self.cameras.len() {
            problem.cameras.push(AdjustedCamera {
                camera: self.cameras[group],
                freedom: self.freedom(group, extent),
                prior: self.prior(group),
            });
        }
        self.add_points(&mut problem, &chosen, |_| false, &view_of);
        let (loss, iterations, tolerance) = match extent {
            Extent::Growing => (GROWING_LOSS, 8, 1e-3),
            Extent::Full => (FINAL_LOSS, 15, 1e-4),
            Extent::Final => (FINAL_LOSS, 30, 1e-5),
        };
        let options = AdjustOptions {
            loss,
            iterations,
            tolerance,
        };
        let report = self.solve(&mut problem, &options);
        for (reference, pose) in reference_photos.into_iter().zip(&problem.poses) {
            self.set_rig_pose(reference, *pose);
        }
        self.cameras = problem.cameras.iter().map(|adjusted| adjusted.camera).collect();
        for (track, point) in chosen.iter().zip(&problem.points) {
            self.points[*track] = Some(*point);
        }
        self.undistort();
        if chosen.len() < points.len() {
            self.refine_points(&points);
        }
        report
    }

    /// Adjusts a new photograph, its neighbours and its points; everything else is held fixed. Photographs on a rig move together.
    pub fn adjust_around(&mut self, photo: usize) {
        let local = self.neighbours(photo);
        let mut variable = vec![false; self.tracks.len()];
        for o in self.rigs[photo].iter().flat_map(|p| &self.tracks.of_photo[*p]) {
            let track = self.track_of(*o);
            variable[track] |= self.used[*o as usize] && self.points[track].is_some();
        }
        // Fixed points of neighbours anchor them.
        let mut is_listed = vec![false; self.tracks.len()];
        let mut tracks = Vec::new();
        for neighbour in &local {
            for o in self.rigs[*neighbour].iter().flat_map(|p| &self.tracks.of_photo[*p]) {
                let track = self.track_of(*o);
                if self.used[*o as usize] && !is_listed[track] {
                    is_listed[track] = true;
                    tracks.push(track);
                }
            }
        }
        tracks.sort_unstable();
        let mut problem = Problem::default();
        let mut view_of = vec![None; self.poses.len()];
        for neighbour in &local {
            self.add_views(&mut problem, *neighbour, self.held_poses[*neighbour], &mut view_of);
        }
        for other in self.reference_photos().filter(|reference| !local.contains(reference)) {
            self.add_views(&mut problem, other, true, &mut view_of);
        }
        problem.cameras = self
            .cameras
            .iter()
            .map(|c| AdjustedCamera::new(*c, Freedom::HELD))
            .collect();
        let group = self.photos[photo].group;
        // The camera is adjusted only if it has no other photograph that this could harm.
        let freedom = if self.registered_in_group(group) == 1 {
            self.freedom(group, Extent::Growing)
        } else {
            Freedom::HELD
        };
        if freedom != Freedom::HELD {
            problem.cameras[group] = AdjustedCamera {
                freedom,
                prior: self.prior(group),
                ..problem.cameras[group]
            };
        }
        self.add_points(&mut problem, &tracks, |track| !variable[track], &view_of);
        let options = AdjustOptions {
            loss: GROWING_LOSS,
            iterations: 6,
            tolerance: 1e-3,
        };
        self.solve(&mut problem, &options);
        for (reference, pose) in local.into_iter().zip(&problem.poses) {
            self.set_rig_pose(reference, *pose);
        }
        for (track, point) in tracks.iter().zip(&problem.points) {
            self.points[*track] = Some(*point);
        }
        if freedom != Freedom::HELD {
            self.cameras[group] = problem.cameras[group].camera;
            self.undistort();
        }
        self.filter(&tracks);
    }

    /// Whether there are several cameras whose focal lengths are guesses.
    pub(super) fn has_guessed_focals(&self) -> bool {
        let is_guess = |group: &usize| self.sources[*group] == FocalSource::Guess && !self.held_cameras[*group];
        (0..self.sources.len()).filter(is_guess).count() > 1
    }

    /// Whether the focal length of a camera is far from where it began.
    pub(super) fn is_far_from_initial_focals(&self) -> bool {
        let is_far = |group: &usize| are_far_apart(self.cameras[*group].focal(), self.initial_focals[*group]);
        (0..self.cameras.len())
            .filter(is_far)
            .any(|group| self.registered_in_group(group) > 0)
    }

    /// Multiplies the focal length of a group by `factor`.
    pub(super) fn scale_focal(&mut self, group: usize, factor: f64) {
        for focal in &mut self.cameras[group].parameters[..2] {
            *focal *= factor;
        }
        self.undistort();
    }

    /// The first photograph of each registered rig; a photograph without a rig is its own.
    fn reference_photos(&self) -> impl Iterator<Item = usize> {
        (0..self.poses.len()).filter(|p| self.poses[*p].is_some() && self.rigs[*p][0] == *p)
    }

    /// Adds the pose of the rig of `reference` and a view for each of its photographs, whose index is stored in `view_of`.
    fn add_views(&self, problem: &mut Problem, reference: usize, held: bool, view_of: &mut [Option<u32>]) {
        let Some(pose) = self.poses[reference] else { return };
        let number = problem.poses.len() as u32;
        problem.poses.push(DPose {
            rotation: pose.rotation * self.rig_from_camera(reference).inverse(),
            ..pose
        });
        problem.held_poses.push(held);
        for photo in &self.rigs[reference] {
            view_of[*photo] = Some(problem.views.len() as u32);
            problem.views.push(View {
                pose: number,
                camera: self.photos[*photo].group as u32,
                rig_from_camera: self.rig_from_camera(*photo),
            });
        }
    }

    /// The reference photographs of the rig of `photo` and of the rigs that share most points with it, at most
    /// [`MapOptions::local_photos`](super::MapOptions) in total.
    fn neighbours(&self, photo: usize) -> Vec<usize> {
        let reference = |photo: usize| self.rigs[photo][0];
        let mut shared = vec![0usize; self.poses.len()];
        for o in self.rigs[photo].iter().flat_map(|p| &self.tracks.of_photo[*p]) {
            if self.used[*o as usize] {
                for other in self.tracks.range(self.track_of(*o)).filter(|o| self.used[*o]) {
                    shared[reference(self.tracks.observations[other].photo as usize)] += 1;
                }
            }
        }
        shared[reference(photo)] = usize::MAX;
        let mut order: Vec<usize> = (0..shared.len())
            .filter(|p| shared[*p] > 0 && self.poses[*p].is_some())
            .collect();
        order.sort_by_key(|p| (std::cmp::Reverse(shared[*p]), *p));
        order.truncate(self.options.local_photos);
        order
    }

    /// Adds the points of `tracks` with their used observations; fixed points only with their observations in adjusted photographs.
    fn add_points(
        &self,
        problem: &mut Problem,
        tracks: &[usize],
        held: impl Fn(usize) -> bool,
        view_of: &[Option<u32>],
    ) {
        problem.starts.push(0);
        for track in tracks {
            let held = held(*track);
            for o in self.tracks.range(*track).filter(|o| self.used[*o]) {
                let Some(view) = view_of[self.tracks.observations[o].photo as usize] else {
                    continue;
                };
                if held && problem.held_poses[problem.views[view as usize].pose as usize] {
                    continue;
                }
                problem.observations.push(Observation {
                    view,
                    at: self.tracks.pixels[o],
                });
            }
            problem
                .points
                .push(self.points[*track].expect("listed tracks have points"));
            problem.held_points.push(held);
            problem.starts.push(problem.observations.len() as u32);
        }
    }

    /// A subset of `tracks`, long ones preferred, that is enough for an adjustment while the model grows; ascending.
    fn covering_tracks(&self, tracks: &[usize]) -> Vec<usize> {
        let photos_of = |track: usize| {
            let observations = self.tracks.range(track).filter(|o| self.used[*o]);
            observations.map(|o| self.tracks.observations[o].photo as usize)
        };
        let tracks = tracks.iter().copied();
        let mut chosen = covering(tracks, self.poses.len(), MIN_PHOTO_OBSERVATIONS, photos_of);
        chosen.sort_unstable();
        chosen
    }

    /// Which intrinsics of a group are adjusted, depending on the number of its photographs.
    fn freedom(&self, group: usize, extent: Extent) -> Freedom {
        if self.held_cameras[group] {
            return Freedom::HELD;
        }
        let count = self.registered_in_group(group);
        let full = extent != Extent::Growing && count >= self.options.full_lens_photos;
        // Other photographs anchor the points of a camera with few photographs.
        let min_photos = match self.sources[group] {
            _ if self.registered() >= MIN_ANCHORED_PHOTOS => 1,
            FocalSource::Prior => 4,
            FocalSource::Pairs | FocalSource::Guess => 3,
        };
        let focal_held = self.focal_held[group] || count < min_photos;
        let lens = lens_freedom(&self.cameras[group], count, focal_held, full);
        if self.principal_free && extent != Extent::Growing && !focal_held {
            lens.with_principal()
        } else {
            lens
        }
    }

    /// The prior on a group's camera.
    fn prior(&self, group: usize) -> Prior {
        // If the focal lengths of several cameras are guesses, each may differ much from the guess.
        let focal = if self.has_guessed_focals() && self.sources[group] == FocalSource::Guess {
            1.0
        } else {
            0.5
        };
        camera_prior(&self.cameras[group], self.initial_focals[group], focal)
    }

    /// Solves `problem`, whose cameras are those of the groups. If the adjusted values of a camera are not plausible, its poses and points
    /// are not either: the problem is solved again with this camera held, and its focal length is held from now on.
    fn solve(&mut self, problem: &mut Problem, options: &AdjustOptions) -> AdjustReport {
        loop {
            let mut solved = problem.clone();
            let report = solved.solve(options);
            let is_implausible = |group: &usize| {
                let AdjustedCamera { camera, freedom, .. } = &solved.cameras[*group];
                *freedom != Freedom::HELD && !has_plausible_values(camera, self.initial_focals[*group])
            };
            let implausible: Vec<usize> = (0..solved.cameras.len()).filter(is_implausible).collect();
            if implausible.is_empty() {
                *problem = solved;
                return report;
            }
            for group in implausible {
                problem.cameras[group].freedom = Freedom::HELD;
                self.focal_held[group] = true;
            }
        }
    }
}

/// Whether the focal length is usual or near the `initial` one, such as a telephoto lens's in metadata, and the lens distorts like those of
/// cameras.
fn has_plausible_values(camera: &DCamera, initial: f64) -> bool {
    let is_usual = USUAL_FOCALS.contains(&(camera.focal() / camera.long_side()));
    let is_near = NEAR_INITIAL.contains(&(camera.focal() / initial));
    (is_usual || is_near) && camera.parameters[4..].iter().all(|k| k.abs() < 1.0)
}

/// Which intrinsics of a finished model's camera are adjusted, depending on the number of its photographs: all but the principal point.
pub(super) fn final_freedom(camera: &DCamera, count: usize, focal_held: bool, options: &MapOptions) -> Freedom {
    lens_freedom(camera, count, focal_held, count >= options.full_lens_photos)
}

/// Which intrinsics of a camera with `count` photographs are adjusted: if `full`, all of [`DCamera`] but the principal point.
fn lens_freedom(camera: &DCamera, count: usize, focal_held: bool, full: bool) -> Freedom {
    Freedom {
        focal: match (focal_held, full) {
            (true, _) => Focal::Held,
            (false, false) => Focal::Tied,
            (false, true) => Focal::Free,
        },
        principal: false,
        radial: match count {
            _ if full => 2,
            0..=3 => 0,
            _ => 1,
        },
        // In a fisheye these are k3 and k4, which stay 0.
        tangential: full && !camera.fisheye,
    }
}

/// A prior for cameras in general, which keeps parameters that the photographs do not determine at their usual values: square pixels, a
/// weak lens, a focal length within the fraction `focal` of the initial one, and a principal point within a tenth of the long side from
/// the centre, as in cropped photographs; it is free only where these require it.
pub(super) fn camera_prior(camera: &DCamera, initial_focal: f64, focal: f64) -> Prior {
    let long_side = camera.long_side();
    let deviations = [
        focal * initial_focal,
        0.002,
        0.1 * long_side,
        0.1 * long_side,
        0.1,
        0.1,
        0.002,
        0.002,
    ];
    let center = 0.5 * DVec2::new(f64::from(camera.width), f64::from(camera.height));
    Prior {
        values: [initial_focal, 1.0, center.x, center.y, 0.0, 0.0, 0.0, 0.0],
        weights: deviations.map(|d| PRIOR_COST / (d * d)),
    }
}
