//! A scene with the list of its selections and edits; those after the current position are undone.

use super::EditingError;
use super::entry_text::{edit_text, select_text};
use super::uploads::Uploads;
use super::world::{operation_to_dataset, placement, step_to_dataset};
use irradia_edit::{
    Draft, Edit, EditError, EditList, Mode, Operation, SelectStep, Selection, Shape, Transform, apply, apply_to,
    floater_scores, select,
};
use irradia_runs::merge_notes;
use irradia_scene::{GaussianCloud, Similarity};
use std::cell::RefCell;
use std::sync::Arc;

/// Maximum bytes of earlier states that are kept for an immediate undo; without a kept state, undo makes the edits again.
const MAX_SNAPSHOT_BYTES: usize = 1 << 30;
/// Maximum number of entries: a selection for each edit of the longest list. A selection may take 60 kB.
const MAX_ENTRIES: usize = 2 * EditList::MAX_ITEMS;
/// Maximum count of numbers in the selections of all entries.
const MAX_SELECTION_NUMBERS: usize = 8_000_000;
/// Maximum count of numbers in the selections of edits, such that the written list can be read again: a pixel's coordinate takes up to 26
/// bytes in it.
const MAX_LISTED_NUMBERS: usize = EditList::MAX_BYTES / 32;

/// The action of an entry.
#[derive(Clone, Debug)]
enum EntryAction {
    Select {
        steps: Vec<SelectStep>,
        replace: bool,
    },
    Deselect,
    /// An edit with everything that was found automatically spelled out, and how it moved the whole scene.
    Edit(Edit, Option<Transform>),
}

#[derive(Clone, Debug)]
struct Entry {
    /// Entries of the same gesture replace each other.
    gesture: u64,
    text: String,
    action: EntryAction,
}

/// A state after a number of edits.
struct Snapshot {
    edits: usize,
    draft: Arc<Draft>,
}

pub(crate) struct Session {
    entries: Vec<Entry>,
    /// The current position: number of entries that are made.
    position: usize,
    draft: Arc<Draft>,
    /// The scene as it was opened, then newer states, oldest first.
    snapshots: Vec<Snapshot>,
    /// The steps of the current selection.
    steps: Vec<SelectStep>,
    selected: Arc<Selection>,
    /// The state, the steps and the selection before the last edit: a slider makes it again and again.
    before: Option<(Arc<Draft>, Vec<SelectStep>, Arc<Selection>)>,
    /// The floater score of each splat of a state.
    scores: Option<(Arc<Draft>, Vec<f32>)>,
    /// Scenes to merge.
    uploads: Arc<Uploads>,
    /// What the user should know about merged scenes, a line each.
    notes: Vec<String>,
}

/// An entry in the form that pages list.
pub(crate) struct EntryView<'a> {
    pub is_edit: bool,
    pub text: &'a str,
}

impl Session {
    /// A session without entries on a scene with which `uploads` can be merged.
    pub fn new(draft: Draft, uploads: Arc<Uploads>) -> Self {
        let draft = Arc::new(draft);
        Self {
            entries: Vec::new(),
            position: 0,
            selected: Arc::new(Selection::none(draft.len())),
            snapshots: vec![Snapshot {
                edits: 0,
                draft: draft.clone(),
            }],
            draft,
            steps: Vec::new(),
            before: None,
            scores: None,
            uploads,
            notes: Vec::new(),
        }
    }

    pub fn draft(&self) -> &Arc<Draft> {
        &self.draft
    }

    /// The scene as it was opened.
    pub fn original(&self) -> &Arc<Draft> {
        &self.snapshots[0].draft
    }

    /// The selected splats of [`Self::draft`].
    pub fn selected(&self) -> &Arc<Selection> {
        &self.selected
    }

    /// Number of entries that are made.
    pub fn position(&self) -> usize {
        self.position
    }

