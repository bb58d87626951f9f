//! The normal equations of one iteration, with the points eliminated.
//!
//! Blocks: a pose has 6 unknowns (rotation in camera axes, shift of the centre), a camera 8, of which fixed ones have no equation.
//! Symbols: per observation r (residual), A = dr/dpose, B = dr/dpoint, K = dr/dcamera, all weighted by the root of the loss's
//! slope; per point V = sum B^T B + damping; per point and block W = A^T B or K^T B.

use super::cholesky::{Symmetric, conjugate_gradients};
use super::{DIRECT_LIMIT, Loss, MIN_DEPTH, Problem, State, View, ViewState};
use crate::geometry::camera::PARAMETERS;
use glam::{DMat3, DVec2, DVec3};
use irradia_compute::simd::{Kernel, Lanes, Level, Simd};
use rayon::prelude::*;

const POSE_SIZE: usize = 6;
const NO_BLOCK: u32 = u32::MAX;

/// Weighted residual and Jacobians of one observation.
#[derive(Clone, Copy)]
struct Row {
    r: [f64; 2],
    a: [[f64; POSE_SIZE]; 2],
    b: [[f64; 3]; 2],
    k: [[f64; PARAMETERS]; 2],
}

const EMPTY_ROW: Row = Row {
    r: [0.0; 2],
    a: [[0.0; POSE_SIZE]; 2],
    b: [[0.0; 3]; 2],
    k: [[0.0; PARAMETERS]; 2],
};

impl Row {
    /// The row of a `point` that `view` shows `at` a pixel, and its loss; `None` if the point is behind the camera. `free` has 1 for each
    /// column of the camera that is adjusted and 0 for the others, and the ratio fy / fx.
    #[inline(always)]
    fn new(
        view: &ViewState,
        point: DVec3,
        at: DVec2,
        loss: Loss,
        (free, ratio): &([f64; PARAMETERS], f64),
    ) -> Option<(Self, f64)> {
        let p = view.rotation * (point - view.position);
        if p.z <= MIN_DEPTH {
            return None;
        }
        let projection = view.camera.project(p);
        let r = projection.at - at;
        let (rho, slope) = loss.evaluate(r.length_squared());
        let root = slope.sqrt();
        let mut row = Self {
            r: (r * root).to_array(),
            ..EMPTY_ROW
        };
        for e in 0..2 {
            let jacobian = projection.point_jacobian[e] * root;
            // d camera point / d turn: the cross product turn x p, in the pose's axes; / d point: the rotation.
            let turn = view.rig_from_camera * p.cross(jacobian);
            let point = view.rotation.transpose() * jacobian;
            row.a[e] = [turn.x, turn.y, turn.z, -point.x, -point.y, -point.z];
            row.b[e] = point.to_array();
            for c in 0..PARAMETERS {
                row.k[e][c] = free[c] * root * projection.camera_jacobian[e][c];
            }
            row.k[e][0] += free[0] * ratio * root * projection.camera_jacobian[e][1];
        }
        Some((row, rho))
    }
}

/// Adds `b^T other` of one observation to `to`.
#[inline(always)]
fn add_products<const N: usize>(b: &[[f64; 3]; 2], other: &[[f64; N]; 2], to: &mut [[f64; N]; 3]) {
    for x in 0..3 {
        for c in 0..N {
            to[x][c] += b[0][x] * other[0][c] + b[1][x] * other[1][c];
        }
    }
}

/// Smallest and largest damped diagonal (Ceres' bounds).
const DIAGONAL_BOUNDS: (f64, f64) = (1e-6, 1e32);

