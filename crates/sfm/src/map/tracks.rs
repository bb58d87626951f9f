//! Tracks: keypoints in different photographs that show the same point, joined by verified matches.

use super::types::{PairKind, VerifiedPair};
use crate::Features;
use glam::DVec2;

/// A photograph with at least this many tracks over three or more photographs needs no tracks over two.
const MIN_LONG_TRACKS: usize = 200;

/// A keypoint of a track.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Observation {
    /// The photograph.
    pub photo: u32,
    /// Its keypoint.
    pub keypoint: u32,
}

/// All tracks; each has at most one observation per photograph.
#[derive(Clone, Debug, Default)]
pub struct Tracks {
    /// `[T + 1]` where the observations of each track begin.
    pub starts: Vec<u32>,
    /// Observations, sorted by track, within a track by photograph.
    pub observations: Vec<Observation>,
    /// The track of each observation.
    pub track_of: Vec<u32>,
    /// The pixel of each observation.
    pub pixels: Vec<DVec2>,
    /// `[photos]` the observations in each photograph, ascending.
    pub of_photo: Vec<Vec<u32>>,
}

impl Tracks {
    /// Joins matches, starting with the pairs with most matches; a match that would bring two keypoints of one photograph into
    /// a track is dropped: it, or an earlier one, is wrong.
    ///
    /// Tracks over two photographs contribute least and are wrong most often, so only photographs with few other tracks have them.
    pub fn new(features: &[Features], pairs: &[VerifiedPair]) -> Self {
        let mut tracks = join_matches(features, pairs);
        let mut long_tracks = vec![0usize; features.len()];
        for member in tracks.iter().filter(|m| m.len() > 2).flatten() {
            long_tracks[member.photo as usize] += 1;
        }
        tracks.retain(|m| {
            m.len() > 2
                || m.iter()
                    .any(|member| long_tracks[member.photo as usize] < MIN_LONG_TRACKS)
        });
        Self::from_members(features, tracks)
    }

    /// Like [`Self::new`], with all tracks over two photographs.
    pub fn complete(features: &[Features], pairs: &[VerifiedPair]) -> Self {
        Self::from_members(features, join_matches(features, pairs))
    }

    fn from_members(features: &[Features], members: Vec<Vec<Observation>>) -> Self {
        let mut tracks = Self {
            starts: vec![0],
            of_photo: vec![Vec::new(); features.len()],
            ..Self::default()
        };
        for (track, members) in members.into_iter().enumerate() {
            for member in members {
                let keypoint = &features[member.photo as usize].keypoints[member.keypoint as usize];
                tracks.of_photo[member.photo as usize].push(tracks.observations.len() as u32);
                tracks.observations.push(member);
                tracks.track_of.push(track as u32);
                tracks.pixels.push(keypoint.at());
            }
            tracks.starts.push(tracks.observations.len() as u32);
        }
        tracks
    }

    /// Number of tracks.
    pub fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// Indices of the observations of `track`.
    pub fn range(&self, track: usize) -> std::ops::Range<usize> {
        self.starts[track] as usize..self.starts[track + 1] as usize
    }
}

/// The observations of each track, sorted by photograph; tracks are in the order of their first observation.
fn join_matches(features: &[Features], pairs: &[VerifiedPair]) -> Vec<Vec<Observation>> {
    // Keypoints at the same position (a blob with two orientations) are one node.
    let mut first_node = vec![0u32];
    let mut node_of: Vec<Vec<u32>> = Vec::new();
    for features in features {
        let mut order: Vec<u32> = (0..features.keypoints.len() as u32).collect();
        let place = |i: u32| {
            let k = &features.keypoints[i as usize];
            (k.x.to_bits(), k.y.to_bits())
        };
        order.sort_by_key(|i| (place(*i), *i));
        let mut canonical: Vec<u32> = (0..features.keypoints.len() as u32).collect();
        for pair in order.windows(2) {
            if place(pair[0]) == place(pair[1]) {
                canonical[pair[1] as usize] = canonical[pair[0] as usize];
            }
        }
        let base = *first_node.last().expect("starts with zero");
        first_node.push(base + canonical.len() as u32);
        node_of.push(canonical.into_iter().map(|c| base + c).collect());
    }
    let nodes = *first_node.last().expect("starts with zero") as usize;
    let mut sets = DisjointSets::new(nodes);
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    // Rotation-only pairs come last: their wrong matches are the hardest to notice.
    order.sort_by_key(|i| {
        let pair = &pairs[*i];
        (
            pair.kind == PairKind::Rotation,
            std::cmp::Reverse(pair.matches.len()),
            pair.photos,
        )
    });
    for pair in order.into_iter().map(|i| &pairs[i]) {
        let [a, b] = pair.photos;
        for [i, j] in &pair.matches {
            let (i, j) = (node_of[a as usize][*i as usize], node_of[b as usize][*j as usize]);
            sets.join((i, a), (j, b));
        }
    }
    // Members are visited by photograph, so tracks are in the order of their first node.
    let nodes = *first_node.last().expect("starts with zero");
    let mut track_of_root = vec![u32::MAX; nodes as usize];
    let mut members: Vec<Vec<Observation>> = Vec::new();
    for (photo, bounds) in first_node.windows(2).enumerate() {
        for node in bounds[0]..bounds[1] {
            let root = sets.find(node);
            if sets.photos[root as usize].len() < 2 {
                continue;
            }
            let track = &mut track_of_root[root as usize];
            if *track == u32::MAX {
                *track = members.len() as u32;
                members.push(Vec::new());
            }
            members[*track as usize].push(Observation {
                photo: photo as u32,
                keypoint: node - bounds[0],
            });
        }
    }
    members
}

