//! The memory of a training, estimated before its first step: it limits the number of splats and the photographs in memory.
//!
//! Constants are bytes per splat or pixel at the peak, from the sizes of the arrays, and checked against the peak memory of runs
//! (RESULTS.md, "How much memory does a training need?").

use crate::field_step::{BYTES_PER_PHOTO_PIXEL, MAX_PHOTO_BYTES, is_field};
use crate::recipe::Recipe;
use crate::trainer::TrainError;
use irradia_measure::LpipsNet;
use irradia_scene::Dataset;
use std::fmt;
use std::fs;

/// Parameters, gradients and two moments are 59 values each; with statistics, filter, activity and screen gradients.
const STATE_BYTES: usize = 4 * (4 * 59 + 5 + 1 + 1 + 4);
/// Footprint, depth key and orders of a frame.
const FOOTPRINT_BYTES: usize = 96;
/// An intersection of a splat and a tile: the hit with its tile, the hit in the list by tile, the tile's entry, its position, and the sums
/// of its gradients.
const INTERSECTION_BYTES: usize = 24 + 16 + 16 + 4 + 48;
/// Intersections per splat: most splats are out of view or within one or two tiles.
const INTERSECTIONS_PER_SPLAT: usize = 3;
/// A copy of parameters, moments and statistics, from which a checkpoint is written in the background.
const SNAPSHOT_BYTES: usize = 4 * (3 * 59 + 6);
/// A splat, in total.
const SPLAT_BYTES: usize =
    STATE_BYTES + FOOTPRINT_BYTES + INTERSECTIONS_PER_SPLAT * INTERSECTION_BYTES + SNAPSHOT_BYTES;
/// A pixel of the largest photograph: frame, gradients, the maps of SSIM, and the intersections of a few thousand splats per tile.
const PIXEL_BYTES: usize = 300;
/// The program with its threads.
const PROGRAM_BYTES: usize = 64 << 20;
/// A radiance field of a built-in recipe with its samples.
const FIELD_BYTES: usize = 512 << 20;
/// A point of the dataset.
const POINT_BYTES: usize = 15;
/// Fraction of the memory, as a divisor, that photographs get before splats, if they need it.
const PHOTO_DIVISOR: usize = 4;
/// Minimum number of photographs in memory: with fewer, training would wait for each.
const MIN_PHOTOS: usize = 8;
/// Fraction of the memory for photographs, as a divisor, that held-out ones may take if the free memory is unknown.
const HELD_OUT_DIVISOR: usize = 8;
/// Memory for photographs if the free memory is unknown: 5,500 of 360 x 360.
const DEFAULT_PHOTO_BYTES: usize = 2 << 30;

/// The distribution of the memory of a process, bytes.
#[derive(Clone, Debug, PartialEq)]
pub struct MemoryPlan {
    /// All memory of the process; `None` if it is unknown, so that only photographs are limited.
    pub limit: Option<usize>,
    /// For the program, the dataset's points, and a field.
    pub program: usize,
    /// For frames and losses.
    pub images: usize,
    /// For photographs, including those being decoded.
    pub photos: usize,
    /// What all photographs would take.
    pub all_photos: usize,
    /// For held-out photographs, which stay in memory between evaluations; 0 if there is not enough for all.
    pub held_out: usize,
    /// Maximum number of splats.
    pub splats: usize,
    /// The maximum without a limit on memory.
    pub wanted_splats: usize,
}

/// What a training needs.
pub(crate) struct Needs {
    /// The program, the dataset's points, and a field, bytes.
    pub program: usize,
    /// Frames and losses, bytes.
    pub images: usize,
    /// The photographs that are needed for a step, and those being decoded, bytes.
    pub few_photos: usize,
    /// All photographs, and those being decoded, bytes.
    pub all_photos: usize,
    /// Held-out photographs, bytes.
    pub held_out: usize,
    /// Number of first splats.
    pub first_splats: usize,
    /// The recipe's limit for this dataset.
    pub max_splats: usize,
}

impl Needs {
    pub fn of(dataset: &Dataset, recipe: &Recipe, lpips: Option<LpipsNet>) -> Self {
        let pixels = |view: &usize| {
            let k = &dataset.views[*view].camera.intrinsics;
            k.width as usize * k.height as usize
        };
        let views = || dataset.train.iter().chain(&dataset.test);
        let largest = views().map(pixels).max().unwrap_or(0);
        let working = views()
            .map(|view| dataset.views[*view].photo.working_bytes())
            .max()
            .unwrap_or(0);
        let bytes = |views: &[usize]| {
            views
                .iter()
                .map(|view| BYTES_PER_PHOTO_PIXEL * pixels(view))
                .sum::<usize>()
        };
        let all = bytes(&dataset.train);
        let has_field = (0..recipe.stage.len()).any(|stage| is_field(recipe, stage));
        let all_at_once = has_field && all <= MAX_PHOTO_BYTES;
        let perceptual = match lpips {
            None => 0,
            Some(LpipsNet::Squeeze | LpipsNet::Alex) => 300,
            Some(LpipsNet::Vgg) => 3000,
        };
        Self {
            program: PROGRAM_BYTES
                + dataset.points.as_ref().map_or(0, |points| POINT_BYTES * points.len())
                + if has_field { FIELD_BYTES } else { 0 },
            images: (PIXEL_BYTES + perceptual) * largest,
            few_photos: working
                + if all_at_once {
                    all
                } else {
                    all.min(MIN_PHOTOS * BYTES_PER_PHOTO_PIXEL * largest)
                },
            all_photos: working + all,
            held_out: bytes(&dataset.test),
            first_splats: 0,
            max_splats: 0,
        }
    }
}