/// The normal equations and the structure that does not change between iterations.
pub(super) struct Linearization {
    /// `[P]` the block of a pose, or NO_BLOCK when it is held fixed.
    pose_block: Vec<u32>,
    /// `[C]` the block of a camera, or NO_BLOCK when it is held fixed or not observed.
    camera_block: Vec<u32>,
    pose_blocks: usize,
    camera_blocks: usize,
    /// `[pose_blocks]` the observations of each pose, in order.
    of_pose: Vec<Vec<u32>>,
    /// The point and the camera block of each observation.
    point_of: Vec<u32>,
    camera_of_row: Vec<u32>,
    /// Where each point's camera blocks begin in `groups`, and the camera block of each.
    group_starts: Vec<u32>,
    groups: Vec<u32>,
    /// `[camera_blocks]` the entries of `groups` of each camera block, and their points.
    of_camera: Vec<Vec<(u32, u32)>>,
    rows: Vec<Row>,
    /// Per observation `A^T B`, `[3][6]`.
    w: Vec<[[f64; POSE_SIZE]; 3]>,
    /// Per entry of `groups`, sums over the point's observations of `K^T B`, `[3][8]`.
    wk: Vec<[[f64; PARAMETERS]; 3]>,
    /// Per camera block and unknown: second and first derivative of the prior's cost.
    prior_terms: Vec<[[f64; 2]; PARAMETERS]>,
    /// Per point: sum of `B^T B` and of `B^T r`.
    v: Vec<(DMat3, DVec3)>,
}

impl Linearization {
    pub(super) fn new(problem: &Problem) -> Self {
        let number = |held: &mut dyn Iterator<Item = bool>| {
            let mut count = 0;
            let blocks: Vec<u32> = held
                .map(|held| {
                    let block = if held { NO_BLOCK } else { count };
                    count += u32::from(!held);
                    block
                })
                .collect();
            (blocks, count as usize)
        };
        let (pose_block, pose_blocks) = number(&mut problem.held_poses.iter().copied());
        let seen = {
            let mut seen = vec![false; problem.cameras.len()];
            for observation in &problem.observations {
                seen[problem.views[observation.view as usize].camera as usize] = true;
            }
            seen
        };
        let (camera_block, camera_blocks) = number(
            &mut problem
                .cameras
                .iter()
                .zip(seen)
                .map(|(c, seen)| !seen || !c.freedom.free_columns().contains(&true)),
        );
        let n = problem.observations.len();
        let mut of_pose = vec![Vec::new(); pose_blocks];
        let mut of_camera = vec![Vec::new(); camera_blocks];
        let (mut point_of, mut camera_of_row, mut groups) = (Vec::with_capacity(n), Vec::with_capacity(n), Vec::new());
        let mut group_starts = vec![0];
        for i in 0..problem.points.len() {
            let first = groups.len();
            for o in problem.starts[i]..problem.starts[i + 1] {
                let View { pose, camera, .. } = problem.views[problem.observations[o as usize].view as usize];
                point_of.push(i as u32);
                let block = pose_block[pose as usize];
                if block != NO_BLOCK {
                    of_pose[block as usize].push(o);
                }
                let camera = camera_block[camera as usize];
                camera_of_row.push(camera);
                if camera != NO_BLOCK && !groups[first..].contains(&camera) {
                    of_camera[camera as usize].push((groups.len() as u32, i as u32));
                    groups.push(camera);
                }
            }
            group_starts.push(groups.len() as u32);
        }
        Self {
            pose_block,
            camera_block,
            pose_blocks,
            camera_blocks,
            of_pose,
            point_of,
            camera_of_row,
            group_starts,
            rows: vec![EMPTY_ROW; n],
            w: vec![[[0.0; POSE_SIZE]; 3]; n],
            wk: vec![[[0.0; PARAMETERS]; 3]; groups.len()],
            prior_terms: Vec::new(),
            v: vec![(DMat3::ZERO, DVec3::ZERO); problem.points.len()],
            groups,
            of_camera,
        }
    }

