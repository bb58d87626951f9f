//! Masks of what stands still in the photographs while the rest moves: poses and splats are those of the rest. Textured parts are found by
//! matches that stand still, before the poses; the plain backdrop of a turntable is found by the poses.

use super::PoseProgress;
use super::attempt::{Attempt, Matched};
use super::import::{MASKS_FOLDER, move_to_unused};
use super::stages::to_rgb;
use crate::RunError;
use crate::scene_file::same_file;
use irradia_formats::{PhotoEntry, PhotoFolder, write_png};
use irradia_sfm::map::{StillRegion, find_still_region, turntable_rings};
use irradia_sfm::{Backdrop, OverlayDetector, StillScene, bars};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// File in the folder of masks that marks them as written by an earlier call.
const RECORD_FILE: &str = ".irradia";
/// Longer side of the reduced photographs in which masks are found, px.
const MASK_SIDE: u32 = 480;
/// Minimum number of photographs of one camera to determine a still background.
const MIN_CAMERA_PHOTOS: usize = 4;
/// A photograph shows a still background if it shows at least this fraction of the mean share that photographs show of it.
const MIN_SHOWN_FRACTION: f64 = 0.5;
/// Minimum fraction of the pixels that moves: photographs from one place are not of a turntable.
const MIN_MOVING_FRACTION: f64 = 0.03;
/// A backdrop surrounds what turns: it takes at least this fraction of the border of half of the photographs. A camera that flies an exact
/// circle, such as a drone's, has plain sky in the upper half at most.
const MIN_BORDER_FRACTION: f64 = 0.55;
/// Minimum fraction of the photographs' pixels that a backdrop takes: if masks keep less than half, training leaves no splats outside of
/// what they keep. A medal in front of a dark backdrop, 29 % of which can be masked, gains nothing from masks.
const MIN_BACKDROP_FRACTION: f64 = 0.5;
/// Number of rings, the largest ones, whose backdrops each photograph is compared with; limits the time.
const MAX_RINGS: usize = 8;
/// Number of photographs of each camera that are examined for bars and text.
const EXAMINED_PHOTOS: usize = 24;
/// Maximum fraction of the pixels that overlaid text covers. A larger still part may be behind the scene, such as the background of a
/// turntable, and hidden by the scene in some photographs: 7 % of a tankard that fills 86 % of its photographs would be masked with it.
const MAX_OVERLAY_FRACTION: f64 = 0.06;
/// Minimum range of a backdrop's colour in half of the photographs, of 255: a backdrop of a single colour looks the same from everywhere
/// and does no harm.
const MIN_COLOR_RANGE: f64 = 8.0;

/// Reduced photographs, `[H, W, 3]`, by index of the photograph.
type Pictures = BTreeMap<usize, Vec<u8>>;

/// The result of masking what stands still.
pub(super) struct Masked {
    /// The photographs with their masks.
    pub folder: PhotoFolder,
    pub still: StillRegion,
    /// Message for the user.
    pub message: String,
}

/// A still background behind some photographs.
struct StillBackground {
    scene: StillScene,
    /// Minimum fraction of a photograph that shows it, for its mask to be used.
    min_shown_fraction: f64,
}

impl StillBackground {
    /// The background behind those of `pictures` that are in `group`, if there are enough.
    fn behind(group: &[usize], [width, height]: [u32; 2], pictures: &Pictures) -> Option<Self> {
        let grouped: Vec<&Vec<u8>> = group.iter().filter_map(|photo| pictures.get(photo)).collect();
        (grouped.len() >= MIN_CAMERA_PHOTOS).then(|| {
            let scene = StillScene::from_pictures(width as usize, height as usize, &grouped);
            let shown_sum: f64 = grouped
                .par_iter()
                .map(|picture| scene.segment(picture).still_fraction())
                .collect::<Vec<_>>()
                .iter()
                .sum();
            let min_shown_fraction = MIN_SHOWN_FRACTION * shown_sum / grouped.len() as f64;
            Self {
                scene,
                min_shown_fraction,
            }
        })
    }
}

/// A mask of what stands still, row by row.
struct Mask {
    size: [u32; 2],
    still: Vec<bool>,
}

