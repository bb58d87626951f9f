//! Captures that go around an object, or look around: gaps, and ends that do not meet.

use super::{Diagnosis, Evidence, Graph};
use crate::upright::up;
use glam::{DQuat, DVec3};

/// Minimum number of photographs for a capture to be a ring.
const RING: usize = 10;
/// A gap wider than this, degrees, is where the capture ends, for example at a wall behind the subject.
const OPEN: f64 = 120.0;
/// Width of the narrowest gap, in degrees and in medians of the spacing.
const GAP: f64 = 18.0;
const SPACINGS: f64 = 3.0;
/// Gaps up to this width, degrees, leave a loop open; wider ones are gaps. Features match over up to 30 degrees.
const LOOP: f64 = 45.0;
/// Photographs on both sides of a gap are expected to match across it up to this angle from its edges, degrees.
const SIDE: f64 = 30.0;
/// Minimum horizontal part of a viewing direction for its azimuth to be usable.
const LEVEL: f64 = 0.3;

/// Gaps between neighbouring viewing directions that no pair of photographs spans. Without a model, `turns` holds the rotation from
/// each camera to the world.
pub(super) fn ring(evidence: &Evidence, graph: &Graph, turns: &[Option<DQuat>]) -> Vec<Diagnosis> {
    let seen = azimuths(evidence, graph, turns);
    let n = seen.len();
    if n < RING {
        return Vec::new();
    }
    let width = |i: usize| {
        let (here, next) = (seen[i].0, seen[(i + 1) % n].0);
        (next - here).rem_euclid(360.0)
    };
    let mut widths: Vec<f64> = (0..n).map(width).collect();
    widths.sort_by(f64::total_cmp);
    let least = GAP.max(SPACINGS * widths[n / 2]);
    let gaps: Vec<usize> = (0..n)
        .filter(|i| width(*i) > least && !is_spanned(&seen, graph, *i))
        .collect();
    let ends_somewhere = gaps.iter().any(|i| width(*i) > OPEN);
    let inner: Vec<usize> = gaps.into_iter().filter(|i| width(*i) <= OPEN).collect();
    let alone = inner.len() == 1 && !ends_somewhere;
    inner
        .into_iter()
        .map(|i| {
            let (ends, degrees) = ([seen[i].1, seen[(i + 1) % n].1], width(i));
            if alone && degrees <= LOOP {
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
        let near = move |azimuth: f64| (sign * (azimuth - from)).rem_euclid(360.0) <= SIDE;
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
fn azimuths(evidence: &Evidence, graph: &Graph, turns: &[Option<DQuat>]) -> Vec<(f64, usize)> {
    let largest = graph.parts().into_iter().next().unwrap_or_default();
    let rotations: Vec<(usize, DQuat)> = match evidence.model() {
        Some(model) => (0..model.poses.len())
            .filter_map(|p| Some((p, model.poses[p]?.rotation)))
            .collect(),
        None => largest.into_iter().filter_map(|p| Some((p, turns[p]?))).collect(),
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
            (forward.truncate().length() > LEVEL)
                .then(|| (forward.y.atan2(forward.x).to_degrees().rem_euclid(360.0), photo))
        })
        .collect();
    seen.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    seen
}
