//! Training photographs in memory, as 8 bits, within a budget, loaded ahead of their steps: scenes larger than memory can be trained.

mod loader;

use irradia_scene::{Dataset, LoadError, Photo};
pub(crate) use loader::caught;
use loader::{Job, Loaded, Loader};
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

/// Number of photographs loaded ahead per loading thread if not all fit into the budget: enough to bridge a few slow ones.
const PREFETCH_PER_THREAD: usize = 8;
/// Fraction of the budget, as a divisor, that photographs being decoded may use.
const DECODING_DIVISOR: usize = 4;

/// A photograph ready for the loss.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[H, W, 3]`, over the background.
    pub rgb: Vec<u8>,
    /// `[H, W]`, where the photograph has an alpha channel.
    pub alpha: Option<Vec<u8>>,
    /// `[H, W]`, 0 for pixels excluded from training.
    pub mask: Option<Vec<u8>>,
    /// The background of `rgb`.
    pub background: [f32; 3],
}

impl Prepared {
    /// `photo` at `width` x `height` over `background`.
    pub fn new(photo: &Photo, width: u32, height: u32, background: [f32; 3]) -> Self {
        let photo = photo.resized(width, height);
        Self {
            width,
            height,
            rgb: photo.over(background),
            alpha: photo.alpha(),
            mask: photo.mask,
            background,
        }
    }

    /// `rgb` over another `background`.
    pub fn recolor(&self, alpha: &[u8], background: [f32; 3], to: &mut Vec<u8>) {
        let change: [f32; 3] = std::array::from_fn(|c| background[c] - self.background[c]);
        to.clear();
        to.extend(self.rgb.iter().enumerate().map(|(i, value)| {
            let through = f32::from(255 - alpha[i / 3]);
            (f32::from(*value) + through * change[i % 3]).round() as u8
        }));
    }

    fn bytes(&self) -> usize {
        self.rgb.len() + self.alpha.as_ref().map_or(0, Vec::len) + self.mask.as_ref().map_or(0, Vec::len)
    }
}

/// The parts of a photograph that are in memory.
#[derive(Default)]
struct CachedPhoto {
    /// At the current scale.
    prepared: Option<Arc<Prepared>>,
    /// At full size, from which other scales are made.
    full: Option<Arc<Photo>>,
}

impl CachedPhoto {
    fn bytes(&self) -> usize {
        self.prepared.as_ref().map_or(0, |photo| photo.bytes()) + self.full.as_ref().map_or(0, |photo| photo.bytes())
    }
}

/// Photographs that are loaded ahead of their use and evicted when they would exceed the budget.
///
/// The pixels of a photograph at a scale depend on nothing else: neither on the budget nor on the number of threads.
pub struct PhotoCache {
    dataset: Arc<Dataset>,
    budget: usize,
    cached: HashMap<usize, CachedPhoto>,
    bytes: usize,
    /// Size relative to the data's.
    scale: f32,
    /// Whether all training photographs fit.
    fits: bool,
    /// Whether all of them were loaded once.
    all_loaded: bool,
    /// Whether they also fit at full size, in addition to those at `scale`.
    keeps_full: bool,
    threads: usize,
    /// Photographs loaded ahead if not all fit: at most half of those that do, so that the others may stay until they are needed.
    ahead: usize,
    loader: Loader,
    /// Seconds spent waiting for photographs since the last [`Self::take_seconds`].
    seconds: f64,
}

impl PhotoCache {
    /// Uses at most `budget` bytes, including photographs being decoded, but always holds the current photograph.
    pub fn new(dataset: Arc<Dataset>, background: [f32; 3], budget: usize) -> Self {
        let working = dataset
            .views
            .iter()
            .map(|view| view.photo.working_bytes())
            .max()
            .unwrap_or(0);
        let max_threads = budget / DECODING_DIVISOR / working.max(1);
        let threads = rayon::current_num_threads().min(max_threads).max(1);
        let mut cache = Self {
            loader: Loader::new(dataset.clone(), background, threads),
            dataset,
            budget: budget.saturating_sub(threads * working),
            cached: HashMap::new(),
            bytes: 0,
            scale: 1.0,
            fits: false,
            all_loaded: false,
            keeps_full: false,
            threads,
            ahead: 1,
            seconds: 0.0,
        };
        cache.use_scale(1.0);
        cache
    }

