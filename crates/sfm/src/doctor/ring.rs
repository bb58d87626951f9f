//! Captures that go around an object, or look around: gaps, and ends that do not meet.

use super::{Diagnosis, Evidence, Graph};
use crate::upright::up;
use glam::{DQuat, DVec3};

/// Minimum number of photographs for a capture to be a ring.
const MIN_RING_PHOTOS: usize = 10;
/// A gap wider than this, degrees, is where the capture ends, for example at a wall behind the subject.
const MAX_GAP_DEGREES: f64 = 120.0;
/// Width of the narrowest gap, in degrees and in medians of the spacing.
const MIN_GAP_DEGREES: f64 = 18.0;
const MIN_GAP_SPACINGS: f64 = 3.0;
/// Gaps up to this width, degrees, leave a loop open; wider ones are gaps. Features match over up to 30 degrees.
const MAX_OPEN_LOOP_DEGREES: f64 = 45.0;
/// Photographs on both sides of a gap are expected to match across it up to this angle from its edges, degrees.
const MAX_MATCH_DEGREES: f64 = 30.0;
/// Minimum horizontal part of a viewing direction for its azimuth to be usable.
const MIN_HORIZONTAL_LENGTH: f64 = 0.3;

/// Gaps between neighbouring viewing directions that no pair of photographs spans. Without a model, `world_from_camera` holds the rotation
/// of each camera.
pub(super) fn ring(evidence: &Evidence, graph: &Graph, world_from_camera: &[Option<DQuat>]) -> Vec<Diagnosis> {
    let seen = azimuths(evidence, graph, world_from_camera);
    let n = seen.len();
    if n < MIN_RING_PHOTOS {
        return Vec::new();
    }
    let width = |i: usize| {
        let (here, next) = (seen[i].0, seen[(i + 1) % n].0);
        (next - here).rem_euclid(360.0)
    };
    let mut widths: Vec<f64> = (0..n).map(width).collect();
    widths.sort_by(f64::total_cmp);
    let min_gap = MIN_GAP_DEGREES.max(MIN_GAP_SPACINGS * widths[n / 2]);
    let gaps: Vec<usize> = (0..n)
        .filter(|i| width(*i) > min_gap && !is_spanned(&seen, graph, *i))
        .collect();
    let has_open_end = gaps.iter().any(|i| width(*i) > MAX_GAP_DEGREES);
    let inner: Vec<usize> = gaps.into_iter().filter(|i| width(*i) <= MAX_GAP_DEGREES).collect();
    let is_single = inner.len() == 1 && !has_open_end;
    inner
        .into_iter()
        .map(|i| {
            let (ends, degrees) = ([seen[i].1, seen[(i + 1) % n].1], width(i));
            if is_single && degrees <= MAX_OPEN_LOOP_DEGREES {
                Diagnosis::OpenLoop { ends, degrees }
            } else {
                Diagnosis::Gap { sides: ends, degrees }
            }
        })
        .collect()
}

/// Whether photographs on both sides of the gap after `seen[i]` match each other.
fn is_spanned(seen: &[(f64, usize)], graph: &Graph, i: usize) -> bool {
    let n = seen.len();
    let (before, after) = (seen[i].0, seen[(i + 1) % n].0);
    let side = |from: f64, sign: f64| {
        let near = move |azimuth: f64| (sign * (azimuth - from)).rem_euclid(360.0) <= MAX_MATCH_DEGREES;
        seen.iter().filter(move |s| near(s.0)).map(|s| s.1).collect::<Vec<_>>()
    };
    let (left, right) = (side(before, -1.0), side(after, 1.0));
    left.iter().any(|photo| {
        graph.partners[*photo]
            .iter()
            .any(|(other, _)| right.contains(other) && !left.contains(other))
    })
}

/// Azimuths of viewing directions in degrees, ascending, with their photographs: those of the model, else those of the largest
/// part of the pairs.
fn azimuths(evidence: &Evidence, graph: &Graph, world_from_camera: &[Option<DQuat>]) -> Vec<(f64, usize)> {
    let largest = graph.components().into_iter().next().unwrap_or_default();
    let rotations: Vec<(usize, DQuat)> = match evidence.model() {
        Some(model) => (0..model.poses.len())
            .filter_map(|p| Some((p, model.poses[p]?.rotation)))
            .collect(),
        None => largest
            .into_iter()
            .filter_map(|p| Some((p, world_from_camera[p]?)))
            .collect(),
    };
    let up = up(rotations
        .iter()
        .map(|(photo, rotation)| (*rotation, evidence.photos[*photo].up)));
    let level = DQuat::from_rotation_arc(up, DVec3::Z);
    let mut seen: Vec<(f64, usize)> = rotations
        .into_iter()
        // Faces of panoramas look in all directions.
        .filter(|(photo, _)| !graph.is_on_rig(*photo))
        .filter_map(|(photo, rotation)| {
            let forward = level * (rotation * DVec3::Z);
            (forward.truncate().length() > MIN_HORIZONTAL_LENGTH)
                .then(|| (forward.y.atan2(forward.x).to_degrees().rem_euclid(360.0), photo))
        })
        .collect();
    seen.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    seen
}
