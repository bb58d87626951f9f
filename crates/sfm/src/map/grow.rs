//! Growing a model from a seed, photograph by photograph.

use super::Input;
use super::contradicted::{agrees_with, contradicted_pairs, explains_matches};
use super::focal::{FocalSource, are_similar};
use super::model::GrowingModel;
use super::refine::Extent;
use super::seed::seeds;
use super::tracks::Tracks;
use super::types::{FEW_PHOTOS, Progress, VerifiedPair};
use crate::geometry::pose::DPose;
use crate::geometry::ransac::{Estimate, Limits};
use crate::geometry::resection::Resection;
use glam::{DVec2, DVec3};

/// Maximum number of seeds tried for one model, and of candidates from which they are selected.
const MAX_SEEDS: usize = 12;
const MAX_SEED_CANDIDATES: usize = 20 * MAX_SEEDS;
/// Minimum fraction of its photographs' observations that a doubtful model must explain, such as one whose focal lengths are guessed.
/// Correct models of six captures, each cropped in ten ways, explain 0.88 to 1.00, and of a clock with three models 0.74; wrong ones
/// 0.06 to 0.67.
const MIN_EXPLAINED_FRACTION: f64 = 0.8;
/// Number of times a photograph is tried before it is given up.
const MAX_REGISTRATION_ATTEMPTS: usize = 3;
/// Number of times a photograph is removed before it is given up: many, since photographs of narrow views are removed until the focal
/// length is found.
const MAX_REMOVALS: usize = 10;
/// Minimum number of points of a pair of photographs for a seed.
const MIN_SEED_POINTS: usize = 12;
/// Minimum fraction of inliers among the points that a photograph shows. Photographs with less than the first wait until the others are
/// registered and everything is adjusted; then the second applies.
const STRICT_INLIER_RATIO: f64 = 0.5;
const LENIENT_INLIER_RATIO: f64 = 0.25;
/// Focal lengths tried for the first photograph of a camera, relative to the current one: steps of 15 %, from 0.5 to 4.8 long sides where
/// that is a guess. The best must be between the ends: for a wrong pose far away, with a long focal length, there is no minimum.
const FOCAL_FACTORS: [f64; 17] = [
    0.43, 0.5, 0.57, 0.66, 0.76, 0.87, 1.0, 1.15, 1.32, 1.52, 1.75, 2.0, 2.3, 2.65, 3.05, 3.5, 4.0,
];
/// Maximum number of rounds of adjustment, filtering and triangulation at the end.
const MAX_FINAL_ROUNDS: usize = 3;

