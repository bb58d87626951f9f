//! The pictures that pages request. A page connects, requests a picture, and gets it when it is drawn; a newer request replaces an
//! older one. At most [`MAX_IN_FLIGHT`] pictures are on the way to a page that has not shown them, so that a slow page gets fewer
//! pictures and does not slow down others.

use crate::message::{RawShot, Shot};
use crate::pace::{Detail, Pace};
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

/// Maximum number of pages.
pub(crate) const MAX_CLIENTS: usize = 8;
/// Maximum number of pictures on the way to a page.
const MAX_IN_FLIGHT: usize = 2;
/// A camera without a new position for this long is at rest.
const REST_DELAY: Duration = Duration::from_millis(100);
/// Maximum number of waiting requests other than pictures.
const MAX_JOBS: usize = 4;
/// Time until an outbox that is nearly full is checked again: nothing signals that a page has taken a message.
const OUTBOX_POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Time between two copies of a training's scene, as a multiple of the time that a copy and its picture take.
const COPY_INTERVAL_FACTOR: u32 = 40;
/// Minimum time between two copies of a training's scene.
const MIN_COPY_INTERVAL: Duration = Duration::from_millis(1000);

/// A message to a page.
pub(crate) enum OutMessage {
    Text(String),
    Binary(Vec<u8>),
}

/// Work to do for a page.
pub(crate) enum Task {
    Picture { shot: Shot, detail: Detail },
    Pick { x: f32, y: f32, tag: String, shot: RawShot },
    Score { view: usize },
}

/// A picture that was drawn, for the page that requested it.
pub(crate) struct DrawnPicture {
    /// [`Shot::id`].
    pub id: u64,
    /// Version of the scene.
    pub version: u64,
    /// How much of it was drawn.
    pub detail: Detail,
    /// Number of pixels.
    pub pixels: f32,
    /// Time that drawing and encoding took.
    pub seconds: f32,
    /// The message to the page.
    pub bytes: Vec<u8>,
}

/// The picture that was drawn last for a page.
struct LastPicture {
    id: u64,
    version: u64,
    detail: Detail,
}

impl LastPicture {
    /// The share of the pixels that was drawn, if all splats were.
    fn share(&self) -> Option<f32> {
        (self.detail.splats == 1.0).then_some(self.detail.pixels)
    }
}

struct Client {
    shot: Option<Shot>,
    shot_at: Instant,
    drawn: Option<LastPicture>,
    in_flight: VecDeque<u64>,
    pace: Pace,
    jobs: VecDeque<Task>,
    /// The view to measure next, and the number of views.
    scores: Option<(usize, usize)>,
    outbox: mpsc::Sender<OutMessage>,
}

#[derive(Default)]
struct State {
    clients: BTreeMap<u64, Client>,
    /// The id of the last client that connected; ids count up from 1.
    last_id: u64,
    /// The client served last.
    served: u64,
    closing: bool,
    /// Number of calls of [`Scheduler::wake`] so far.
    wakes: u64,
    /// Nothing is drawn before this time, so that a training gets the processor.
    rest_until: Option<Instant>,
    /// No picture is renewed for a newer scene before this time.
    renew_after: Option<Instant>,
}

#[derive(Default)]
pub(crate) struct Scheduler {
    state: Mutex<State>,
    changed: Condvar,
}

/// Version of the scene, and whether a training competes for the processor.
#[derive(Clone, Copy)]
pub(crate) struct SceneStatus {
    pub version: u64,
    pub training: bool,
}

impl Scheduler {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a client, unless there are too many.
    pub fn connect(&self, outbox: mpsc::Sender<OutMessage>) -> Option<u64> {
        let mut state = self.lock();
        if state.clients.len() >= MAX_CLIENTS || state.closing {
            return None;
        }
        state.last_id += 1;
        let id = state.last_id;
        state.clients.insert(
            id,
            Client {
                shot: None,
                shot_at: Instant::now(),
                drawn: None,
                in_flight: VecDeque::new(),
                pace: Pace::default(),
                jobs: VecDeque::new(),
                scores: None,
                outbox,
            },
        );
        Some(id)
    }

    pub fn disconnect(&self, client: u64) {
        self.lock().clients.remove(&client);
        self.changed.notify_all();
    }

    /// Number of connected clients.
    pub fn len(&self) -> usize {
        self.lock().clients.len()
    }

    fn with_client(&self, client: u64, change: impl FnOnce(&mut Client)) {
        if let Some(client) = self.lock().clients.get_mut(&client) {
            change(client);
        }
        self.changed.notify_all();
    }