/// Disjoint sets of nodes with the photographs of each set.
struct DisjointSets {
    parent: Vec<u32>,
    /// Per root: photographs, ascending; empty for a single node.
    photos: Vec<Vec<u32>>,
}

impl DisjointSets {
    fn new(nodes: usize) -> Self {
        Self {
            parent: (0..nodes as u32).collect(),
            photos: vec![Vec::new(); nodes],
        }
    }

    fn find(&mut self, mut node: u32) -> u32 {
        while self.parent[node as usize] != node {
            let up = self.parent[self.parent[node as usize] as usize];
            self.parent[node as usize] = up;
            node = up;
        }
        node
    }

    fn join(&mut self, (a, photo_a): (u32, u32), (b, photo_b): (u32, u32)) {
        let (root_a, root_b) = (self.find(a), self.find(b));
        if root_a == root_b {
            return;
        }
        for (root, photo) in [(root_a, photo_a), (root_b, photo_b)] {
            if self.photos[root as usize].is_empty() {
                self.photos[root as usize].push(photo);
            }
        }
        let (larger, smaller) = if self.photos[root_a as usize].len() >= self.photos[root_b as usize].len() {
            (root_a as usize, root_b as usize)
        } else {
            (root_b as usize, root_a as usize)
        };
        if self.photos[smaller]
            .iter()
            .any(|p| self.photos[larger].binary_search(p).is_ok())
        {
            return;
        }
        for photo in std::mem::take(&mut self.photos[smaller]) {
            let at = self.photos[larger].partition_point(|p| *p < photo);
            self.photos[larger].insert(at, photo);
        }
        self.parent[smaller] = larger as u32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Keypoint;
    use crate::geometry::essential::Motion;
    use glam::{DQuat, DVec3};

    fn features(places: &[f32]) -> Features {
        let keypoints = places
            .iter()
            .map(|x| Keypoint {
                x: *x,
                y: 0.0,
                scale: 1.0,
                angle: 0.0,
            })
            .collect();
        Features {
            keypoints,
            ..Features::default()
        }
    }

    fn pair(photos: [u32; 2], matches: &[[u32; 2]]) -> VerifiedPair {
        VerifiedPair {
            photos,
            matches: matches.to_vec(),
            kind: PairKind::General,
            motion: Motion {
                rotation: DQuat::IDENTITY,
                translation: DVec3::X,
            },
            angle: 0.1,
        }
    }

    #[test]
    fn matches_join_over_photographs_and_conflicts_are_refused() {
        let all = [
            features(&[1.0, 2.0, 3.0]),
            features(&[4.0, 5.0]),
            features(&[6.0, 7.0, 6.0]),
        ];
        let pairs = [
            pair([0, 1], &[[0, 0], [1, 1]]),
            // Keypoint 2 of the last photograph is its keypoint 0 with another orientation.
            pair([1, 2], &[[0, 2], [1, 1]]),
            // Would join keypoints 0 and 1 of the first photograph.
            pair([0, 2], &[[1, 0]]),
        ];
        let tracks = Tracks::new(&all, &pairs);
        assert_eq!(tracks.len(), 2);
        let members = |track| {
            tracks.observations[tracks.range(track)]
                .iter()
                .map(|o| (o.photo, o.keypoint))
                .collect::<Vec<_>>()
        };
        assert_eq!(members(0), [(0, 0), (1, 0), (2, 0)]);
        assert_eq!(members(1), [(0, 1), (1, 1), (2, 1)]);
        assert_eq!(tracks.of_photo[1], [1, 4]);
        assert_eq!(tracks.pixels[2], DVec2::new(6.0, 0.0));
        assert_eq!(tracks.track_of, [0, 0, 0, 1, 1, 1]);
    }
}