    /// Wall-clock seconds of waiting for photographs since the last call.
    pub fn take_seconds(&mut self) -> f64 {
        std::mem::take(&mut self.seconds)
    }

    /// The photograph of view `upcoming[0]` at `scale`; waits until it is loaded. The next ones are loaded meanwhile, as far as there is
    /// room; to make room, those needed last, or not at all, are evicted. If all fit, none is loaded twice, and the first call waits for
    /// all, so that a damaged file ends a run before its first step.
    ///
    /// # Errors
    /// When a photograph, this one or one loaded ahead, cannot be read.
    pub fn get(&mut self, upcoming: &[usize], scale: f32) -> Result<Arc<Prepared>, LoadError> {
        if scale != self.scale {
            self.use_scale(scale);
        }
        self.store_loaded(false)?;
        self.load_ahead(upcoming);
        let started = Instant::now();
        let mut all = self.fits && !self.all_loaded && upcoming.len() == self.dataset.train.len();
        loop {
            let needed = if all { upcoming } else { &upcoming[..1] };
            if needed.iter().all(|view| self.is_cached(view)) {
                self.seconds += started.elapsed().as_secs_f64();
                self.all_loaded |= all;
                return Ok(self.cached[&upcoming[0]].prepared.clone().expect("it is there"));
            }
            if all && self.loader.is_idle() {
                // Masks in addition to alpha take more than was assumed: not all fit.
                all = false;
                continue;
            }
            self.store_loaded(true)?;
            self.load_ahead(upcoming);
        }
    }

    /// Changes the scale of photographs to `scale`. Pixels at full size stay in memory, if they are there.
    fn use_scale(&mut self, scale: f32) {
        self.scale = scale;
        let total = |scale: f32| -> usize { self.dataset.train.iter().map(|view| self.size(*view, scale)).sum() };
        let (full, scaled) = (total(1.0), total(scale));
        let fitting = self.budget * self.dataset.train.len() / scaled.max(1);
        self.ahead = (PREFETCH_PER_THREAD * self.threads).min(fitting / 2).max(1);
        self.fits = scaled <= self.budget;
        self.keeps_full = scale < 1.0 && full + scaled <= self.budget;
        self.cached.retain(|_, cached| {
            cached.prepared = None;
            cached.full.is_some()
        });
        self.bytes = self.cached.values().map(CachedPhoto::bytes).sum();
    }

    /// Maximum number of bytes of a view's photograph at `scale`.
    fn size(&self, view: usize, scale: f32) -> usize {
        let k = self.dataset.views[view].camera.intrinsics.scaled(scale);
        4 * k.width as usize * k.height as usize
    }

    /// Whether view `view` is in memory at the current scale.
    fn is_cached(&self, view: &usize) -> bool {
        self.cached.get(view).is_some_and(|cached| cached.prepared.is_some())
    }

    /// Bytes to reserve for loading view `view`, beyond what is in memory already.
    fn reserved(&self, view: usize) -> usize {
        let full = if self.keeps_full { self.size(view, 1.0) } else { 0 };
        let cached = self.cached.get(&view).map_or(0, CachedPhoto::bytes);
        (self.size(view, self.scale) + full).saturating_sub(cached)
    }

    /// Stores the photographs that were loaded; waits for at least one if `wait`.
    fn store_loaded(&mut self, wait: bool) -> Result<(), LoadError> {
        for Loaded { view, scale, result } in self.loader.take(wait) {
            let (prepared, full) = result?;
            let cached = self.cached.entry(view).or_default();
            self.bytes -= cached.bytes();
            // A photograph loaded for an earlier scale may still be of use at full size.
            cached.full = full.filter(|_| self.keeps_full);
            if scale == self.scale {
                cached.prepared = Some(prepared);
            }
            self.bytes += cached.bytes();
        }
        Ok(())
    }

