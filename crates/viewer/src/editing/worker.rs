//! The editing thread.

use super::save::{Saved, UnsavedEdits, save};
use super::session::Session;
use super::{Editing, EditingError};
use crate::message::EditRequest;
use crate::subject::Subject;
use irradia_edit::{Draft, EditList, Selection, Transform};
use irradia_runs::{Scene, photographs_of};
use irradia_splat::{RenderOptions, Splats};
use serde_json::{Value, json};
use std::path::Path;
use std::sync::Arc;

/// Maximum number of entries of the list that pages are told: those around the current position.
const MAX_LISTED_ENTRIES: usize = 120;

/// A session, and what is shown of it.
struct Workspace {
    session: Session,
    options: RenderOptions,
    /// Whether the scene is shown as it was opened.
    before: bool,
    saved: Option<Saved>,
    unsaved: UnsavedEdits,
    /// Whether the last attempt to keep the unsaved edits has failed, which pages are told once.
    save_failed: bool,
    /// What was shown last: splats, selection and its number, which is 0 if nothing is selected.
    shown: Option<(Arc<Draft>, Option<Arc<Selection>>)>,
    mask: u64,
    last_mask: u64,
}

/// The state that pages are told of a scene of `splats` splats before the first request.
pub(super) fn initial_state(splats: usize) -> Value {
    json!({
        "tell": "editing", "version": 1, "selected": 0, "of": splats, "hidden": 0, "locked": 0, "box": null, "at": 0, "first": 0,
        "total": 0, "entries": [], "gesture": 0, "before": false, "busy": false, "mask": 0, "saved": null,
    })
}

/// Carries out the requests of pages until `editing` closes. `tell` sends a line to a page, `wake` wakes the drawing thread. Returns a line
/// about unsaved edits, if there are any.
pub(crate) fn run_editing(
    editing: &Editing,
    subject: &Subject,
    tell: &dyn Fn(u64, &str),
    wake: &dyn Fn(),
) -> Option<String> {
    let mut workspace: Option<Workspace> = None;
    while let Some((client, request)) = editing.next() {
        let mut state = (*editing.state.borrow()).as_ref().clone();
        state["busy"] = true.into();
        editing.publish(state.clone());
        let outcome = match &mut workspace {
            Some(workspace) => workspace.handle(editing, &request),
            none => Workspace::open(editing, subject).and_then(|opened| none.insert(opened).handle(editing, &request)),
        };
        match outcome {
            Ok(Some(line)) => tell(client, &line),
            Ok(None) => {}
            Err(error) => tell(client, &error.to_string()),
        }
        state["busy"] = false.into();
        if let Some(workspace) = &mut workspace {
            workspace.show(subject);
            let failed_before = workspace.save_failed;
            if let Err(error) = workspace.keep_edits(editing)
                && !failed_before
            {
                tell(client, &format!("unsaved edits would be lost in a crash: {error}"));
            }
            state = workspace.to_json(subject);
        }
        wake();
        editing.publish(state);
    }
    let mut workspace = workspace?;
    let kept = workspace.keep_edits(editing);
    match (workspace.unsaved.path().map(Path::display), kept) {
        (None, Ok(())) => None,
        (Some(path), Ok(())) => Some(format!(
            "unsaved edits are in {path}: use Open edits to make them again"
        )),
        (Some(path), Err(error)) => Some(format!("unsaved edits are in {path}, but not all of them: {error}")),
        (None, Err(error)) => Some(format!("unsaved edits are lost: {error}")),
    }
}

impl Workspace {
    fn open(editing: &Editing, subject: &Subject) -> Result<Self, EditingError> {
        let cloud = editing.read_source()?;
        let edition = subject.edition();
        let scene = edition.as_ref().map(|edition| edition.scene());
        let cameras = scene.and_then(|scene| scene.cameras.as_deref()).unwrap_or_default();
        let mut draft = Draft::new(cloud, cameras.to_vec());
        draft.photographs = photographs_of(&editing.source);
        let session = Session::new(draft, editing.uploads.clone());
        let drawn = scene.and_then(|scene| scene.model.splats()).map(Splats::len);
        Ok(Self {
            options: scene.map_or_else(RenderOptions::default, |scene| scene.options),
            before: false,
            saved: None,
            unsaved: UnsavedEdits::default(),
            save_failed: false,
            // What is drawn was read from the same file.
            shown: (drawn == Some(session.draft().len())).then(|| (session.original().clone(), None)),
            session,
            mask: 0,
            last_mask: 0,
        })
    }

