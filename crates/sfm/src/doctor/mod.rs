//! The capture doctor: the faults of a set of photographs, in plain sentences with evidence.
//!
//! [`diagnose`] examines pixels, features, pairs and, if there is one, the model. Every diagnosis is a pure function in the file
//! of its family; thresholds are constants beside it, measured by the example `doctor` on damaged and on clean captures.

mod appearance;
mod consistency;
mod lens;
mod missing;
mod motion;
mod moving;
mod overlap;
mod quality;
mod ring;
mod rotation_averaging;
mod shots;
mod types;

pub use appearance::Appearance;
pub use consistency::{Consistency, consistency};
pub use rotation_averaging::{GlobalRotations, average_rotations};
pub use shots::{Shot, shots};
pub use types::{Diagnosis, Kind};

use crate::map::{
    GroupCamera, LeftOut, MissingMatches, Model, PairKind, PhotoInfo, Reason, StillRegion, VerifiedPair, Zoom, rigs,
};
use crate::{Features, PairMatches, connected_components};
use std::collections::BTreeMap;

/// Everything that is known about a capture. All lists by photograph have the same order.
#[derive(Clone, Copy, Debug)]
pub struct Evidence<'a> {
    /// `[photos]`
    pub photos: &'a [PhotoInfo],
    /// `[photos]` measurements of the pixels.
    pub appearances: &'a [Appearance],
    /// `[photos]`
    pub features: &'a [Features],
    /// `[photos]` the colour at each keypoint.
    pub colors: &'a [Vec<[u8; 3]>],
    /// Pairs before verification.
    pub matches: &'a [PairMatches],
    /// What stood still before it was masked, if it was; `features` and `matches` are then without it.
    pub masked: Option<&'a StillRegion>,
    /// Pairs after verification.
    pub pairs: &'a [VerifiedPair],
    /// `[groups]` the camera of each group before any adjustment.
    pub cameras: &'a [GroupCamera],
    /// The models, largest first, if the photographs were mapped.
    pub models: &'a [Model],
    /// Focal lengths that are not in the metadata and that the mapper found.
    pub zooms: &'a [Zoom],
    /// Whether the mapper gave each photograph its own camera.
    pub own_focals: bool,
    /// Photographs that should share points of a model and do not.
    pub missing: &'a [MissingMatches],
    /// Number of models into which the mapper split the first model because of missing matches, if it did.
    pub split_models: Option<usize>,
    /// Photographs without a pose and the reasons, if the photographs were mapped.
    pub left_out: &'a [LeftOut],
}

impl<'a> Evidence<'a> {
    /// The largest model.
    fn model(&self) -> Option<&'a Model> {
        self.models.first()
    }
}

/// The partners of each photograph.
struct Graph {
    /// `[photos]` partner and index of the pair, most matches first.
    partners: Vec<Vec<(usize, usize)>>,
    /// `[photos]` the photographs on the same rig, or the photograph alone.
    rigs: Vec<Vec<usize>>,
}

/// Minimum number of matches of a pair that connects photographs. COLMAP accepts 15, but among thousands of pairs chance alone reaches
/// up to 20.
const MIN_LINK_MATCHES: usize = 25;

impl Graph {
    /// The graph of all pairs with at least `min_matches` matches.
    fn new(evidence: &Evidence, min_matches: usize) -> Self {
        let pairs = evidence.pairs;
        let mut partners = vec![Vec::new(); evidence.photos.len()];
        for (i, pair) in pairs
            .iter()
            .enumerate()
            .filter(|(_, pair)| pair.matches.len() >= min_matches)
        {
            let [a, b] = pair.photos.map(|p| p as usize);
            partners[a].push((b, i));
            partners[b].push((a, i));
        }
        for partners in &mut partners {
            partners.sort_by_key(|(photo, i)| (std::cmp::Reverse(pairs[*i].matches.len()), *photo));
        }
        let rigs = rigs(evidence.photos);
        Self { partners, rigs }
    }

    /// Whether a photograph is on a rig, where the others on it make up for what it lacks.
    fn is_on_rig(&self, photo: usize) -> bool {
        self.rigs[photo].len() > 1
    }

    /// The partners of a photograph, and those on its rig.
    fn linked(&self, photo: usize) -> impl Iterator<Item = usize> {
        let partners = self.partners[photo].iter().map(|p| p.0);
        partners.chain(self.rigs[photo].iter().copied())
    }

