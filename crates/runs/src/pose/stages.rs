//! Features and matches, with those of an earlier call.

use super::store::{Looks, Store};
use super::{PoseInput, PoseProgress};
use crate::RunError;
use irradia_formats::{PhotoEntry, PhotoFolder, Pixels};
use irradia_sfm::features::{Extractor, GreyPhoto, Sift};
use irradia_sfm::matching::{MatchOptions, PairOptions, candidate_pairs, match_pairs};
use irradia_sfm::{Features, PairMatches};
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

/// The file of features and matches.
const STORE: &str = "features.bin";

/// The photographs on their way to matches.
pub(super) struct Work<'a> {
    folder: &'a PhotoFolder,
    progress: &'a (dyn Fn(PoseProgress) + Sync),
    path: PathBuf,
    sift: Sift,
    store: Store,
    /// Indices of the folder's photographs that could be decoded.
    used: Vec<usize>,
    features: Vec<Features>,
    colors: Vec<Vec<[u8; 3]>>,
    /// Names of the others, and why.
    undecodable: Vec<(String, String)>,
    warnings: Vec<String>,
}

impl<'a> Work<'a> {
    pub fn new(input: &PoseInput, folder: &'a PhotoFolder, progress: &'a (dyn Fn(PoseProgress) + Sync)) -> Self {
        let sift = Sift {
            max_features: input.max_features,
            ..Sift::default()
        };
        let path = input.out.join(STORE);
        let settings = [
            sift.max_side,
            sift.max_features as u32,
            sift.peak_threshold.to_bits(),
            sift.edge_threshold.to_bits(),
        ];
        let (store, warning) = Store::read(&path, settings);
        let mut work = Self {
            folder,
            progress,
            path,
            sift,
            store,
            used: Vec::new(),
            features: Vec::new(),
            colors: Vec::new(),
            undecodable: Vec::new(),
            warnings: Vec::new(),
        };
        work.warn(warning);
        work
    }

    fn warn(&mut self, warning: Option<String>) {
        if let Some(warning) = warning {
            (self.progress)(PoseProgress::Warned(warning.clone()));
            self.warnings.push(warning);
        }
    }

    /// Indices of the folder's photographs that have features, which is the order of everything below.
    pub fn photos(&self) -> &[usize] {
        &self.used
    }

    pub fn features(&self) -> &[Features] {
        &self.features
    }

    /// The colour at each keypoint, by photograph.
    pub fn colors(&self) -> &[Vec<[u8; 3]>] {
        &self.colors
    }

    pub fn undecodable(&self) -> &[(String, String)] {
        &self.undecodable
    }

    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Features of all photographs, those that are not known yet in parallel.
    pub fn find_features(&mut self) -> Result<(), RunError> {
        let photos = &self.folder.photos;
        (self.progress)(PoseProgress::Stage {
            name: "features",
            of: photos.len(),
        });
        let done = AtomicUsize::new(0);
        let found: Vec<Result<Option<Looks>, String>> = photos
            .par_iter()
            .map(|photo| {
                let looks = match self.store.looks.contains_key(&photo.hash) {
                    true => Ok(None),
                    false => extract(&self.sift, photo).map(Some),
                };
                let now = done.fetch_add(1, Ordering::Relaxed) + 1;
                (self.progress)(PoseProgress::Done(now));
                looks
            })
            .collect();
        let mut is_new = false;
        for (i, (photo, looks)) in photos.iter().zip(found).enumerate() {
            match looks {
                Ok(new) => {
                    is_new |= new.is_some();
                    self.store.looks.extend(new.map(|looks| (photo.hash, looks)));
                    self.used.push(i);
                }
                Err(reason) => self.undecodable.push((photo.name.clone(), reason)),
            }
        }
        self.store.keep_only(photos.iter().map(|photo| photo.hash));
        if is_new {
            self.store.write(&self.path)?;
        }
        for i in &self.used {
            let looks = &self.store.looks[&photos[*i].hash];
            self.features.push(looks.features.clone());
            self.colors.push(looks.colors.clone());
        }
        Ok(())
    }

    /// Matches of the pairs worth it, those that are not known yet in parallel.
    pub fn match_pairs(&mut self, options: &PairOptions) -> Result<Vec<PairMatches>, RunError> {
        let matching = MatchOptions::default();
        let pairs = candidate_pairs(&self.features, options, &matching);
        let hash = |pair: &[u32; 2]| pair.map(|i| self.folder.photos[self.used[i as usize]].hash);
        let new: Vec<[u32; 2]> = pairs
            .iter()
            .filter(|pair| !self.store.matches.contains_key(&hash(pair)))
            .copied()
            .collect();
        (self.progress)(PoseProgress::Stage {
            name: "matches",
            of: new.len(),
        });
        let done = AtomicUsize::new(0);
        let found = match_pairs(&self.features, &new, &matching, || {
            let now = done.fetch_add(1, Ordering::Relaxed) + 1;
            (self.progress)(PoseProgress::Done(now));
        });
        let found: HashMap<[u64; 2], Vec<[u32; 2]>> = found
            .into_iter()
            .map(|pair| (hash(&pair.photos), pair.matches))
            .collect();
        let is_new = !found.is_empty();
        let all = pairs
            .iter()
            .map(|photos| {
                let key = hash(photos);
                let matches = found.get(&key).or_else(|| self.store.matches.get(&key));
                PairMatches {
                    photos: *photos,
                    matches: matches.cloned().unwrap_or_default(),
                }
            })
            .collect();
        self.store.matches.extend(found);
        if is_new {
            self.store.write(&self.path)?;
        }
        Ok(all)
    }
}

/// Features of a photograph, in its pixels at full size, and the colours there.
fn extract(sift: &Sift, photo: &PhotoEntry) -> Result<Looks, String> {
    let pixels = photo.read(sift.max_side).map_err(|error| error.to_string())?;
    let grey: Vec<u8> = pixels.data.chunks_exact(pixels.channels as usize).map(luma).collect();
    let mask: Option<Vec<u8>> =
        (pixels.channels == 4).then(|| pixels.data.chunks_exact(4).map(|pixel| pixel[3]).collect());
    let features = sift.extract(&GreyPhoto {
        width: pixels.width,
        height: pixels.height,
        data: &grey,
        mask: mask.as_deref(),
    });
    let colors = features.keypoints.iter().map(|k| color_at(&pixels, k.x, k.y)).collect();
    let enlarge = [
        photo.width as f32 / pixels.width as f32,
        photo.height as f32 / pixels.height as f32,
    ];
    Ok(Looks {
        features: features.scaled(enlarge),
        colors,
    })
}

/// Brightness of a pixel of 3 or 4 channels, with the weights of BT.709 in 1/256.
fn luma(pixel: &[u8]) -> u8 {
    let [r, g, b] = [0, 1, 2].map(|c| u32::from(pixel[c]));
    ((54 * r + 183 * g + 19 * b + 128) >> 8) as u8
}

fn color_at(pixels: &Pixels, x: f32, y: f32) -> [u8; 3] {
    let at = |v: f32, side: u32| (v as usize).min(side as usize - 1);
    let pixel = at(y, pixels.height) * pixels.width as usize + at(x, pixels.width);
    let from = pixel * pixels.channels as usize;
    [0, 1, 2].map(|c| pixels.data[from + c])
}
