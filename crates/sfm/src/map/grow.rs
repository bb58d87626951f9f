//! Growing a model from a seed, photograph by photograph.

use super::focal::{Source, are_alike};
use super::model::Working;
use super::refine::Extent;
use super::seed::seeds;
use super::tracks::Tracks;
use super::types::{FEW_PHOTOS, MapOptions, PhotoInfo, Progress, VerifiedPair};
use super::verify::Cameras;
use crate::geometry::pose::DPose;
use crate::geometry::ransac::{Estimate, Limits};
use crate::geometry::resection::Resection;
use glam::{DVec2, DVec3};

/// Maximum number of seeds tried for one model, and of candidates from which they are selected.
const SEEDS: usize = 12;
const CANDIDATES: usize = 20 * SEEDS;
/// Minimum fraction of its photographs' observations that a doubtful model must explain, such as one whose focal lengths are open.
/// Correct models of six captures, each cropped in ten ways, explain 0.88 to 1.00, and of a clock with three models 0.74; wrong ones
/// 0.06 to 0.67.
const EXPLAINED: f64 = 0.8;
/// Number of times a photograph is tried before it is given up.
const TRIES: usize = 3;
/// Minimum number of points of a pair of photographs for a seed.
const SEED_POINTS: usize = 12;
/// Minimum fraction of inliers among the points that a photograph shows. Photographs with less than the first wait until the others are
/// registered and everything is adjusted; then the second applies.
const STRICT: f64 = 0.5;
const LENIENT: f64 = 0.25;
/// Focal lengths tried for the first photograph of a camera, relative to the current one: steps of 15 %, from 0.5 to 4.8 long sides where
/// that is a guess. The best must be between the ends: for a wrong pose far away, with a long focal length, there is no minimum.
const FOCALS: [f64; 17] = [
    0.43, 0.5, 0.57, 0.66, 0.76, 0.87, 1.0, 1.15, 1.32, 1.52, 1.75, 2.0, 2.3, 2.65, 3.05, 3.5, 4.0,
];
/// Maximum number of rounds of adjustment, filtering and triangulation at the end.
const LAST_ROUNDS: usize = 3;

/// The largest model over several seeds among photographs not yet taken; `None` if there is none.
///
/// The search ends with a seed whose model has more than half of the photographs it could reach. Two photographs with wrong focal lengths
/// may lead to a wrong model of all photographs, which explains a third of their observations instead of nine tenths: where focal lengths
/// are open, or end far from where they began, the model must explain most observations as well. So must a model of few photographs: a
/// seed with wrong poses hardly finds others that disagree. `tried` counts failed registrations.
pub(super) fn model<'a>(
    photos: &'a [PhotoInfo],
    cameras: &Cameras,
    pairs: &[VerifiedPair],
    tracks: &'a Tracks,
    taken: &[bool],
    tried: &mut [usize],
    options: &'a MapOptions,
    progress: &mut dyn FnMut(Progress),
) -> Option<Working<'a>> {
    let empty = Working::new(photos, cameras, tracks, options);
    let open = empty.has_open_focals();
    let few = photos.len() <= FEW_PHOTOS;
    // Whether the model must also explain enough observations.
    let is_doubtful = |model: &Working| open || few || model.is_far_from_first_focals();
    let mut in_doubt = open || few;
    let mut best: Option<(Working, Vec<usize>)> = None;
    let mut outcomes: Vec<Outcome> = Vec::new();
    let mut left = SEEDS;
    for seed in seeds(pairs, taken, CANDIDATES) {
        if left == 0 {
            break;
        }
        // Two earlier seeds led to the same model, which contains this seed: it would lead there once more. 984 frames of two films of
        // a brick car, whose models explain 0.74 of their observations, used up all seeds, a minute each, and ended as the second.
        let holding: Vec<&Outcome> = (outcomes.iter())
            .filter(|outcome| outcome.holds(&pairs[seed]))
            .collect();
        if (1..holding.len()).any(|i| holding[..i].iter().any(|other| holding[i].is_like(other))) {
            continue;
        }
        left -= 1;
        let reachable = reachable(&pairs[seed], pairs, taken);
        if best
            .as_ref()
            .is_some_and(|(best, _)| best.registered() >= reachable && !is_doubtful(best))
        {
            continue;
        }
        let mut grown = empty.clone();
        let mut failures = vec![0; photos.len()];
        if !grown.start(&pairs[seed]) || !grown.grow(taken, &mut failures, progress) {
            continue;
        }
        // If photographs were cropped off centre, no seed explains more while principal points are held at the centre: fox, with each
        // photograph cropped at a different position, took all seeds and 88 s to be mapped, and now takes 9 s.
        if open && grown.explained_fraction() <= EXPLAINED {
            let mut free = grown.clone();
            free.free_principal_points();
            free.settle_fully(progress);
            free.grow(taken, &mut failures, progress);
            if free.explained_fraction() > EXPLAINED && free.registered() >= grown.registered() {
                grown = free;
            }
        }
        let doubtful = is_doubtful(&grown);
        outcomes.push(Outcome::of(&grown, doubtful));
        in_doubt |= doubtful;
        let size = |model: &Working| match in_doubt {
            true => model.used_count(),
            false => model.registered(),
        };
        if grown.registered() >= options.min_model_photos
            && best.as_ref().is_none_or(|(best, _)| size(&grown) > size(best))
        {
            best = Some((grown, failures));
        }
        let suffices = |best: &Working| {
            2 * best.registered() > reachable && (!is_doubtful(best) || best.explained_fraction() > EXPLAINED)
        };
        if best.as_ref().is_some_and(|(best, _)| suffices(best)) {
            break;
        }
    }
    let (best, failures) = best?;
    for (total, failed) in tried.iter_mut().zip(failures) {
        *total += failed;
    }
    Some(best)
}