    /// Residuals and Jacobians at `state`; returns the cost.
    pub(super) fn linearize(&mut self, problem: &Problem, state: &State, loss: Loss) -> f64 {
        let views = state.views(problem);
        let columns: Vec<([f64; PARAMETERS], f64)> = problem
            .cameras
            .iter()
            .zip(&state.cameras)
            .map(|(adjusted, camera)| {
                let ratio = camera.parameters[1] / camera.parameters[0];
                (adjusted.freedom.free_columns().map(f64::from), ratio)
            })
            .collect();
        let chunks = problem.chunks();
        let mut jobs = Vec::with_capacity(chunks.len());
        let (mut rows, mut w) = (&mut self.rows[..], &mut self.w[..]);
        let (mut wk, mut v) = (&mut self.wk[..], &mut self.v[..]);
        for chunk in chunks {
            let observations = (problem.starts[chunk.end] - problem.starts[chunk.start]) as usize;
            let groups = (self.group_starts[chunk.end] - self.group_starts[chunk.start]) as usize;
            let (rows_here, w_here, wk_here, v_here);
            (rows_here, rows) = rows.split_at_mut(observations);
            (w_here, w) = w.split_at_mut(observations);
            (wk_here, wk) = wk.split_at_mut(groups);
            (v_here, v) = v.split_at_mut(chunk.len());
            jobs.push((chunk, rows_here, w_here, wk_here, v_here));
        }
        let (group_starts, groups, camera_of_row) = (&self.group_starts, &self.groups, &self.camera_of_row);
        let costs: Vec<f64> = jobs
            .into_par_iter()
            .map(|(chunk, rows, w, wk, v)| {
                let (first_row, first_group) = (problem.starts[chunk.start], group_starts[chunk.start]);
                let mut cost = 0.0;
                wk.fill([[0.0; PARAMETERS]; 3]);
                for (i, v) in chunk.clone().zip(v) {
                    *v = (DMat3::ZERO, DVec3::ZERO);
                    let here = group_starts[i] as usize..group_starts[i + 1] as usize;
                    for o in problem.starts[i]..problem.starts[i + 1] {
                        let observation = &problem.observations[o as usize];
                        let view = observation.view as usize;
                        let at = (o - first_row) as usize;
                        w[at] = [[0.0; POSE_SIZE]; 3];
                        let camera = &columns[problem.views[view].camera as usize];
                        let Some((row, rho)) = Row::new(&views[view], state.points[i], observation.at, loss, camera)
                        else {
                            rows[at] = EMPTY_ROW;
                            cost = f64::INFINITY;
                            continue;
                        };
                        cost += rho;
                        rows[at] = row;
                        add_products(&row.b, &row.a, &mut w[at]);
                        let b = row.b.map(DVec3::from_array);
                        for b in b {
                            v.0 += DMat3::from_cols(b * b.x, b * b.y, b * b.z);
                        }
                        v.1 += b[0] * row.r[0] + b[1] * row.r[1];
                        let block = camera_of_row[o as usize];
                        if block != NO_BLOCK {
                            let entry = here
                                .clone()
                                .find(|g| groups[*g] == block)
                                .expect("its camera is listed");
                            add_products(&row.b, &row.k, &mut wk[entry - first_group as usize]);
                        }
                    }
                }
                cost
            })
            .collect();
        self.prior_terms = (problem.cameras.iter().zip(&state.cameras).zip(&self.camera_block))
            .filter(|(_, block)| **block != NO_BLOCK)
            .map(|((adjusted, now), _)| {
                let columns = adjusted.freedom.free_columns();
                let (errors, weights) = (adjusted.prior.errors(now), adjusted.prior.weights);
                std::array::from_fn(|i| {
                    // The derivative of the ratio fy / fx by fy is 1 / fx.
                    let slope = if i == 1 { 1.0 / now.parameters[0] } else { 1.0 };
                    let weight = if columns[i] { weights[i] * slope } else { 0.0 };
                    [weight * slope, weight * errors[i]]
                })
            })
            .collect();
        0.5 * costs.iter().sum::<f64>() + problem.prior_cost(state)
    }

