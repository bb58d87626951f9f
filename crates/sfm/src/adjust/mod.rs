//! Bundle adjustment: finds the poses, points and shared intrinsics that minimise the reprojection errors.
//!
//! The Levenberg-Marquardt method with analytic Jacobians. Points are eliminated (Schur complement); what remains is a dense
//! symmetric system over poses and cameras, solved by Cholesky factorisation or, beyond [`DIRECT_LIMIT`] unknowns, by
//! conjugate gradients. Every sum has a fixed order: the result does not depend on the number of threads.

mod cholesky;
mod loss;
mod schur;

pub use cholesky::{Symmetric, conjugate_gradients};
pub use loss::Loss;

use crate::geometry::camera::{DCamera, PARAMETERS};
use crate::geometry::pose::DPose;
use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;
use schur::Linearization;

/// Number of unknowns of poses and cameras beyond which conjugate gradients are used: 2,000 photographs. On two cores the direct
/// solution of a full system takes 0.13 s for 2,400 unknowns and 0.88 s for 4,800; 200 iterations of conjugate gradients take 0.7 s
/// and 2.7 s, and stop before they have converged.
pub const DIRECT_LIMIT: usize = 12_000;

/// Which intrinsics of a camera are adjusted; the others are held fixed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Freedom {
    /// The focal length.
    pub focal: Focal,
    /// The principal point.
    pub principal: bool,
    /// How many of the radial coefficients k1, k2.
    pub radial: usize,
    /// The tangential coefficients p1 and p2.
    pub tangential: bool,
}

/// How the focal length is adjusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Focal {
    /// It is held fixed.
    Held,
    /// fx and fy are adjusted together; their ratio is kept.
    Tied,
    /// fx and fy are adjusted independently.
    Free,
}

impl Freedom {
    /// Nothing is adjusted.
    pub const HELD: Self = Self {
        focal: Focal::Held,
        principal: false,
        radial: 0,
        tangential: false,
    };

    /// With the principal point adjusted instead of p1 and p2: their effects are nearly the same, and together they hardly converge.
    pub fn with_principal(self) -> Self {
        Self {
            principal: true,
            tangential: false,
            ..self
        }
    }

    /// Which unknowns of a camera are adjusted. The first scales fx and fy together, the second moves fy alone.
    fn free_columns(self) -> [bool; PARAMETERS] {
        let focal = self.focal;
        [
            focal != Focal::Held,
            focal == Focal::Free,
            self.principal,
            self.principal,
            self.radial > 0,
            self.radial > 1,
            self.tangential,
            self.tangential,
        ]
    }
}

/// A camera, the intrinsics that are adjusted, and the prior on them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdjustedCamera {
    /// The camera.
    pub camera: DCamera,
    /// Which intrinsics are adjusted.
    pub freedom: Freedom,
    /// The prior.
    pub prior: Prior,
}

impl AdjustedCamera {
    /// A camera without a prior.
    pub fn new(camera: DCamera, freedom: Freedom) -> Self {
        Self {
            camera,
            freedom,
            prior: Prior::default(),
        }
    }
}

/// A Gaussian prior on the parameters of a camera: the cost has a term `weight (parameter - value)^2 / 2` for each.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Prior {
    /// Expected values in the order of the parameters; in place of fy, the value of `fy / fx`.
    pub values: [f64; PARAMETERS],
    /// Weights, px^2 per squared unit of the parameter.
    pub weights: [f64; PARAMETERS],
}

impl Prior {
    /// The differences from the expected values.
    fn errors(&self, camera: &DCamera) -> [f64; PARAMETERS] {
        let mut errors = camera.parameters;
        errors[1] /= errors[0];
        std::array::from_fn(|i| errors[i] - self.values[i])
    }

    fn cost(&self, camera: &DCamera) -> f64 {
        let terms = self.errors(camera).into_iter().zip(self.weights);
        0.5 * terms.map(|(error, weight)| weight * error * error).sum::<f64>()
    }
}

/// A photograph: a camera at a pose, or mounted on a rig that has the pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Index of the pose.
    pub pose: u32,
    /// Index of the camera.
    pub camera: u32,
    /// Rotation of the camera's axes into those of the pose.
    pub rig_from_camera: DQuat,
}

impl View {
    /// A camera whose own pose is the pose.
    pub fn new(pose: u32, camera: u32) -> Self {
        Self {
            pose,
            camera,
            rig_from_camera: DQuat::IDENTITY,
        }
    }
}

/// A point's projection in one photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Index of the view.
    pub view: u32,
    /// Measured position, pixels.
    pub at: DVec2,
}

/// A bundle adjustment problem. Fields are public: a caller fills them, calls [`Problem::solve`] and reads the results from the same
/// fields.
#[derive(Clone, Debug, Default)]
pub struct Problem {
    /// `[C]` cameras.
    pub cameras: Vec<AdjustedCamera>,
    /// `[P]` poses.
    pub poses: Vec<DPose>,
    /// `[P]` whether a pose is held fixed.
    pub held_poses: Vec<bool>,
    /// Photographs.
    pub views: Vec<View>,
    /// `[N]` points.
    pub points: Vec<DVec3>,
    /// `[N]` whether a point is held fixed.
    pub held_points: Vec<bool>,
    /// Observations, sorted by point.
    pub observations: Vec<Observation>,
    /// `[N + 1]` where each point's observations begin.
    pub starts: Vec<u32>,
}

