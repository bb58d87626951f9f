//! The socket of one page: passes its requests to the scheduler, and sends it pictures and news.

use crate::live::ReportCursor;
use crate::message::Request;
use crate::scheduler::{MAX_CLIENTS, OutMessage, Task};
use crate::serve::{Shared, downloads};
use crate::subject::Edition;
use axum::body::Bytes;
use axum::extract::ws::{CloseFrame, Message, WebSocket};
use irradia_edit::Transform;
use irradia_train::model::Model;
use serde_json::{Value, json};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, watch};
use tokio::time::{Interval, MissedTickBehavior, interval_at, timeout};

/// Maximum number of messages that wait for a page.
const OUTBOX_CAPACITY: usize = 8;
/// Maximum number of requests per second; a page with a moving camera sends one per frame of its screen.
const MAX_REQUESTS_PER_SECOND: f32 = 500.0;
/// Number of requests beyond the rate or unreadable after which a page is disconnected.
const MAX_FAULTS: u32 = 200;
/// Time in which a page must accept a message.
const SEND_TIMEOUT: Duration = Duration::from_secs(20);
/// Interval of news about a training.
const NEWS_INTERVAL: Duration = Duration::from_millis(250);
/// Interval of pings. A page from which nothing came since the last one is gone: machines fall asleep without closing their connections.
const PING_INTERVAL: Duration = Duration::from_secs(30);

/// Disconnects the client however the task ends.
struct ClientGuard {
    shared: Arc<Shared>,
    client: u64,
}

impl Drop for ClientGuard {
    fn drop(&mut self) {
        let shared = &self.shared;
        shared.scheduler.disconnect(self.client);
        if let Some(live) = &shared.subject.live
            && shared.scheduler.len() == 0
        {
            live.set_due(None);
        }
    }
}

/// Serves a page until it leaves or misbehaves.
pub(crate) async fn serve(mut socket: WebSocket, shared: Arc<Shared>) {
    let (outbox, mut inbox) = mpsc::channel(OUTBOX_CAPACITY);
    let Some(client) = shared.scheduler.connect(outbox) else {
        shared.notices.report_once(
            "too many pages",
            format_args!("more than {MAX_CLIENTS} pages: further ones are rejected"),
        );
        let reason = CloseFrame {
            code: 1013,
            reason: "there are too many pages".into(),
        };
        let _ = timeout(SEND_TIMEOUT, socket.send(Message::Close(Some(reason)))).await;
        return;
    };
    let _guard = ClientGuard {
        shared: shared.clone(),
        client,
    };
    if let Some(live) = &shared.subject.live {
        live.page_opened();
    }
    let mut told = Told::default();
    let (mut news, mut pings) = (every(NEWS_INTERVAL), every(PING_INTERVAL));
    let mut is_there = true;
    let mut edits = shared.subject.editing.as_ref().ok().map(|editing| editing.watch());
    let mut limiter = RateLimiter::new();
    let greeting = hello(&shared, told.changed_scene(&shared));
    let messages = [Some(greeting), told.new_report(&shared)];
    if !send_all(&mut socket, texts(messages.iter().flatten())).await {
        return;
    }
    if let Some(edits) = &mut edits {
        edits.mark_changed();
    }
    loop {
        tokio::select! {
            message = socket.recv() => match message {
                Some(Ok(message)) => match handle(&shared, client, message, &mut limiter) {
                    Outcome::Continue => is_there = true,
                    Outcome::Closed => return,
                    Outcome::Rejected(why) => {
                        shared.notices.report_once(why, format_args!("a page was disconnected: {why}"));
                        let reason = CloseFrame { code: 1008, reason: why.into() };
                        send(&mut socket, Message::Close(Some(reason))).await;
                        return;
                    }
                },
                Some(Err(_)) => {
                    shared.notices.report_once("socket", "a page broke the protocol of its socket, or was cut off");
                    return;
                }
                None => return,
            },
            Some(out) = inbox.recv() => {
                let message = match out {
                    OutMessage::Text(text) => Message::text(text),
                    OutMessage::Binary(bytes) => Message::binary(bytes),
                };
                if !send(&mut socket, message).await {
                    return;
                }
            }
            Some(state) = next_edit_state(&mut edits) => {
                // The scene first: the selection is one of its splats.
                let messages = texts(told.changed_scene(&shared).iter().chain([&*state]));
                if !send_all(&mut socket, messages).await {
                    return;
                }
            }
            _ = news.tick() => {
                let messages = [told.new_report(&shared), told.changed_scene(&shared)];
                if !send_all(&mut socket, texts(messages.iter().flatten())).await {
                    return;
                }
            }
            _ = pings.tick() => {
                if !std::mem::take(&mut is_there) || !send(&mut socket, Message::Ping(Bytes::new())).await {
                    return;
                }
            }
        }
    }
}

