//! Regions of space, and ranges of splats' properties.

use crate::shape::quat;
use crate::{Draft, Selection, Shape};
use glam::DVec3;
use irradia_scene::sh;
use irradia_splat::sigmoid;

/// The splats whose centres are in a box, a ball or a half-space.
pub(super) fn in_region(draft: &Draft, shape: &Shape) -> Selection {
    let n = draft.len();
    match *shape {
        Shape::Box { center, size, rotation } => {
            let (center, half) = (DVec3::from(center), 0.5 * DVec3::from(size));
            let into_box = quat(rotation).inverse();
            Selection::of(n, |i| (into_box * (draft.position(i) - center)).abs().cmple(half).all())
        }
        Shape::Sphere { center, radius } => {
            Selection::of(n, |i| draft.position(i).distance(DVec3::from(center)) <= radius)
        }
        Shape::HalfSpace { point, normal } => {
            let (point, normal) = (DVec3::from(point), DVec3::from(normal));
            Selection::of(n, |i| (draft.position(i) - point).dot(normal) >= 0.0)
        }
        _ => unreachable!("not a region"),
    }
}

/// The splats with a colour, opacity, size or elongation in a range.
pub(super) fn in_property_range(draft: &Draft, shape: &Shape) -> Selection {
    let (n, cloud) = (draft.len(), &draft.cloud);
    let sorted = |i: usize| {
        let mut scales = cloud.log_scales[i].map(f64::from);
        scales.sort_unstable_by(f64::total_cmp);
        scales
    };
    let within = |value: f64, min: Option<f64>, max: Option<f64>| {
        min.is_none_or(|min| value >= min) && max.is_none_or(|max| value <= max)
    };
    match *shape {
        Shape::Color { low, high } => {
            let width = 3 * cloud.sh_coefficients();
            // Colours of splats may be beyond black and white, and so may bounds around such a colour.
            let (low, high) = (low.map(|v| v.min(1.0)), high.map(|v| v.max(0.0)));
            Selection::of(n, |i| {
                (0..3).all(|c| {
                    let color = f64::from(sh::color_from_dc(cloud.sh[i * width + c]).clamp(0.0, 1.0));
                    (low[c]..=high[c]).contains(&color)
                })
            })
        }
        Shape::Opacity { min, max } => {
            Selection::of(n, |i| within(f64::from(sigmoid(cloud.opacity_logits[i])), min, max))
        }
        Shape::Size { min, max } => {
            let unit = cloud.world_from_dataset.scale;
            Selection::of(n, |i| within(sorted(i)[2].exp() / unit, min, max))
        }
        Shape::Elongation { min, max } => Selection::of(n, |i| {
            let [_, middle, largest] = sorted(i);
            within((largest - middle).exp(), min, max)
        }),
        _ => unreachable!("not a property"),
    }
}