impl MemoryPlan {
    /// Distributes `limit` bytes.
    ///
    /// # Errors
    /// When the first splats and a few photographs do not fit: the error says what would.
    pub(crate) fn new(needs: &Needs, limit: Option<usize>) -> Result<Self, TrainError> {
        let plan = |splats, photos, held_out| Self {
            limit,
            program: needs.program,
            images: needs.images,
            photos,
            all_photos: needs.all_photos,
            held_out,
            splats,
            wanted_splats: needs.max_splats,
        };
        let Some(memory) = limit else {
            let held_out = Some(needs.held_out).filter(|bytes| *bytes <= DEFAULT_PHOTO_BYTES / HELD_OUT_DIVISOR);
            return Ok(plan(needs.max_splats, DEFAULT_PHOTO_BYTES, held_out.unwrap_or(0)));
        };
        let fixed = needs.program + needs.images;
        let min_total = fixed + needs.few_photos + SPLAT_BYTES * needs.first_splats.max(1);
        if min_total > memory {
            let fitting = memory.saturating_sub(fixed + needs.few_photos) / SPLAT_BYTES;
            return Err(TrainError::Memory {
                limit: in_gib(memory),
                needed: in_gib_rounded_up(min_total),
                splats: needs.first_splats,
                otherwise: if fitting >= 1000 {
                    format!(", or {fitting} splats with --max-splats")
                } else {
                    ", or smaller photographs with --max-side".into()
                },
            });
        }
        let photos = needs
            .all_photos
            .min(needs.few_photos.max((memory - fixed) / PHOTO_DIVISOR));
        let fitting = (memory - fixed).saturating_sub(photos) / SPLAT_BYTES;
        let splats = needs.max_splats.min(fitting.max(needs.first_splats)).max(1);
        let rest = memory - fixed - SPLAT_BYTES * splats;
        let held_out = Some(needs.held_out).filter(|bytes| photos + bytes <= rest).unwrap_or(0);
        // Photographs at full size, and at the scale of a stage.
        Ok(plan(splats, (2 * needs.all_photos).min(rest - held_out), held_out))
    }

    /// The limit on the number of splats, given a frame of `pixels` pixels in which `splats` splats have `intersections` intersections with
    /// tiles; more of these than were reserved reduce the limit.
    pub(crate) fn splats_at(&self, intersections: usize, splats: usize, pixels: usize) -> usize {
        let reserved = INTERSECTIONS_PER_SPLAT * splats + pixels / 10;
        let excess = INTERSECTION_BYTES * intersections.saturating_sub(reserved);
        match self.limit {
            // Intersections grow with splats, and other views may have more.
            Some(_) => self.splats.saturating_sub(2 * excess / SPLAT_BYTES).max(1),
            None => usize::MAX,
        }
    }

    /// A warning, one line, if memory limits the splats of the recipe `name`.
    pub(crate) fn warning(&self, name: &str) -> Option<String> {
        let limit = self.limit.filter(|_| self.splats < self.wanted_splats)?;
        // A recipe may have any limit, also one that means none.
        let more = SPLAT_BYTES.saturating_mul(self.wanted_splats - self.splats);
        Some(format!(
            "{} of memory allows {} splats, but recipe {name} has up to {}: density control adds fewer; --memory {} allows all",
            in_gib(limit),
            self.splats,
            self.wanted_splats,
            in_gib_rounded_up(limit.saturating_add(more))
        ))
    }
}

impl fmt::Display for MemoryPlan {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Some(limit) = self.limit else {
            return write!(f, "memory: {} for photographs", in_gib(self.photos));
        };
        write!(f, "memory: at most {}: ", in_gib(limit))?;
        if self.wanted_splats > 0 {
            write!(
                f,
                "{} for up to {} splats, ",
                in_gib(SPLAT_BYTES * self.splats),
                self.splats
            )?;
        }
        write!(
            f,
            "{} for photographs (all: {}), {} for images, {} for the program",
            in_gib(self.photos),
            in_gib(self.all_photos),
            in_gib(self.images),
            in_gib(self.program)
        )
    }
}

fn in_gib(bytes: usize) -> String {
    format!("{:.2} GiB", bytes as f64 / (1u64 << 30) as f64)
}

/// As `--memory` reads it; rounded up, so that the figure suffices.
fn in_gib_rounded_up(bytes: usize) -> String {
    in_gib(bytes.saturating_add((1 << 30) / 100)).replace(' ', "")
}

