//! Features and matches on disk, keyed by the hash of the photographs' bytes: renamed photographs keep theirs, changed ones lose them.
//!
//! Little-endian: the signature; the settings; u64 number of photographs, each with u64 hash, five `f32` of its appearance, u64 number of
//! features, each with `f32 x, y, scale, angle`, the descriptor, the frontal descriptor if there are any, and `r, g, b`; u64 number of
//! pairs, each with the hashes of both photographs, u64 number of matches, each `u32, u32`.

use irradia_formats::{FormatError, write_atomic};
use irradia_sfm::doctor::Appearance;
use irradia_sfm::{DESCRIPTOR_BYTES, Features, Keypoint};
use std::collections::HashMap;
use std::io::{self, Write};
use std::path::Path;

/// Ends in the version of everything besides the settings on which features and matches depend.
const SIGNATURE: &[u8; 16] = b"irradia.sfm 0004";
/// What features depend on: the settings of their extractor, and whether they have frontal descriptors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Settings {
    pub extractor: [u32; 4],
    pub frontal: bool,
}

impl Settings {
    fn header(self) -> Vec<u8> {
        let settings = self.extractor.into_iter().chain([self.frontal.into()]);
        let settings = settings.flat_map(u32::to_le_bytes);
        SIGNATURE.iter().copied().chain(settings).collect()
    }

    /// Size of a feature, bytes.
    fn feature_bytes(self) -> usize {
        16 + DESCRIPTOR_BYTES * (1 + usize::from(self.frontal)) + 3
    }
}

/// The features of a photograph, their colours, and statistics of its pixels.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct PhotoFeatures {
    /// In pixels at full size.
    pub features: Features,
    /// `[N]`
    pub colors: Vec<[u8; 3]>,
    pub appearance: Appearance,
}

/// The results of an earlier call.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct StoredFeatures {
    /// By the photograph's hash.
    pub photos: HashMap<u64, PhotoFeatures>,
    /// By the hashes of both photographs.
    pub matches: HashMap<[u64; 2], Vec<[u32; 2]>>,
}

/// The content of the file at `path` if it was written with the same `settings`, otherwise nothing; and a warning if it is damaged.
pub(super) fn read(path: &Path, settings: Settings) -> (StoredFeatures, Option<String>) {
    let Ok(bytes) = std::fs::read(path) else {
        return Default::default();
    };
    let Some(rest) = bytes.strip_prefix(&settings.header()[..]) else {
        return Default::default();
    };
    match parse(rest, settings) {
        Some(stored) => (stored, None),
        None => (
            StoredFeatures::default(),
            Some(format!("{} is damaged; features are extracted again", path.display())),
        ),
    }
}

/// The hash of a photograph, its features, their colours, and its pixel statistics.
pub(super) type Photo<'a> = (u64, &'a Features, &'a [[u8; 3]], Appearance);

/// Writes photographs and the matches between them.
pub(super) fn write(
    path: &Path,
    settings: Settings,
    photos: &[Photo],
    matches: &HashMap<[u64; 2], Vec<[u32; 2]>>,
) -> Result<(), FormatError> {
    write_atomic(path, |out| {
        out.write_all(&settings.header())?;
        write_u64(out, photos.len() as u64)?;
        for (hash, features, colors, appearance) in photos {
            write_u64(out, *hash)?;
            for value in appearance.to_array() {
                out.write_all(&value.to_le_bytes())?;
            }
            write_u64(out, colors.len() as u64)?;
            for (i, (k, color)) in features.keypoints.iter().zip(*colors).enumerate() {
                for value in [k.x, k.y, k.scale, k.angle] {
                    out.write_all(&value.to_le_bytes())?;
                }
                out.write_all(&features.descriptors[i])?;
                if settings.frontal {
                    out.write_all(&features.frontal[i])?;
                }
                out.write_all(color)?;
            }
        }
        let mut matches: Vec<_> = matches.iter().collect();
        matches.sort_unstable_by_key(|(pair, _)| **pair);
        write_u64(out, matches.len() as u64)?;
        for (pair, matches) in matches {
            write_u64(out, pair[0])?;
            write_u64(out, pair[1])?;
            write_u64(out, matches.len() as u64)?;
            for index in matches.iter().flatten() {
                out.write_all(&index.to_le_bytes())?;
            }
        }
        Ok(())
    })
}

fn write_u64(out: &mut dyn Write, value: u64) -> io::Result<()> {
    out.write_all(&value.to_le_bytes())
}

