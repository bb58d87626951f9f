//! The text by which pages list an entry of a session.

use irradia_edit::{Mode, Operation, SelectStep, Shape};

/// The text of a selection in the list.
pub(super) fn select_text(steps: &[SelectStep], replace: bool) -> String {
    let Some(first) = steps.first() else {
        return String::new();
    };
    let connected = steps.iter().find(|step| matches!(step.shape, Shape::Connected { .. }));
    let named = &connected.unwrap_or(first).shape;
    let name = match named {
        Shape::All {} => "All",
        Shape::Box { .. } => "Box",
        Shape::Sphere { .. } => "Sphere",
        Shape::HalfSpace { .. } => "Half-space",
        Shape::Polygon { .. } => "Outline",
        Shape::Brush { .. } => "Brush",
        Shape::Color { .. } => "Colour",
        Shape::Opacity { .. } => "Opacity",
        Shape::Size { .. } => "Size",
        Shape::Elongation { .. } => "Elongation",
        Shape::Views { .. } => "Views",
        Shape::Clusters { .. } => "Clusters",
        Shape::Floaters { .. } => "Floaters",
        Shape::Subject { .. } => "Subject",
        Shape::Invert {} => "Invert",
        Shape::Grow { .. } => "Grow",
        Shape::Connected { .. } => "Connected",
        Shape::Last {} => "Last",
    };
    match (replace, first.mode) {
        (false, Mode::Add) if !matches!(named, Shape::Invert {} | Shape::Grow { .. } | Shape::Connected { .. }) => {
            format!("+ {name}")
        }
        (_, Mode::Subtract) => format!("− {name}"),
        (_, Mode::Intersect) => format!("∩ {name}"),
        _ => name.to_owned(),
    }
}

/// The text of an edit of `selected` splats in the list.
pub(super) fn edit_text(op: &Operation, selected: usize, before: usize, after: usize) -> String {
    let verb = match op {
        Operation::Delete {} => return format!("Delete {}", before - after),
        Operation::Keep {} => return format!("Keep {after}"),
        Operation::Reduce { .. } => return format!("Reduce to {after}"),
        Operation::Upright { .. } => return "Set upright".to_owned(),
        Operation::SetLength { .. } => return "Set scale".to_owned(),
        Operation::Merge { .. } => return "Merge".to_owned(),
        Operation::Split { name } => return format!("Split off {name}"),
        Operation::Show {} => return "Show all".to_owned(),
        Operation::Unlock {} => return "Unlock all".to_owned(),
        Operation::Move { .. } => "Move",
        Operation::Rotate { .. } => "Rotate",
        Operation::Scale { .. } => "Scale",
        Operation::Duplicate { .. } => "Duplicate",
        Operation::Recolor { .. } => "Recolour",
        Operation::Opacity { .. } => "Opacity of",
        Operation::Hide {} => "Hide",
        Operation::Lock {} => "Lock",
    };
    format!("{verb} {selected}")
}