/// Ticks after each `period`, which begins anew if a tick is late.
fn every(period: Duration) -> Interval {
    let mut ticks = interval_at(tokio::time::Instant::now() + period, period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    ticks
}

/// Waits for the next state of the editing session; for ever if there is none.
async fn next_edit_state(edits: &mut Option<watch::Receiver<Arc<Value>>>) -> Option<Arc<Value>> {
    if let Some(edits) = edits
        && edits.changed().await.is_ok()
    {
        return Some(edits.borrow_and_update().clone());
    }
    std::future::pending().await
}

/// What a page has been told.
#[derive(Default)]
struct Told {
    /// Version of the scene's splats.
    version: u64,
    cursor: ReportCursor,
    report: Value,
}

impl Told {
    /// The scene, if its splats are not those that the page knows.
    fn changed_scene(&mut self, shared: &Shared) -> Option<Value> {
        let edition = shared.subject.edition()?;
        if edition.splats_version == self.version {
            return None;
        }
        self.version = edition.splats_version;
        Some(scene(&edition))
    }

    /// The state of the training, if it has changed.
    fn new_report(&mut self, shared: &Shared) -> Option<Value> {
        let report = shared.subject.live.as_ref()?.report(&mut self.cursor);
        if report == self.report {
            return None;
        }
        self.report = report.clone();
        Some(report)
    }
}

/// Sends `message`; returns whether the page accepted it in time.
async fn send(socket: &mut WebSocket, message: Message) -> bool {
    matches!(timeout(SEND_TIMEOUT, socket.send(message)).await, Ok(Ok(())))
}

fn texts<'v>(values: impl Iterator<Item = &'v Value>) -> Vec<String> {
    values.map(Value::to_string).collect()
}

/// Sends `messages` one after another, as long as the page accepts them in time.
async fn send_all(socket: &mut WebSocket, messages: Vec<String>) -> bool {
    for message in messages {
        if !send(socket, Message::text(message)).await {
            return false;
        }
    }
    true
}

enum Outcome {
    Continue,
    Closed,
    Rejected(&'static str),
}

/// Limits the rate of requests and the number of faults.
struct RateLimiter {
    tokens: f32,
    at: Instant,
    faults: u32,
}

impl RateLimiter {
    fn new() -> Self {
        Self {
            tokens: MAX_REQUESTS_PER_SECOND,
            at: Instant::now(),
            faults: 0,
        }
    }

    /// Counts a request; returns whether it is within the rate.
    fn try_acquire(&mut self) -> bool {
        let now = Instant::now();
        self.tokens = (self.tokens + MAX_REQUESTS_PER_SECOND * now.duration_since(self.at).as_secs_f32())
            .min(MAX_REQUESTS_PER_SECOND);
        self.at = now;
        self.tokens -= 1.0;
        self.tokens >= 0.0
    }

