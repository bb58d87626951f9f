//! The socket of one page: takes its requests to the desk, and sends it pictures and news.

use crate::Subject;
use crate::desk::{Out, SEATS, Task};
use crate::live::Known;
use crate::message::Request;
use crate::serve::{Shared, downloads};
use crate::subject::Edition;
use axum::extract::ws::{CloseFrame, Message, WebSocket};
use irradia_train::model::Model;
use serde_json::{Value, json};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, watch};
use tokio::time::{MissedTickBehavior, interval, timeout};

/// Maximum number of messages that wait for a page.
const OUTBOX: usize = 8;
/// Maximum number of requests per second; a page with a moving camera sends one per frame of its screen.
const RATE: f32 = 500.0;
/// Number of requests beyond the rate or unreadable after which a page is disconnected.
const PATIENCE: u32 = 200;
/// Time in which a page must accept a message.
const TAKES: Duration = Duration::from_secs(20);
/// Interval of news about a training.
const NEWS: Duration = Duration::from_millis(250);

/// Frees the seat however the task ends.
struct Seat(Arc<Shared>, u64);

impl Drop for Seat {
    fn drop(&mut self) {
        let Self(shared, seat) = self;
        shared.desk.leave(*seat);
        if let Some(live) = &shared.subject.live
            && shared.desk.len() == 0
        {
            live.set_due(None);
        }
    }
}

/// Serves a page until it leaves or misbehaves.
pub(crate) async fn serve(mut socket: WebSocket, shared: Arc<Shared>) {
    let (outbox, mut inbox) = mpsc::channel(OUTBOX);
    let Some(seat) = shared.desk.sit(outbox) else {
        shared.notices.once(
            "seats",
            format_args!("more than {SEATS} pages: further ones are rejected"),
        );
        let reason = CloseFrame {
            code: 1013,
            reason: "there are too many pages".into(),
        };
        let _ = timeout(TAKES, socket.send(Message::Close(Some(reason)))).await;
        return;
    };
    let seat = Seat(shared.clone(), seat);
    if let Some(live) = &shared.subject.live {
        live.look();
    }
    let mut known = Known::default();
    let (mut version, mut reported) = (0, Value::Null);
    let mut news = interval(NEWS);
    news.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut edits = shared.subject.editing.as_ref().ok().map(|editing| editing.watch());
    let mut allowance = Allowance::new();
    if !send(&mut socket, Message::text(hello(&shared).to_string())).await {
        return;
    }
    if let Some(edits) = &mut edits {
        edits.mark_changed();
    }
    loop {
        tokio::select! {
            message = socket.recv() => match message {
                Some(Ok(message)) => match handle(&shared, seat.1, message, &mut allowance) {
                    Handled::Fine => {}
                    Handled::Left => return,
                    Handled::SentAway(why) => {
                        shared.notices.once(why, format_args!("a page was disconnected: {why}"));
                        let reason = CloseFrame { code: 1008, reason: why.into() };
                        send(&mut socket, Message::Close(Some(reason))).await;
                        return;
                    }
                },
                Some(Err(_)) => {
                    shared.notices.once("socket", "a page broke the protocol of its socket, or was cut off");
                    return;
                }
                None => return,
            },
            Some(out) = inbox.recv() => {
                let message = match out {
                    Out::Text(text) => Message::text(text),
                    Out::Binary(bytes) => Message::binary(bytes),
                };
                if !send(&mut socket, message).await {
                    return;
                }
            }
            Some(told) = changed(&mut edits) => {
                // The scene first: the selection is one of its splats.
                for text in fresh_scene(&shared, &mut version).iter().chain([&*told]) {
                    if !send(&mut socket, Message::text(text.to_string())).await {
                        return;
                    }
                }
            }
            _ = news.tick() => {
                let mut told = Vec::new();
                if let Some(live) = &shared.subject.live {
                    let report = live.report(&mut known);
                    if report != reported {
                        told.push(report.clone());
                        reported = report;
                    }
                }
                told.extend(fresh_scene(&shared, &mut version));
                for text in told {
                    if !send(&mut socket, Message::text(text.to_string())).await {
                        return;
                    }
                }
            }
        }
    }
}

/// Waits for the next state of the editing session; for ever if there is none.
async fn changed(edits: &mut Option<watch::Receiver<Arc<Value>>>) -> Option<Arc<Value>> {
    if let Some(edits) = edits
        && edits.changed().await.is_ok()
    {
        return Some(edits.borrow_and_update().clone());
    }
    std::future::pending().await
}

/// The scene, if its splats are not those of `version`, which is updated.
fn fresh_scene(shared: &Shared, version: &mut u64) -> Option<Value> {
    let edition = shared.subject.edition()?;
    if edition.splats_version == *version {
        return None;
    }
    *version = edition.splats_version;
    Some(scene(&edition))
}

/// Sends `message`; returns whether the page accepted it in time.
async fn send(socket: &mut WebSocket, message: Message) -> bool {
    matches!(timeout(TAKES, socket.send(message)).await, Ok(Ok(())))
}

