//! Operations in two parts: first everything that may fail, then the change itself.

use crate::color::ColorMap;
use crate::draft::{append, gather};
use crate::ground::ground;
use crate::select::{select, select_among, selectable};
use crate::transform::{transform_scene, transform_splats};
use crate::{Draft, Edit, EditError, Operation, Selection, Transform, UpAxis};
use glam::{DQuat, DVec3};
use irradia_scene::GaussianCloud;
use irradia_splat::{logit, sigmoid};
use rayon::prelude::*;

/// Opens the scenes that [`Operation::Merge`] names; an error is one line.
pub type OpenScene<'a> = &'a dyn Fn(&str) -> Result<GaussianCloud, String>;

/// For edits that must not read other scenes.
pub fn open_nothing(file: &str) -> Result<GaussianCloud, String> {
    Err(format!("{file} cannot be opened here"))
}

/// Where the splats of an edited scene come from.
#[derive(Clone, Debug, PartialEq)]
pub struct Provenance {
    /// For each splat its index before, or [`Provenance::NEW`]; `None` if they are the same splats in the same order.
    pub sources: Option<Vec<u32>>,
    /// The splats whose values may differ from those of their source, and all new splats.
    pub changed: Selection,
}

impl Provenance {
    /// The source of a splat that did not exist before.
    pub const NEW: u32 = u32::MAX;

    /// The provenance of `n` splats that did not change.
    pub fn identity(n: usize) -> Self {
        Self {
            sources: None,
            changed: Selection::none(n),
        }
    }

    /// The index before of splat `i`, if it existed.
    pub fn source(&self, i: usize) -> Option<u32> {
        match &self.sources {
            None => Some(i as u32),
            Some(sources) => Some(sources[i]).filter(|source| *source != Self::NEW),
        }
    }

    /// The provenance of this edit followed by `next`.
    pub fn then(&self, next: &Self) -> Self {
        let n = next.changed.len();
        let changed = Selection::of(n, |i| {
            let before = next.source(i);
            next.changed.contains(i) || before.is_none_or(|i| self.changed.contains(i as usize))
        });
        let sources = (self.sources.is_some() || next.sources.is_some()).then(|| {
            let source = |i| next.source(i).and_then(|before| self.source(before as usize));
            (0..n).map(|i| source(i).unwrap_or(Self::NEW)).collect()
        });
        Self { sources, changed }
    }
}

/// The result of an edit.
#[derive(Clone, Debug)]
pub struct Applied {
    /// The edit with all automatically determined values filled in, so that replaying it gives the same result.
    pub edit: Edit,
    /// Where the splats come from.
    pub provenance: Provenance,
    /// Number of selected splats; all of them if the edit applies to the whole scene.
    pub selected: usize,
    /// The transform of the whole scene, in the dataset's coordinates, if it was moved: for other objects in it. The draft's cameras have
    /// been moved already.
    pub moved: Option<Transform>,
    /// The scene that was split off, with its name.
    pub split: Option<(String, GaussianCloud)>,
}

/// Applies an edit. If it fails, nothing changes.
///
/// # Errors
/// When the edit is invalid or not possible on this scene.
pub fn apply(draft: &mut Draft, edit: &Edit, open: OpenScene) -> Result<Applied, EditError> {
    Ok(Plan::new(draft, edit, open)?.execute(draft))
}

/// Like [`apply`], for an edit whose steps are known to give `selection` on this scene: they are not evaluated again. Edits that show or
/// unlock splats, and those of the whole scene, do not use it.
///
/// # Errors
/// The same.
///
/// # Panics
/// When `selection` is that of another number of splats.
pub fn apply_to(draft: &mut Draft, edit: &Edit, selection: &Selection, open: OpenScene) -> Result<Applied, EditError> {
    assert_eq!(selection.len(), draft.len(), "a selection of the same scene");
    Ok(Plan::with_selection(draft, edit, Some(selection), open)?.execute(draft))
}

/// An edit that can no longer fail.
pub(crate) struct Plan {
    edit: Edit,
    selection: Selection,
    pub(crate) change: Change,
}

/// What happens to the splats.
pub(crate) enum Change {
    Remove(Selection),
    /// Moves the splats to a new scene of this name.
    Split(Selection, String),
    Transform(Selection, Transform),
    TransformScene(Transform),
    Recolor(Selection, ColorMap),
    Fade(Selection, f64),
    /// New splats, with their sources.
    Append(GaussianCloud, Vec<u32>),
    Hide(Selection, bool),
    Lock(Selection, bool),
    Nothing,
}