/// The largest model over several seeds among photographs that are not `assigned` to a model yet, from `pairs` and their `tracks`; `None`
/// if there is none.
///
/// The search ends with a seed whose model has more than half of the photographs it could reach. Two photographs with wrong focal lengths
/// may lead to a wrong model of all photographs, which explains a third of their observations instead of nine tenths: where focal lengths
/// are guessed, or end far from where they began, the model must explain most observations as well. So must a model of few photographs: a
/// seed with wrong poses hardly finds others that disagree. A model that most of its pairs contradict never suffices: two motions fit a
/// plane, and from the wrong one a model grows that fits the ground and nothing above it. The failures of the best seed are added to
/// `failed_registrations`.
pub(super) fn grow_model<'a>(
    input: &Input<'a>,
    pairs: &[VerifiedPair],
    tracks: &'a Tracks,
    assigned: &[bool],
    failed_registrations: &mut [usize],
    progress: &mut dyn FnMut(Progress),
) -> Option<GrowingModel<'a>> {
    let Input {
        photos,
        cameras,
        options,
        ..
    } = *input;
    let empty = GrowingModel::new(photos, cameras, tracks, options);
    let guessed_focals = empty.has_guessed_focals();
    let few = photos.len() <= FEW_PHOTOS;
    // Whether the model must also explain enough observations.
    let is_doubtful =
        |grown: &Grown| guessed_focals || few || grown.model.is_far_from_initial_focals() || grown.is_contradicted;
    let mut is_any_doubtful = guessed_focals || few;
    let mut best: Option<Grown> = None;
    let mut outcomes: Vec<SeedOutcome> = Vec::new();
    let mut seeds_left = MAX_SEEDS;
    for seed in seeds(pairs, assigned, MAX_SEED_CANDIDATES) {
        if seeds_left == 0 {
            break;
        }
        // Two earlier seeds led to the same model, which agrees with this seed: it would lead there once more. 984 frames of two films of
        // a brick car, whose models explain 0.74 of their observations, used up all seeds, a minute each, and ended as the second.
        let agreeing: Vec<&SeedOutcome> = (outcomes.iter())
            .filter(|outcome| agrees_with(&outcome.poses, &pairs[seed]) == Some(true))
            .collect();
        if (1..agreeing.len()).any(|i| agreeing[..i].iter().any(|other| agreeing[i].is_similar(other))) {
            continue;
        }
        seeds_left -= 1;
        let reachable = reachable(&pairs[seed], pairs, assigned);
        if best
            .as_ref()
            .is_some_and(|best| best.model.registered() >= reachable && !is_doubtful(best))
        {
            continue;
        }
        let mut model = empty.clone();
        if !model.initialize(&pairs[seed]) || !model.grow(assigned, progress) {
            continue;
        }
        // If photographs were cropped off centre, no seed explains more while principal points are held at the centre: fox, with each
        // photograph cropped at a different position, took all seeds and 88 s to be mapped, and now takes 9 s.
        if guessed_focals && model.explained_fraction() <= MIN_EXPLAINED_FRACTION {
            let mut free = model.clone();
            free.free_principal_points();
            free.refine_fully(progress);
            free.grow(assigned, progress);
            if free.explained_fraction() > MIN_EXPLAINED_FRACTION && free.registered() >= model.registered() {
                model = free;
            }
        }
        let grown = Grown::new(model, input, pairs);
        let doubtful = is_doubtful(&grown);
        outcomes.push(SeedOutcome::new(&grown.model, doubtful));
        is_any_doubtful |= doubtful;
        // The motion that only fits the ground may explain more than the right one, by bending the lens: 198,154 and 191,558 observations.
        let size = |grown: &Grown| {
            let count = if is_any_doubtful {
                grown.model.used_count()
            } else {
                grown.model.registered()
            };
            (!grown.is_contradicted, count)
        };
        let is_large = grown.model.registered() >= options.min_model_photos;
        if is_large && best.as_ref().is_none_or(|best| size(&grown) > size(best)) {
            best = Some(grown);
        }
        let is_sufficient = |best: &Grown| {
            2 * best.model.registered() > reachable
                && !best.is_contradicted
                && (!is_doubtful(best) || best.model.explained_fraction() > MIN_EXPLAINED_FRACTION)
        };
        if best.as_ref().is_some_and(is_sufficient) {
            break;
        }
    }
    let best = best?.model;
    for (total, failed) in failed_registrations.iter_mut().zip(&best.failures) {
        *total += failed;
    }
    Some(best)
}

/// A model grown from a seed.
struct Grown<'a> {
    model: GrowingModel<'a>,
    /// Whether most of its pairs contradict it.
    is_contradicted: bool,
}

impl<'a> Grown<'a> {
    fn new(model: GrowingModel<'a>, input: &Input, pairs: &[VerifiedPair]) -> Self {
        let is_reliable = |pair: &VerifiedPair| {
            let cameras = pair.photos.map(|photo| Some(model.camera(photo)));
            explains_matches(pair, input.features, cameras)
        };
        let is_contradicted = !contradicted_pairs(pairs, &model.poses, is_reliable).is_empty();
        Self { model, is_contradicted }
    }
}

/// The model to which a seed led.
struct SeedOutcome {
    /// `[photos]` those with a pose.
    poses: Vec<Option<DPose>>,
    /// `[groups]` focal lengths of cameras with photographs, px; empty if the model is not in doubt.
    focals: Vec<Option<f64>>,
}

impl SeedOutcome {
    fn new(model: &GrowingModel, is_doubtful: bool) -> Self {
        let groups = 0..if is_doubtful { model.cameras.len() } else { 0 };
        let focal = |group| (model.registered_in_group(group) > 0).then(|| model.cameras[group].focal());
        Self {
            poses: model.poses.clone(),
            focals: groups.map(focal).collect(),
        }
    }

    fn is_similar(&self, other: &Self) -> bool {
        let both = self.focals.iter().zip(&other.focals).filter_map(|(a, b)| (*a).zip(*b));
        both.into_iter().all(|(a, b)| are_similar(a, b))
    }
}

/// Number of photographs that chains of pairs connect with the seed.
fn reachable(seed: &VerifiedPair, pairs: &[VerifiedPair], assigned: &[bool]) -> usize {
    let mut reached = vec![false; assigned.len()];
    reached[seed.photos[0] as usize] = true;
    loop {
        let mut grew = false;
        for pair in pairs {
            let [a, b] = pair.photos.map(|p| p as usize);
            if !assigned[a] && !assigned[b] && reached[a] != reached[b] {
                (reached[a], reached[b], grew) = (true, true, true);
            }
        }
        if !grew {
            return reached.iter().filter(|r| **r).count();
        }
    }
}

