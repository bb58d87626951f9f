//! Evaluation of selections.

mod region;
mod screen;
mod space;

use crate::floaters::floater_scores;
use crate::subject::subject;
use crate::visibility::count_seeing_views;
use crate::{Draft, EditError, Mode, SelectStep, Selection, Shape};

/// The splats that `steps` select, none of them hidden or locked; without steps nothing is selected.
///
/// # Errors
/// When a number is out of range, or a step needs cameras that are not known.
pub fn select(draft: &Draft, steps: &[SelectStep]) -> Result<Selection, EditError> {
    select_among(draft, steps, &selectable(draft))
}

/// The splats that are neither hidden nor locked.
pub(crate) fn selectable(draft: &Draft) -> Selection {
    let mut selectable = draft.hidden.clone();
    selectable.add(&draft.locked);
    selectable.invert();
    selectable
}

/// Like [`select`], but among the splats `selectable`.
pub(crate) fn select_among(
    draft: &Draft,
    steps: &[SelectStep],
    selectable: &Selection,
) -> Result<Selection, EditError> {
    steps.iter().try_for_each(SelectStep::check)?;
    // Hidden splats are as if they were not there, unless they are to be shown.
    let mut present = draft.visible();
    present.add(selectable);
    let begins_full = steps.first().is_some_and(|step| step.mode != Mode::Add);
    let mut selected = if begins_full {
        Selection::all(draft.len())
    } else {
        Selection::none(draft.len())
    };
    for step in steps {
        match &step.shape {
            Shape::Invert {} => selected.invert(),
            Shape::Grow { by } => selected = space::grow(draft, &selected, *by),
            Shape::Connected { gap } => selected = space::connected(draft, &present, &selected, *gap),
            shape => {
                let inside = evaluate(draft, &present, shape)?;
                match step.mode {
                    Mode::Add => selected.add(&inside),
                    Mode::Subtract => selected.subtract(&inside),
                    Mode::Intersect => selected.intersect(&inside),
                }
            }
        }
        selected.intersect(selectable);
    }
    Ok(selected)
}

/// The splats in one shape; clusters are those of the splats `present`.
fn evaluate(draft: &Draft, present: &Selection, shape: &Shape) -> Result<Selection, EditError> {
    Ok(match shape {
        Shape::All {} => Selection::all(draft.len()),
        Shape::Last {} => draft.last.clone(),
        Shape::Box { .. } | Shape::Sphere { .. } | Shape::HalfSpace { .. } => region::in_region(draft, shape),
        Shape::Color { .. } | Shape::Opacity { .. } | Shape::Size { .. } | Shape::Elongation { .. } => {
            region::in_property_range(draft, shape)
        }
        Shape::Polygon {
            camera,
            points,
            visible,
        } => screen::visible_only(draft, camera, *visible, screen::polygon(draft, camera, points)),
        Shape::Brush {
            camera,
            points,
            radius,
            visible,
        } => screen::visible_only(draft, camera, *visible, screen::brush(draft, camera, points, *radius)),
        Shape::Clusters { min, max, gap } => space::clusters(draft, present, [*min, *max], *gap),
        Shape::Views { min, max } => {
            if draft.cameras.is_empty() {
                return Err(EditError::NoCameras("views"));
            }
            let range = min.unwrap_or(0)..=max.unwrap_or(u32::MAX);
            let views = count_seeing_views(draft);
            Selection::of(draft.len(), |i| range.contains(&views[i]))
        }
        Shape::Floaters { score } => {
            let least = score.unwrap_or(1.0) as f32;
            let scores = floater_scores(draft);
            Selection::of(draft.len(), |i| scores[i].score() >= least)
        }
        Shape::Subject { margin } => {
            let (center, radius) = subject(draft).ok_or(EditError::NoCameras("subject"))?;
            let radius = radius * margin.unwrap_or(1.0);
            region::in_region(draft, &Shape::Sphere { center, radius })
        }
        Shape::Invert {} | Shape::Grow { .. } | Shape::Connected { .. } => {
            unreachable!("they change the current selection")
        }
    })
}