impl Change {
    /// Whether the scene no longer matches its photographs after the change.
    fn invalidates_photographs(&self) -> bool {
        matches!(
            self,
            Self::Transform(..) | Self::Recolor(..) | Self::Fade(..) | Self::Append(..)
        )
    }
}

impl Plan {
    pub fn new(draft: &Draft, edit: &Edit, open: OpenScene) -> Result<Self, EditError> {
        Self::with_selection(draft, edit, None, open)
    }

    /// The plan of an edit whose steps give `known`, if that is known.
    fn with_selection(
        draft: &Draft,
        edit: &Edit,
        known: Option<&Selection>,
        open: OpenScene,
    ) -> Result<Self, EditError> {
        edit.check()?;
        let mut edit = edit.clone();
        let selection = selection_of(draft, &edit, known)?;
        let target = Target {
            draft,
            selection: selection.clone(),
            is_scene: edit.select.is_none(),
        };
        let change = target.change(&mut edit.op, open)?;
        let grown = match &change {
            Change::Append(cloud, _) => draft.len() + cloud.len(),
            _ => draft.len(),
        };
        if grown >= Provenance::NEW as usize {
            return Err(EditError::Scene(format!(
                "the scene would have {grown} splats, at most 4294967294 are possible"
            )));
        }
        Ok(Self {
            edit,
            selection,
            change,
        })
    }

    pub fn execute(self, draft: &mut Draft) -> Applied {
        let n = draft.len();
        let mut provenance = Provenance::identity(n);
        let (mut moved, mut split) = (None, None);
        let selected = self.selection.count();
        draft.last = self.selection;
        if self.change.invalidates_photographs() {
            draft.photographs = None;
        }
        match self.change {
            Change::Remove(selection) => provenance = remove(draft, selection),
            Change::Split(selection, name) => {
                split = Some((name, gather(&draft.cloud, &selection.indices())));
                provenance = remove(draft, selection);
            }
            Change::Transform(selection, transform) => {
                transform_splats(&mut draft.cloud, &selection, &transform);
                provenance.changed = selection;
            }
            Change::TransformScene(transform) => {
                transform_scene(draft, &transform);
                (moved, provenance.changed) = (Some(transform), Selection::all(n));
            }
            Change::Recolor(selection, map) => {
                let width = 3 * draft.cloud.sh_coefficients();
                let rows = draft.cloud.sh.par_chunks_exact_mut(width).zip(selection.as_slice());
                rows.filter(|(_, s)| **s).for_each(|(row, _)| map.apply(row));
                provenance.changed = selection;
            }
            Change::Fade(selection, factor) => {
                let rows = draft.cloud.opacity_logits.iter_mut().zip(selection.as_slice());
                rows.filter(|(_, s)| **s)
                    .for_each(|(value, _)| *value = scaled_opacity_logit(*value, factor));
                provenance.changed = selection;
            }
            Change::Append(mut cloud, new) => {
                let degree = draft.cloud.sh_degree.max(cloud.sh_degree);
                draft.cloud.set_degree(degree);
                cloud.set_degree(degree);
                append(&mut draft.cloud, &cloud);
                draft.hidden.append(new.len());
                draft.locked.append(new.len());
                draft.last = Selection::of(n + new.len(), |i| i >= n);
                provenance = Provenance {
                    sources: Some((0..n as u32).chain(new.iter().copied()).collect()),
                    changed: Selection::of(n + new.len(), |i| i >= n),
                };
            }
            Change::Hide(selection, true) => draft.hidden.add(&selection),
            Change::Hide(selection, false) => draft.hidden.subtract(&selection),
            Change::Lock(selection, true) => draft.locked.add(&selection),
            Change::Lock(selection, false) => draft.locked.subtract(&selection),
            Change::Nothing => {}
        }
        Applied {
            edit: self.edit,
            provenance,
            selected,
            moved,
            split,
        }
    }
}

/// The splats to which an edit applies: `known`, if its steps are known to give that.
fn selection_of(draft: &Draft, edit: &Edit, known: Option<&Selection>) -> Result<Selection, EditError> {
    match (&edit.op, &edit.select) {
        (Operation::Show {}, steps) => select_marked(draft, &draft.hidden, steps.as_deref()),
        (Operation::Unlock {}, steps) => select_marked(draft, &draft.locked, steps.as_deref()),
        (_, Some(steps)) => known.map_or_else(|| select(draft, steps), |known| Ok(known.clone())),
        // Hidden and locked splats move with the whole scene.
        (
            Operation::Move { .. }
            | Operation::Rotate { .. }
            | Operation::Scale { .. }
            | Operation::Merge { .. }
            | Operation::Upright { .. }
            | Operation::SetLength { .. },
            None,
        ) => Ok(Selection::all(draft.len())),
        (_, None) => Ok(selectable(draft)),
    }
}