    /// The page wants this picture, or none.
    pub fn request_picture(&self, client: u64, shot: Option<Shot>) {
        self.with_client(client, |client| {
            // Every request counts as a motion of the camera: it is at rest [`REST_DELAY`] after the last one.
            (client.shot, client.shot_at) = (shot, Instant::now());
        });
    }

    /// The page shows the picture `id`.
    pub fn acknowledge(&self, client: u64, id: u64) {
        self.with_client(client, |client| {
            if let Some(at) = client.in_flight.iter().position(|sent| *sent == id) {
                client.in_flight.drain(..=at);
            }
        });
    }

    /// Adds a request other than a picture; the oldest is dropped if too many wait.
    pub fn add_job(&self, client: u64, task: Task) {
        self.with_client(client, |client| {
            if client.jobs.len() >= MAX_JOBS {
                client.jobs.pop_front();
            }
            client.jobs.push_back(task);
        });
    }

    /// Measures `views` views for the page.
    pub fn request_scores(&self, client: u64, views: usize) {
        self.with_client(client, |client| client.scores = (views > 0).then_some((0, views)));
    }

    /// Wakes [`Self::next`] after a change of the scene or of the training's state.
    pub fn wake(&self) {
        // Under the lock, so that no sleeping thread misses it; counted for a thread that is about to sleep.
        self.lock().wakes += 1;
        self.changed.notify_all();
    }

    pub fn close(&self) {
        self.lock().closing = true;
        self.changed.notify_all();
    }

    /// Whether the picture of `shot` is still wanted by `client`.
    pub fn is_current(&self, client: u64, shot: &Shot) -> bool {
        let state = self.lock();
        let newest = state.clients.get(&client).and_then(|client| client.shot.as_ref());
        !state.closing && newest.is_some_and(|newest| newest.id == shot.id)
    }

    /// Waits for the next task, clients in turn; `None` when closing. `status` is called again at every wake-up.
    pub fn next(&self, status: impl Fn() -> SceneStatus) -> Option<(u64, Task)> {
        let mut state = self.lock();
        loop {
            if state.closing {
                return None;
            }
            // Not under the lock of the scheduler: `status` takes other locks.
            let wakes = state.wakes;
            drop(state);
            let status = status();
            state = self.lock();
            if state.wakes != wakes {
                continue;
            }
            let now = Instant::now();
            let mut wake_at: Option<Instant> = None;
            let mut sooner = |at: Instant| wake_at = Some(wake_at.map_or(at, |other| other.min(at)));
            match state.rest_until.filter(|until| status.training && *until > now) {
                Some(until) => sooner(until),
                None => {
                    let after: Vec<u64> = state.clients.range(state.served + 1..).map(|(id, _)| *id).collect();
                    let before: Vec<u64> = state.clients.range(..=state.served).map(|(id, _)| *id).collect();
                    for id in after.into_iter().chain(before) {
                        let renew_after = state.renew_after.filter(|_| status.training);
                        let client = state.clients.get_mut(&id).expect("listed");
                        match client.next(status, renew_after, now) {
                            Next::Now(task) => {
                                state.served = id;
                                return Some((id, *task));
                            }
                            Next::At(at) => sooner(at),
                            Next::Nothing => {}
                        }
                    }
                }
            }
            state = match wake_at {
                Some(at) => {
                    let wait = at.saturating_duration_since(Instant::now());
                    let waited = self.changed.wait_timeout(state, wait);
                    waited.unwrap_or_else(PoisonError::into_inner).0
                }
                None => self.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
            };
        }
    }

    /// Delivers a picture to its page.
    pub fn deliver(&self, client: u64, picture: DrawnPicture) {
        let DrawnPicture {
            id, version, detail, ..
        } = picture;
        self.with_client(client, |client| {
            client.pace.update(&detail, picture.pixels, picture.seconds);
            client.drawn = Some(LastPicture { id, version, detail });
            // The outbox has room for more than the pictures in flight: a full one belongs to a page that is being closed.
            if client.outbox.try_send(OutMessage::Binary(picture.bytes)).is_ok() {
                client.in_flight.push_back(id);
            }
        });
    }

    /// Tells a page something.
    pub fn send_text(&self, client: u64, text: String) {
        self.with_client(client, |client| drop(client.outbox.try_send(OutMessage::Text(text))));
    }

    /// Tells all pages something.
    pub fn send_text_to_all(&self, text: &str) {
        for client in self.lock().clients.values() {
            let _ = client.outbox.try_send(OutMessage::Text(text.to_owned()));
        }
    }