    /// The damped Gauss-Newton step; `None` where the system is not positive definite.
    pub(super) fn step(&self, problem: &Problem, damping: f64) -> Option<Step> {
        let inverses: Vec<DMat3> = self
            .v
            .par_iter()
            .zip(&problem.held_points)
            .map(|((v, _), held)| {
                if *held {
                    return DMat3::ZERO;
                }
                let damped = *v + DMat3::from_diagonal(damp(v.x_axis.x, v.y_axis.y, v.z_axis.z, damping));
                let inverse = damped.inverse();
                if inverse.is_finite() { inverse } else { DMat3::ZERO }
            })
            .collect();
        let n = POSE_SIZE * self.pose_blocks + PARAMETERS * self.camera_blocks;
        let (mut system, right, diagonal) = self.reduce(problem, &inverses, damping, n);
        let mut solution = right.iter().map(|x| -x).collect::<Vec<f64>>();
        if n <= DIRECT_LIMIT {
            if !system.solve(&mut solution) {
                return None;
            }
        } else {
            let blocks: Vec<(usize, usize)> = (0..self.pose_blocks)
                .map(|i| (POSE_SIZE * i, POSE_SIZE))
                .chain((0..self.camera_blocks).map(|i| (POSE_SIZE * self.pose_blocks + PARAMETERS * i, PARAMETERS)))
                .collect();
            solution = conjugate_gradients(&system, &solution, &blocks, 1e-3, 200)?;
        }
        if solution.iter().any(|x| !x.is_finite()) {
            return None;
        }
        Some(self.substitute(problem, &inverses, solution, &diagonal, damping))
    }

    /// The system over poses and cameras: matrix, gradient with the points eliminated (the negated right side), and the undamped
    /// diagonal with the gradient before elimination.
    fn reduce(
        &self,
        problem: &Problem,
        inverses: &[DMat3],
        damping: f64,
        n: usize,
    ) -> (Symmetric, Vec<f64>, Vec<[f64; 2]>) {
        let mut system = Symmetric::zeros(n);
        let mut right = vec![0.0; n];
        let mut diagonal = vec![[0.0; 2]; n];
        let cameras_at = POSE_SIZE * self.pose_blocks;
        let (pose_rows, camera_rows) = system.values.split_at_mut(cameras_at * n);
        let (pose_right, camera_right) = right.split_at_mut(cameras_at);
        let (pose_diagonal, camera_diagonal) = diagonal.split_at_mut(cameras_at);
        pose_rows
            .par_chunks_mut((POSE_SIZE * n).max(1))
            .zip(pose_right.par_chunks_mut(POSE_SIZE))
            .zip(pose_diagonal.par_chunks_mut(POSE_SIZE))
            .enumerate()
            .for_each(|(pose, ((rows, right), diagonal))| {
                Level::detect().run(PoseRows {
                    linear: self,
                    problem,
                    inverses,
                    damping,
                    n,
                    pose,
                    rows,
                    right,
                    diagonal,
                });
            });
        // A shared camera may see every point: its sums are split into pieces that are added in order.
        let chunks = 16usize.div_ceil(self.camera_blocks.max(1));
        for c in 0..self.camera_blocks {
            let entries = &self.of_camera[c];
            let size = entries.len().div_ceil(chunks).max(1);
            let parts: Vec<CameraSums> = entries
                .par_chunks(size)
                .map(|entries| self.camera_sums(problem, c, entries, inverses))
                .collect();
            let rows = &mut camera_rows[c * PARAMETERS * n..(c + 1) * PARAMETERS * n];
            for part in &parts {
                for i in 0..PARAMETERS {
                    camera_right[c * PARAMETERS + i] += part.right[i];
                    camera_diagonal[c * PARAMETERS + i][0] += part.own[i][i];
                    camera_diagonal[c * PARAMETERS + i][1] += part.gradient[i];
                    for j in 0..PARAMETERS {
                        rows[i * n + cameras_at + c * PARAMETERS + j] += part.own[i][j];
                    }
                    for (other, block) in &part.eliminated {
                        for j in 0..PARAMETERS {
                            rows[i * n + cameras_at + *other as usize * PARAMETERS + j] -= block[i][j];
                        }
                    }
                }
            }
            for (i, [second, first]) in self.prior_terms[c].into_iter().enumerate() {
                camera_right[c * PARAMETERS + i] += first;
                camera_diagonal[c * PARAMETERS + i][0] += second;
                camera_diagonal[c * PARAMETERS + i][1] += first;
                rows[i * n + cameras_at + c * PARAMETERS + i] += second;
                let own = camera_diagonal[c * PARAMETERS + i][0];
                // A fixed parameter has no equation: a 1 on the diagonal makes its unknown zero.
                let damped = if own == 0.0 {
                    1.0
                } else {
                    damping * own.clamp(DIAGONAL_BOUNDS.0, DIAGONAL_BOUNDS.1)
                };
                rows[i * n + cameras_at + c * PARAMETERS + i] += damped;
            }
        }
        (system, right, diagonal)
    }