/// What an operation applies to.
struct Target<'a> {
    draft: &'a Draft,
    selection: Selection,
    /// Whether the operation applies to the whole scene, because there are no steps of a selection.
    is_scene: bool,
}

impl Target<'_> {
    /// What `op` does to the splats. Values that `op` does not have and that are determined automatically are filled in.
    fn change(self, op: &mut Operation, open: OpenScene) -> Result<Change, EditError> {
        let change = match op {
            Operation::Delete {} => Change::Remove(self.selection),
            Operation::Keep {} => Change::Remove(self.others()),
            Operation::Move { by } => self.transformed(Transform::translation((*by).into())),
            Operation::Rotate { axis, degrees, about } => {
                let transform = self.rotation(*axis, *degrees, about);
                self.transformed(transform)
            }
            Operation::Scale { factor, about } => {
                let transform = self.scaling(*factor, about);
                self.transformed(transform)
            }
            Operation::Upright { up, ground, axis } => {
                let transform = self.upright(up, ground, *axis)?;
                self.transformed(transform)
            }
            Operation::SetLength { from, to, length } => self.transformed(scaling_to_length(*from, *to, *length)?),
            Operation::Duplicate { by } => self.duplicated(*by),
            Operation::Merge { file } => self.merged(file, open)?,
            Operation::Recolor { .. } => self.recolored(ColorMap::of(op)),
            Operation::Opacity { factor } if *factor == 1.0 => Change::Nothing,
            Operation::Opacity { factor } => Change::Fade(self.selection, *factor),
            Operation::Reduce { count } => self.reduced(*count),
            Operation::Hide {} => Change::Hide(self.selection, true),
            Operation::Show {} => Change::Hide(self.selection, false),
            Operation::Lock {} => Change::Lock(self.selection, true),
            Operation::Unlock {} => Change::Lock(self.selection, false),
            Operation::Split { name } => Change::Split(self.selection, name.clone()),
        };
        Ok(change)
    }

    fn transformed(self, transform: Transform) -> Change {
        if transform.is_identity() {
            Change::Nothing
        } else if self.is_scene {
            Change::TransformScene(transform)
        } else {
            Change::Transform(self.selection, transform)
        }
    }

    fn recolored(self, map: ColorMap) -> Change {
        if map.is_identity() {
            Change::Nothing
        } else {
            Change::Recolor(self.selection, map)
        }
    }

    fn duplicated(self, by: [f64; 3]) -> Change {
        let sources = self.selection.indices();
        let mut copy = gather(&self.draft.cloud, &sources);
        let all = Selection::all(copy.len());
        transform_splats(&mut copy, &all, &Transform::translation(by.into()));
        Change::Append(copy, sources)
    }

    fn merged(self, file: &str, open: OpenScene) -> Result<Change, EditError> {
        let mut other = open(file).map_err(EditError::Source)?;
        if !other.is_consistent() {
            return Err(EditError::Source(format!("{file} has columns of unequal lengths")));
        }
        other.bring_to_world(self.draft.cloud.world_from_dataset);
        let new = vec![Provenance::NEW; other.len()];
        Ok(Change::Append(other, new))
    }

    fn reduced(self, count: usize) -> Change {
        // In the whole scene, locked splats stay and count.
        let stay = if self.is_scene {
            count_visible_locked(self.draft)
        } else {
            0
        };
        Change::Remove(least_important(self.draft, self.selection, count.saturating_sub(stay)))
    }

    /// The splats that are not selected, but neither the hidden nor the locked ones.
    fn others(self) -> Selection {
        let mut rest = self.selection;
        rest.add(&self.draft.hidden);
        rest.add(&self.draft.locked);
        rest.invert();
        rest
    }

    /// The rotation about a point, which is filled in unless the rotation is the identity.
    fn rotation(&self, axis: [f64; 3], degrees: f64, about: &mut Option<[f64; 3]>) -> Transform {
        if degrees % 360.0 == 0.0 {
            return Transform::IDENTITY;
        }
        let rotation = DQuat::from_axis_angle(DVec3::from(axis).normalize(), degrees.to_radians());
        Transform::about(self.pivot(about), 1.0, rotation)
    }

    /// The scaling about a point, which is filled in unless the factor is 1.
    fn scaling(&self, factor: f64, about: &mut Option<[f64; 3]>) -> Transform {
        if factor == 1.0 {
            Transform::IDENTITY
        } else {
            Transform::about(self.pivot(about), factor, DQuat::IDENTITY)
        }
    }

    /// The point `about`; if absent, it becomes the origin for the whole scene, otherwise the selection's centre.
    fn pivot(&self, about: &mut Option<[f64; 3]>) -> DVec3 {
        let center = || {
            if self.is_scene {
                DVec3::ZERO
            } else {
                mean_position(self.draft, &self.selection)
            }
        };
        DVec3::from(*about.get_or_insert_with(|| center().to_array()))
    }

    /// The transform that makes the scene upright; if `up` is absent, it is found, and a point on the ground with it.
    fn upright(
        &self,
        up: &mut Option<[f64; 3]>,
        point: &mut Option<[f64; 3]>,
        axis: UpAxis,
    ) -> Result<Transform, EditError> {
        if up.is_none() {
            let found = ground(self.draft).ok_or(EditError::NoCameras("upright without up"))?;
            *up = Some(found.up);
            *point = point.or(found.point);
        }
        Ok(upright_transform(up.unwrap_or_default(), *point, axis))
    }
}

