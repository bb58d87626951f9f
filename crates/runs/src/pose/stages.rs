//! Finding of features and matches, which reuses those of an earlier call.

use super::feature_store::{self, PhotoFeatures, Settings, StoredFeatures};
use super::{MIN_POSED_FRACTION, PoseProgress};
use crate::RunError;
use irradia_formats::{PhotoEntry, PhotoFolder, Pixels};
use irradia_scene::resize_area;
use irradia_sfm::doctor::Appearance;
use irradia_sfm::features::{Extractor, GreyPhoto, Sift};
use irradia_sfm::matching::{MatchOptions, PairOptions, candidate_pairs, match_pairs};
use irradia_sfm::{Features, PairMatches};
use rayon::prelude::*;
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Number of photographs per thread whose features are extracted between two checks of the time.
const PHOTOS_PER_THREAD: usize = 32;
/// Number of pairs that are matched between two checks of the time.
const PAIRS_PER_BATCH: usize = 1000;
/// How often features and matches are saved while they are found.
const SAVE_INTERVAL: Duration = Duration::from_secs(60);

/// Files of features and matches: of the first attempt, of a second one, and of photographs in which what stands still is masked.
const FEATURES_FILE: &str = "features.bin";
const RETRY_FEATURES_FILE: &str = "features-more.bin";
const MASKED_FEATURES_FILE: &str = "features-masked.bin";

/// Numbers of photographs, and the maximum number of features if there are at most that many: a scene of few photographs has few points
/// otherwise, and matching costs little. Splats that begin from these points end 0.7 dB better on lund_door, 12 photographs.
const MAX_FEATURES_BY_PHOTOS: [(usize, usize); 2] = [(25, 8192), (35, 6144)];

/// Maximum number of features per photograph: the `requested` one, or one that depends on the number of photographs.
pub(super) fn max_features(requested: Option<usize>, photos: usize) -> usize {
    let many = MAX_FEATURES_BY_PHOTOS.into_iter().find(|(most, _)| photos <= *most);
    let usual = many.map_or(Sift::default().max_features, |(_, features)| features);
    requested.unwrap_or(usual)
}

/// The photographs with the features and matches found so far.
pub(super) struct Work<'a> {
    folder: &'a PhotoFolder,
    progress: &'a (dyn Fn(PoseProgress) + Sync),
    /// The file in which features and matches are kept, if any.
    path: Option<PathBuf>,
    settings: Settings,
    sift: Sift,
    stored: StoredFeatures,
    /// Indices of the folder's photographs that could be decoded.
    used: Vec<usize>,
    /// Hashes of their files.
    hashes: Vec<u64>,
    features: Vec<Features>,
    colors: Vec<Vec<[u8; 3]>>,
    appearances: Vec<Appearance>,
    /// Names of the photographs that could not be decoded, and why.
    undecodable: Vec<(String, String)>,
    warnings: Vec<String>,
}

impl<'a> Work<'a> {
    /// Features and matches are kept in the folder `out`, if there is one.
    pub fn new(
        requested: Option<usize>,
        out: Option<&Path>,
        folder: &'a PhotoFolder,
        progress: &'a (dyn Fn(PoseProgress) + Sync),
    ) -> Self {
        let sift = Sift {
            max_features: max_features(requested, folder.photos.len()),
            ..Sift::default()
        };
        Self::open(sift, out.map(|out| out.join(FEATURES_FILE)), folder, progress)
    }

    /// The same photographs for a second attempt: with frontal descriptors, and with twice the features if at least half of the photographs
    /// that were `left_out` have the maximum number. The number stays if it was `requested`, or if some but at most a fifth of the photographs
    /// were left out, since twice as many features take four times as long to match.
    pub fn retry(&self, requested: Option<usize>, left_out: &[usize], out: &Path) -> Self {
        let most = self.sift.max_features;
        let full = left_out
            .iter()
            .filter(|photo| self.features[**photo].keypoints.len() >= most);
        let few = !left_out.is_empty() && left_out.len() as f64 <= (1.0 - MIN_POSED_FRACTION) * self.used.len() as f64;
        let more = requested.is_none() && !few && 2 * full.count() >= left_out.len();
        let sift = Sift {
            max_features: if more { 2 * most } else { most },
            frontal: true,
            ..self.sift.clone()
        };
        Self::open(sift, Some(out.join(RETRY_FEATURES_FILE)), self.folder, self.progress)
    }