/// Writes masks into `out` if a part of the photographs stands still and no photograph has a mask of its own.
pub(super) fn mask(
    matched: &Matched,
    folder: &PhotoFolder,
    out: &Path,
    progress: &(dyn Fn(PoseProgress) + Sync),
) -> Result<Option<Masked>, RunError> {
    if !clear_own_masks(folder, out)? {
        return Ok(None);
    }
    let Some(still) = find_still_region(&matched.infos, matched.work.features(), &matched.pairs) else {
        return Ok(None);
    };
    let masks = find_still_masks(matched, folder, &still)?;
    if masks.is_empty() {
        return Ok(None);
    }
    let (written, message) = write_and_report(
        out,
        folder,
        &masks,
        "stand still while the rest moves (the background of a turntable, or whatever carries the camera)",
        progress,
    )?;
    let with_mask = |photo: &PhotoEntry| photo.with_mask(written.join(file_name(photo)));
    let photos = folder.photos.iter().map(with_mask).collect::<Result<_, _>>()?;
    Ok(Some(Masked {
        folder: PhotoFolder {
            photos,
            ..folder.clone()
        },
        still,
        message,
    }))
}

/// Writes masks of the backdrop into `out` if the poses are those of a turntable in front of a plain backdrop and no photograph has a mask
/// of its own; returns the message for the user. The poses do not need these masks.
pub(super) fn mask_backdrop(
    attempt: &Attempt,
    folder: &PhotoFolder,
    out: &Path,
    progress: &(dyn Fn(PoseProgress) + Sync),
) -> Result<Option<String>, RunError> {
    let rings = attempt
        .reconstruction
        .models
        .first()
        .map_or(Vec::new(), turntable_rings);
    if rings.is_empty() || !clear_own_masks(folder, out)? {
        return Ok(None);
    }
    let masks = turntable_masks(&attempt.matched, folder, &rings)?;
    if masks.is_empty() {
        return Ok(None);
    }
    let (_, message) = write_and_report(out, folder, &masks, "are the backdrop of a turntable", progress)?;
    Ok(Some(message))
}

/// Writes masks of bars around the photographs and of overlaid text into `out` if there are any and no photograph has a mask of its own;
/// returns the message for the user. The poses do not need these masks, since bars have no features and text few, but training would place
/// splats directly in front of the cameras to reproduce them.
pub(super) fn mask_bars_and_text(
    attempt: &Attempt,
    folder: &PhotoFolder,
    out: &Path,
    progress: &(dyn Fn(PoseProgress) + Sync),
) -> Result<Option<String>, RunError> {
    if !clear_own_masks(folder, out)? {
        return Ok(None);
    }
    let mut masks = BTreeMap::new();
    for photos in photos_by_camera(&attempt.matched) {
        let examined = photos
            .iter()
            .copied()
            .step_by(photos.len().div_ceil(EXAMINED_PHOTOS))
            .collect::<Vec<_>>();
        if examined.len() < MIN_CAMERA_PHOTOS {
            continue;
        }
        let (size, pictures) = pictures(&attempt.matched, folder, &examined)?;
        let Some(still) = bar_mask(size, &pictures).or_else(|| overlay_mask(size, &pictures)) else {
            continue;
        };
        for photo in photos {
            let still = still.clone();
            masks.insert(attempt.matched.work.photos()[photo], Mask { size, still });
        }
    }
    if masks.is_empty() {
        return Ok(None);
    }
    let (_, message) = write_and_report(
        out,
        folder,
        &masks,
        "are bars around the image or text laid over it",
        progress,
    )?;
    Ok(Some(message))
}

/// The pixels of bars around `pictures`, the same in all; `None` if there are no bars.
fn bar_mask(size: [u32; 2], pictures: &Pictures) -> Option<Vec<bool>> {
    let [width, height] = size.map(|side| side as usize);
    let bars = bars(width, height, &pictures.values().collect::<Vec<_>>());
    // Lines at the edge of a bar are a mixture of bar and photograph.
    let [left, above, right, below] = bars.map(|bar| if bar > 0 { bar + 2 } else { 0 });
    let is_bar = |at: usize| {
        let (x, y) = (at % width, at / width);
        x < left || y < above || x >= width - right || y >= height - below
    };
    (bars != [0; 4]).then(|| (0..width * height).map(is_bar).collect())
}

/// Candidates for what is overlaid on all of `pictures`.
fn overlay([width, height]: [u32; 2], pictures: &Pictures) -> OverlayDetector<'_> {
    OverlayDetector::new(width as usize, height as usize, &pictures.values().collect::<Vec<_>>())
}

