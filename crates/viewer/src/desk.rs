//! The pictures that pages request. A page takes a seat, requests a picture, and gets it when it is drawn; a newer request replaces
//! an older one. At most [`IN_FLIGHT`] pictures are on the way to a page that has not shown them, so that a slow page gets fewer
//! pictures and does not slow down others.

use crate::message::{RawShot, Shot};
use crate::pace::{Detail, Pace};
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

/// Maximum number of pages.
pub(crate) const SEATS: usize = 8;
/// Maximum number of pictures on the way to a page.
const IN_FLIGHT: usize = 2;
/// A camera without a new position for this long is at rest.
const REST: Duration = Duration::from_millis(100);
/// Maximum number of waiting requests other than pictures.
const JOBS: usize = 4;
/// Time until an outbox that is nearly full is checked again: nothing signals that a page has taken a message.
const DRAINS: Duration = Duration::from_millis(20);
/// Time between two copies of a training's scene, as a multiple of the time that a copy and its picture take.
const AT_REST: u32 = 40;
/// Minimum time between two copies of a training's scene.
const COPIES: Duration = Duration::from_millis(1000);

/// A message to a page.
pub(crate) enum Out {
    Text(String),
    Binary(Vec<u8>),
}

/// Work to do for a page.
pub(crate) enum Task {
    Picture { shot: Shot, detail: Detail },
    Pick { x: f32, y: f32, tag: String, shot: RawShot },
    Score { view: usize },
}

struct Drawn {
    id: u64,
    version: u64,
    detail: Detail,
}

impl Drawn {
    /// The share of the pixels that was drawn, if all splats were.
    fn share(&self) -> Option<f32> {
        (self.detail.splats == 1.0).then_some(self.detail.pixels)
    }
}

struct Seat {
    shot: Option<Shot>,
    shot_at: Instant,
    drawn: Option<Drawn>,
    in_flight: VecDeque<u64>,
    pace: Pace,
    jobs: VecDeque<Task>,
    /// The view to measure next, and the number of views.
    scores: Option<(usize, usize)>,
    outbox: mpsc::Sender<Out>,
}

#[derive(Default)]
struct State {
    seats: BTreeMap<u64, Seat>,
    /// Number of seats taken so far, those left again included.
    taken: u64,
    /// The seat served last.
    served: u64,
    closing: bool,
    /// Number of calls of [`Desk::wake`] so far.
    wakes: u64,
    /// Nothing is drawn before this time, so that a training gets the processor.
    rest_until: Option<Instant>,
    /// No picture is renewed for a newer scene before this time.
    renew_after: Option<Instant>,
}

#[derive(Default)]
pub(crate) struct Desk {
    state: Mutex<State>,
    changed: Condvar,
}

/// Version of the scene, and whether a training competes for the processor.
#[derive(Clone, Copy)]
pub(crate) struct Now {
    pub version: u64,
    pub training: bool,
}