/// The model to which a seed led.
struct Outcome {
    /// `[photos]` whether each has a pose.
    posed: Vec<bool>,
    /// `[groups]` focal lengths of cameras with photographs, px; empty if the model is not in doubt.
    focals: Vec<Option<f64>>,
}

impl Outcome {
    fn of(model: &Working, in_doubt: bool) -> Self {
        let groups = 0..if in_doubt { model.cameras.len() } else { 0 };
        let focal = |group| (model.registered_of(group) > 0).then(|| model.cameras[group].focal());
        Self {
            posed: model.poses.iter().map(Option::is_some).collect(),
            focals: groups.map(focal).collect(),
        }
    }

    fn holds(&self, pair: &VerifiedPair) -> bool {
        pair.photos.iter().all(|photo| self.posed[*photo as usize])
    }

    fn is_like(&self, other: &Self) -> bool {
        let both = self.focals.iter().zip(&other.focals).filter_map(|(a, b)| (*a).zip(*b));
        both.into_iter().all(|(a, b)| are_alike(a, b))
    }
}

/// Number of photographs that chains of pairs connect with the seed.
fn reachable(seed: &VerifiedPair, pairs: &[VerifiedPair], taken: &[bool]) -> usize {
    let mut reached = vec![false; taken.len()];
    reached[seed.photos[0] as usize] = true;
    loop {
        let mut grew = false;
        for pair in pairs {
            let [a, b] = pair.photos.map(|p| p as usize);
            if !taken[a] && !taken[b] && reached[a] != reached[b] {
                (reached[a], reached[b], grew) = (true, true, true);
            }
        }
        if !grew {
            return reached.iter().filter(|r| **r).count();
        }
    }
}