/// The pixels of what is overlaid on `pictures`, if it is certain and small.
fn overlay_mask(size: [u32; 2], pictures: &Pictures) -> Option<Vec<bool>> {
    let overlay = overlay(size, pictures);
    let overlaid = overlay.is_certain().then(|| overlay.mask())?;
    (still_pixels(&overlaid) as f64 <= MAX_OVERLAY_FRACTION * overlaid.len() as f64).then_some(overlaid)
}

/// Removes from `photos` the masks that an earlier call wrote into `out`, which is also the folder of the photographs: they are not the
/// user's.
pub(super) fn ignore_own_masks(photos: &mut [PhotoEntry], out: &Path) -> Result<(), RunError> {
    let written = out.join(MASKS_FOLDER);
    if !written.join(RECORD_FILE).exists() {
        return Ok(());
    }
    for photo in photos {
        let folder = photo.mask.as_deref().and_then(Path::parent);
        if folder.is_some_and(|folder| same_file(folder, &written)) {
            *photo = photo.without_mask()?;
        }
    }
    Ok(())
}

/// Moves the masks of an earlier call to `unused`, which the user may have edited; returns whether there are no other masks.
fn clear_own_masks(folder: &PhotoFolder, out: &Path) -> Result<bool, RunError> {
    let written = out.join(MASKS_FOLDER);
    let record = written.join(RECORD_FILE);
    if record.exists() {
        let entries = fs::read_dir(&written).map_err(RunError::io("read", &written))?;
        let names: Vec<String> = (entries.flatten())
            .map(|entry| entry.file_name().to_string_lossy().into_owned())
            .filter(|name| name != RECORD_FILE)
            .collect();
        fs::remove_file(&record).map_err(RunError::io("remove", &record))?;
        move_to_unused(out, names.into_iter().map(|name| format!("{MASKS_FOLDER}/{name}")))?;
    }
    // Any remaining masks are the user's, for the poses or for the training alone.
    Ok(!written.exists() && folder.photos.iter().all(|photo| photo.mask.is_none()))
}

/// Writes masks and tells the user of `what` they are; returns their folder and that message.
fn write_and_report(
    out: &Path,
    folder: &PhotoFolder,
    masks: &BTreeMap<usize, Mask>,
    what: &str,
    progress: &(dyn Fn(PoseProgress) + Sync),
) -> Result<(PathBuf, String), RunError> {
    let written = write(out, folder, masks)?;
    let masked_pixels: usize = (masks.values()).map(|mask| still_pixels(&mask.still)).sum();
    let all_pixels: usize = masks.values().map(|mask| mask.still.len()).sum();
    let message = format!(
        "{:.0} % of the pixels of {} photographs {what}: masked in {}; to change this, put masks of your own into a folder named masks \
         beside the photographs",
        100.0 * masked_pixels as f64 / all_pixels as f64,
        masks.len(),
        written.display()
    );
    progress(PoseProgress::Warned(message.clone()));
    Ok((written, message))
}

/// Masks by index of the folder's photographs.
fn find_still_masks(
    matched: &Matched,
    folder: &PhotoFolder,
    still: &StillRegion,
) -> Result<BTreeMap<usize, Mask>, RunError> {
    let groups = still.groups(matched.infos.len());
    masks_by_camera(matched, folder, |size, pictures| {
        let scenes: Vec<StillBackground> = groups
            .iter()
            .filter_map(|group| StillBackground::behind(group, size, pictures))
            .collect();
        let mut masks = background_masks(&scenes, pictures);
        add_overlay(size, pictures, &mut masks);
        masks
    })
}

/// Adds what is overlaid on all of `pictures` to the mask of each: unlike a background, it is hidden in none of them.
fn add_overlay(size: [u32; 2], pictures: &Pictures, masks: &mut BTreeMap<usize, Vec<bool>>) {
    let mut overlaid = overlay(size, pictures).mask();
    for (at, overlaid) in overlaid.iter_mut().enumerate() {
        let still = masks.values().filter(|mask| mask[at]).count();
        *overlaid |= still > 0 && 2 * still >= masks.len();
    }
    let covers = still_pixels(&overlaid) as f64 / overlaid.len() as f64;
    if covers > 0.0 && covers <= MAX_OVERLAY_FRACTION {
        for photo in pictures.keys() {
            let mask = masks.entry(*photo).or_insert_with(|| vec![false; overlaid.len()]);
            mask.iter_mut()
                .zip(&overlaid)
                .for_each(|(still, overlaid)| *still |= *overlaid);
        }
    }
}

