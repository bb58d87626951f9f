//! The running server.

use crate::draw::draw;
use crate::editing::run_editing;
use crate::guard::{Guard, TOKEN_NAME, random_token};
use crate::listen::{Listen, accept, open_browser, reachable};
use crate::notices::{LineSink, Notices};
use crate::serve::{Shared, router};
use crate::{Subject, ViewerError};
use serde_json::json;
use std::fmt::Display;
use std::net::TcpListener;
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};
use tokio::sync::Notify;

/// Interval at which a waiting program checks whether it should stop: the load is not measurable.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Time without pages after which the viewer counts as closed: a page that is reloaded comes back sooner.
const CLOSED_TIMEOUT: Duration = Duration::from_secs(4);

/// A server with its thread, and the thread that draws; both end when it is dropped.
pub struct Viewer {
    shared: Arc<Shared>,
    address: String,
    closing: Arc<Notify>,
    threads: Vec<JoinHandle<()>>,
}

/// The system does not give what a viewer needs.
fn refused(error: impl Display) -> ViewerError {
    ViewerError::Start(error.to_string())
}

impl Viewer {
    /// Serves `subject`. `sink` receives lines for the user of the program, such as each kind of refused request once.
    ///
    /// # Errors
    /// When no address can be listened on, or the system refuses threads or random numbers.
    pub fn start(subject: Subject, listen: &Listen, sink: LineSink) -> Result<Self, ViewerError> {
        let notices = Arc::new(Notices::new(sink));
        let listener = listen.bind()?;
        let bound = listener.local_addr().map_err(refused)?;
        if listen.port != 0 && bound.port() != listen.port {
            notices.report(format_args!("port {} is taken: using {}", listen.port, bound.port()));
        }
        let token = if bound.ip().is_loopback() {
            None
        } else {
            Some(random_token().map_err(refused)?)
        };
        let query = token
            .as_ref()
            .map_or(String::new(), |token| format!("?{TOKEN_NAME}={token}"));
        let address = format!("http://{}/{query}", reachable(bound));
        let guard = Guard {
            host: listen.host.clone(),
            port: bound.port(),
            token,
        };
        let shared = Arc::new(Shared::new(subject, guard, notices).map_err(refused)?);
        wake_on_change(&shared);
        let closing = Arc::new(Notify::new());
        let viewer = Self {
            threads: vec![
                spawn("serve", serving(&shared, listener, closing.clone())?)?,
                spawn("draw", drawing(&shared)?)?,
                spawn("edit", editing(&shared))?,
            ],
            shared,
            address,
            closing,
        };
        if listen.open
            && let Err(error) = open_browser(&viewer.address)
        {
            viewer
                .shared
                .notices
                .report(format_args!("cannot start a browser: {error}"));
        }
        Ok(viewer)
    }

    /// The address of the page, with its token if it has one.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Whether a page is open.
    pub fn is_watched(&self) -> bool {
        self.shared.scheduler.len() > 0
    }

    /// Serves until `stop`.
    pub fn wait(&self, stop: &dyn Fn() -> bool) {
        while !stop() {
            thread::sleep(POLL_INTERVAL);
        }
    }

    /// Serves until `stop`, or until no page has been open for a few seconds.
    pub fn wait_while_watched(&self, stop: &dyn Fn() -> bool) {
        let mut seen = Instant::now();
        while !stop() && seen.elapsed() < CLOSED_TIMEOUT {
            thread::sleep(POLL_INTERVAL);
            if self.is_watched() {
                seen = Instant::now();
            }
        }
    }
}

/// Wakes the drawing thread whenever the scene of a training may have changed.
fn wake_on_change(shared: &Arc<Shared>) {
    let Some(live) = &shared.subject.live else { return };
    let weak = Arc::downgrade(shared);
    let wake = move || {
        if let Some(shared) = weak.upgrade() {
            shared.scheduler.wake();
        }
    };
    // A subject is shown by one viewer.
    let _ = live.on_change.set(Box::new(wake));
}

fn spawn(name: &str, run: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>, ViewerError> {
    let thread = thread::Builder::new().name(name.into());
    thread.spawn(run).map_err(refused)
}

/// What the serving thread does, until `closing`.
fn serving(
    shared: &Arc<Shared>,
    listener: TcpListener,
    closing: Arc<Notify>,
) -> Result<impl FnOnce() + Send + use<>, ViewerError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(4)
        .build()
        .map_err(refused)?;
    let (router, notices) = (router(shared.clone()), shared.notices.clone());
    Ok(move || {
        if let Err(error) = runtime.block_on(accept(listener, router, notices.clone(), closing)) {
            notices.report(format_args!("the viewer has stopped: {error}"));
        }
        // Photographs that are being decoded must not delay the end.
        runtime.shutdown_background();
    })
}

/// What the drawing thread does, until the scheduler closes.
fn drawing(shared: &Arc<Shared>) -> Result<impl FnOnce() + Send + use<>, ViewerError> {
    // A separate pool: a training keeps its own, and the system shares the processor between both.
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(rayon::current_num_threads())
        .thread_name(|i| format!("draw-{i}"))
        .build()
        .map_err(refused)?;
    let shared = shared.clone();
    Ok(move || pool.install(|| draw(&shared.subject, &shared.scheduler)))
}

/// What the editing thread does, until the session closes: in the program's global pool, since only finished scenes are edited.
fn editing(shared: &Arc<Shared>) -> impl FnOnce() + Send + use<> {
    let shared = shared.clone();
    move || {
        let Ok(editing) = &shared.subject.editing else { return };
        let tell = |client, line: &str| {
            let message = json!({ "tell": "problem", "text": line });
            shared.scheduler.send_text(client, message.to_string());
        };
        if let Some(line) = run_editing(editing, &shared.subject, &tell, &|| shared.scheduler.wake()) {
            shared.notices.report(format_args!("{line}"));
        }
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        self.shared.scheduler.close();
        if let Ok(editing) = &self.shared.subject.editing {
            editing.close();
        }
        self.closing.notify_one();
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}