/// Three quarters of the free memory, bytes; `None` where unknown.
pub fn default_limit() -> Option<usize> {
    Some(free()? / 4 * 3)
}

/// Memory that can be taken without swapping, bytes: of the system, or of the control group if that is less. `None` where unknown.
pub fn free() -> Option<usize> {
    let read = |path: &str| fs::read_to_string(path).ok();
    let number = |path: &str| read(path)?.trim().parse::<u64>().ok();
    let system = read("/proc/meminfo").and_then(|text| {
        let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
        Some(1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?)
    })?;
    // Files in the page cache count as used there, but they are evicted when memory is needed.
    let cached = || inactive_files(&read("/sys/fs/cgroup/memory.stat")?);
    let group = number("/sys/fs/cgroup/memory.max")
        .zip(number("/sys/fs/cgroup/memory.current"))
        .map_or(u64::MAX, |(limit, used)| {
            limit.saturating_sub(used.saturating_sub(cached().unwrap_or(0)))
        });
    usize::try_from(system.min(group)).ok()
}

/// Bytes of the file cache that a control group gives up first, by its `memory.stat`.
fn inactive_files(stat: &str) -> Option<u64> {
    stat.lines()
        .find_map(|line| line.strip_prefix("inactive_file "))?
        .trim()
        .parse()
        .ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_cache_of_a_control_group_is_read() {
        let stat = "anon 1000\nfile 9000\ninactive_file 4096\nactive_file 4904\n";
        assert_eq!(inactive_files(stat), Some(4096));
        assert_eq!(inactive_files("anon 1000\n"), None);
    }

    const GIB: usize = 1 << 30;

    fn needs(first_splats: usize, max_splats: usize) -> Needs {
        Needs {
            program: PROGRAM_BYTES,
            images: PIXEL_BYTES * 1_000_000,
            few_photos: 50 << 20,
            all_photos: 10 * GIB,
            held_out: GIB,
            first_splats,
            max_splats,
        }
    }

    #[test]
    fn the_parts_are_within_the_limit_and_a_plan_is_refused_with_the_figure_that_suffices() {
        for limit in [GIB, 2 * GIB, 4 * GIB, 8 * GIB, 32 * GIB] {
            for first in [0, 200_000, 1_000_000, 5_000_000] {
                match MemoryPlan::new(&needs(first, 6_000_000), Some(limit)) {
                    Ok(plan) => {
                        let used = plan.program + plan.images + plan.photos + plan.held_out + SPLAT_BYTES * plan.splats;
                        assert!(used <= limit && plan.splats >= first && plan.photos >= 50 << 20);
                        assert!([0, GIB].contains(&plan.held_out) && (limit < 32 * GIB || plan.held_out > 0));
                    }
                    Err(TrainError::Memory { needed, .. }) => {
                        let gib: f64 = needed.trim_end_matches("GiB").parse().unwrap();
                        assert!(gib > limit as f64 / GIB as f64);
                        assert!(MemoryPlan::new(&needs(first, 6_000_000), Some((gib * GIB as f64) as usize)).is_ok());
                    }
                    Err(error) => panic!("{error}"),
                }
            }
        }
    }

    #[test]
    fn a_warning_names_the_memory_that_allows_all_splats() {
        let plan = MemoryPlan::new(&needs(1000, 1_000_000), Some(2 * GIB)).unwrap();
        let warning = plan.warning("fast").unwrap();
        let figure = warning.split("--memory ").nth(1).unwrap().split("GiB").next().unwrap();
        let enough = (figure.parse::<f64>().unwrap() * GIB as f64) as usize;
        assert!(plan.splats < 1_000_000, "{warning}");
        assert!(
            MemoryPlan::new(&needs(1000, 1_000_000), Some(enough + 3 * GIB))
                .unwrap()
                .warning("fast")
                .is_none()
        );
        assert!(
            MemoryPlan::new(&needs(1000, 1_000_000), None)
                .unwrap()
                .warning("fast")
                .is_none()
        );
    }

    #[test]
    fn a_limit_beyond_all_memory_is_not_said_to_fit_into_little() {
        for max_splats in [usize::MAX, i64::MAX as usize] {
            let plan = MemoryPlan::new(&needs(1000, max_splats), Some(2 * GIB)).unwrap();
            let warning = plan.warning("classic").unwrap();
            let figure = warning.split("--memory ").nth(1).unwrap().split("GiB").next().unwrap();
            assert!(figure.parse::<f64>().unwrap() > 1e6, "{warning}");
        }
    }

    #[test]
    fn splats_over_many_tiles_leave_room_for_fewer() {
        let plan = MemoryPlan::new(&needs(1000, 1_000_000), Some(4 * GIB)).unwrap();
        let usual = plan.splats_at(200_000, 100_000, 1_000_000);
        assert_eq!(usual, plan.splats);
        assert!(plan.splats_at(10_000_000, 100_000, 1_000_000) < usual);
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn the_free_memory_is_known() {
        assert!(default_limit().unwrap() > 1 << 26);
    }
}
