//! Editing from the pages: one session on a finished scene of splats, which all pages share. Their requests wait in a queue; a
//! separate thread carries them out, shows the resulting scene and informs every page.

mod entry_text;
mod save;
mod session;
mod uploads;
mod worker;
mod world;

use crate::message::EditRequest;
use irradia_edit::{Draft, EditError, EditList};
use irradia_runs::RunError;
use irradia_runs::formats::{FormatError, read_splats};
use irradia_scene::GaussianCloud;
use serde_json::Value;
use std::collections::VecDeque;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;
use tokio::sync::watch;

use save::folder_of;
pub(crate) use save::stem_of;
use session::Session;
use uploads::Uploads;
pub(crate) use worker::run_editing;
pub(crate) use world::moved_camera;

/// Maximum number of waiting requests.
const MAX_WAITING: usize = 64;

/// Why a request of a page is not fulfilled.
#[derive(Debug, thiserror::Error)]
pub(crate) enum EditingError {
    /// The file is no longer the one that pages show.
    #[error("{} has changed since it was opened: start irradia view again to edit it", .0.display())]
    Changed(PathBuf),
    #[error(transparent)]
    Edit(#[from] EditError),
    #[error(transparent)]
    Format(#[from] FormatError),
    #[error(transparent)]
    Run(#[from] RunError),
}

#[derive(Default)]
struct Queue {
    waiting: VecDeque<(u64, EditRequest)>,
    closing: bool,
}

/// The edited scene and its list of edits as TOML.
type EditedScene = (Arc<Draft>, Arc<str>);

/// Length of a file and when it was written; `None` if it cannot be told.
pub(crate) type FileState = Option<(u64, SystemTime)>;

/// The state of the file `path`.
pub(crate) fn file_state(path: &Path) -> FileState {
    let metadata = fs::metadata(path).ok()?;
    Some((metadata.len(), metadata.modified().ok()?))
}

pub(crate) struct Editing {
    /// The file of the scene.
    pub source: PathBuf,
    /// Its state before the scene that pages show was read from it.
    opened: FileState,
    /// Scenes to merge.
    pub uploads: Arc<Uploads>,
    queue: Mutex<Queue>,
    request_added: Condvar,
    /// The state that pages are told.
    state: watch::Sender<Arc<Value>>,
    /// `None` before the first request.
    current: Mutex<Option<EditedScene>>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Editing {
    /// A session on the scene in the file `source`, which has `splats` splats and was read when the file was in the state `opened`.
    pub fn new(source: PathBuf, opened: FileState, splats: usize) -> Self {
        Self {
            opened,
            uploads: Arc::new(Uploads::new(folder_of(&source))),
            source,
            queue: Mutex::default(),
            request_added: Condvar::new(),
            state: watch::Sender::new(Arc::new(worker::initial_state(splats))),
            current: Mutex::default(),
        }
    }

    /// The state that pages are told, now and at every change.
    pub fn watch(&self) -> watch::Receiver<Arc<Value>> {
        self.state.subscribe()
    }

    fn publish(&self, state: Value) {
        self.state.send_replace(Arc::new(state));
    }

    /// Adds a request of a page, replacing a waiting one of the same gesture. Returns whether there was room.
    pub fn push(&self, client: u64, request: EditRequest) -> bool {
        let mut queue = lock(&self.queue);
        let last = queue.waiting.back().and_then(|(_, last)| last.gesture());
        if last.is_some() && last == request.gesture() {
            queue.waiting.pop_back();
        }
        if queue.waiting.len() >= MAX_WAITING {
            return false;
        }
        queue.waiting.push_back((client, request));
        drop(queue);
        self.request_added.notify_all();
        true
    }

    /// Waits for the next request; `None` when closing.
    fn next(&self) -> Option<(u64, EditRequest)> {
        let mut queue = lock(&self.queue);
        loop {
            if queue.closing {
                return None;
            }
            if let Some(next) = queue.waiting.pop_front() {
                return Some(next);
            }
            queue = self.request_added.wait(queue).unwrap_or_else(PoisonError::into_inner);
        }
    }

    pub fn close(&self) {
        lock(&self.queue).closing = true;
        self.request_added.notify_all();
    }

    /// Sets the edited scene to that of `session`; returns its list of edits as TOML. Each edit makes a new draft: for the same draft,
    /// the list is not written out again.
    fn set_current(&self, session: &Session) -> Arc<str> {
        let draft = session.draft();
        if let Some((_, list)) = self.current().filter(|(known, _)| Arc::ptr_eq(known, draft)) {
            return list;
        }
        let list: Arc<str> = session.list().to_toml().into();
        *lock(&self.current) = Some((draft.clone(), list.clone()));
        list
    }

    fn current(&self) -> Option<EditedScene> {
        lock(&self.current).clone()
    }

    /// The splats of the scene as it was opened.
    ///
    /// # Errors
    /// When its file can no longer be read, or has changed.
    fn read_source(&self) -> Result<GaussianCloud, EditingError> {
        let cloud = read_splats(&self.source)?;
        // Checked last, since the file may be replaced while it is read.
        if file_state(&self.source) != self.opened {
            return Err(EditingError::Changed(self.source.clone()));
        }
        Ok(cloud)
    }

    /// The splats to write.
    ///
    /// # Errors
    /// When nothing has been edited, and the file of the scene can no longer be read, or has changed.
    pub fn cloud(&self) -> Result<GaussianCloud, EditingError> {
        match self.current() {
            Some((draft, _)) => Ok(draft.visible_cloud().into_owned()),
            None => self.read_source(),
        }
    }

    /// The list of edits as TOML.
    pub fn list(&self) -> String {
        self.current()
            .map_or_else(|| EditList::default().to_toml(), |(_, list)| list.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_edit::{Operation, SelectStep, Shape};

    #[test]
    fn the_list_is_written_out_again_only_after_an_edit() {
        let cloud = GaussianCloud {
            means: vec![[0.0; 3]; 2],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            log_scales: vec![[-2.0; 3]; 2],
            opacity_logits: vec![1.0; 2],
            sh: vec![0.3; 6],
            ..GaussianCloud::default()
        };
        let editing = Editing::new("a.ply".into(), None, 2);
        let mut session = Session::new(Draft::new(cloud, Vec::new()), editing.uploads.clone());
        let opened = editing.set_current(&session);
        session
            .select(1, true, vec![SelectStep::add(Shape::All {})])
            .expect("selected");
        assert!(Arc::ptr_eq(&opened, &editing.set_current(&session)), "a selection");
        for factor in [0.5, 0.25] {
            let before = editing.list();
            session.edit(2, false, Operation::Opacity { factor }).expect("edited");
            editing.set_current(&session);
            assert_ne!(editing.list(), before);
            assert_eq!(editing.list(), session.list().to_toml());
        }
        session.go_to(0).expect("undone");
        assert_eq!(*editing.set_current(&session), *opened);
    }
}
