//! Points of tracks: robust triangulation, completion by further photographs, and removal of outliers.

use super::model::GrowingModel;
use crate::geometry::triangulate::{ViewRay, cosine_at, midpoint, refine_point};
use glam::DVec3;
use irradia_scene::Rng;
use rayon::prelude::*;

/// Number of pairs of rays tried for one track: if half of its observations are wrong, all pairs fail once in 70 times.
const MAX_RAY_PAIRS: usize = 15;

impl GrowingModel<'_> {
    /// Triangulates the tracks in `tracks` that have no point yet, and completes those that have. Returns how many observations
    /// were added.
    pub fn triangulate(&mut self, tracks: &[usize]) -> usize {
        let found: Vec<Option<(DVec3, Vec<usize>)>> =
            tracks.par_iter().map(|track| self.triangulate_track(*track)).collect();
        let mut added = 0;
        for (track, found) in tracks.iter().zip(found) {
            if let Some((point, observations)) = found {
                added += observations.len();
                self.points[*track] = Some(point);
                for o in observations {
                    self.used[o] = true;
                }
            }
        }
        added
    }

    /// A track's point and the observations to add to it; `None` if there is nothing to change.
    fn triangulate_track(&self, track: usize) -> Option<(DVec3, Vec<usize>)> {
        let limit = self.options.max_error * self.options.max_error;
        if let Some(point) = self.points[track] {
            let added: Vec<usize> = self
                .tracks
                .range(track)
                .filter(|o| !self.used[*o] && self.view_ray(*o).is_some_and(|s| s.error_squared(point) < limit))
                .collect();
            return (!added.is_empty()).then_some((point, added));
        }
        let rays: Vec<(usize, ViewRay)> = self
            .tracks
            .range(track)
            .filter_map(|o| Some((o, self.view_ray(o)?)))
            .collect();
        if rays.len() < 2 {
            return None;
        }
        let cosine = self.options.min_angle.cos();
        let directions: Vec<DVec3> = rays.iter().map(|s| s.1.direction()).collect();
        let score = |point: DVec3| {
            let errors = rays.iter().map(|s| s.1.error_squared(point));
            let (mut count, mut sum) = (0, 0.0);
            for error in errors.filter(|e| *e < limit) {
                count += 1;
                sum += error;
            }
            (count, sum)
        };
        let mut best: Option<(DVec3, usize, f64)> = None;
        let mut try_pair = |i: usize, j: usize| {
            if directions[i].dot(directions[j]) > cosine {
                return false;
            }
            let Some(point) = midpoint([rays[i].1, rays[j].1].into_iter()) else {
                return false;
            };
            let (count, sum) = score(point);
            if count >= 2 && best.is_none_or(|(_, c, s)| count > c || (count == c && sum < s)) {
                best = Some((point, count, sum));
            }
            count == rays.len()
        };
        let n = rays.len();
        if n * (n - 1) / 2 <= MAX_RAY_PAIRS {
            'all: for i in 0..n {
                for j in i + 1..n {
                    if try_pair(i, j) {
                        break 'all;
                    }
                }
            }
        } else {
            let mut rng = Rng::new(track as u64, 3);
            for _ in 0..MAX_RAY_PAIRS {
                let i = rng.below(n as u32) as usize;
                let j = (i + 1 + rng.below(n as u32 - 1) as usize) % n;
                if try_pair(i, j) {
                    break;
                }
            }
        }
        let (start, ..) = best?;
        let mut point = start;
        for _ in 0..2 {
            let near = rays.iter().map(|s| s.1).filter(|s| s.error_squared(point) < limit);
            point = refine_point(point, near, 4)?;
        }
        let observations: Vec<&(usize, ViewRay)> = rays.iter().filter(|s| s.1.error_squared(point) < limit).collect();
        let centers: Vec<DVec3> = observations.iter().map(|s| s.1.position).collect();
        has_wide_angle(point, &centers, cosine).then(|| (point, observations.into_iter().map(|s| s.0).collect()))
    }

    /// Removes observations with large errors from the points of `tracks`, and points with too few observations or too
    /// narrow rays. Returns how many observations were removed.
    pub fn filter(&mut self, tracks: &[usize]) -> usize {
        let limit = self.options.max_error * self.options.max_error;
        let cosine = self.options.min_angle.cos();
        let bad: Vec<(Vec<usize>, bool)> = tracks
            .par_iter()
            .map(|track| {
                let Some(point) = self.points[*track] else {
                    return (Vec::new(), false);
                };
                let mut bad = Vec::new();
                let mut centers = Vec::new();
                for o in self.tracks.range(*track).filter(|o| self.used[*o]) {
                    match self.view_ray(o) {
                        Some(ray) if ray.error_squared(point) < limit => centers.push(ray.position),
                        _ => bad.push(o),
                    }
                }
                (bad, !has_wide_angle(point, &centers, cosine))
            })
            .collect();
        let mut removed = 0;
        for (track, (bad, drop)) in tracks.iter().zip(bad) {
            removed += bad.len();
            for o in bad {
                self.used[o] = false;
            }
            if drop {
                removed += self.tracks.range(*track).filter(|o| self.used[*o]).count();
                self.remove_point(*track);
            }
        }
        removed
    }

    /// Moves the points of `tracks` to the least-squares solution for their current observations.
    pub fn refine_points(&mut self, tracks: &[usize]) {
        let moved: Vec<Option<DVec3>> = tracks
            .par_iter()
            .map(|track| {
                let rays: Vec<ViewRay> = self
                    .tracks
                    .range(*track)
                    .filter(|o| self.used[*o])
                    .filter_map(|o| self.view_ray(o))
                    .collect();
                refine_point(self.points[*track]?, rays.into_iter(), 3)
            })
            .collect();
        for (track, point) in tracks.iter().zip(moved) {
            if point.is_some() {
                self.points[*track] = point;
            }
        }
    }

    /// Tracks with an observation in the photograph, in their order.
    pub fn tracks_of(&self, photo: usize) -> Vec<usize> {
        self.tracks.of_photo[photo].iter().map(|o| self.track_of(*o)).collect()
    }

    /// All tracks that have a point.
    pub fn triangulated_tracks(&self) -> Vec<usize> {
        (0..self.tracks.len()).filter(|t| self.points[*t].is_some()).collect()
    }
}

/// Whether two of the centres see the point at an angle whose cosine is below `cosine`.
fn has_wide_angle(point: DVec3, centers: &[DVec3], cosine: f64) -> bool {
    centers
        .iter()
        .enumerate()
        .any(|(i, a)| centers[..i].iter().any(|b| cosine_at(point, *a, *b) < cosine))
}