    fn camera_sums(&self, problem: &Problem, c: usize, entries: &[(u32, u32)], inverses: &[DMat3]) -> CameraSums {
        let mut part = CameraSums::default();
        let starts = &self.group_starts;
        for &(entry, point) in entries {
            let point = point as usize;
            let inverse = inverses[point];
            let w = &self.wk[entry as usize];
            let y = times_inverse(w, &inverse);
            let g = self.v[point].1;
            for i in 0..PARAMETERS {
                part.right[i] -= y[0][i] * g.x + y[1][i] * g.y + y[2][i] * g.z;
            }
            for other in starts[point] as usize..starts[point + 1] as usize {
                let block = self.groups[other];
                if (block as usize) < c {
                    continue;
                }
                let at = match part.eliminated.iter().position(|m| m.0 == block) {
                    Some(at) => at,
                    None => {
                        part.eliminated.push((block, [[0.0; PARAMETERS]; PARAMETERS]));
                        part.eliminated.len() - 1
                    }
                };
                let to = &mut part.eliminated[at].1;
                let w = &self.wk[other];
                for i in 0..PARAMETERS {
                    for j in 0..PARAMETERS {
                        to[i][j] += y[0][i] * w[0][j] + y[1][i] * w[1][j] + y[2][i] * w[2][j];
                    }
                }
            }
            for o in problem.starts[point] as usize..problem.starts[point + 1] as usize {
                if self.camera_of_row[o] as usize != c {
                    continue;
                }
                let row = &self.rows[o];
                for e in 0..2 {
                    for i in 0..PARAMETERS {
                        part.gradient[i] += row.k[e][i] * row.r[e];
                        for j in 0..PARAMETERS {
                            part.own[i][j] += row.k[e][i] * row.k[e][j];
                        }
                    }
                }
            }
        }
        for i in 0..PARAMETERS {
            part.right[i] += part.gradient[i];
        }
        part
    }

