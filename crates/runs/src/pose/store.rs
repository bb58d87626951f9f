//! Features and matches on disk, by the hash of the photographs' bytes: renamed photographs keep theirs, changed ones lose them.
//!
//! Little-endian: the signature; the settings; u64 photographs, each u64 hash, u64 features, each `f32 x, y, scale, angle`, the
//! descriptor and `r, g, b`; u64 pairs, each the hashes of both photographs, u64 matches, each `u32, u32`.

use irradia_formats::{FormatError, write_atomic};
use irradia_sfm::{DESCRIPTOR_BYTES, Features, Keypoint};
use std::collections::{BTreeMap, HashMap, HashSet};
use std::io::{self, Write};
use std::path::Path;

/// Ends in the version of everything that features and matches depend on beside the settings.
const SIGNATURE: &[u8; 16] = b"irradia.sfm 0001";
/// Bytes of a feature.
const FEATURE: usize = 16 + DESCRIPTOR_BYTES + 3;

/// The features of a photograph, and the colours there.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Looks {
    /// In pixels at full size.
    pub features: Features,
    /// `[N]`
    pub colors: Vec<[u8; 3]>,
}

/// What is known from earlier.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Store {
    settings: [u32; 4],
    /// By the photograph's hash.
    pub looks: BTreeMap<u64, Looks>,
    /// By the hashes of both photographs.
    pub matches: HashMap<[u64; 2], Vec<[u32; 2]>>,
}

impl Store {
    /// The content of the file at `path` if it has the same `settings`, else nothing; a warning if it is damaged.
    pub fn read(path: &Path, settings: [u32; 4]) -> (Self, Option<String>) {
        let mut store = Self {
            settings,
            looks: BTreeMap::new(),
            matches: HashMap::new(),
        };
        let Ok(bytes) = std::fs::read(path) else {
            return (store, None);
        };
        let known: Vec<u8> = SIGNATURE
            .iter()
            .copied()
            .chain(settings.into_iter().flat_map(u32::to_le_bytes))
            .collect();
        let Some(rest) = bytes.strip_prefix(&known[..]) else {
            return (store, None);
        };
        if parse(rest, &mut store).is_none() {
            store.looks.clear();
            store.matches.clear();
            let warning = format!("{} is damaged; features are found again", path.display());
            return (store, Some(warning));
        }
        (store, None)
    }

    /// Forgets all other photographs.
    pub fn keep_only(&mut self, hashes: impl Iterator<Item = u64>) {
        let kept: HashSet<u64> = hashes.collect();
        self.looks.retain(|hash, _| kept.contains(hash));
        self.matches
            .retain(|pair, _| pair.iter().all(|hash| kept.contains(hash)));
    }

    pub fn write(&self, path: &Path) -> Result<(), FormatError> {
        write_atomic(path, |out| self.write_to(out))
    }

    fn write_to(&self, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(SIGNATURE)?;
        for setting in self.settings {
            out.write_all(&setting.to_le_bytes())?;
        }
        let write_u64 = |out: &mut dyn Write, value: u64| out.write_all(&value.to_le_bytes());
        write_u64(out, self.looks.len() as u64)?;
        for (hash, Looks { features, colors }) in &self.looks {
            write_u64(out, *hash)?;
            write_u64(out, colors.len() as u64)?;
            for ((k, descriptor), color) in features.keypoints.iter().zip(&features.descriptors).zip(colors) {
                for value in [k.x, k.y, k.scale, k.angle] {
                    out.write_all(&value.to_le_bytes())?;
                }
                out.write_all(descriptor)?;
                out.write_all(color)?;
            }
        }
        let mut matches: Vec<_> = self.matches.iter().collect();
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
    }
}