    /// The same photographs with the masks of `folder`.
    pub fn masked<'b>(&self, folder: &'b PhotoFolder, out: &Path) -> Work<'b>
    where
        'a: 'b,
    {
        Work::open(
            self.sift.clone(),
            Some(out.join(MASKED_FEATURES_FILE)),
            folder,
            self.progress,
        )
    }

    fn open(
        sift: Sift,
        path: Option<PathBuf>,
        folder: &'a PhotoFolder,
        progress: &'a (dyn Fn(PoseProgress) + Sync),
    ) -> Self {
        let settings = Settings {
            extractor: [
                sift.max_side,
                sift.max_features as u32,
                sift.peak_threshold.to_bits(),
                sift.edge_threshold.to_bits(),
            ],
            frontal: sift.frontal,
        };
        let (stored, warning) = path
            .as_ref()
            .map(|path| feature_store::read(path, settings))
            .unwrap_or_default();
        let mut work = Self {
            folder,
            progress,
            path,
            settings,
            sift,
            stored,
            used: Vec::new(),
            hashes: Vec::new(),
            features: Vec::new(),
            colors: Vec::new(),
            appearances: Vec::new(),
            undecodable: Vec::new(),
            warnings: Vec::new(),
        };
        work.warn(warning);
        work
    }

    /// The settings of feature extraction.
    pub fn sift(&self) -> &Sift {
        &self.sift
    }

    /// Shows a warning to the user now, and keeps it for the report.
    pub fn warn(&mut self, warning: Option<String>) {
        if let Some(warning) = warning {
            (self.progress)(PoseProgress::Warned(warning.clone()));
            self.warnings.push(warning);
        }
    }

    /// Indices of the folder's photographs that have features; features, colours and appearances are in this order.
    pub fn photos(&self) -> &[usize] {
        &self.used
    }

    pub fn features(&self) -> &[Features] {
        &self.features
    }

    /// For changes that are undone before features and matches are saved.
    pub fn features_mut(&mut self) -> &mut [Features] {
        &mut self.features
    }

    /// The colour at each keypoint, by photograph.
    pub fn colors(&self) -> &[Vec<[u8; 3]>] {
        &self.colors
    }

    /// The pixel statistics of each photograph.
    pub fn appearances(&self) -> &[Appearance] {
        &self.appearances
    }

    pub fn undecodable(&self) -> &[(String, String)] {
        &self.undecodable
    }

    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Finds the features of all photographs; those that are not known yet are extracted in parallel.
    pub fn find_features(&mut self) -> Result<(), RunError> {
        let photos = &self.folder.photos;
        (self.progress)(PoseProgress::Stage {
            name: "features",
            of: photos.len(),
        });
        let new: Vec<&PhotoEntry> = photos
            .iter()
            .filter(|photo| !self.stored.photos.contains_key(&photo.hash))
            .collect();
        let done = AtomicUsize::new(photos.len() - new.len());
        let mut failed: HashMap<u64, String> = HashMap::new();
        let mut saved = Instant::now();
        for batch in new.chunks(PHOTOS_PER_THREAD * rayon::current_num_threads()) {
            let found: Vec<Result<PhotoFeatures, String>> = batch
                .par_iter()
                .map(|photo| {
                    let features = extract(&self.sift, photo);
                    let now = done.fetch_add(1, Ordering::Relaxed) + 1;
                    (self.progress)(PoseProgress::Done(now));
                    features
                })
                .collect();
            for (photo, features) in batch.iter().zip(found) {
                match features {
                    Ok(features) => self.stored.photos.extend([(photo.hash, features)]),
                    Err(reason) => failed.extend([(photo.hash, reason)]),
                }
            }
            if saved.elapsed() > SAVE_INTERVAL {
                self.save()?;
                saved = Instant::now();
            }
        }
        for (i, photo) in photos.iter().enumerate() {
            match failed.get(&photo.hash) {
                None => {
                    // A photograph may be there twice.
                    let is_repeated = photos[i + 1..].iter().any(|other| other.hash == photo.hash);
                    let found = if is_repeated {
                        self.stored.photos.get(&photo.hash).cloned()
                    } else {
                        self.stored.photos.remove(&photo.hash)
                    };
                    let PhotoFeatures {
                        features,
                        colors,
                        appearance,
                    } = found.unwrap_or_default();
                    self.used.push(i);
                    self.hashes.push(photo.hash);
                    self.features.push(features);
                    self.colors.push(colors);
                    self.appearances.push(appearance);
                }
                Some(reason) => self.undecodable.push((photo.name.clone(), reason.clone())),
            }
        }
        // Discards photographs that no longer exist.
        self.stored.photos = Default::default();
        let kept: HashSet<u64> = self.hashes.iter().copied().collect();
        self.stored
            .matches
            .retain(|pair, _| pair.iter().all(|hash| kept.contains(hash)));
        if failed.len() < new.len() {
            self.save()?;
        }
        Ok(())
    }

    fn save(&self) -> Result<(), RunError> {
        let Some(path) = &self.path else { return Ok(()) };
        let ordered = self.hashes.iter().zip(&self.features).zip(&self.colors);
        let mut photos: Vec<feature_store::Photo> = ordered
            .zip(&self.appearances)
            .map(|(((hash, features), colors), appearance)| (*hash, features, &colors[..], *appearance))
            .collect();
        // While features are extracted, all that are known are still here.
        let mut stored: Vec<_> = self.stored.photos.iter().collect();
        stored.sort_unstable_by_key(|(hash, _)| **hash);
        let stored = stored
            .into_iter()
            .map(|(hash, photo)| (*hash, &photo.features, &photo.colors[..], photo.appearance));
        photos.extend(stored);
        Ok(feature_store::write(
            path,
            self.settings,
            &photos,
            &self.stored.matches,
        )?)
    }

    /// Matches the pairs that are worth matching.
    pub fn match_pairs(&mut self, options: &PairOptions) -> Result<Vec<PairMatches>, RunError> {
        self.matches_of(candidate_pairs(&self.features, options, &MatchOptions::default()))
    }

    /// The matches of `pairs`; those that are not known yet are computed in parallel.
    pub fn matches_of(&mut self, pairs: Vec<[u32; 2]>) -> Result<Vec<PairMatches>, RunError> {
        let matching = MatchOptions::default();
        let hash = |pair: &[u32; 2]| pair.map(|i| self.hashes[i as usize]);
        let new: Vec<[u32; 2]> = pairs
            .iter()
            .filter(|pair| !self.stored.matches.contains_key(&hash(pair)))
            .copied()
            .collect();
        (self.progress)(PoseProgress::Stage {
            name: "matches",
            of: new.len(),
        });
        let done = AtomicUsize::new(0);
        let mut saved = Instant::now();
        for batch in new.chunks(PAIRS_PER_BATCH) {
            let found = match_pairs(&self.features, batch, &matching, || {
                let now = done.fetch_add(1, Ordering::Relaxed) + 1;
                (self.progress)(PoseProgress::Done(now));
            });
            let hash = |pair: &[u32; 2]| pair.map(|i| self.hashes[i as usize]);
            let found: Vec<_> = found
                .into_iter()
                .map(|pair| (hash(&pair.photos), pair.matches))
                .collect();
            self.stored.matches.extend(found);
            // If a long stage is interrupted, little is lost.
            if saved.elapsed() > SAVE_INTERVAL {
                self.save()?;
                saved = Instant::now();
            }
        }
        if !new.is_empty() {
            self.save()?;
        }
        let matches = |photos: [u32; 2]| PairMatches {
            photos,
            matches: self.stored.matches[&photos.map(|i| self.hashes[i as usize])].clone(),
        };
        Ok(pairs.into_iter().map(matches).collect())
    }
}