/// Options of an adjustment.
#[derive(Clone, Copy, Debug)]
pub struct AdjustOptions {
    /// The loss of each observation's squared error.
    pub loss: Loss,
    /// Maximum number of iterations.
    pub iterations: usize,
    /// Stop when an iteration lowers the cost by less than this fraction.
    pub tolerance: f64,
}

/// The outcome of an adjustment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdjustReport {
    /// Half the sum of losses before, px^2.
    pub initial_cost: f64,
    /// Half the sum of losses after, px^2.
    pub final_cost: f64,
    /// Number of linear systems solved.
    pub iterations: usize,
    /// Whether the last step was below the tolerance.
    pub converged: bool,
}

impl Problem {
    /// Half the sum of the losses plus the terms of the priors at the current values, px^2; infinite if a point is behind a camera that
    /// observes it.
    pub fn cost(&self, loss: Loss) -> f64 {
        self.cost_at(&self.state(), loss)
    }

    /// Adjusts in place.
    pub fn solve(&mut self, options: &AdjustOptions) -> AdjustReport {
        let mut state = self.state();
        let mut linear = Linearization::new(self);
        let mut cost = linear.linearize(self, &state, options.loss);
        let mut report = AdjustReport {
            initial_cost: cost,
            final_cost: cost,
            iterations: 0,
            converged: false,
        };
        // Ceres' trust region: a radius of 1e4, divided by 2, 4, 8, .. after failures.
        let (mut damping, mut failure) = (1e-4, 2.0);
        while report.iterations < options.iterations && damping < 1e12 && cost.is_finite() {
            report.iterations += 1;
            let accepted = linear.step(self, damping).and_then(|step| {
                let next = step.applied(&state);
                let next_cost = self.cost_at(&next, options.loss);
                let gain = (cost - next_cost) / step.predicted;
                (gain.is_finite() && gain > 1e-3).then_some((next, next_cost, gain))
            });
            let Some((next, next_cost, gain)) = accepted else {
                damping *= failure;
                failure *= 2.0;
                continue;
            };
            state = next;
            let decrease = (cost - next_cost) / cost;
            damping = (damping * (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 3.0)).max(1e-14);
            failure = 2.0;
            cost = next_cost;
            if decrease.is_nan() || decrease < options.tolerance {
                report.converged = true;
                break;
            }
            if report.iterations < options.iterations {
                linear.linearize(self, &state, options.loss);
            }
        }
        report.final_cost = cost;
        for (camera, adjusted) in self.cameras.iter_mut().zip(state.cameras) {
            camera.camera = adjusted;
        }
        (self.poses, self.points) = (state.poses, state.points);
        report
    }

    /// The pose of an observation.
    fn pose_of(&self, observation: usize) -> usize {
        self.views[self.observations[observation].view as usize].pose as usize
    }

    fn state(&self) -> State {
        State {
            cameras: self.cameras.iter().map(|c| c.camera).collect(),
            poses: self.poses.clone(),
            points: self.points.clone(),
        }
    }

    fn cost_at(&self, state: &State, loss: Loss) -> f64 {
        let views = state.views(self);
        let sums: Vec<f64> = self
            .chunks()
            .into_par_iter()
            .map(|points| {
                let mut sum = 0.0;
                for i in points {
                    for observation in &self.observations[self.starts[i] as usize..self.starts[i + 1] as usize] {
                        let view = &views[observation.view as usize];
                        let p = view.rotation * (state.points[i] - view.position);
                        if p.z <= MIN_DEPTH {
                            return f64::INFINITY;
                        }
                        sum += loss
                            .evaluate((view.camera.pixel(p) - observation.at).length_squared())
                            .0;
                    }
                }
                sum
            })
            .collect();
        0.5 * sums.iter().sum::<f64>() + self.prior_cost(state)
    }

    /// The cost of the priors on the cameras.
    fn prior_cost(&self, state: &State) -> f64 {
        self.cameras
            .iter()
            .zip(&state.cameras)
            .map(|(c, now)| c.prior.cost(now))
            .sum()
    }

    /// Ranges of points with about equal numbers of observations; they depend only on the problem.
    fn chunks(&self) -> Vec<std::ops::Range<usize>> {
        let goal = (self.observations.len() / 64).max(256) as u32;
        let mut chunks = Vec::new();
        let mut first = 0;
        for i in 0..self.points.len() {
            if self.starts[i + 1] - self.starts[first] >= goal || i + 1 == self.points.len() {
                chunks.push(first..i + 1);
                first = i + 1;
            }
        }
        chunks
    }
}

/// Depth below which a point counts as behind its camera, in world units.
const MIN_DEPTH: f64 = 1e-9;

/// The values that change during an adjustment.
#[derive(Clone)]
struct State {
    cameras: Vec<DCamera>,
    poses: Vec<DPose>,
    points: Vec<DVec3>,
}

/// A view at the current values.
struct ViewState {
    /// From world to camera axes.
    rotation: DMat3,
    position: DVec3,
    /// From camera axes to those of the pose.
    rig_from_camera: DMat3,
    camera: DCamera,
}

impl State {
    fn views(&self, problem: &Problem) -> Vec<ViewState> {
        let now = |view: &View| {
            let pose = &self.poses[view.pose as usize];
            ViewState {
                rotation: DMat3::from_quat(view.rig_from_camera.inverse()) * pose.camera_rotation(),
                position: pose.position,
                rig_from_camera: DMat3::from_quat(view.rig_from_camera),
                camera: self.cameras[view.camera as usize],
            }
        };
        problem.views.iter().map(now).collect()
    }
}

#[cfg(test)]
mod tests;