/// Fills `store`; `None` if the bytes are damaged.
fn parse(mut bytes: &[u8], store: &mut Store) -> Option<()> {
    for _ in 0..take_u64(&mut bytes)? {
        let hash = take_u64(&mut bytes)?;
        let count = usize::try_from(take_u64(&mut bytes)?).ok()?;
        let mut looks = Looks::default();
        for feature in take(&mut bytes, count.checked_mul(FEATURE)?)?.chunks_exact(FEATURE) {
            let (place, rest) = feature.split_at(16);
            let value = |i: usize| f32::from_le_bytes(place[4 * i..][..4].try_into().expect("4 bytes"));
            let [x, y, scale, angle] = [0, 1, 2, 3].map(value);
            looks.features.keypoints.push(Keypoint { x, y, scale, angle });
            looks.features.descriptors.push(*rest.first_chunk()?);
            looks.colors.push(*rest.last_chunk()?);
        }
        store.looks.insert(hash, looks);
    }
    for _ in 0..take_u64(&mut bytes)? {
        let pair = [take_u64(&mut bytes)?, take_u64(&mut bytes)?];
        let count = usize::try_from(take_u64(&mut bytes)?).ok()?;
        let counts = pair.map(|hash| store.looks.get(&hash).map_or(0, |looks| looks.colors.len()));
        let matches: Vec<[u32; 2]> = take(&mut bytes, count.checked_mul(8)?)?
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
        store.matches.insert(pair, matches);
    }
    bytes.is_empty().then_some(())
}

fn take<'a>(bytes: &mut &'a [u8], count: usize) -> Option<&'a [u8]> {
    let (taken, rest) = bytes.split_at_checked(count)?;
    *bytes = rest;
    Some(taken)
}

fn take_u64(bytes: &mut &[u8]) -> Option<u64> {
    Some(u64::from_le_bytes(*take(bytes, 8)?.first_chunk()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn store() -> Store {
        let looks = |n: u8| Looks {
            features: Features {
                keypoints: (0..n)
                    .map(|i| Keypoint {
                        x: i.into(),
                        y: 0.5,
                        scale: 2.0,
                        angle: -1.0,
                    })
                    .collect(),
                descriptors: (0..n).map(|i| [i; DESCRIPTOR_BYTES]).collect(),
            },
            colors: (0..n).map(|i| [i, 1, 2]).collect(),
        };
        Store {
            settings: [1, 2, 3, 4],
            looks: BTreeMap::from([(7, looks(3)), (u64::MAX, looks(2)), (8, looks(0))]),
            matches: HashMap::from([([7, u64::MAX], vec![[0, 1], [2, 0]]), ([7, 8], Vec::new())]),
        }
    }

    #[test]
    fn what_is_written_is_read_back_under_the_same_settings_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("features.bin");
        let stored = store();
        stored.write(&path).unwrap();
        assert_eq!(Store::read(&path, [1, 2, 3, 4]), (stored, None));
        assert!(Store::read(&path, [1, 2, 3, 5]).0.looks.is_empty());
        assert!(Store::read(&folder.path().join("none"), [0; 4]).0.looks.is_empty());
    }

    #[test]
    fn damage_is_noticed_and_forgotten() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("features.bin");
        store().write(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        for length in 32..whole.len() {
            std::fs::write(&path, &whole[..length]).unwrap();
            let (read, warning) = Store::read(&path, [1, 2, 3, 4]);
            assert!(read.looks.is_empty() && read.matches.is_empty(), "{length}");
            assert!(warning.is_some_and(|line| line.contains("damaged")), "{length}");
        }
        // A match with a feature that does not exist.
        let mut broken = store();
        broken.matches.insert([8, 7], vec![[0, 0]]);
        broken.write(&path).unwrap();
        assert!(Store::read(&path, [1, 2, 3, 4]).1.is_some());
    }

    #[test]
    fn photographs_that_are_gone_are_forgotten_with_their_matches() {
        let mut store = store();
        store.keep_only([7, 8].into_iter());
        assert_eq!(store.looks.keys().collect::<Vec<_>>(), [&7, &8]);
        assert_eq!(store.matches.keys().collect::<Vec<_>>(), [&[7, 8]]);
    }
}
