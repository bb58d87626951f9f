//! Training photographs in memory, as 8 bits, within a budget: scenes larger than memory can be trained.

use irradia_scene::{Dataset, LoadError, Photo};
use rayon::prelude::*;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

/// A photograph ready for the loss.
#[derive(Debug)]
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

/// Photographs that are loaded on demand and evicted when they would exceed the budget.
pub struct PhotoCache {
    dataset: Arc<Dataset>,
    background: [f32; 3],
    budget: usize,
    held: HashMap<usize, Arc<Prepared>>,
    bytes: usize,
    /// Size relative to the data's; a change evicts everything.
    scale: f32,
    /// Seconds spent on loading since the last [`Self::take_seconds`].
    seconds: f64,
}

impl PhotoCache {
    /// Holds at most `budget` bytes, but always at least the current photograph.
    pub fn new(dataset: Arc<Dataset>, background: [f32; 3], budget: usize) -> Self {
        Self {
            dataset,
            background,
            budget,
            held: HashMap::new(),
            bytes: 0,
            scale: 1.0,
            seconds: 0.0,
        }
    }

    /// Wall-clock seconds of loading since the last call.
    pub fn take_seconds(&mut self) -> f64 {
        std::mem::take(&mut self.seconds)
    }

    /// The photograph of view `upcoming[0]` at `scale`. If it must be loaded, the next ones are loaded with it, in parallel, as
    /// far as there is room; those needed last, or not at all, are evicted.
    ///
    /// # Errors
    /// When a photograph cannot be read.
    pub fn get(&mut self, upcoming: &[usize], scale: f32) -> Result<Arc<Prepared>, LoadError> {
        if scale != self.scale {
            self.held.clear();
            self.bytes = 0;
            self.scale = scale;
        }
        let view = upcoming[0];
        if let Some(photo) = self.held.get(&view) {
            return Ok(photo.clone());
        }
        let started = Instant::now();
        let wanted = self.plan_loads(upcoming);
        let (dataset, background) = (&self.dataset, self.background);
        let loaded: Vec<(usize, Result<Prepared, LoadError>)> = wanted
            .into_par_iter()
            .map(|view| (view, load(dataset, view, scale, background)))
            .collect();
        for (view, photo) in loaded {
            let photo = Arc::new(photo?);
            self.bytes += photo.bytes();
            self.held.insert(view, photo);
        }
        self.seconds += started.elapsed().as_secs_f64();
        Ok(self.held[&view].clone())
    }

    /// The largest scale, at most 1, at which all of `views` fit into the budget together.
    pub fn scale_that_fits(&self, views: &[usize]) -> f32 {
        let total = |scale: f32| -> usize { views.iter().map(|view| self.size(*view, scale)).sum() };
        let mut scale = 1.0;
        // Sides are rounded, so that a second or third iteration may be needed; at one pixel each, this ends.
        while total(scale) > self.budget && scale > 1e-3 {
            scale *= 0.98 * (self.budget as f32 / total(scale) as f32).sqrt();
        }
        scale
    }

    /// Maximum number of bytes of a view's photograph at `scale`.
    fn size(&self, view: usize, scale: f32) -> usize {
        let k = self.dataset.views[view].camera.intrinsics.scaled(scale);
        4 * k.width as usize * k.height as usize
    }

    /// Selects the views to load now: as many of the upcoming ones as fit beside those needed sooner. Evicts others to make room.
    fn plan_loads(&mut self, upcoming: &[usize]) -> Vec<usize> {
        let mut planned = 0;
        let keep: Vec<usize> = upcoming
            .iter()
            .copied()
            .take_while(|view| {
                planned += self.size(*view, self.scale);
                planned <= self.budget || *view == upcoming[0]
            })
            .collect();
        let all_fit = keep.len() == upcoming.len();
        if !all_fit || self.bytes + planned > self.budget {
            let bytes = &mut self.bytes;
            self.held.retain(|view, photo| {
                let stays = keep.contains(view);
                if !stays {
                    *bytes -= photo.bytes();
                }
                stays
            });
        }
        // If not everything fits, a batch of a few per thread keeps the threads busy without a long wait.
        let batch = if all_fit {
            keep.len()
        } else {
            4 * rayon::current_num_threads()
        };
        keep.into_iter()
            .filter(|view| !self.held.contains_key(view))
            .take(batch)
            .collect()
    }
}

fn load(dataset: &Dataset, view: usize, scale: f32, background: [f32; 3]) -> Result<Prepared, LoadError> {
    let view = &dataset.views[view];
    let photo = view.photo.load()?;
    let k = &view.camera.intrinsics;
    if (photo.width, photo.height) != (k.width, k.height) {
        return Err(LoadError(format!(
            "{}: the photograph has {}x{} pixels where its camera has {}x{}: was the file replaced while training?",
            view.name, photo.width, photo.height, k.width, k.height
        )));
    }
    let k = k.scaled(scale);
    Ok(Prepared::new(&photo, k.width, k.height, background))
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
            .map(|s| View {
                name: format!("{}", s.1),
                camera,
                photo: s.clone(),
                depth_bounds: None,
                time: None,
                points_seen: vec![],
            })
            .collect();
        (
            Arc::new(Dataset {
                views,
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
            assert!(cache.bytes <= 2000 && cache.bytes == cache.held.values().map(|p| p.bytes()).sum::<usize>());
        }
        assert!(loads(&sources) >= 35);
        let all: Vec<usize> = (0..20).collect();
        let scale = cache.scale_that_fits(&all);
        assert!(scale < 0.5 && all.iter().map(|view| cache.size(*view, scale)).sum::<usize>() <= 2000);
        assert_eq!(cache.scale_that_fits(&[0, 1]), 1.0);
        let mut tiny = PhotoCache::new(dataset(3).0, [0.0; 3], 1);
        assert!(tiny.get(&[0, 1, 2], 1.0).is_ok() && tiny.get(&[1, 2, 0], 1.0).is_ok());
    }
}