enum Handled {
    Fine,
    Left,
    SentAway(&'static str),
}

/// Limits the rate of requests and the number of faults.
struct Allowance {
    left: f32,
    at: Instant,
    faults: u32,
}

impl Allowance {
    fn new() -> Self {
        Self {
            left: RATE,
            at: Instant::now(),
            faults: 0,
        }
    }

    /// Counts a request; returns whether it is within the rate.
    fn take(&mut self) -> bool {
        let now = Instant::now();
        self.left = (self.left + RATE * now.duration_since(self.at).as_secs_f32()).min(RATE);
        self.at = now;
        self.left -= 1.0;
        self.left >= 0.0
    }

    fn fault(&mut self, why: &'static str) -> Handled {
        self.faults += 1;
        if self.faults > PATIENCE {
            Handled::SentAway(why)
        } else {
            Handled::Fine
        }
    }
}

fn handle(shared: &Shared, seat: u64, message: Message, allowance: &mut Allowance) -> Handled {
    if !allowance.take() {
        return allowance.fault("too many requests");
    }
    let text = match &message {
        Message::Text(text) => text.as_str(),
        Message::Binary(_) => return allowance.fault("binary requests"),
        Message::Close(_) => return Handled::Left,
        Message::Ping(_) | Message::Pong(_) => return Handled::Fine,
    };
    let Ok(request) = serde_json::from_str::<Request>(text) else {
        return allowance.fault("requests that cannot be read");
    };
    let (desk, subject) = (&shared.desk, &shared.subject);
    match request {
        Request::Shot(raw) => match raw.check() {
            Some(shot) => desk.want(seat, Some(shot)),
            None => return allowance.fault("cameras that cannot be drawn"),
        },
        Request::Rest => desk.want(seat, None),
        Request::Shown { id } => desk.shown(seat, id),
        Request::Pick { x, y, tag, shot } => {
            let tag = tag.chars().take(64).collect();
            desk.ask(seat, Task::Pick { x, y, tag, shot });
        }
        Request::Scores => desk.score(seat, subject.views.0.len()),
        Request::Train { action } => {
            if let Some(live) = &subject.live {
                live.act(action);
            }
        }
        Request::Edit(request) => {
            let refused = match &subject.editing {
                Err(why) => Some((*why).to_owned()),
                Ok(editing) => match request.check() {
                    Err(error) => Some(error.to_string()),
                    Ok(()) if editing.ask(seat, request) => None,
                    Ok(()) => Some("too many edits are waiting: try again when they are done".to_owned()),
                },
            };
            if let Some(why) = refused {
                desk.tell(seat, json!({ "tell": "problem", "text": why }).to_string());
            }
        }
        Request::Unit { metres } => {
            let folder = subject.folder.as_ref();
            let kept = folder.map(|folder| folder.set_metres_per_unit(metres * scale_of(subject)));
            let told = match kept {
                Some(Ok(())) => json!({ "tell": "unit", "metres": metres }),
                Some(Err(error)) => json!({ "tell": "problem", "text": error.to_string() }),
                None => json!({ "tell": "problem", "text": "the scale can only be saved in the folder of a run" }),
            };
            desk.tell(seat, told.to_string());
        }
    }
    Handled::Fine
}

/// The factor by which edits have scaled the whole scene: the unit saved in the run is that before the edits.
fn scale_of(subject: &Subject) -> f64 {
    subject.edition().map_or(1.0, |edition| edition.placement.scale)
}

/// The first message to a page.
fn hello(shared: &Shared) -> Value {
    let subject = &shared.subject;
    let edition = subject.edition();
    json!({
        "tell": "hello",
        "program": concat!("Irradia ", env!("CARGO_PKG_VERSION")),
        "title": subject.title,
        "views": subject.views.to_json(),
        "live": subject.live.is_some(),
        "plan": subject.live.as_ref().map(|live| live.plan()),
        "recipe": subject.recipe,
        "id": shared.id,
        "metres": subject.folder.as_ref().and_then(|folder| folder.metres_per_unit()).map(|metres| metres / scale_of(subject)),
        "keeps_unit": subject.folder.is_some(),
        "warnings": subject.warnings,
        "editing": { "works": subject.editing.is_ok(), "why": subject.editing.as_ref().err() },
        "formats": downloads().map(|(name, format)| json!({ "name": name, "format": format.to_string() })).collect::<Value>(),
        "scene": edition.as_ref().map(scene),
    })
}

/// The message that describes a version of the scene.
fn scene(edition: &Edition) -> Value {
    let scene = edition.scene();
    let outlook = scene.outlook();
    let k = outlook.intrinsics;
    let rotation = edition.placement.rotation;
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
        "placement": {
            "scale": edition.placement.scale,
            "rotation": [rotation.w, rotation.x, rotation.y, rotation.z],
            "translation": edition.placement.translation.to_array(),
        },
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
        "center": outlook.center.to_array(),
        "up": outlook.up.to_array(),
        "radius": outlook.radius,
        "height": outlook.height,
        "fov": 2.0 * (0.5 * k.height as f32 / k.fy).atan(),
    })
}
