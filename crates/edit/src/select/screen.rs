//! Selections drawn over a picture: polygons and brush strokes.

use crate::visibility::{MIN_VISIBLE_WEIGHT, Observer};
use crate::{Draft, Selection, Viewpoint};
use glam::DVec2;

/// The splats whose centres are inside a polygon, by the even-odd rule.
pub(super) fn polygon(draft: &Draft, camera: &Viewpoint, points: &[[f64; 2]]) -> Selection {
    let corners: Vec<DVec2> = points.iter().map(|p| DVec2::from(*p)).collect();
    let low = corners.iter().copied().fold(DVec2::INFINITY, DVec2::min);
    let high = corners.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
    let is_inside = |at: DVec2| {
        if at.cmplt(low).any() || at.cmpgt(high).any() {
            return false;
        }
        // Counts edges to the right of the point: their number is odd if it is inside.
        let mut inside = false;
        let mut from = corners[corners.len() - 1];
        for to in &corners {
            if (from.y > at.y) != (to.y > at.y) {
                let x = from.x + (at.y - from.y) / (to.y - from.y) * (to.x - from.x);
                inside ^= at.x < x;
            }
            from = *to;
        }
        inside
    };
    Selection::of(draft.len(), |i| {
        camera.project(draft.position(i)).is_some_and(is_inside)
    })
}

/// The splats whose centres are within `radius` pixels of a stroke.
pub(super) fn brush(draft: &Draft, camera: &Viewpoint, points: &[[f64; 2]], radius: f64) -> Selection {
    let points: Vec<DVec2> = points.iter().map(|p| DVec2::from(*p)).collect();
    let margin = DVec2::splat(radius);
    let low = points.iter().copied().fold(DVec2::INFINITY, DVec2::min) - margin;
    let high = points.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max) + margin;
    let distance_to = |at: DVec2, from: DVec2, to: DVec2| {
        let along = to - from;
        let share = (at - from).dot(along) / along.length_squared().max(f64::MIN_POSITIVE);
        at.distance(from + share.clamp(0.0, 1.0) * along)
    };
    let is_touched = |at: DVec2| {
        let is_near = at.cmpge(low).all() && at.cmple(high).all();
        is_near
            && (at.distance(points[0]) <= radius
                || points
                    .windows(2)
                    .any(|ends| distance_to(at, ends[0], ends[1]) <= radius))
    };
    Selection::of(draft.len(), |i| {
        camera.project(draft.position(i)).is_some_and(is_touched)
    })
}

/// Restricts a selection to the splats that the picture shows, if `visible`.
pub(super) fn visible_only(draft: &Draft, camera: &Viewpoint, visible: bool, mut selection: Selection) -> Selection {
    if visible {
        let camera = camera.camera(&draft.cloud.world_from_dataset);
        let weights = Observer::new(draft, &draft.visible()).weights(&camera);
        selection.intersect(&Selection::of(draft.len(), |i| weights[i] >= MIN_VISIBLE_WEIGHT));
    }
    selection
}