    /// All entries, including those undone.
    pub fn entries(&self) -> impl ExactSizeIterator<Item = EntryView<'_>> {
        self.entries.iter().map(|entry| EntryView {
            is_edit: matches!(entry.action, EntryAction::Edit(..)),
            text: &entry.text,
        })
    }

    /// The gesture of the entry made last; 0 if there is none.
    pub fn gesture(&self) -> u64 {
        self.position
            .checked_sub(1)
            .map_or(0, |last| self.entries[last].gesture)
    }

    /// The edits that are made.
    pub fn edits(&self) -> impl Iterator<Item = &Edit> {
        self.entries[..self.position]
            .iter()
            .filter_map(|entry| match &entry.action {
                EntryAction::Edit(edit, _) => Some(edit),
                _ => None,
            })
    }

    /// The list of the edits that are made.
    pub fn list(&self) -> EditList {
        EditList {
            edits: self.edits().cloned().collect(),
            ..EditList::default()
        }
    }

    /// How the edits moved the whole scene, in the dataset's coordinates.
    pub fn moved(&self) -> Transform {
        let moved = self.entries[..self.position]
            .iter()
            .filter_map(|entry| match &entry.action {
                EntryAction::Edit(_, moved) => moved.as_ref(),
                _ => None,
            });
        moved.fold(Transform::IDENTITY, |all, next| all.then(next))
    }

    /// From the world of the scene as it was opened to the current one.
    pub fn placement(&self) -> Transform {
        placement(&self.original().cloud.world_from_dataset, &self.moved(), self.world())
    }

    fn world(&self) -> &Similarity {
        &self.draft.cloud.world_from_dataset
    }

    /// Selects; `steps` are in the world of the draft.
    ///
    /// # Errors
    /// When they cannot be evaluated, or there is nothing to subtract from or to intersect with.
    pub fn select(&mut self, gesture: u64, replace: bool, mut steps: Vec<SelectStep>) -> Result<(), EditError> {
        self.check_capacity(&steps)?;
        let world = *self.world();
        steps.iter_mut().for_each(|step| step_to_dataset(step, &world));
        self.replace_gesture(gesture, |session| {
            let before = if replace { Vec::new() } else { session.steps.clone() };
            if before.is_empty() && steps.first().is_none_or(|step| step.mode != Mode::Add) {
                return Err(EditError::Selection("nothing is selected to subtract from".to_owned()));
            }
            let all = [&before[..], &steps].concat();
            let selected = session.evaluate(&all, before.len())?;
            let text = select_text(&steps, replace);
            session.push(gesture, text, EntryAction::Select { steps, replace });
            (session.steps, session.selected) = (all, Arc::new(selected));
            Ok(())
        })
    }

    /// What `steps` select; the first `known` of them give the current selection.
    fn evaluate(&mut self, steps: &[SelectStep], known: usize) -> Result<Selection, EditError> {
        let is_simple = |step: &SelectStep| {
            !matches!(
                step.shape,
                Shape::Invert {} | Shape::Grow { .. } | Shape::Connected { .. }
            )
        };
        if !steps[known..].iter().all(is_simple) {
            return select(&self.draft, steps);
        }
        // Starts from the current selection, so that a hundred brush strokes are not evaluated again for each further one.
        let mut selected = match known {
            0 => Selection::none(self.draft.len()),
            _ => (*self.selected).clone(),
        };
        for step in &steps[known..] {
            let alone = self.select_shape(&step.shape)?;
            match step.mode {
                Mode::Add => selected.add(&alone),
                Mode::Subtract => selected.subtract(&alone),
                Mode::Intersect => selected.intersect(&alone),
            }
        }
        Ok(selected)
    }

    /// What a shape selects.
    fn select_shape(&mut self, shape: &Shape) -> Result<Selection, EditError> {
        let Shape::Floaters { score } = shape else {
            return select(&self.draft, &[SelectStep::add(shape.clone())]);
        };
        // A slider for the minimum score needs the same scores again, which take seconds.
        let kept = self.scores.take().filter(|(draft, _)| Arc::ptr_eq(draft, &self.draft));
        let (draft, scores) = kept.unwrap_or_else(|| {
            let scores = floater_scores(&self.draft);
            (self.draft.clone(), scores.iter().map(|scores| scores.score()).collect())
        });
        let least = score.unwrap_or(1.0) as f32;
        let mut selected = Selection::of(draft.len(), |i| scores[i] >= least);
        selected.subtract(&draft.hidden);
        selected.subtract(&draft.locked);
        self.scores = Some((draft, scores));
        Ok(selected)
    }

    /// Selects nothing.
    pub fn deselect(&mut self) {
        if self.steps.is_empty() {
            return;
        }
        self.push(0, "Deselect".to_owned(), EntryAction::Deselect);
        (self.steps, self.selected) = (Vec::new(), Arc::new(Selection::none(self.draft.len())));
    }

    /// Makes an edit of the selection, or of the `whole` scene; `op` is in the world of the draft.
    ///
    /// # Errors
    /// When nothing is selected, or the edit is not possible; nothing has changed then.
    pub fn edit(&mut self, gesture: u64, whole: bool, mut op: Operation) -> Result<(), EditError> {
        self.check_capacity(if whole { &[] } else { &self.steps })?;
        operation_to_dataset(&mut op, self.world());
        self.replace_gesture(gesture, |session| {
            if !whole && session.selected.is_empty() {
                return Err(EditError::Selection("nothing is selected".to_owned()));
            }
            let select = (!whole).then(|| session.steps.clone());
            session.apply_edit(gesture, Edit { op, select })
        })
    }

    /// Makes the edits of a list, in the dataset's coordinates; each is an entry.
    ///
    /// # Errors
    /// When one is not possible; those before it have been made, but none if a scene to merge is missing.
    pub fn replay(&mut self, list: &EditList) -> Result<(), EditError> {
        let in_list = |i: usize, reason: EditError| EditError::InList {
            number: i + 1,
            reason: Box::new(reason),
        };
        for (i, edit) in list.edits.iter().enumerate() {
            if let Operation::Merge { file } = &edit.op {
                let found = self.uploads.check(file).map_err(EditError::Source);
                found.map_err(|reason| in_list(i, reason))?;
            }
        }
        for (i, edit) in list.edits.iter().enumerate() {
            let made = self
                .check_capacity(edit.select.as_deref().unwrap_or_default())
                .and_then(|()| self.apply_edit(0, edit.clone()));
            made.map_err(|reason| in_list(i, reason))?;
        }
        Ok(())
    }

    /// Makes an edit and adds it to the list.
    fn apply_edit(&mut self, gesture: u64, mut edit: Edit) -> Result<(), EditError> {
        if let Operation::Split { name } = &mut edit.op {
            let parts = self.edits().filter(|edit| matches!(edit.op, Operation::Split { .. }));
            *name = format!("part-{}", parts.count() + 1);
        }
        let mut draft = (*self.draft).clone();
        let notes = RefCell::new(Vec::new());
        let cloud = &self.draft.cloud;
        let open = |file: &str| {
            let other = self.uploads.open(file)?;
            notes
                .borrow_mut()
                .extend(merge_notes(file, &other, cloud.antialiased, &cloud.extra));
            Ok(other.cloud)
        };
        // What is selected need not be searched for again, which may take a minute.
        let applied = if edit.select.as_ref() == Some(&self.steps) {
            apply_to(&mut draft, &edit, &self.selected, &open)?
        } else {
            apply(&mut draft, &edit, &open)?
        };
        self.notes.extend(notes.into_inner());
        self.before = Some((self.draft.clone(), self.steps.clone(), self.selected.clone()));
        let text = edit_text(&applied.edit.op, applied.selected, self.draft.len(), draft.len());
        self.push(gesture, text, EntryAction::Edit(applied.edit, applied.moved));
        self.set_draft(Arc::new(draft));
        self.steps = self.steps_at(self.position);
        self.selected = Arc::new(select(&self.draft, &self.steps)?);
        Ok(())
    }

    /// A scene to merge again.
    fn open(&self, file: &str) -> Result<GaussianCloud, String> {
        Ok(self.uploads.open(file)?.cloud)
    }

    /// What the user should know about the scenes that were merged since the last call, a line each.
    pub fn take_notes(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notes)
    }

    /// Checks that there is room for an entry with `steps`.
    fn check_capacity(&self, steps: &[SelectStep]) -> Result<(), EditError> {
        let numbers = |steps: &[SelectStep]| steps.iter().map(count_numbers).sum::<usize>();
        let (mut all, mut listed) = (numbers(steps), numbers(steps));
        for entry in &self.entries {
            match &entry.action {
                EntryAction::Select { steps, .. } => all += numbers(steps),
                EntryAction::Edit(edit, _) => {
                    let count = numbers(edit.select.as_deref().unwrap_or_default());
                    (all, listed) = (all + count, listed + count);
                }
                EntryAction::Deselect => {}
            }
        }
        if self.entries.len() >= MAX_ENTRIES
            || self.edits().count() >= EditList::MAX_ITEMS
            || all > MAX_SELECTION_NUMBERS
            || listed > MAX_LISTED_NUMBERS
        {
            let message = "the list of edits is full: save the scene and open the saved one";
            return Err(EditError::Scene(message.to_owned()));
        }
        Ok(())
    }

    /// Runs `next` in place of the last entry if that is of the same gesture; if it fails, the last entry stays.
    fn replace_gesture(
        &mut self,
        gesture: u64,
        next: impl FnOnce(&mut Self) -> Result<(), EditError>,
    ) -> Result<(), EditError> {
        let replaces = gesture != 0 && self.position == self.entries.len() && self.gesture() == gesture;
        if !replaces {
            return next(self);
        }
        self.go_to(self.position - 1)?;
        let outcome = next(self);
        if outcome.is_err() {
            self.go_to(self.position + 1)?;
        }
        outcome
    }

    fn push(&mut self, gesture: u64, text: String, action: EntryAction) {
        let edits = self.edits().count();
        self.snapshots.retain(|snapshot| snapshot.edits <= edits);
        self.entries.truncate(self.position);
        self.entries.push(Entry { gesture, text, action });
        self.position += 1;
    }

    /// Sets the state after the current edits, and keeps it.
    fn set_draft(&mut self, draft: Arc<Draft>) {
        let edits = self.edits().count();
        self.draft = draft.clone();
        if self.snapshots.iter().all(|snapshot| snapshot.edits != edits) {
            self.snapshots.push(Snapshot { edits, draft });
            self.snapshots.sort_unstable_by_key(|snapshot| snapshot.edits);
        }
        let bytes = |snapshots: &[Snapshot]| {
            snapshots
                .iter()
                .map(|snapshot| cloud_bytes(&snapshot.draft.cloud))
                .sum::<usize>()
        };
        // The opened scene and the last two states stay.
        while self.snapshots.len() > 3 && bytes(&self.snapshots) > MAX_SNAPSHOT_BYTES {
            self.snapshots.remove(1);
        }
    }

    /// The steps of the selection after the first `at` entries.
    fn steps_at(&self, at: usize) -> Vec<SelectStep> {
        let mut steps = Vec::new();
        for entry in &self.entries[..at] {
            match &entry.action {
                EntryAction::Select { steps: more, replace } => {
                    if *replace {
                        steps.clear();
                    }
                    steps.extend_from_slice(more);
                }
                EntryAction::Deselect => steps.clear(),
                EntryAction::Edit(edit, _) => {
                    steps.clear();
                    let is_whole = edit.select.is_none();
                    if keeps_selection(&edit.op) && is_whole == matches!(edit.op, Operation::Merge { .. }) {
                        steps.push(SelectStep::add(Shape::Last {}));
                    }
                }
            }
        }
        steps
    }

    /// Undoes or redoes entries until the first `at` are made.
    ///
    /// # Errors
    /// Those of the edits, although these have been made before: a merged file may be gone. Nothing has changed then.
    pub fn go_to(&mut self, at: usize) -> Result<(), EditError> {
        let at = at.min(self.entries.len());
        let before = self.edits().count();
        let previous = std::mem::replace(&mut self.position, at);
        let edits = self.edits().count();
        if edits != before {
            let nearest = self.snapshots.iter().rfind(|snapshot| snapshot.edits <= edits);
            let (mut made, mut draft) = nearest.map_or((0, self.original().clone()), |snapshot| {
                (snapshot.edits, snapshot.draft.clone())
            });
            let again: Vec<Edit> = self.edits().skip(made).cloned().collect();
            for edit in again {
                if let Err(error) = apply(Arc::make_mut(&mut draft), &edit, &|file| self.open(file)) {
                    self.position = previous;
                    return Err(error);
                }
                made += 1;
            }
            debug_assert_eq!(made, edits);
            self.set_draft(draft);
        }
        let steps = self.steps_at(at);
        let known = self.before.as_ref();
        let known = known.filter(|(draft, of, _)| Arc::ptr_eq(draft, &self.draft) && *of == steps);
        let known = known.map(|(_, _, selected)| selected.clone());
        self.selected = match known {
            Some(selected) => selected,
            None => Arc::new(self.evaluate(&steps, 0)?),
        };
        self.steps = steps;
        Ok(())
    }

    /// The scenes that the list merges.
    pub fn merged(&self) -> impl Iterator<Item = &str> {
        self.edits().filter_map(|edit| match &edit.op {
            Operation::Merge { file } => Some(file.as_str()),
            _ => None,
        })
    }

    /// Writes the scenes that the list merges beside the scene.
    ///
    /// # Errors
    /// When one cannot be written.
    pub fn save_merged(&self) -> Result<(), EditingError> {
        self.merged().try_for_each(|file| self.uploads.save(file))
    }

    /// The scenes that were split off, with their names.
    ///
    /// # Errors
    /// Those of the edits, although these have been made before.
    pub fn parts(&self) -> Result<Vec<(String, GaussianCloud)>, EditError> {
        let mut parts = Vec::new();
        let edits: Vec<&Edit> = self.edits().collect();
        let Some(last) = edits
            .iter()
            .rposition(|edit| matches!(edit.op, Operation::Split { .. }))
        else {
            return Ok(parts);
        };
        let mut draft = (**self.original()).clone();
        for edit in &edits[..=last] {
            parts.extend(apply(&mut draft, edit, &|file| self.open(file))?.split);
        }
        Ok(parts)
    }
}