/// Extracts the features of a photograph, in pixels at full size, with their colours and the photograph's pixel statistics.
fn extract(sift: &Sift, photo: &PhotoEntry) -> Result<PhotoFeatures, String> {
    let pixels = photo.read(sift.max_side).map_err(|error| error.to_string())?;
    let grey = to_grey(&pixels.data, pixels.channels);
    let mask = mask_of(photo, &pixels)?;
    let features = sift.extract(&GreyPhoto {
        width: pixels.width,
        height: pixels.height,
        data: &grey,
        mask: mask.as_deref(),
    });
    let size = [pixels.width, pixels.height];
    let color = |x, y| color_at(&pixels.data, size, pixels.channels, x, y);
    let colors = features.keypoints.iter().map(|k| color(k.x, k.y)).collect();
    let scale = [
        photo.width as f32 / pixels.width as f32,
        photo.height as f32 / pixels.height as f32,
    ];
    let (width, height) = (pixels.width as usize, pixels.height as usize);
    Ok(PhotoFeatures {
        features: features.scaled(scale),
        colors,
        appearance: Appearance::measure(width, height, &grey, mask.as_deref()),
    })
}

/// The combined mask of a photograph: its alpha and its mask file, if it has them.
fn mask_of(photo: &PhotoEntry, pixels: &Pixels) -> Result<Option<Vec<u8>>, String> {
    let given = photo
        .read_mask(pixels.width, pixels.height)
        .map_err(|error| error.to_string())?;
    let alpha = (pixels.channels == 4).then(|| pixels.data.chunks_exact(4).map(|pixel| pixel[3]).collect());
    Ok(combine_masks(given, alpha))
}