    /// Carries out a request; returns a line for the page that sent it.
    fn handle(&mut self, editing: &Editing, request: &EditRequest) -> Result<Option<String>, EditingError> {
        let session = &mut self.session;
        if self.before && !matches!(request, EditRequest::Compare { .. } | EditRequest::Save) {
            self.before = false;
            if request.is_placed() {
                let line =
                    "this was placed in the scene as it was opened: place it in the edited scene, which is shown again";
                return Ok(Some(line.to_owned()));
            }
        }
        match request.clone() {
            EditRequest::Select {
                gesture,
                replace,
                steps,
            } => session.select(gesture, replace, steps)?,
            EditRequest::Deselect => session.deselect(),
            EditRequest::Edit { gesture, whole, edit } => session.edit(gesture, whole, edit)?,
            EditRequest::Replay { list } => session.replay(&EditList::parse(&list)?)?,
            EditRequest::Undo => session.go_to(session.position().saturating_sub(1))?,
            EditRequest::Redo => session.go_to(session.position() + 1)?,
            EditRequest::Go { at } => session.go_to(at)?,
            EditRequest::Compare { before } => self.before = before,
            EditRequest::Save => {
                let saved = save(session, &editing.source, self.saved.as_ref())?;
                let line = saved.line();
                self.saved = Some(saved);
                return Ok(Some(line));
            }
        }
        let notes = session.take_notes();
        Ok((!notes.is_empty()).then(|| notes.join("; ")))
    }

    /// Updates what pages download, and the file of unsaved edits beside the scene.
    fn keep_edits(&mut self, editing: &Editing) -> Result<(), EditingError> {
        let list = editing.set_current(&self.session);
        let kept = self
            .unsaved
            .update(&self.session, list, &editing.source, self.saved.as_ref());
        self.save_failed = kept.is_err();
        kept
    }

    /// Shows the current state of the session.
    fn show(&mut self, subject: &Subject) {
        let session = &self.session;
        let (draft, selected, placement) = if self.before {
            (session.original(), None, Transform::IDENTITY)
        } else {
            (session.draft(), Some(session.selected()), session.placement())
        };
        let selected = selected.filter(|selected| !selected.is_empty()).cloned();
        let is_same = |a: &Option<Arc<Selection>>, b: &Option<Arc<Selection>>| match (a, b) {
            (Some(a), Some(b)) => Arc::ptr_eq(a, b),
            (a, b) => a.is_none() && b.is_none(),
        };
        let known = self.shown.as_ref();
        let is_new = known.is_none_or(|(known, _)| !Arc::ptr_eq(known, draft));
        let selection_changed = known.is_none_or(|(_, known)| !is_same(known, &selected));
        if is_new || selection_changed {
            let shown = |selected: &Arc<Selection>| {
                let all = selected.as_slice().iter().zip(draft.hidden.as_slice());
                Arc::new(
                    all.filter(|(_, hidden)| !**hidden)
                        .map(|(selected, _)| *selected)
                        .collect(),
                )
            };
            self.last_mask += 1;
            self.mask = if selected.is_some() { self.last_mask } else { 0 };
            let scene = is_new.then(|| Scene::of_draft(draft, self.options));
            subject.show(scene, placement, selected.as_ref().map(shown));
        }
        self.shown = Some((draft.clone(), selected));
    }

    /// The state that pages are told.
    fn to_json(&self, subject: &Subject) -> Value {
        let session = &self.session;
        let (draft, selected) = (session.draft(), session.selected());
        let (at, total) = (session.position(), session.entries().len());
        let first = at
            .saturating_sub(MAX_LISTED_ENTRIES / 2)
            .min(total.saturating_sub(MAX_LISTED_ENTRIES));
        let entries: Vec<Value> = session
            .entries()
            .skip(first)
            .take(MAX_LISTED_ENTRIES)
            .map(|entry| json!({ "kind": if entry.is_edit { "edit" } else { "select" }, "text": entry.text }))
            .collect();
        json!({
            "tell": "editing",
            "version": subject.edition().map(|edition| edition.version),
            "selected": selected.count(),
            "of": draft.len(),
            "hidden": draft.hidden.count(),
            "locked": draft.locked.count(),
            "box": box_around(draft, selected),
            "at": at,
            "first": first,
            "total": total,
            "entries": entries,
            "gesture": session.gesture(),
            "before": self.before,
            "busy": false,
            "mask": self.mask,
            "saved": self.saved.as_ref().map(Saved::line),
        })
    }
}

/// The corners of a box around the centres of the selected splats, world. Along each axis the outermost hundredth on either side is left
/// out: what a lasso catches in the far background would make the box useless.
fn box_around(draft: &Draft, selected: &Selection) -> Option<[[f32; 3]; 2]> {
    let means = draft.cloud.means.iter().zip(selected.as_slice());
    let means: Vec<[f32; 3]> = means
        .filter(|(_, selected)| **selected)
        .map(|(mean, _)| *mean)
        .collect();
    let last = means.len().checked_sub(1)?;
    let bounds = [0, 1, 2].map(|c| {
        let mut values: Vec<f32> = means.iter().map(|mean| mean[c]).collect();
        [last / 100, last - last / 100].map(|at| *values.select_nth_unstable_by(at, f32::total_cmp).1)
    });
    Some([0, 1].map(|side| bounds.map(|bound| bound[side])))
}