    /// The full step, with the points substituted back from the step of poses and cameras.
    fn substitute(
        &self,
        problem: &Problem,
        inverses: &[DMat3],
        reduced: Vec<f64>,
        diagonal: &[[f64; 2]],
        damping: f64,
    ) -> Step {
        let cameras_at = POSE_SIZE * self.pose_blocks;
        let points: Vec<(DVec3, f64)> = (0..self.v.len())
            .into_par_iter()
            .map(|i| {
                if problem.held_points[i] {
                    return (DVec3::ZERO, 0.0);
                }
                let (v, gradient) = &self.v[i];
                let mut right = *gradient;
                for o in problem.starts[i] as usize..problem.starts[i + 1] as usize {
                    let block = self.pose_block[problem.pose_of(o)];
                    if block != NO_BLOCK {
                        let x = &reduced[POSE_SIZE * block as usize..][..POSE_SIZE];
                        right += DVec3::from_array(self.w[o].map(|w| w.iter().zip(x).map(|(w, x)| w * x).sum()));
                    }
                }
                for entry in self.group_starts[i] as usize..self.group_starts[i + 1] as usize {
                    let x = &reduced[cameras_at + PARAMETERS * self.groups[entry] as usize..][..PARAMETERS];
                    right += DVec3::from_array(self.wk[entry].map(|w| w.iter().zip(x).map(|(w, x)| w * x).sum()));
                }
                let step = -(inverses[i] * right);
                let damped = damp(v.x_axis.x, v.y_axis.y, v.z_axis.z, damping);
                (step, 0.5 * step.dot(damped * step - *gradient))
            })
            .collect();
        // The model's decrease, 1/2 dx^T (damping D dx - g).
        let mut predicted: f64 = points.iter().map(|p| p.1).sum();
        for (x, [own, gradient]) in reduced.iter().zip(diagonal) {
            predicted += 0.5 * x * (damping * own.clamp(DIAGONAL_BOUNDS.0, DIAGONAL_BOUNDS.1) * x - gradient);
        }
        let pose = |block: u32| {
            let x = &reduced[POSE_SIZE * block as usize..][..POSE_SIZE];
            (DVec3::from_slice(x), DVec3::from_slice(&x[3..]))
        };
        let camera = |block: u32| {
            let x = &reduced[cameras_at + PARAMETERS * block as usize..][..PARAMETERS];
            std::array::from_fn(|i| x[i])
        };
        Step {
            poses: self
                .pose_block
                .iter()
                .map(|b| (*b != NO_BLOCK).then(|| pose(*b)))
                .collect(),
            cameras: self
                .camera_block
                .iter()
                .map(|b| (*b != NO_BLOCK).then(|| camera(*b)))
                .collect(),
            points: points.into_iter().map(|p| p.0).collect(),
            predicted,
        }
    }
}

/// What the Levenberg-Marquardt method adds to the diagonal of V.
fn damp(x: f64, y: f64, z: f64, damping: f64) -> DVec3 {
    damping * DVec3::new(x, y, z).clamp(DVec3::splat(DIAGONAL_BOUNDS.0), DVec3::splat(DIAGONAL_BOUNDS.1))
}

/// `w inverse`, both as `[3][N]`.
#[inline(always)]
fn times_inverse<const N: usize>(w: &[[f64; N]; 3], inverse: &DMat3) -> [[f64; N]; 3] {
    let m = inverse.to_cols_array_2d();
    let mut y = [[0.0; N]; 3];
    for x in 0..3 {
        for c in 0..N {
            y[x][c] = m[x][0] * w[0][c] + m[x][1] * w[1][c] + m[x][2] * w[2][c];
        }
    }
    y
}

/// `to -= y^T w`.
#[inline(always)]
fn subtract_product<const N: usize, const M: usize>(y: &[[f64; N]; 3], w: &[[f64; M]; 3], to: &mut [[f64; M]; N]) {
    for i in 0..N {
        for j in 0..M {
            to[i][j] -= y[0][i] * w[0][j] + y[1][i] * w[1][j] + y[2][i] * w[2][j];
        }
    }
}

/// One camera's sums over some points.
#[derive(Default)]
struct CameraSums {
    /// Sum of `K^T K`.
    own: [[f64; PARAMETERS]; PARAMETERS],
    /// Sum of `K^T r`.
    gradient: [f64; PARAMETERS],
    /// Gradient with the points eliminated.
    right: [f64; PARAMETERS],
    /// Per camera block from this one on: sum of `W V^-1 W^T`.
    eliminated: Vec<(u32, [[f64; PARAMETERS]; PARAMETERS])>,
}

/// The six rows of one pose in the reduced system; every row is written by one task only.
struct PoseRows<'a> {
    linear: &'a Linearization,
    problem: &'a Problem,
    inverses: &'a [DMat3],
    damping: f64,
    n: usize,
    pose: usize,
    rows: &'a mut [f64],
    right: &'a mut [f64],
    diagonal: &'a mut [[f64; 2]],
}