/// What follows the header; `None` if it is damaged.
fn parse(mut bytes: &[u8], settings: Settings) -> Option<StoredFeatures> {
    let mut stored = StoredFeatures::default();
    for _ in 0..take_u64(&mut bytes)? {
        let hash = take_u64(&mut bytes)?;
        let values = take_bytes(&mut bytes, 20)?.as_chunks::<4>().0;
        let values: [f32; 5] = std::array::from_fn(|i| f32::from_le_bytes(values[i]));
        let count = usize::try_from(take_u64(&mut bytes)?).ok()?;
        let mut photo = PhotoFeatures {
            appearance: Appearance::from_array(values),
            ..PhotoFeatures::default()
        };
        let size = settings.feature_bytes();
        for feature in take_bytes(&mut bytes, count.checked_mul(size)?)?.chunks_exact(size) {
            let (place, rest) = feature.split_at(16);
            let value = |i: usize| f32::from_le_bytes(place[4 * i..][..4].try_into().expect("4 bytes"));
            let [x, y, scale, angle] = [0, 1, 2, 3].map(value);
            photo.features.keypoints.push(Keypoint { x, y, scale, angle });
            photo.features.descriptors.push(*rest.first_chunk()?);
            if settings.frontal {
                photo.features.frontal.push(*rest[DESCRIPTOR_BYTES..].first_chunk()?);
            }
            photo.colors.push(*rest.last_chunk()?);
        }
        stored.photos.insert(hash, photo);
    }
    for _ in 0..take_u64(&mut bytes)? {
        let pair = [take_u64(&mut bytes)?, take_u64(&mut bytes)?];
        let count = usize::try_from(take_u64(&mut bytes)?).ok()?;
        let counts = pair.map(|hash| stored.photos.get(&hash).map_or(0, |photo| photo.colors.len()));
        let matches: Vec<[u32; 2]> = take_bytes(&mut bytes, count.checked_mul(8)?)?
            .as_chunks::<8>()
            .0
            .iter()
            .map(|m| [[m[0], m[1], m[2], m[3]], [m[4], m[5], m[6], m[7]]].map(u32::from_le_bytes))
            .collect();
        if !matches
            .iter()
            .all(|m| (m[0] as usize) < counts[0] && (m[1] as usize) < counts[1])
        {
            return None;
        }
        stored.matches.insert(pair, matches);
    }
    bytes.is_empty().then_some(stored)
}

fn take_bytes<'a>(bytes: &mut &'a [u8], count: usize) -> Option<&'a [u8]> {
    let (taken, rest) = bytes.split_at_checked(count)?;
    *bytes = rest;
    Some(taken)
}

fn take_u64(bytes: &mut &[u8]) -> Option<u64> {
    Some(u64::from_le_bytes(*take_bytes(bytes, 8)?.first_chunk()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: Settings = Settings {
        extractor: [1, 2, 3, 4],
        frontal: false,
    };

    fn photo(n: u8) -> PhotoFeatures {
        let keypoint = |i: u8| Keypoint {
            x: i.into(),
            y: 0.5,
            scale: 2.0,
            angle: -1.0,
        };
        PhotoFeatures {
            features: Features {
                keypoints: (0..n).map(keypoint).collect(),
                descriptors: (0..n).map(|i| [i; DESCRIPTOR_BYTES]).collect(),
                frontal: Vec::new(),
            },
            colors: (0..n).map(|i| [i, 1, 2]).collect(),
            appearance: Appearance::from_array([0.1, 0.5, 0.0, f32::from(n), 0.2]),
        }
    }

    fn stored() -> StoredFeatures {
        StoredFeatures {
            photos: HashMap::from([(7, photo(3)), (u64::MAX, photo(2)), (8, photo(0))]),
            matches: HashMap::from([([7, u64::MAX], vec![[0, 1], [2, 0]]), ([7, 8], Vec::new())]),
        }
    }

    fn save(path: &Path, settings: Settings, stored: &StoredFeatures) {
        let photos: Vec<Photo> = (stored.photos.iter())
            .map(|(hash, photo)| (*hash, &photo.features, &photo.colors[..], photo.appearance))
            .collect();
        write(path, settings, &photos, &stored.matches).unwrap();
    }

    #[test]
    fn what_is_written_is_read_back_under_the_same_settings_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("features.bin");
        save(&path, SETTINGS, &stored());
        assert_eq!(read(&path, SETTINGS), (stored(), None));
        let mut other = SETTINGS;
        other.extractor[3] = 5;
        let frontal = Settings {
            frontal: true,
            ..SETTINGS
        };
        for other in [other, frontal] {
            assert_eq!(read(&path, other), Default::default());
        }
        assert_eq!(read(&folder.path().join("none"), SETTINGS), Default::default());

        let mut seen_from_the_front = stored();
        for photo in seen_from_the_front.photos.values_mut() {
            let of = photo.features.descriptors.iter();
            photo.features.frontal = of.map(|descriptor| descriptor.map(|byte| byte + 100)).collect();
        }
        save(&path, frontal, &seen_from_the_front);
        assert_eq!(read(&path, frontal), (seen_from_the_front, None));
    }

    #[test]
    fn damage_is_noticed_and_forgotten() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("features.bin");
        save(&path, SETTINGS, &stored());
        let whole = std::fs::read(&path).unwrap();
        for length in SETTINGS.header().len()..whole.len() {
            std::fs::write(&path, &whole[..length]).unwrap();
            let (read, warning) = read(&path, SETTINGS);
            assert_eq!(read, StoredFeatures::default(), "{length}");
            assert!(warning.is_some_and(|line| line.contains("damaged")), "{length}");
        }
        // A match with a feature that does not exist.
        let mut broken = stored();
        broken.matches.insert([8, 7], vec![[0, 0]]);
        save(&path, SETTINGS, &broken);
        assert!(read(&path, SETTINGS).1.is_some());
    }
}