    /// Queues the next photographs that are not in memory, and evicts others to make room.
    fn load_ahead(&mut self, upcoming: &[usize]) {
        let horizon = if self.fits {
            upcoming.len()
        } else {
            self.ahead.min(upcoming.len())
        };
        if upcoming[..horizon].iter().all(|view| self.is_cached(view)) {
            return;
        }
        let in_flight = self.loader.in_flight();
        let mut planned: usize = in_flight.iter().map(|view| self.reserved(*view)).sum();
        let mut jobs = Vec::new();
        let eviction = EvictionOrder::new(upcoming, self.dataset.views.len());
        for (position, view) in upcoming[..horizon].iter().enumerate() {
            if self.is_cached(view) || in_flight.contains(view) && position > 0 {
                continue;
            }
            let bytes = self.reserved(*view);
            while self.bytes + planned + bytes > self.budget {
                let Some(evicted) = eviction.last_needed(&self.cached, position) else {
                    break;
                };
                self.bytes -= self.cached.remove(&evicted).map_or(0, |cached| cached.bytes());
            }
            if position > 0 && self.bytes + planned + bytes > self.budget {
                break;
            }
            planned += bytes;
            let k = self.dataset.views[*view].camera.intrinsics.scaled(self.scale);
            let from_full = self.dataset.views[*view].photo.is_shrunk_from_full(k.width, k.height);
            jobs.push(Job {
                view: *view,
                scale: self.scale,
                full: self
                    .cached
                    .get(view)
                    .and_then(|cached| cached.full.clone())
                    .filter(|_| from_full),
                keep_full: self.keeps_full && from_full,
            });
        }
        self.loader.queue(jobs);
    }
}

/// Finds the photographs in memory that are needed last.
struct EvictionOrder {
    /// By view: its position among the upcoming ones.
    positions: Vec<usize>,
}

impl EvictionOrder {
    fn new(upcoming: &[usize], views: usize) -> Self {
        let mut positions = vec![usize::MAX; views];
        for (position, view) in upcoming.iter().enumerate().rev() {
            positions[*view] = position;
        }
        Self { positions }
    }