    /// Leaves time to a training after drawing for a moving camera took `seconds`; the browser needs about as much again.
    pub fn pause_drawing(&self, seconds: f32) {
        self.lock().rest_until = Some(Instant::now() + Duration::from_secs_f32(4.5 * seconds));
    }

    /// When the next copy of a training's scene is due, after a picture of the current one that took `seconds` and a copy that took
    /// `copying`; `None` while no page is open.
    pub fn schedule_renewal(&self, seconds: f32, copying: f32) -> Option<Instant> {
        let mut state = self.lock();
        if state.clients.is_empty() {
            return None;
        }
        let pause = Duration::from_secs_f32(seconds + copying) * COPY_INTERVAL_FACTOR;
        let due = Instant::now() + pause.max(MIN_COPY_INTERVAL);
        state.renew_after = Some(due);
        Some(due)
    }
}

enum Next {
    Now(Box<Task>),
    At(Instant),
    Nothing,
}

impl Client {
    fn next(&mut self, status: SceneStatus, renew_after: Option<Instant>, now: Instant) -> Next {
        if let Some(job) = self.jobs.pop_front() {
            return Next::Now(Box::new(job));
        }
        let picture = self.picture(status, renew_after, now);
        if matches!(picture, Next::Now(_)) {
            return picture;
        }
        let Some((view, count)) = self.scores else {
            return picture;
        };
        // Views are measured only while the camera is at rest, and only while the outbox has room for pictures besides.
        let rests_at = self.shot_at + REST_DELAY;
        let free_at = if self.outbox.capacity() > 2 {
            now
        } else {
            now + OUTBOX_POLL_INTERVAL
        };
        let measured_at = rests_at.max(free_at);
        if measured_at <= now {
            self.scores = (view + 1 < count).then_some((view + 1, count));
            return Next::Now(Box::new(Task::Score { view }));
        }
        match picture {
            Next::At(at) => Next::At(at.min(measured_at)),
            _ => Next::At(measured_at),
        }
    }