    fn fault(&mut self, why: &'static str) -> Outcome {
        self.faults += 1;
        if self.faults > MAX_FAULTS {
            Outcome::Rejected(why)
        } else {
            Outcome::Continue
        }
    }
}

fn handle(shared: &Shared, client: u64, message: Message, limiter: &mut RateLimiter) -> Outcome {
    if !limiter.try_acquire() {
        return limiter.fault("too many requests");
    }
    let text = match &message {
        Message::Text(text) => text.as_str(),
        Message::Binary(_) => return limiter.fault("binary requests"),
        Message::Close(_) => return Outcome::Closed,
        Message::Ping(_) | Message::Pong(_) => return Outcome::Continue,
    };
    let Ok(request) = serde_json::from_str::<Request>(text) else {
        return limiter.fault("requests that cannot be read");
    };
    let (scheduler, subject) = (&shared.scheduler, &shared.subject);
    match request {
        Request::Shot(raw) => match raw.check() {
            Some(shot) => scheduler.request_picture(client, Some(shot)),
            None => return limiter.fault("cameras that cannot be drawn"),
        },
        Request::Rest => scheduler.request_picture(client, None),
        Request::Shown { id } => scheduler.acknowledge(client, id),
        Request::Pick { x, y, tag, shot } => {
            let tag = tag.chars().take(64).collect();
            scheduler.add_job(client, Task::Pick { x, y, tag, shot });
        }
        Request::Scores => scheduler.request_scores(client, subject.views.0.len()),
        Request::Train { action } => {
            if let Some(live) = &subject.live {
                live.apply(action);
            }
        }
        Request::Edit(request) => {
            let refused = match &subject.editing {
                Err(why) => Some((*why).to_owned()),
                Ok(editing) => match request.check() {
                    Err(error) => Some(error.to_string()),
                    Ok(()) if editing.push(client, request) => None,
                    Ok(()) => Some("too many edits are waiting: try again when they are done".to_owned()),
                },
            };
            if let Some(why) = refused {
                scheduler.send_text(client, json!({ "tell": "problem", "text": why }).to_string());
            }
        }
        Request::Unit { metres } => {
            let folder = subject.folder.as_ref();
            let problem = match folder.map(|folder| folder.set_metres_per_unit(metres)) {
                Some(Ok(())) => {
                    scheduler.send_text_to_all(&json!({ "tell": "unit", "metres": metres }).to_string());
                    return Outcome::Continue;
                }
                Some(Err(error)) => error.to_string(),
                None => "the scale can only be saved in the folder of a run".to_owned(),
            };
            scheduler.send_text(client, json!({ "tell": "problem", "text": problem }).to_string());
        }
    }
    Outcome::Continue
}

/// The first message to a page, with the scene if there is one.
fn hello(shared: &Shared, scene: Option<Value>) -> Value {
    let subject = &shared.subject;
    json!({
        "tell": "hello",
        "program": concat!("Irradia ", env!("CARGO_PKG_VERSION")),
        "title": subject.title,
        "views": subject.views.to_json(),
        "live": subject.live.is_some(),
        "plan": subject.live.as_ref().map(|live| live.plan()),
        "recipe": subject.recipe,
        "id": shared.id,
        "server": shared.server,
        "metres": subject.folder.as_ref().and_then(|folder| folder.metres_per_unit()),
        "keeps_unit": subject.folder.is_some(),
        "warnings": subject.warnings,
        "editing": { "works": subject.editing.is_ok(), "why": subject.editing.as_ref().err() },
        "formats": downloads().map(|(name, format)| json!({ "name": name, "format": format.to_string() })).collect::<Value>(),
        "scene": scene,
    })
}

/// The message that describes a version of the scene.
fn scene(edition: &Edition) -> Value {
    let scene = edition.scene();
    let orbit_geometry = scene.orbit_geometry();
    let k = orbit_geometry.intrinsics;
    let first = scene.cameras.as_deref().and_then(|cameras| cameras.first());
    let (kind, count, sh_degree) = match &scene.model {
        Model::Splats { splats, residual: None } => {
            ("splats", splats.len(), scene.options.sh_degree.min(splats.sh_degree()))
        }
        Model::Splats { splats, .. } => ("splats with a residual field", splats.len(), splats.sh_degree()),
        Model::Field(field) => ("field", field.len(), 0),
    };
    json!({
        "tell": "scene",
        "version": edition.splats_version,
        "placement": transform(&edition.placement),
        "world_from_photographs": transform(&edition.world_from_photographs()),
        // To the coordinates of the dataset.
        "world": { "scale": scene.world_from_dataset.scale, "center": scene.world_from_dataset.center.to_array() },
        "step": edition.step(),
        "kind": kind,
        "count": count,
        "sh_degree": sh_degree,
        // Only plain splats travel to the browser.
        "travels": kind == "splats",
        "antialias": scene.options.antialias,
        "lights": edition.lights.is_some(),
        "background": scene.options.background,
        "center": orbit_geometry.center.to_array(),
        "up": orbit_geometry.up.to_array(),
        "radius": orbit_geometry.radius,
        "height": orbit_geometry.height,
        // The side from which a page first sees the scene, as an orbit does.
        "first": first.map(|camera| camera.pose.position.to_array()),
        "fov": 2.0 * (0.5 * k.height as f32 / k.fy).atan(),
    })
}

/// A transform in the form that the page reads.
fn transform(transform: &Transform) -> Value {
    let rotation = transform.rotation;
    json!({
        "scale": transform.scale,
        "rotation": [rotation.w, rotation.x, rotation.y, rotation.z],
        "translation": transform.translation.to_array(),
    })
}