    /// The view of `cached` that is needed last, after `position`.
    fn last_needed(&self, cached: &HashMap<usize, CachedPhoto>, position: usize) -> Option<usize> {
        let later = cached.keys().filter(|view| self.positions[**view] > position);
        later.max_by_key(|view| (self.positions[**view], **view)).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::{Camera, Intrinsics, PhotoSource, Pose, View};
    use std::sync::atomic::{AtomicUsize, Ordering};

    struct Counting(AtomicUsize, u8);
    impl PhotoSource for Counting {
        fn load(&self) -> Result<Photo, LoadError> {
            self.0.fetch_add(1, Ordering::Relaxed);
            Ok(Photo {
                width: 10,
                height: 10,
                channels: 3,
                data: vec![self.1; 300],
                mask: None,
            })
        }
    }

    fn dataset(n: u8) -> (Arc<Dataset>, Vec<Arc<Counting>>) {
        let sources: Vec<_> = (0..n).map(|i| Arc::new(Counting(AtomicUsize::new(0), i))).collect();
        let camera = Camera::new(
            Pose {
                rotation: glam::Quat::IDENTITY,
                position: glam::Vec3::ZERO,
            },
            Intrinsics::from_fov_x(10, 10, 1.0),
        );
        let views = sources
            .iter()
            .map(|s| View::new(format!("{}", s.1), camera, s.clone()))
            .collect();
        (
            Arc::new(Dataset {
                views,
                train: (0..usize::from(n)).collect(),
                ..Default::default()
            }),
            sources,
        )
    }

    fn loads(sources: &[Arc<Counting>]) -> usize {
        sources.iter().map(|s| s.0.load(Ordering::Relaxed)).sum()
    }

    #[test]
    fn a_new_background_shows_through_transparent_pixels() {
        let photo = Photo {
            width: 3,
            height: 1,
            channels: 4,
            data: vec![200, 100, 0, 255, 200, 100, 0, 0, 200, 100, 0, 51],
            mask: None,
        };
        let white = Prepared::new(&photo, 3, 1, [1.0; 3]);
        let mut blue = Vec::new();
        white.recolor(white.alpha.as_ref().unwrap(), [0.0, 0.0, 1.0], &mut blue);
        assert_eq!(blue, [200, 100, 0, 0, 0, 255, 40, 20, 204]);
    }

    #[test]
    fn with_room_each_photograph_is_loaded_once() {
        let (data, sources) = dataset(20);
        let mut cache = PhotoCache::new(data, [0.0; 3], 1 << 20);
        for epoch in 0..3 {
            for i in 0..20 {
                let upcoming: Vec<usize> = (0..20).map(|k| (i + k + epoch) % 20).collect();
                assert_eq!(cache.get(&upcoming, 1.0).unwrap().rgb[0] as usize, upcoming[0]);
            }
        }
        assert_eq!(loads(&sources), 20);
        assert_eq!(cache.get(&[3], 0.5).unwrap().rgb.len(), 75);
    }

    #[test]
    fn without_room_the_budget_is_respected() {
        let (data, sources) = dataset(20);
        let mut cache = PhotoCache::new(data, [0.0; 3], 2000);
        for i in 0..40 {
            let upcoming: Vec<usize> = (0..20).map(|k| (i + k) % 20).collect();
            assert_eq!(cache.get(&upcoming, 1.0).unwrap().rgb[0] as usize, upcoming[0]);
            assert!(cache.bytes <= 2000 && cache.bytes == cache.cached.values().map(CachedPhoto::bytes).sum::<usize>());
        }
        // A fifth of the photographs fits, and stays.
        assert!((20..40).contains(&loads(&sources)), "{}", loads(&sources));
        let mut tiny = PhotoCache::new(dataset(3).0, [0.0; 3], 1);
        assert!(tiny.get(&[0, 1, 2], 1.0).is_ok() && tiny.get(&[1, 2, 0], 1.0).is_ok());
    }

    #[test]
    fn a_change_of_scale_shrinks_what_is_in_memory() {
        let (data, sources) = dataset(20);
        let mut cache = PhotoCache::new(data, [0.0; 3], 1 << 20);
        let all: Vec<usize> = (0..20).collect();
        for scale in [0.25, 0.5, 1.0] {
            for view in 0..20 {
                let photo = cache.get(&all[view..], scale).unwrap();
                assert_eq!(photo.width, (10.0 * scale).round() as u32);
                assert_eq!(photo.rgb[0] as usize, view);
            }
        }
        assert_eq!(loads(&sources), 20);
        assert!(
            cache.cached.values().all(|cached| cached.full.is_none()),
            "at full size one copy suffices"
        );
    }

    #[test]
    fn photographs_do_not_depend_on_the_budget() {
        let pixels = |budget: usize| -> Vec<Vec<u8>> {
            let mut cache = PhotoCache::new(dataset(20).0, [0.0; 3], budget);
            let order = |i: usize| -> Vec<usize> { (0..20).map(|k| (i * 7 + k) % 20).collect() };
            let scale = |i: usize| [0.3, 1.0, 0.5][i / 30 % 3];
            (0..90)
                .map(|i| cache.get(&order(i), scale(i)).unwrap().rgb.clone())
                .collect()
        };
        assert_eq!(pixels(1 << 20), pixels(1));
        assert_eq!(pixels(1 << 20), pixels(3000));
    }

    struct Broken(bool);
    impl PhotoSource for Broken {
        fn load(&self) -> Result<Photo, LoadError> {
            assert!(!self.0, "a decoder's bug");
            Err(LoadError("gone.png: not found".into()))
        }
    }

    #[test]
    fn errors_and_panics_of_a_source_arrive() {
        for panics in [false, true] {
            let (data, _) = dataset(3);
            let mut data = Arc::try_unwrap(data).unwrap_or_else(|_| panic!("not shared"));
            data.views[1].photo = Arc::new(Broken(panics));
            let mut cache = PhotoCache::new(Arc::new(data), [0.0; 3], 1 << 20);
            let error = (0..3)
                .find_map(|view| cache.get(&[view], 1.0).err())
                .expect("an error")
                .to_string();
            assert!(
                error.contains(if panics { "1: the image decoder" } else { "gone.png" }),
                "{error}"
            );
        }
    }
}