impl Working<'_> {
    /// Places the two photographs of a seed and their points; `false` if too few remain.
    fn start(&mut self, pair: &VerifiedPair) -> bool {
        let [a, b] = pair.photos.map(|p| p as usize);
        self.place(a, DPose::IDENTITY);
        self.place(
            b,
            DPose::from_camera_from_world(pair.motion.rotation, pair.motion.translation),
        );
        let tracks = self.tracks_of_rig(a);
        self.triangulate(&tracks);
        self.adjust_all(Extent::Growing);
        let points = self.with_points();
        self.filter(&points);
        self.point_count() >= SEED_POINTS
    }

    /// Registers photographs as long as that succeeds, then adjusts everything; `false` if the model is left with too few photographs.
    pub(super) fn grow(&mut self, taken: &[bool], failures: &mut [usize], progress: &mut dyn FnMut(Progress)) -> bool {
        let (mut photos_then, mut points_then) = (self.registered(), self.point_count());
        let mut settled = false;
        loop {
            let next = self.candidates(taken, failures).into_iter().find(|photo| {
                let registered = self.register(*photo, if settled { LENIENT } else { STRICT });
                failures[*photo] += usize::from(!registered && settled);
                registered
            });
            let Some(photo) = next else {
                if settled {
                    break;
                }
                // What failed before may succeed after a global adjustment.
                self.settle(Extent::Growing, progress);
                (photos_then, points_then, settled) = (self.registered(), self.point_count(), true);
                continue;
            };
            settled = false;
            let tracks = self.tracks_of_rig(photo);
            self.triangulate(&tracks);
            let growth = self.options.global_growth;
            let (photos, points) = (self.registered(), self.point_count());
            if photos as f64 >= growth * photos_then as f64 || points as f64 >= growth * points_then as f64 {
                self.settle(Extent::Growing, progress);
                (photos_then, points_then) = (self.registered(), self.point_count());
            } else {
                self.adjust_around(photo);
            }
            progress(Progress::Registered {
                photos: self.registered(),
                of: self.photos.len(),
                points: self.point_count(),
            });
        }
        self.settle_fully(progress);
        self.registered() >= self.options.min_model_photos
    }

    /// Adjusts everything with the full lens until hardly any observation changes, then once more until convergence.
    pub(super) fn settle_fully(&mut self, progress: &mut dyn FnMut(Progress)) {
        for _ in 0..LAST_ROUNDS {
            let changed = self.settle(Extent::Full, progress);
            let observations = self.used_count();
            if (changed as f64) < 1e-3 * observations as f64 {
                break;
            }
        }
        self.settle(Extent::Last, progress);
    }

    /// Adjusts everything, filters, triangulates again and removes photographs that lost their points. Returns the number of
    /// observations that changed.
    fn settle(&mut self, extent: Extent, progress: &mut dyn FnMut(Progress)) -> usize {
        self.adjust_all(extent);
        let points = self.with_points();
        let mut changed = self.filter(&points);
        if extent != Extent::Last {
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
    fn candidates(&self, taken: &[bool], failures: &[usize]) -> Vec<usize> {
        let mut scored: Vec<(usize, usize)> = (0..self.poses.len())
            .filter(|p| self.poses[*p].is_none() && !taken[*p] && failures[*p] < TRIES)
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
        let solved = |longer: f64| {
            let projections = at.iter().map(|at| *at / longer).zip(points.iter().copied());
            let problem = Resection::new(
                projections.collect(),
                self.options.max_registration_error / (focal * longer),
            );
            let found = problem.solve(Vec::new(), limits)?;
            Some((longer, problem, found))
        };
        let least = self.options.min_registration_inliers as f64;
        let agrees = |found: &Estimate<DPose>| found.inliers as f64 >= least.max(ratio * seen.len() as f64);
        let group = self.photos[photo].group;
        let first = self.registered_of(group) == 0 && !self.held_cameras[group];
        let mut found = if first && self.sources[group] == Source::Guess {
            None
        } else {
            solved(1.0).filter(|(.., found)| agrees(found))
        };
        // The metadata of a photograph that was cropped later are wrong.
        if found.is_none() && first {
            let any = FOCALS.into_iter().filter_map(solved);
            let best = any.min_by(|(.., a), (.., b)| a.cost.total_cmp(&b.cost));
            let between = |longer: f64| longer > FOCALS[0] && longer < FOCALS[FOCALS.len() - 1];
            found = best.filter(|(longer, _, found)| between(*longer) && agrees(found));
        }
        let Some((longer, problem, found)) = found else {
            return false;
        };
        if longer != 1.0 {
            self.scale_focal(group, longer);
        }
        self.place(photo, found.model);
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
        let of = |focals: &[Option<f64>]| Outcome {
            posed: Vec::new(),
            focals: focals.to_vec(),
        };
        let model = of(&[Some(1164.0), Some(1242.0), None]);
        assert!(model.is_like(&of(&[Some(1160.0), Some(1239.0), Some(900.0)])));
        assert!(!model.is_like(&of(&[Some(1160.0), Some(1300.0), None])));
        assert!(!of(&[Some(9300.0)]).is_like(&of(&[Some(8446.0)])));
        assert!(of(&[]).is_like(&of(&[])), "no doubt");
    }
}