/// Like [`find_still_masks`], for a plain backdrop behind what turns in `rings`.
fn turntable_masks(
    matched: &Matched,
    folder: &PhotoFolder,
    rings: &[Vec<usize>],
) -> Result<BTreeMap<usize, Mask>, RunError> {
    masks_by_camera(matched, folder, |[width, height], pictures| {
        // A photograph in different light, such as with the shadow of what turns, may match the backdrop of another ring better.
        let backdrops: Vec<Backdrop> = rings
            .iter()
            .take(MAX_RINGS)
            .map(|ring| ring.iter().filter_map(|photo| pictures.get(photo)).collect::<Vec<_>>())
            .filter(|of_ring| of_ring.len() >= MIN_CAMERA_PHOTOS)
            .map(|of_ring| Backdrop::from_pictures(width as usize, height as usize, &of_ring))
            .collect();
        let best_backdrop = |picture: &[u8]| {
            let all = backdrops.iter().map(|backdrop| (backdrop, backdrop.mask(picture)));
            all.max_by_key(|(_, shown)| still_pixels(shown))
        };
        let masks: Vec<_> = pictures
            .par_iter()
            .filter_map(|(photo, picture)| {
                let (backdrop, shown) = best_backdrop(picture)?;
                Some((*photo, backdrop, shown))
            })
            .collect();
        let half_have = |value: &dyn Fn(&Backdrop, &[bool]) -> f64, min: f64| {
            let enough = masks
                .iter()
                .filter(|(_, backdrop, shown)| value(backdrop, shown) >= min);
            2 * enough.count() > masks.len()
        };
        let is_backdrop = half_have(&|backdrop, shown| backdrop.border_fraction(shown), MIN_BORDER_FRACTION)
            && half_have(
                &|backdrop, shown| f64::from(backdrop.color_range(shown)),
                MIN_COLOR_RANGE,
            );
        let mean = masks.iter().map(|mask| still_pixels(&mask.2)).sum::<usize>() as f64 / masks.len().max(1) as f64;
        let covers = mean > MIN_BACKDROP_FRACTION * f64::from(width * height);
        let kept = masks
            .into_iter()
            .filter(|mask| is_backdrop && covers && still_pixels(&mask.2) as f64 >= MIN_SHOWN_FRACTION * mean);
        kept.map(|(photo, _, shown)| (photo, shown)).collect()
    })
}

/// Number of pixels of a mask where something stands still.
fn still_pixels(mask: &[bool]) -> usize {
    mask.iter().filter(|still| **still).count()
}

/// Masks by index of the folder's photographs; `find` finds them in the reduced photographs, `[H, W, 3]`, of each camera.
fn masks_by_camera(
    matched: &Matched,
    folder: &PhotoFolder,
    find: impl Fn([u32; 2], &Pictures) -> BTreeMap<usize, Vec<bool>>,
) -> Result<BTreeMap<usize, Mask>, RunError> {
    let mut masks = BTreeMap::new();
    for photos in photos_by_camera(matched) {
        let (size, pictures) = pictures(matched, folder, &photos)?;
        for (photo, still) in find(size, &pictures) {
            masks.insert(matched.work.photos()[photo], Mask { size, still });
        }
    }
    Ok(masks)
}

/// The photographs of each camera.
fn photos_by_camera(matched: &Matched) -> Vec<Vec<usize>> {
    let mut cameras: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (photo, info) in matched.infos.iter().enumerate() {
        cameras.entry(info.group).or_default().push(photo);
    }
    cameras.into_values().collect()
}

/// Reduced copies of `photos`, which are by one camera, and their size.
fn pictures(matched: &Matched, folder: &PhotoFolder, photos: &[usize]) -> Result<([u32; 2], Pictures), RunError> {
    let entry = |photo: usize| &folder.photos[matched.work.photos()[photo]];
    let size = reduced_size(entry(photos[0]));
    let pictures = photos
        .par_iter()
        .map(|photo| Ok((*photo, to_rgb(&entry(*photo).read(MASK_SIDE)?, size))))
        .collect::<Result<_, RunError>>()?;
    Ok((size, pictures))
}