/// Whether the selected splats still exist after the operation, and stay selected.
fn keeps_selection(op: &Operation) -> bool {
    matches!(
        op,
        Operation::Move { .. }
            | Operation::Rotate { .. }
            | Operation::Scale { .. }
            | Operation::Duplicate { .. }
            | Operation::Recolor { .. }
            | Operation::Opacity { .. }
            | Operation::Merge { .. }
    )
}

/// Count of numbers in a step.
fn count_numbers(step: &SelectStep) -> usize {
    match &step.shape {
        Shape::Polygon { points, .. } | Shape::Brush { points, .. } => 16 + 2 * points.len(),
        _ => 16,
    }
}

fn cloud_bytes(cloud: &GaussianCloud) -> usize {
    4 * cloud.len() * (11 + 3 * cloud.sh_coefficients())
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_edit::{Viewpoint, open_nothing};

    /// Splats at 0, 1, .. along x, in a world of half the dataset's unit.
    fn session(n: usize) -> Session {
        let draft = Draft::new(
            GaussianCloud {
                means: (0..n).map(|i| [i as f32, 0.0, 0.0]).collect(),
                quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
                log_scales: vec![[-2.0; 3]; n],
                opacity_logits: vec![1.0; n],
                sh: vec![0.3; 3 * n],
                world_from_dataset: Similarity {
                    scale: 2.0,
                    center: glam::DVec3::new(10.0, 0.0, 0.0),
                },
                ..GaussianCloud::default()
            },
            Vec::new(),
        );
        Session::new(draft, Arc::new(Uploads::new("".as_ref())))
    }

    fn ball(x: f64, radius: f64) -> Vec<SelectStep> {
        vec![SelectStep::add(Shape::Sphere {
            center: [x, 0.0, 0.0],
            radius,
        })]
    }

    fn selected(session: &Session) -> Vec<u32> {
        session.selected().indices()
    }

    fn xs(session: &Session) -> Vec<f32> {
        session.draft().cloud.means.iter().map(|mean| mean[0]).collect()
    }

    /// Size of an edit in a list.
    fn edit_bytes(edit: &Edit) -> usize {
        let list = |edits| EditList {
            edits,
            ..EditList::default()
        };
        list(vec![edit.clone()]).to_toml().len()
    }

    /// What the saved list makes of the scene as it was opened.
    fn replayed(session: &Session) -> Draft {
        let list = EditList::parse(&session.list().to_toml()).expect("a list");
        let mut draft = (**session.original()).clone();
        for edit in &list.edits {
            apply(&mut draft, edit, &open_nothing).expect("possible");
        }
        draft
    }

    #[test]
    fn a_selection_that_was_moved_is_moved_on_and_the_list_says_the_same() {
        let mut session = session(6);
        session.select(1, true, ball(1.0, 1.2)).expect("a ball");
        assert_eq!(selected(&session), [0, 1, 2]);
        // Onto splats that are not selected.
        session
            .edit(2, false, Operation::Move { by: [3.0, 0.0, 0.0] })
            .expect("moved");
        session
            .edit(3, false, Operation::Move { by: [0.0, 1.0, 0.0] })
            .expect("moved");
        assert_eq!(
            (selected(&session), xs(&session)),
            (vec![0, 1, 2], vec![3.0, 4.0, 5.0, 3.0, 4.0, 5.0])
        );
        session
            .edit(4, false, Operation::Duplicate { by: [0.0; 3] })
            .expect("copied");
        assert_eq!(selected(&session), [6, 7, 8], "the copies");
        session
            .edit(5, false, Operation::Move { by: [1.0, 0.0, 0.0] })
            .expect("moved");
        assert_eq!(replayed(&session), **session.draft());
    }

    #[test]
    fn every_position_of_the_list_is_reached_from_every_other_one_and_a_gesture_is_one_entry() {
        let mut session = session(8);
        let mut states = vec![(session.draft().clone(), session.selected().clone())];
        let mut then = |session: &Session| states.push((session.draft().clone(), session.selected().clone()));
        session.select(1, true, ball(2.0, 1.2)).expect("a ball");
        then(&session);
        session.select(2, false, ball(6.0, 0.5)).expect("another");
        then(&session);
        for exposure in [0.3, 0.7, 1.0] {
            let op = Operation::Recolor {
                exposure,
                temperature: 0.0,
                tint: 0.0,
                saturation: 1.0,
                contrast: 1.0,
            };
            session.edit(3, false, op).expect("brighter");
        }
        then(&session);
        session.edit(4, false, Operation::Delete {}).expect("deleted");
        then(&session);
        session
            .edit(
                5,
                true,
                Operation::Scale {
                    factor: 2.0,
                    about: None,
                },
            )
            .expect("scaled");
        then(&session);
        assert_eq!((session.position(), session.entries().len(), states.len()), (5, 5, 6));
        for forget in [false, true] {
            for at in [0, 5, 3, 1, 4, 2, 5, 0] {
                if forget {
                    session.snapshots.truncate(1);
                }
                session.go_to(at).expect("made before");
                assert_eq!(
                    (&**session.draft(), &**session.selected()),
                    (&*states[at].0, &*states[at].1),
                    "{at}"
                );
            }
        }
        session.select(9, true, ball(0.0, 0.5)).expect("a ball");
        assert_eq!(session.entries().len(), 1, "what was undone is forgotten");
    }

    #[test]
    fn a_list_that_is_opened_gives_the_scene_of_which_it_was_written() {
        let mut session = session(8);
        session.select(1, true, ball(2.0, 1.2)).expect("a ball");
        session.edit(2, false, Operation::Delete {}).expect("deleted");
        let scale = Operation::Scale {
            factor: 2.0,
            about: None,
        };
        session.edit(3, true, scale).expect("scaled");
        let list = session.list();
        let mut opened = super::tests::session(8);
        opened.replay(&list).expect("the same edits");
        assert_eq!(opened.draft(), session.draft());
        assert_eq!((opened.position(), opened.list()), (2, list.clone()), "an entry each");
        opened.go_to(0).expect("undone");
        assert_eq!(opened.draft(), opened.original());
        // One that fails tells which; those before it are made.
        let mut broken = list.clone();
        broken.edits.push("upright".parse().expect("an edit"));
        let error = opened.replay(&broken).expect_err("no cameras").to_string();
        assert!(error.contains('3') && opened.position() == 2, "{error}");
        // A missing scene is found before the first edit is made.
        let file = "absent.ply".to_owned();
        *broken.edits.last_mut().expect("three") = Edit::of_scene(Operation::Merge { file });
        let error = opened.replay(&broken).expect_err("no such scene").to_string();
        assert!(
            error.starts_with("edit 3: merge: ") && opened.position() == 2,
            "{error}"
        );
    }

    #[test]
    fn a_list_that_can_be_made_can_be_read_again() {
        let list = EditList {
            edits: vec![Edit::of_scene(Operation::Move { by: [0.001, 0.0, 0.0] }); EditList::MAX_ITEMS / 2 + 1],
            ..EditList::default()
        };
        let mut session = session(1);
        session.replay(&list).expect("half of what is allowed");
        let error = session.replay(&list).expect_err("too many").to_string();
        assert!(error.contains("the list of edits is full"), "{error}");
        assert_eq!(session.edits().count(), EditList::MAX_ITEMS);
        assert_eq!(
            EditList::parse(&session.list().to_toml()).expect("a list"),
            session.list()
        );
        // So can one of outlines, of which each edit has its own.
        let outline = SelectStep::add(Shape::Polygon {
            camera: Viewpoint {
                position: [0.1, 0.2, -4.0],
                rotation: [1.0, 0.0, 0.0, 0.0],
                focal: [50.0; 2],
                principal: [32.0, 24.0],
                size: [64, 48],
            },
            points: (1..=2000).map(|i| [1.0 / f64::from(i), 16e3 / f64::from(i)]).collect(),
            visible: true,
        });
        let edit = Edit::of(Operation::Opacity { factor: 1.0 }, [outline]);
        let bytes = edit_bytes(&edit);
        let most = MAX_LISTED_NUMBERS / count_numbers(&edit.select.expect("steps")[0]);
        assert!(most * bytes <= EditList::MAX_BYTES, "{most} edits of {bytes} bytes");
    }

    #[test]
    fn a_slider_edits_the_same_selection_at_every_tick() {
        let mut session = session(6);
        session.select(1, true, ball(1.0, 1.2)).expect("a ball");
        let known = session.selected().clone();
        for factor in [0.9, 0.5, 0.2] {
            session.edit(2, false, Operation::Opacity { factor }).expect("faded");
            assert_eq!(
                (session.position(), replayed(&session)),
                (2, (**session.draft()).clone())
            );
        }
        session.go_to(1).expect("undone");
        assert!(Arc::ptr_eq(session.selected(), &known), "it is not evaluated again");
        // The same steps select something else in another state.
        session.edit(3, false, Operation::Delete {}).expect("deleted");
        session.select(4, true, ball(1.0, 1.2)).expect("a ball");
        session.go_to(2).expect("undone");
        session.go_to(3).expect("made before");
        assert_eq!((session.selected().len(), selected(&session)), (3, vec![]));
        assert_eq!(replayed(&session), **session.draft());
    }

    #[test]
    fn what_fails_changes_nothing() {
        let mut session = session(3);
        assert!(session.edit(1, false, Operation::Delete {}).is_err());
        let subtracted = SelectStep {
            mode: Mode::Subtract,
            ..ball(0.0, 1.0)[0].clone()
        };
        assert!(session.select(1, false, vec![subtracted]).is_err());
        session.select(7, true, ball(1.0, 0.5)).expect("a ball");
        let views = SelectStep::add(Shape::Views {
            min: Some(1),
            max: None,
        });
        assert!(session.select(7, true, vec![views]).is_err(), "no cameras");
        assert_eq!(
            (session.position(), selected(&session)),
            (1, vec![1]),
            "the entry of the gesture is still there"
        );
    }

    #[test]
    fn a_part_that_was_split_off_is_found_again() {
        let mut session = session(4);
        session.select(1, true, ball(0.0, 1.2)).expect("a ball");
        session
            .edit(2, false, Operation::Split { name: "mine".into() })
            .expect("split");
        let parts = session.parts().expect("made before");
        assert_eq!(
            (
                parts.len(),
                parts[0].0.as_str(),
                parts[0].1.len(),
                session.draft().len()
            ),
            (1, "part-1", 2, 2)
        );
    }
}