    fn picture(&self, status: SceneStatus, renew_after: Option<Instant>, now: Instant) -> Next {
        let Some(shot) = self
            .shot
            .filter(|_| status.version > 0 && self.in_flight.len() < MAX_IN_FLIGHT)
        else {
            return Next::Nothing;
        };
        let same = self.drawn.as_ref().filter(|drawn| drawn.id == shot.id);
        let picture = |detail| Next::Now(Box::new(Task::Picture { shot, detail }));
        let resting = |last| picture(self.pace.resting(&shot, last));
        let rests_at = self.shot_at + REST_DELAY;
        match same {
            None => picture(self.pace.moving(&shot, status.training)),
            Some(drawn) if drawn.version != status.version => match renew_after.filter(|after| *after > now) {
                // The camera has just stopped: its picture becomes sharp first.
                _ if !drawn.detail.sharp && rests_at <= now => resting(None),
                Some(after) => Next::At(after.min(rests_at.max(now))),
                None => resting(drawn.share()),
            },
            Some(drawn) if !drawn.detail.sharp && rests_at <= now => resting(drawn.share()),
            Some(drawn) if !drawn.detail.sharp => Next::At(rests_at),
            Some(_) => Next::Nothing,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::Mode;
    use irradia_scene::{Camera, Intrinsics, Pose};
    use std::sync::Arc;

    fn shot(id: u64) -> Shot {
        let pose = Pose {
            rotation: glam::Quat::IDENTITY,
            position: glam::Vec3::ZERO,
        };
        Shot {
            id,
            camera: Camera::new(pose, Intrinsics::from_fov_x(100, 100, 1.0)),
            mode: Mode::Color,
            background: None,
            clip: None,
            view: None,
            highlight: false,
            light: None,
        }
    }

    const AT_REST: SceneStatus = SceneStatus {
        version: 1,
        training: false,
    };

    fn next(scheduler: &Scheduler) -> (u64, Shot, Detail) {
        match scheduler.next(|| AT_REST) {
            Some((client, Task::Picture { shot, detail })) => (client, shot, detail),
            _ => panic!("a picture"),
        }
    }

    /// Ends a wait that would last for ever.
    fn close_after(scheduler: &Arc<Scheduler>, time: Duration) {
        let scheduler = scheduler.clone();
        std::thread::spawn(move || {
            std::thread::sleep(time);
            scheduler.close();
        });
    }

    fn deliver(scheduler: &Scheduler, client: u64, shot: &Shot, detail: Detail) {
        let picture = DrawnPicture {
            id: shot.id,
            version: 1,
            detail,
            pixels: 1e4,
            seconds: 0.001,
            bytes: vec![],
        };
        scheduler.deliver(client, picture);
    }

    #[test]
    fn a_change_while_the_state_is_read_is_not_missed() {
        let scheduler = Arc::new(Scheduler::default());
        let (outbox, _inbox) = mpsc::channel(8);
        let client = scheduler.connect(outbox).expect("free");
        scheduler.request_picture(client, Some(shot(1)));
        let reads = std::cell::Cell::new(0);
        let status = || {
            // The first version appears just after the state was read without it.
            reads.set(reads.get() + 1);
            if reads.get() == 1 {
                scheduler.wake();
                return SceneStatus { version: 0, ..AT_REST };
            }
            AT_REST
        };
        close_after(&scheduler, Duration::from_secs(10));
        assert!(matches!(scheduler.next(status), Some((_, Task::Picture { .. }))));
    }

    #[test]
    fn measurements_wait_for_a_slow_page_and_go_on() {
        const VIEWS: usize = 20;
        let scheduler = Arc::new(Scheduler::default());
        let (outbox, mut inbox) = mpsc::channel(4);
        let client = scheduler.connect(outbox).expect("free");
        scheduler.request_scores(client, VIEWS);
        let page = std::thread::spawn(move || {
            for _ in 0..VIEWS {
                std::thread::sleep(Duration::from_millis(2));
                let _ = inbox.blocking_recv();
            }
        });
        close_after(&scheduler, Duration::from_secs(10));
        for expected in 0..VIEWS {
            let Some((_, Task::Score { view })) = scheduler.next(|| AT_REST) else {
                panic!("view {expected} is never measured");
            };
            assert_eq!(view, expected);
            scheduler.send_text(client, "score".to_owned());
        }
        page.join().expect("all are told");
    }

    #[test]
    fn the_newest_wish_wins_and_becomes_sharp_at_rest() {
        let scheduler = Scheduler::default();
        let (outbox, mut inbox) = mpsc::channel(8);
        let client = scheduler.connect(outbox).expect("free");
        scheduler.request_picture(client, Some(shot(1)));
        scheduler.request_picture(client, Some(shot(2)));
        let (_, drawn, detail) = next(&scheduler);
        assert!(drawn.id == 2 && detail.moving && !detail.sharp);
        scheduler.request_picture(client, Some(shot(3)));
        assert!(!scheduler.is_current(client, &drawn));
        deliver(&scheduler, client, &drawn, detail);
        let (_, drawn, ..) = next(&scheduler);
        assert_eq!(drawn.id, 3);
        deliver(&scheduler, client, &drawn, detail);
        scheduler.acknowledge(client, 2);
        // Without a newer request, the next picture, after a moment, is the sharp one of the same request.
        let (_, drawn, resting) = next(&scheduler);
        assert!(drawn.id == 3 && !resting.moving && resting.sharp);
        assert!(inbox.try_recv().is_ok() && inbox.try_recv().is_ok() && inbox.try_recv().is_err());
    }

    #[test]
    fn a_page_that_shows_nothing_gets_no_more_and_hurts_no_other() {
        let scheduler = Scheduler::default();
        let (slow, _slow) = mpsc::channel(8);
        let (fast, _fast) = mpsc::channel(8);
        let [slow, fast] = [slow, fast].map(|outbox| scheduler.connect(outbox).expect("free"));
        for id in 1..=6 {
            scheduler.request_picture(slow, Some(shot(id)));
            scheduler.request_picture(fast, Some(shot(id)));
            let (first, drawn, detail) = next(&scheduler);
            deliver(&scheduler, first, &drawn, detail);
            if id <= MAX_IN_FLIGHT as u64 {
                let (second, drawn, detail) = next(&scheduler);
                assert_ne!(first, second, "in turn");
                deliver(&scheduler, second, &drawn, detail);
            } else {
                assert_eq!(first, fast);
            }
            scheduler.acknowledge(fast, id);
        }
    }

    #[test]
    fn clients_are_bounded_and_closing_ends_the_wait() {
        let scheduler = Arc::new(Scheduler::default());
        let (outbox, _inbox) = mpsc::channel(8);
        let clients: Vec<u64> = std::iter::from_fn(|| scheduler.connect(outbox.clone())).collect();
        assert_eq!(clients.len(), MAX_CLIENTS);
        scheduler.disconnect(clients[0]);
        assert!(scheduler.connect(outbox).is_some());
        let waiting = std::thread::spawn({
            let scheduler = scheduler.clone();
            move || scheduler.next(|| AT_REST).is_none()
        });
        scheduler.close();
        assert!(waiting.join().expect("no panic"));
    }
}
