use crate::draft::{append, gather, scatter, truncate};
use crate::plan::{Change, Plan};
use crate::{Applied, Draft, Edit, EditError, EditList, OpenScene, Photographs, Provenance, Selection};
use irradia_scene::{Camera, GaussianCloud, Similarity};

/// A scene and the edits applied to it, which can be undone one by one. Only the splats that an edit changed or removed are kept for that.
///
/// ```
/// # use irradia_edit::{Draft, History, open_nothing};
/// # use irradia_scene::GaussianCloud;
/// # let cloud = GaussianCloud {
/// #     means: vec![[0.0; 3], [5.0, 0.0, 0.0]], quats: vec![[1.0, 0.0, 0.0, 0.0]; 2], log_scales: vec![[-1.0; 3]; 2],
/// #     opacity_logits: vec![4.0; 2], sh: vec![1.0; 6], ..Default::default()
/// # };
/// let mut history = History::new(Draft::new(cloud, Vec::new()));
/// history.apply(&"delete sphere center=5,0,0 radius=1".parse()?, &open_nothing)?;
/// history.apply(&"move by=0,0,1".parse()?, &open_nothing)?;
/// assert_eq!(history.draft().cloud.means, [[0.0, 0.0, 1.0]]);
/// history.undo();
/// assert_eq!(history.draft().cloud.means, [[0.0; 3]]);
/// history.undo();
/// assert_eq!(history.draft().len(), 2);
/// # Ok::<(), irradia_edit::EditError>(())
/// ```
pub struct History {
    draft: Draft,
    undo_stack: Vec<(Edit, Undo)>,
    redo_stack: Vec<Edit>,
}

impl History {
    /// A scene without edits.
    pub fn new(draft: Draft) -> Self {
        Self {
            draft,
            undo_stack: Vec::new(),
            redo_stack: Vec::new(),
        }
    }

    /// The scene after the edits.
    pub fn draft(&self) -> &Draft {
        &self.draft
    }

    /// The edits applied and not undone, with all automatically determined values filled in.
    pub fn list(&self) -> EditList {
        EditList {
            edits: self.undo_stack.iter().map(|(edit, _)| edit.clone()).collect(),
            ..EditList::default()
        }
    }

    /// Number of edits that can be redone.
    pub fn redo_count(&self) -> usize {
        self.redo_stack.len()
    }

    /// Applies an edit, after which undone edits can no longer be redone. If it fails, nothing changes.
    ///
    /// # Errors
    /// Those of [`apply`](crate::apply).
    pub fn apply(&mut self, edit: &Edit, open: OpenScene) -> Result<Applied, EditError> {
        let applied = self.perform(edit, open)?;
        self.redo_stack.clear();
        Ok(applied)
    }

    /// Redoes the edit that was undone last; `None` if there is none.
    ///
    /// # Errors
    /// Those of [`apply`](crate::apply).
    pub fn redo(&mut self, open: OpenScene) -> Option<Result<Applied, EditError>> {
        let edit = self.redo_stack.last()?.clone();
        Some(self.perform(&edit, open).inspect(|_| {
            self.redo_stack.pop();
        }))
    }

    /// Undoes the last edit, bit for bit. Returns where the splats come from; `None` if there is no edit.
    pub fn undo(&mut self) -> Option<Provenance> {
        let (edit, undo) = self.undo_stack.pop()?;
        self.redo_stack.push(edit);
        Some(undo.apply(&mut self.draft))
    }

    fn perform(&mut self, edit: &Edit, open: OpenScene) -> Result<Applied, EditError> {
        let plan = Plan::new(&self.draft, edit, open)?;
        let undo = Undo::of(&plan.change, &self.draft);
        let applied = plan.execute(&mut self.draft);
        self.undo_stack.push((applied.edit.clone(), undo));
        Ok(applied)
    }
}

/// The state that an edit overwrites.
struct Undo {
    /// Number of splats before.
    len: usize,
    /// The splats that were changed or removed: their indices, ascending, and rows.
    indices: Vec<u32>,
    rows: GaussianCloud,
    removed: bool,
    sh_degree: u32,
    /// Number of extra columns before.
    extra: usize,
    world_from_dataset: Similarity,
    /// The cameras before, if the edit moves them.
    cameras: Option<Vec<Camera>>,
    hidden: Selection,
    locked: Selection,
    last: Selection,
    photographs: Option<Photographs>,
}

impl Undo {
    fn of(change: &Change, draft: &Draft) -> Self {
        let all;
        let none = Selection::none(draft.len());
        let (touched, removed) = match change {
            Change::Remove(selection) | Change::Split(selection, _) => (selection, true),
            Change::Transform(selection, _) | Change::Recolor(selection, _) | Change::Fade(selection, _) => {
                (selection, false)
            }
            Change::TransformScene(_) => {
                all = Selection::all(draft.len());
                (&all, false)
            }
            Change::Append(..) | Change::Hide(..) | Change::Lock(..) | Change::Nothing => (&none, false),
        };
        let indices = touched.indices();
        Self {
            len: draft.len(),
            rows: gather(&draft.cloud, &indices),
            indices,
            removed,
            sh_degree: draft.cloud.sh_degree,
            extra: draft.cloud.extra.len(),
            world_from_dataset: draft.cloud.world_from_dataset,
            cameras: matches!(change, Change::TransformScene(_)).then(|| draft.cameras.clone()),
            hidden: draft.hidden.clone(),
            locked: draft.locked.clone(),
            last: draft.last.clone(),
            photographs: draft.photographs.clone(),
        }
    }

    fn apply(self, draft: &mut Draft) -> Provenance {
        let cloud = &mut draft.cloud;
        let provenance = if self.removed {
            // Removed splats return to their places between those that stayed.
            let mut sources = vec![Provenance::NEW; self.len];
            let mut removed = Selection::none(self.len);
            self.indices.iter().for_each(|i| removed.set(*i as usize, true));
            let mut order = vec![0; self.len];
            let (mut kept, mut restored) = (0, cloud.len() as u32);
            for (i, to) in order.iter_mut().enumerate() {
                if removed.contains(i) {
                    *to = restored;
                    restored += 1;
                } else {
                    (*to, sources[i]) = (kept, kept);
                    kept += 1;
                }
            }
            append(cloud, &self.rows);
            *cloud = gather(cloud, &order);
            Provenance {
                sources: Some(sources),
                changed: removed,
            }
        } else {
            let was_longer = cloud.len() > self.len;
            truncate(cloud, self.len);
            cloud.extra.truncate(self.extra);
            cloud.set_degree(self.sh_degree);
            scatter(cloud, &self.indices, &self.rows);
            let mut changed = Selection::none(self.len);
            self.indices.iter().for_each(|i| changed.set(*i as usize, true));
            Provenance {
                sources: was_longer.then(|| (0..self.len as u32).collect()),
                changed,
            }
        };
        cloud.world_from_dataset = self.world_from_dataset;
        draft.hidden = self.hidden;
        draft.locked = self.locked;
        draft.last = self.last;
        draft.photographs = self.photographs;
        if let Some(cameras) = self.cameras {
            draft.cameras = cameras;
        }
        provenance
    }
}