impl Desk {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a seat, if one is free.
    pub fn sit(&self, outbox: mpsc::Sender<Out>) -> Option<u64> {
        let mut state = self.lock();
        if state.seats.len() >= SEATS || state.closing {
            return None;
        }
        state.taken += 1;
        let id = state.taken;
        state.seats.insert(
            id,
            Seat {
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

    pub fn leave(&self, seat: u64) {
        self.lock().seats.remove(&seat);
        self.changed.notify_all();
    }

    /// Number of seats taken now.
    pub fn len(&self) -> usize {
        self.lock().seats.len()
    }

    fn with_seat(&self, seat: u64, change: impl FnOnce(&mut Seat)) {
        if let Some(seat) = self.lock().seats.get_mut(&seat) {
            change(seat);
        }
        self.changed.notify_all();
    }

    /// The page wants this picture, or none.
    pub fn want(&self, seat: u64, shot: Option<Shot>) {
        self.with_seat(seat, |seat| {
            // Every request counts as a motion of the camera: it is at rest [`REST`] after the last one.
            (seat.shot, seat.shot_at) = (shot, Instant::now());
        });
    }

    /// The page shows the picture `id`.
    pub fn shown(&self, seat: u64, id: u64) {
        self.with_seat(seat, |seat| {
            if let Some(at) = seat.in_flight.iter().position(|sent| *sent == id) {
                seat.in_flight.drain(..=at);
            }
        });
    }

    /// Adds a request other than a picture; the oldest is dropped if too many wait.
    pub fn ask(&self, seat: u64, task: Task) {
        self.with_seat(seat, |seat| {
            if seat.jobs.len() >= JOBS {
                seat.jobs.pop_front();
            }
            seat.jobs.push_back(task);
        });
    }

    /// Measures `views` views for the page.
    pub fn score(&self, seat: u64, views: usize) {
        self.with_seat(seat, |seat| seat.scores = (views > 0).then_some((0, views)));
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

    /// Whether the picture of `shot` is still wanted by `seat`.
    pub fn is_wanted(&self, seat: u64, shot: &Shot) -> bool {
        let state = self.lock();
        let newest = state.seats.get(&seat).and_then(|seat| seat.shot.as_ref());
        !state.closing && newest.is_some_and(|newest| newest.id == shot.id)
    }

    /// Waits for the next task, seats in turn; `None` when closing. `now` is called again at every wake-up.
    pub fn next(&self, now: impl Fn() -> Now) -> Option<(u64, Task)> {
        let mut state = self.lock();
        loop {
            if state.closing {
                return None;
            }
            // Not under the lock of the desk: `now` takes other locks.
            let wakes = state.wakes;
            drop(state);
            let at = now();
            state = self.lock();
            if state.wakes != wakes {
                continue;
            }
            let clock = Instant::now();
            let mut wake_at: Option<Instant> = None;
            let mut sooner = |at: Instant| wake_at = Some(wake_at.map_or(at, |other| other.min(at)));
            match state.rest_until.filter(|until| at.training && *until > clock) {
                Some(until) => sooner(until),
                None => {
                    let after: Vec<u64> = state.seats.range(state.served + 1..).map(|(id, _)| *id).collect();
                    let before: Vec<u64> = state.seats.range(..=state.served).map(|(id, _)| *id).collect();
                    for id in after.into_iter().chain(before) {
                        let renew_after = state.renew_after.filter(|_| at.training);
                        let seat = state.seats.get_mut(&id).expect("listed");
                        match seat.next(at, renew_after, clock) {
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

    /// Delivers a picture drawn in `seconds`.
    pub fn deliver(
        &self,
        seat: u64,
        shot: &Shot,
        detail: Detail,
        bytes: Vec<u8>,
        pixels: f32,
        seconds: f32,
        version: u64,
    ) {
        self.with_seat(seat, |seat| {
            seat.pace.learn(&detail, pixels, seconds);
            seat.drawn = Some(Drawn {
                id: shot.id,
                version,
                detail,
            });
            // The outbox has room for more than the pictures in flight: a full one belongs to a page that is being closed.
            if seat.outbox.try_send(Out::Binary(bytes)).is_ok() {
                seat.in_flight.push_back(shot.id);
            }
        });
    }

    /// Tells a page something.
    pub fn tell(&self, seat: u64, text: String) {
        self.with_seat(seat, |seat| drop(seat.outbox.try_send(Out::Text(text))));
    }

    /// Leaves time to a training after drawing for a moving camera took `seconds`; the browser needs about as much again.
    pub fn rest(&self, seconds: f32) {
        self.lock().rest_until = Some(Instant::now() + Duration::from_secs_f32(4.5 * seconds));
    }

    /// When the next copy of a training's scene is due, after a picture of the current one that took `seconds` and a copy that took
    /// `copying`; `None` while no page is open.
    pub fn renewal(&self, seconds: f32, copying: f32) -> Option<Instant> {
        let mut state = self.lock();
        if state.seats.is_empty() {
            return None;
        }
        let pause = Duration::from_secs_f32(seconds + copying) * AT_REST;
        let due = Instant::now() + pause.max(COPIES);
        state.renew_after = Some(due);
        Some(due)
    }
}

enum Next {
    Now(Box<Task>),
    At(Instant),
    Nothing,
}

impl Seat {
    fn next(&mut self, now: Now, renew_after: Option<Instant>, clock: Instant) -> Next {
        if let Some(job) = self.jobs.pop_front() {
            return Next::Now(Box::new(job));
        }
        let picture = self.picture(now, renew_after, clock);
        if matches!(picture, Next::Now(_)) {
            return picture;
        }
        let Some((view, count)) = self.scores else {
            return picture;
        };
        // Views are measured only while the camera is at rest, and only while the outbox has room for pictures besides.
        let rests_at = self.shot_at + REST;
        let free_at = if self.outbox.capacity() > 2 {
            clock
        } else {
            clock + DRAINS
        };
        let measured_at = rests_at.max(free_at);
        if measured_at <= clock {
            self.scores = (view + 1 < count).then_some((view + 1, count));
            return Next::Now(Box::new(Task::Score { view }));
        }
        match picture {
            Next::At(at) => Next::At(at.min(measured_at)),
            _ => Next::At(measured_at),
        }
    }

    fn picture(&self, now: Now, renew_after: Option<Instant>, clock: Instant) -> Next {
        let Some(shot) = self
            .shot
            .filter(|_| now.version > 0 && self.in_flight.len() < IN_FLIGHT)
        else {
            return Next::Nothing;
        };
        let same = self.drawn.as_ref().filter(|drawn| drawn.id == shot.id);
        let picture = |detail| Next::Now(Box::new(Task::Picture { shot, detail }));
        let resting = |last| picture(self.pace.resting(&shot, last));
        let rests_at = self.shot_at + REST;
        match same {
            None => picture(self.pace.moving(&shot, now.training)),
            Some(drawn) if drawn.version != now.version => match renew_after.filter(|after| *after > clock) {
                // The camera has just stopped: its picture becomes sharp first.
                _ if !drawn.detail.sharp && rests_at <= clock => resting(None),
                Some(after) => Next::At(after.min(rests_at.max(clock))),
                None => resting(drawn.share()),
            },
            Some(drawn) if !drawn.detail.sharp && rests_at <= clock => resting(drawn.share()),
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

    const STILL: Now = Now {
        version: 1,
        training: false,
    };

    fn next(desk: &Desk) -> (u64, Shot, Detail) {
        match desk.next(|| STILL) {
            Some((seat, Task::Picture { shot, detail })) => (seat, shot, detail),
            _ => panic!("a picture"),
        }
    }

    /// Ends a wait that would last for ever.
    fn close_after(desk: &Arc<Desk>, time: Duration) {
        let desk = desk.clone();
        std::thread::spawn(move || {
            std::thread::sleep(time);
            desk.close();
        });
    }

    fn deliver(desk: &Desk, seat: u64, shot: &Shot, detail: Detail) {
        desk.deliver(seat, shot, detail, vec![], 1e4, 0.001, 1);
    }

    #[test]
    fn a_change_while_the_state_is_read_is_not_missed() {
        let desk = Arc::new(Desk::default());
        let (outbox, _inbox) = mpsc::channel(8);
        let seat = desk.sit(outbox).expect("free");
        desk.want(seat, Some(shot(1)));
        let reads = std::cell::Cell::new(0);
        let now = || {
            // The first version appears just after the state was read without it.
            reads.set(reads.get() + 1);
            if reads.get() == 1 {
                desk.wake();
                return Now { version: 0, ..STILL };
            }
            STILL
        };
        close_after(&desk, Duration::from_secs(10));
        assert!(matches!(desk.next(now), Some((_, Task::Picture { .. }))));
    }

    #[test]
    fn measurements_wait_for_a_slow_page_and_go_on() {
        const VIEWS: usize = 20;
        let desk = Arc::new(Desk::default());
        let (outbox, mut inbox) = mpsc::channel(4);
        let seat = desk.sit(outbox).expect("free");
        desk.score(seat, VIEWS);
        let page = std::thread::spawn(move || {
            for _ in 0..VIEWS {
                std::thread::sleep(Duration::from_millis(2));
                let _ = inbox.blocking_recv();
            }
        });
        close_after(&desk, Duration::from_secs(10));
        for expected in 0..VIEWS {
            let Some((_, Task::Score { view })) = desk.next(|| STILL) else {
                panic!("view {expected} is never measured");
            };
            assert_eq!(view, expected);
            desk.tell(seat, "score".to_owned());
        }
        page.join().expect("all are told");
    }

    #[test]
    fn the_newest_wish_wins_and_becomes_sharp_at_rest() {
        let desk = Desk::default();
        let (outbox, mut inbox) = mpsc::channel(8);
        let seat = desk.sit(outbox).expect("free");
        desk.want(seat, Some(shot(1)));
        desk.want(seat, Some(shot(2)));
        let (_, drawn, detail) = next(&desk);
        assert!(drawn.id == 2 && detail.moving && !detail.sharp);
        desk.want(seat, Some(shot(3)));
        assert!(!desk.is_wanted(seat, &drawn));
        deliver(&desk, seat, &drawn, detail);
        let (_, drawn, ..) = next(&desk);
        assert_eq!(drawn.id, 3);
        deliver(&desk, seat, &drawn, detail);
        desk.shown(seat, 2);
        // Without a newer request, the next picture, after a moment, is the sharp one of the same request.
        let (_, drawn, resting) = next(&desk);
        assert!(drawn.id == 3 && !resting.moving && resting.sharp);
        assert!(inbox.try_recv().is_ok() && inbox.try_recv().is_ok() && inbox.try_recv().is_err());
    }

    #[test]
    fn a_page_that_shows_nothing_gets_no_more_and_hurts_no_other() {
        let desk = Desk::default();
        let (slow, _slow) = mpsc::channel(8);
        let (fast, _fast) = mpsc::channel(8);
        let [slow, fast] = [slow, fast].map(|outbox| desk.sit(outbox).expect("free"));
        for id in 1..=6 {
            desk.want(slow, Some(shot(id)));
            desk.want(fast, Some(shot(id)));
            let (first, drawn, detail) = next(&desk);
            deliver(&desk, first, &drawn, detail);
            if id <= IN_FLIGHT as u64 {
                let (second, drawn, detail) = next(&desk);
                assert_ne!(first, second, "in turn");
                deliver(&desk, second, &drawn, detail);
            } else {
                assert_eq!(first, fast);
            }
            desk.shown(fast, id);
        }
    }

    #[test]
    fn seats_are_bounded_and_closing_ends_the_wait() {
        let desk = Arc::new(Desk::default());
        let (outbox, _inbox) = mpsc::channel(8);
        let seats: Vec<u64> = std::iter::from_fn(|| desk.sit(outbox.clone())).collect();
        assert_eq!(seats.len(), SEATS);
        desk.leave(seats[0]);
        assert!(desk.sit(outbox).is_some());
        let waiting = std::thread::spawn({
            let desk = desk.clone();
            move || desk.next(|| STILL).is_none()
        });
        desk.close();
        assert!(waiting.join().expect("no panic"));
    }
}