/// Combines a mask and an alpha channel: a pixel is kept if neither hides it.
pub(super) fn combine_masks(mask: Option<Vec<u8>>, alpha: Option<Vec<u8>>) -> Option<Vec<u8>> {
    match (mask, alpha) {
        (Some(mask), Some(alpha)) => Some(mask.into_iter().zip(alpha).map(|(a, b)| a.min(b)).collect()),
        (mask, alpha) => mask.or(alpha),
    }
}

/// `[to[1], to[0], 3]` the pixels reduced to the size `to`.
pub(super) fn to_rgb(pixels: &Pixels, to: [u32; 2]) -> Vec<u8> {
    let reduced = resize_area(&pixels.data, pixels.channels, [pixels.width, pixels.height], to);
    let channels = pixels.channels as usize;
    let rgb = reduced
        .chunks_exact(channels)
        .flat_map(|pixel| [0, 1, 2].map(|c| pixel[c.min(channels - 1)]));
    rgb.collect()
}

/// `[H, W]` the brightness of `[H, W, channels]`.
pub(super) fn to_grey(data: &[u8], channels: u32) -> Vec<u8> {
    data.chunks_exact(channels as usize).map(luma).collect()
}

/// Brightness of a pixel of 3 or 4 channels, with the weights of BT.709 in 1/256.
fn luma(pixel: &[u8]) -> u8 {
    let [r, g, b] = [0, 1, 2].map(|c| u32::from(pixel[c]));
    ((54 * r + 183 * g + 19 * b + 128) >> 8) as u8
}

/// The colour at `(x, y)` of `[H, W, channels]`.
pub(super) fn color_at(data: &[u8], [width, height]: [u32; 2], channels: u32, x: f32, y: f32) -> [u8; 3] {
    let at = |v: f32, side: u32| (v as usize).min(side as usize - 1);
    let pixel = at(y, height) * width as usize + at(x, width);
    let from = pixel * channels as usize;
    [0, 1, 2].map(|c| data[from + c])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn features_saved_while_others_are_extracted_are_reused() {
        let out = tempfile::tempdir().unwrap();
        let folder = PhotoFolder::default();
        let progress = |_: PoseProgress| ();
        let mut work = Work::new(None, Some(out.path()), &folder, &progress);
        work.stored
            .photos
            .extend([7, 3].map(|hash| (hash, PhotoFeatures::default())));
        work.save().unwrap();
        let again = Work::new(None, Some(out.path()), &folder, &progress);
        assert_eq!(again.stored, work.stored);
    }
}