impl Kernel for PoseRows<'_> {
    type Output = ();

    // Plain f64 code: inside a kernel it is compiled for the widest instruction set.
    #[inline(always)]
    fn run<S: Simd>(self, _: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let Self {
            linear,
            problem,
            inverses,
            damping,
            n,
            pose,
            rows,
            right,
            diagonal,
        } = self;
        let mut poses = vec![[[0.0; POSE_SIZE]; POSE_SIZE]; linear.pose_blocks - pose];
        let mut cameras = vec![[[0.0; PARAMETERS]; POSE_SIZE]; linear.camera_blocks];
        let mut reduced = [0.0; POSE_SIZE];
        let mut gradient = [0.0; POSE_SIZE];
        let mut own = [[0.0; POSE_SIZE]; POSE_SIZE];
        for &o in &linear.of_pose[pose] {
            let o = o as usize;
            let point = linear.point_of[o] as usize;
            let row = &linear.rows[o];
            for e in 0..2 {
                for i in 0..POSE_SIZE {
                    gradient[i] += row.a[e][i] * row.r[e];
                    for j in 0..POSE_SIZE {
                        own[i][j] += row.a[e][i] * row.a[e][j];
                    }
                }
            }
            let camera = linear.camera_of_row[o];
            if camera != NO_BLOCK {
                let to = &mut cameras[camera as usize];
                for e in 0..2 {
                    for i in 0..POSE_SIZE {
                        for j in 0..PARAMETERS {
                            to[i][j] += row.a[e][i] * row.k[e][j];
                        }
                    }
                }
            }
            if problem.held_points[point] {
                continue;
            }
            let y = times_inverse(&linear.w[o], &inverses[point]);
            let g = linear.v[point].1;
            for i in 0..POSE_SIZE {
                reduced[i] -= y[0][i] * g.x + y[1][i] * g.y + y[2][i] * g.z;
            }
            for other in problem.starts[point] as usize..problem.starts[point + 1] as usize {
                let block = linear.pose_block[problem.pose_of(other)];
                if block != NO_BLOCK && block as usize >= pose {
                    subtract_product(&y, &linear.w[other], &mut poses[block as usize - pose]);
                }
            }
            for entry in linear.group_starts[point] as usize..linear.group_starts[point + 1] as usize {
                subtract_product(&y, &linear.wk[entry], &mut cameras[linear.groups[entry] as usize]);
            }
        }
        let cameras_at = POSE_SIZE * linear.pose_blocks;
        for i in 0..POSE_SIZE {
            right[i] = gradient[i] + reduced[i];
            diagonal[i] = [own[i][i], gradient[i]];
            let row = &mut rows[i * n..(i + 1) * n];
            for (block, values) in poses.iter().enumerate() {
                row[POSE_SIZE * (pose + block)..][..POSE_SIZE].copy_from_slice(&values[i]);
            }
            for (block, values) in cameras.iter().enumerate() {
                row[cameras_at + PARAMETERS * block..][..PARAMETERS].copy_from_slice(&values[i]);
            }
            for j in 0..POSE_SIZE {
                row[POSE_SIZE * pose + j] += own[i][j];
            }
            row[POSE_SIZE * pose + i] += damping * own[i][i].clamp(DIAGONAL_BOUNDS.0, DIAGONAL_BOUNDS.1);
        }
    }
}

/// A step of all unknowns.
pub(super) struct Step {
    poses: Vec<Option<(DVec3, DVec3)>>,
    cameras: Vec<Option<[f64; PARAMETERS]>>,
    points: Vec<DVec3>,
    /// The decrease of the cost that the quadratic model predicts.
    pub(super) predicted: f64,
}

impl Step {
    pub(super) fn applied(&self, state: &State) -> State {
        let mut next = state.clone();
        for (pose, step) in next.poses.iter_mut().zip(&self.poses) {
            if let Some((turn, shift)) = step {
                *pose = pose.moved(*turn, *shift);
            }
        }
        for (camera, step) in next.cameras.iter_mut().zip(&self.cameras) {
            if let Some(step) = step {
                let ratio = camera.parameters[1] / camera.parameters[0];
                for (value, step) in camera.parameters.iter_mut().zip(step) {
                    *value += step;
                }
                camera.parameters[1] += ratio * step[0];
            }
        }
        for (point, step) in next.points.iter_mut().zip(&self.points) {
            *point += *step;
        }
        next
    }
}