/// The splats that `steps` select among `marked`; all of those if there are no steps.
fn select_marked(
    draft: &Draft,
    marked: &Selection,
    steps: Option<&[crate::SelectStep]>,
) -> Result<Selection, EditError> {
    steps.map_or_else(|| Ok(marked.clone()), |steps| select_among(draft, steps, marked))
}

/// Number of locked splats that are not hidden.
fn count_visible_locked(draft: &Draft) -> usize {
    let mut locked = draft.locked.clone();
    locked.subtract(&draft.hidden);
    locked.count()
}

fn remove(draft: &mut Draft, selection: Selection) -> Provenance {
    if selection.is_empty() {
        return Provenance::identity(draft.len());
    }
    let mut kept = selection;
    kept.invert();
    let kept = kept.indices();
    draft.cloud = gather(&draft.cloud, &kept);
    draft.hidden = draft.hidden.gather(&kept);
    draft.locked = draft.locked.gather(&kept);
    draft.last = draft.last.gather(&kept);
    Provenance {
        changed: Selection::none(kept.len()),
        sources: Some(kept),
    }
}

/// Mean position of the selected splats.
fn mean_position(draft: &Draft, selection: &Selection) -> DVec3 {
    let indices = selection.indices();
    let sum: DVec3 = indices.iter().map(|i| draft.position(*i as usize)).sum();
    sum / indices.len().max(1) as f64
}

/// The logit of an opacity times `factor`.
fn scaled_opacity_logit(opacity_logit: f32, factor: f64) -> f32 {
    let opacity = f64::from(sigmoid(opacity_logit)) * factor;
    logit(opacity.clamp(1e-6, 0.9999) as f32)
}

/// The scaling about the origin after which the distance from `from` to `to` is `length`.
fn scaling_to_length(from: [f64; 3], to: [f64; 3], length: f64) -> Result<Transform, EditError> {
    let factor = length / DVec3::from(from).distance(DVec3::from(to));
    if !(1e-12..=1e12).contains(&factor) {
        let message = "would scale the scene by more than 1e12; check from, to and length";
        return Err(EditError::value("set-length length", message));
    }
    Ok(Transform::about(DVec3::ZERO, factor, DQuat::IDENTITY))
}

/// The transform that turns `up` to the axis and moves the ground to height 0.
fn upright_transform(up: [f64; 3], ground: Option<[f64; 3]>, axis: UpAxis) -> Transform {
    let to = match axis {
        UpAxis::PlusY => DVec3::Y,
        UpAxis::MinusY => DVec3::NEG_Y,
        UpAxis::PlusZ => DVec3::Z,
    };
    let up = DVec3::from(up).normalize();
    let rotation = if (up - to).length() < 1e-12 {
        DQuat::IDENTITY
    } else {
        DQuat::from_rotation_arc(up, to)
    };
    let height = ground.map_or(0.0, |ground| to.dot(rotation * DVec3::from(ground)));
    Transform {
        scale: 1.0,
        rotation,
        translation: -height * to,
    }
}

/// The least important of the selected splats: all but `count`.
fn least_important(draft: &Draft, selection: Selection, count: usize) -> Selection {
    let cloud = &draft.cloud;
    let importance = |i: &u32| {
        let mut scales = cloud.log_scales[*i as usize];
        scales.sort_unstable_by(f32::total_cmp);
        // ln of the opacity times the area of the largest cross section.
        (
            sigmoid(cloud.opacity_logits[*i as usize]).ln() + scales[1] + scales[2],
            *i,
        )
    };
    let mut order: Vec<(f32, u32)> = selection.indices().par_iter().map(importance).collect();
    order.par_sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut least = Selection::none(draft.len());
    for (_, i) in order.iter().skip(count) {
        least.set(*i as usize, true);
    }
    least
}