    /// Photographs in connected parts, largest first.
    fn components(&self) -> Vec<Vec<usize>> {
        connected_components(self.partners.len(), |photo| self.linked(photo))
    }
}

/// All faults of a capture, the most serious first.
///
/// # Panics
/// When lengths or indices in `evidence` are inconsistent.
pub fn diagnose(evidence: &Evidence) -> Vec<Diagnosis> {
    let n = evidence.photos.len();
    assert!(
        [
            evidence.appearances.len(),
            evidence.features.len(),
            evidence.colors.len()
        ] == [n; 3]
    );
    if n == 0 {
        return Vec::new();
    }
    let graph = Graph::new(evidence, MIN_LINK_MATCHES);
    let (still, duplicates) = motion::still_and_duplicates(evidence);
    let (moving, moving_pairs) = if still.is_empty() {
        moving::moving(evidence)
    } else {
        Default::default()
    };
    let rotation_only = motion::rotation_only(evidence, &graph, &moving_pairs);
    let quality = [
        quality::blurred(evidence, &graph),
        quality::exposure(evidence, &graph),
        quality::few_features(evidence, &graph),
    ]
    .concat();
    let lens = [
        lens::settings(evidence),
        lens::zoom(evidence),
        lens::own_focals(evidence),
        lens::cropped(evidence),
        lens::focal_unknown(evidence),
    ]
    .concat();
    let overlap = overlap::overlap(evidence, &graph);
    let ring = match evidence.model() {
        Some(_) => ring::ring(evidence, &graph, &[]),
        None => {
            let found = consistency(evidence.photos, evidence.features, evidence.cameras, evidence.pairs);
            if found.is_consistent() {
                ring::ring(evidence, &graph, &found.rotations.world_from_camera)
            } else {
                Vec::new()
            }
        }
    };
    let contradiction =
        consistency::contradiction(evidence, &moving.iter().flat_map(Diagnosis::photos).collect::<Vec<_>>());
    let other_motion = consistency::other_motion(evidence).into_iter().collect();
    let known = [
        contradiction,
        other_motion,
        missing::missing(evidence),
        rotation_only,
        motion::rotation_between_models(evidence),
        still,
        overlap,
        ring,
        lens,
        quality,
        moving,
        duplicates,
    ]
    .concat();
    let left_out = left_out(evidence, &known);
    [left_out, known].concat()
}

/// One reason for each photograph without a pose: the doctor's diagnosis if there is one, else the mapper's reason.
fn left_out(evidence: &Evidence, known: &[Diagnosis]) -> Vec<Diagnosis> {
    let mut causes: BTreeMap<usize, String> = BTreeMap::new();
    for diagnosis in known {
        let cause = match diagnosis {
            Diagnosis::Blurred { times, .. } => {
                format!("it is blurred, {times:.1} times less sharp than its neighbours")
            }
            Diagnosis::ExposureJump { stops, .. } => format!(
                "it is {:.1} stops {} than its neighbours",
                stops.abs(),
                if *stops > 0.0 { "brighter" } else { "darker" }
            ),
            Diagnosis::Clipped { fraction, bright, .. } => format!(
                "{:.0} % of it is {} without detail",
                100.0 * fraction,
                if *bright { "white" } else { "black" }
            ),
            Diagnosis::FewFeatures { features, .. } => format!("only {features} features: it shows little texture"),
            Diagnosis::Hidden { fraction, .. } => format!("{:.0} % of it is masked or transparent", 100.0 * fraction),
            Diagnosis::Zoom { ratio, .. } => format!("it has {ratio:.2} times the focal length of the others"),
            _ => continue,
        };
        for photo in diagnosis.photos() {
            causes.entry(photo).or_insert_with(|| cause.clone());
        }
    }
    evidence
        .left_out
        .iter()
        .map(|left| Diagnosis::LeftOut {
            photo: left.photo,
            // A photograph from the same place as all its partners may be fine in itself: the mapper's reason counts.
            reason: match (causes.get(&left.photo), left.reason) {
                (_, Reason::RotationOnly { .. }) | (None, _) => left.reason.to_string(),
                (Some(cause), _) => cause.clone(),
            },
        })
        .collect()
}

/// Whether the pair is a turn on the spot.
fn is_pure_rotation(pair: &VerifiedPair) -> bool {
    pair.kind == PairKind::Rotation
}