impl GrowingModel<'_> {
    /// Places the two photographs of a seed and their points; `false` if too few remain.
    fn initialize(&mut self, pair: &VerifiedPair) -> bool {
        let [a, b] = pair.photos.map(|p| p as usize);
        self.set_pose(a, DPose::IDENTITY);
        self.set_pose(
            b,
            DPose::from_camera_from_world(pair.motion.rotation, pair.motion.translation),
        );
        let tracks = self.tracks_of_rig(a);
        self.triangulate(&tracks);
        self.adjust_all(Extent::Growing);
        let points = self.triangulated_tracks();
        self.filter(&points);
        self.point_count() >= MIN_SEED_POINTS
    }

    /// Registers photographs as long as that succeeds, then adjusts everything; `false` if the model is left with too few photographs.
    pub(super) fn grow(&mut self, assigned: &[bool], progress: &mut dyn FnMut(Progress)) -> bool {
        let (mut photos_then, mut points_then) = (self.registered(), self.point_count());
        let mut refined = false;
        loop {
            let next = self.registration_candidates(assigned).into_iter().find(|photo| {
                let registered = self.register(
                    *photo,
                    if refined {
                        LENIENT_INLIER_RATIO
                    } else {
                        STRICT_INLIER_RATIO
                    },
                );
                self.failures[*photo] += usize::from(!registered && refined);
                registered
            });
            let Some(photo) = next else {
                if refined {
                    break;
                }
                // What failed before may succeed after a global adjustment.
                self.refine_globally(Extent::Growing, progress);
                (photos_then, points_then, refined) = (self.registered(), self.point_count(), true);
                continue;
            };
            refined = false;
            let tracks = self.tracks_of_rig(photo);
            self.triangulate(&tracks);
            let growth = self.options.global_growth;
            let (photos, points) = (self.registered(), self.point_count());
            if photos as f64 >= growth * photos_then as f64 || points as f64 >= growth * points_then as f64 {
                self.refine_globally(Extent::Growing, progress);
                (photos_then, points_then) = (self.registered(), self.point_count());
            } else {
                self.adjust_around(photo);
            }
            progress(Progress::Registered {
                photos: self.registered(),
                total: self.photos.len(),
                points: self.point_count(),
            });
        }
        self.refine_fully(progress);
        self.registered() >= self.options.min_model_photos
    }

    /// Adjusts everything with the full lens until hardly any observation changes, then once more until convergence.
    pub(super) fn refine_fully(&mut self, progress: &mut dyn FnMut(Progress)) {
        for _ in 0..MAX_FINAL_ROUNDS {
            let changed = self.refine_globally(Extent::Full, progress);
            let observations = self.used_count();
            if (changed as f64) < 1e-3 * observations as f64 {
                break;
            }
        }
        self.refine_globally(Extent::Final, progress);
    }

    /// Adjusts everything, filters, triangulates again and removes photographs that lost their points. Returns the number of
    /// observations that changed.
    fn refine_globally(&mut self, extent: Extent, progress: &mut dyn FnMut(Progress)) -> usize {
        self.adjust_all(extent);
        let points = self.triangulated_tracks();
        let mut changed = self.filter(&points);
        if extent != Extent::Final {
            let all: Vec<usize> = (0..self.tracks.len()).collect();
            changed += self.triangulate(&all);
        }
        for photo in 0..self.poses.len() {
            let lost = self.poses[photo].is_some() && self.used_in(photo) < self.options.min_inliers;
            if lost && !self.held_poses[photo] && self.registered() > 2 * self.rigs[photo].len() {
                self.deregister(photo);
            }
        }
        progress(Progress::Adjusted {
            photos: self.registered(),
            points: self.point_count(),
            error: self.mean_error(),
        });
        changed
    }

    /// Photographs to register, best first: those that show many points of the model, spread over the photograph.
    fn registration_candidates(&self, assigned: &[bool]) -> Vec<usize> {
        let mut scored: Vec<(usize, usize)> = (0..self.poses.len())
            .filter(|p| self.poses[*p].is_none() && !assigned[*p])
            .filter(|p| self.failures[*p] < MAX_REGISTRATION_ATTEMPTS && self.removals[*p] < MAX_REMOVALS)
            .filter_map(|photo| {
                let (count, score) = self.visibility(photo);
                (count >= self.options.min_registration_inliers).then_some((score, photo))
            })
            .collect();
        scored.sort_by_key(|(score, photo)| (std::cmp::Reverse(*score), *photo));
        scored.into_iter().map(|s| s.1).collect()
    }

    /// How many points of the model a photograph shows, and the pyramid score of Schoenberger and Frahm (2016, 4.2): on grids
    /// with 2, 4, .. 64 cells per side, each cell that contains a point counts as much as the grid has cells.
    fn visibility(&self, photo: usize) -> (usize, usize) {
        const LEVELS: usize = 6;
        const SIDE: usize = 1 << LEVELS;
        let camera = self.camera(photo as u32);
        let mut cells = vec![false; SIDE * SIDE];
        let mut count = 0;
        for o in &self.tracks.of_photo[photo] {
            if self.points[self.track_of(*o)].is_some() {
                let at = self.tracks.pixels[*o as usize];
                let cell = |x: f64, size: u32| ((x / f64::from(size) * SIDE as f64) as usize).min(SIDE - 1);
                cells[cell(at.y, camera.height) * SIDE + cell(at.x, camera.width)] = true;
                count += 1;
            }
        }
        let mut score = 0;
        let mut side = SIDE;
        while side > 1 {
            score += cells.iter().filter(|c| **c).count() * side * side;
            let half = side / 2;
            let coarse = |i: usize| {
                let (y, x) = (i / half * 2, i % half * 2);
                cells[y * side + x]
                    || cells[y * side + x + 1]
                    || cells[(y + 1) * side + x]
                    || cells[(y + 1) * side + x + 1]
            };
            cells = (0..half * half).map(coarse).collect();
            side = half;
        }
        (count, score)
    }

    /// Finds the pose of a photograph from the points it shows; `false` if less than the fraction `ratio` of them agree.
    fn register(&mut self, photo: usize, ratio: f64) -> bool {
        let seen: Vec<u32> = self.tracks.of_photo[photo]
            .iter()
            .copied()
            .filter(|o| self.points[self.track_of(*o)].is_some() && self.plane[*o as usize].is_finite())
            .collect();
        let (at, points): (Vec<DVec2>, Vec<DVec3>) = seen
            .iter()
            .map(|o| {
                let point = self.points[self.track_of(*o)].expect("filtered");
                (self.plane[*o as usize], point)
            })
            .unzip();
        let focal = self.camera(photo as u32).focal();
        let limits = Limits {
            samples: 2000,
            confidence: 0.9999,
            seed: photo as u64,
        };
        let solved = |factor: f64| {
            let projections = at.iter().map(|at| *at / factor).zip(points.iter().copied());
            let problem = Resection::new(
                projections.collect(),
                self.options.max_registration_error / (focal * factor),
            );
            let found = problem.solve(Vec::new(), limits)?;
            Some((factor, problem, found))
        };
        let min_inliers = self.options.min_registration_inliers as f64;
        let agrees = |found: &Estimate<DPose>| found.inliers as f64 >= min_inliers.max(ratio * seen.len() as f64);
        let group = self.photos[photo].group;
        let is_first = self.registered_in_group(group) == 0 && !self.held_cameras[group];
        let mut found = if is_first && self.sources[group] == FocalSource::Guess {
            None
        } else {
            solved(1.0).filter(|(.., found)| agrees(found))
        };
        // The metadata of a photograph that was cropped later are wrong.
        if found.is_none() && is_first {
            let any = FOCAL_FACTORS.into_iter().filter_map(solved);
            let best = any.min_by(|(.., a), (.., b)| a.cost.total_cmp(&b.cost));
            let is_inside = |factor: f64| factor > FOCAL_FACTORS[0] && factor < FOCAL_FACTORS[FOCAL_FACTORS.len() - 1];
            found = best.filter(|(factor, _, found)| is_inside(*factor) && agrees(found));
        }
        let Some((factor, problem, found)) = found else {
            return false;
        };
        if factor != 1.0 {
            self.scale_focal(group, factor);
        }
        self.set_pose(photo, found.model);
        for (o, inlier) in seen.iter().zip(problem.inliers(&found.model)) {
            self.used[*o as usize] = inlier;
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_are_alike_where_cameras_of_both_have_one_focal_length() {
        let of = |focals: &[Option<f64>]| SeedOutcome {
            poses: Vec::new(),
            focals: focals.to_vec(),
        };
        let model = of(&[Some(1164.0), Some(1242.0), None]);
        assert!(model.is_similar(&of(&[Some(1160.0), Some(1239.0), Some(900.0)])));
        assert!(!model.is_similar(&of(&[Some(1160.0), Some(1300.0), None])));
        assert!(!of(&[Some(9300.0)]).is_similar(&of(&[Some(8446.0)])));
        assert!(of(&[]).is_similar(&of(&[])), "no doubt");
    }
}