/// The pixels at which `pictures` show a background, by photograph. Of several `scenes`, such as those of rings at different heights, each
/// photograph gets the one of which it shows most.
fn background_masks(scenes: &[StillBackground], pictures: &Pictures) -> BTreeMap<usize, Vec<bool>> {
    let best_scene = |picture: &[u8]| {
        let all = scenes.iter().enumerate().map(|(i, background)| {
            let shown = background.scene.segment(picture);
            (i, shown.still_fraction(), shown)
        });
        let shown = all.filter(|(i, share, _)| *share >= scenes[*i].min_shown_fraction);
        shown.max_by(|a, b| a.1.total_cmp(&b.1))
    };
    let shown: Vec<_> = pictures
        .par_iter()
        .filter_map(|(photo, picture)| {
            let (scene, _, shown) = best_scene(picture)?;
            Some((scene, *photo, shown.mask()))
        })
        .collect();
    let mut by_scene: BTreeMap<usize, BTreeMap<usize, Vec<bool>>> = BTreeMap::new();
    for (scene, photo, still) in shown {
        by_scene.entry(scene).or_default().insert(photo, still);
    }
    let moves = |masks: &BTreeMap<usize, Vec<bool>>| {
        let pixels = || masks.values().flatten();
        pixels().filter(|still| !**still).count() as f64 >= MIN_MOVING_FRACTION * pixels().count() as f64
    };
    by_scene.into_values().filter(moves).flatten().collect()
}

/// The reduced size at which the mask of `photo` is found, the same for all photographs of its camera.
fn reduced_size(photo: &PhotoEntry) -> [u32; 2] {
    let size = [photo.width, photo.height];
    let scale = (f64::from(MASK_SIDE) / f64::from(photo.width.max(photo.height))).min(1.0);
    size.map(|side| ((scale * f64::from(side)).round() as u32).max(1))
}

fn file_name(photo: &PhotoEntry) -> String {
    format!("{}.png", photo.name)
}

/// Writes one mask per photograph, at its size, into a subfolder of `out`: white where nothing is known to stand still.
fn write(out: &Path, folder: &PhotoFolder, masks: &BTreeMap<usize, Mask>) -> Result<PathBuf, RunError> {
    let written = out.join(MASKS_FOLDER);
    let new = written.with_extension("new");
    if new.exists() {
        fs::remove_dir_all(&new).map_err(RunError::io("clear", &new))?;
    }
    fs::create_dir_all(&new).map_err(RunError::io("create", &new))?;
    let record = new.join(RECORD_FILE);
    fs::write(&record, b"").map_err(RunError::io("write", &record))?;
    folder.photos.par_iter().enumerate().try_for_each(|(i, photo)| {
        let size = [photo.width, photo.height];
        let pixels = match masks.get(&i) {
            Some(mask) => mask.enlarged(size),
            None => vec![255; size[0] as usize * size[1] as usize],
        };
        write_png(&new.join(file_name(photo)), size[0], size[1], 1, &pixels)
    })?;
    fs::rename(&new, &written).map_err(RunError::io("rename", &new))?;
    Ok(written)
}

impl Mask {
    /// The mask at `size`, black where something stands still, with smooth edges.
    fn enlarged(&self, [width, height]: [u32; 2]) -> Vec<u8> {
        let [w, h] = self.size.map(|side| side as usize);
        // The two pixels of the mask between whose centres the centre of this pixel is, and the distance from the first.
        let between = |at: u32, of: u32, side: usize| {
            let at = ((at as f32 + 0.5) * side as f32 / of as f32 - 0.5).clamp(0.0, (side - 1) as f32);
            (at as usize, (at as usize + 1).min(side - 1), at.fract())
        };
        let columns: Vec<_> = (0..width).map(|x| between(x, width, w)).collect();
        let mut pixels = Vec::with_capacity(width as usize * height as usize);
        for y in 0..height {
            let (above, below, down) = between(y, height, h);
            let still = |x: usize, y: usize| f32::from(u8::from(self.still[y * w + x]));
            pixels.extend(columns.iter().map(|&(left, right, across)| {
                let row = |y: usize| still(left, y) * (1.0 - across) + still(right, y) * across;
                let covered = row(above) * (1.0 - down) + row(below) * down;
                if covered >= 0.5 { 0 } else { 255 }
            }));
        }
        pixels
    }
}
