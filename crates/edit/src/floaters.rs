//! Floaters: splats in empty space. Every score is independent of scale; a splat counts as a floater from a score of 1.
//!
//! The main criterion is support: the spacing of a surface's splats is about their size. In trained scenes the distance to the sixth
//! neighbour is 1.3 to 1.6 times the largest standard deviation in the median, and below 4 times for 95 % of the splats. Splats with
//! support determine the depth that cameras see; a splat without support in front of that depth is in empty space. If cameras are not
//! known, geometry alone decides.

use crate::draft::median;
use crate::opacity_fit::{InitialOpacity, are_needed};
use crate::visibility::{MIN_VISIBLE_WEIGHT, Observer};
use crate::{Draft, LoadedPhotographs, Photographs, Selection};
use irradia_splat::{Nearest, sigmoid};
use rayon::prelude::*;

/// Spacing is the distance to the nearest neighbour of this rank.
const NEIGHBOUR_RANK: usize = 6;
/// Maximum spacing, in units of its size, of a splat that is part of a surface.
const MAX_SURFACE_SPACING: f32 = 2.0;

/// Minimum spacing of an isolated splat, in units of its size.
const MIN_ISOLATED_SIZES: f32 = 12.0;
/// The same in units of the scene's median spacing.
const MIN_ISOLATED_MEDIANS: f32 = 4.0;
/// Minimum ratio of the largest to the middle standard deviation of a needle.
const MIN_NEEDLE_ELONGATION: f32 = 15.0;
/// Minimum size of a needle, relative to the distance of the nearest camera.
const MIN_NEEDLE_SIZE: f32 = 0.1;
/// Minimum size of a huge splat, relative to the distance of the nearest camera.
const MIN_HUGE_SIZE: f32 = 0.6;
/// The same for a splat that is huge among smaller ones.
const MIN_HUGE_AMONG_SMALL: f32 = 0.35;
/// Minimum size of such a splat in units of its spacing: the size of a background's splats is about their spacing.
const MIN_HUGE_SPACINGS: f32 = 4.0;

/// Minimum score at which photographs decide.
const SUSPICION_THRESHOLD: f32 = 0.4;
/// Minimum score of a splat in front of what views show at which photographs are not consulted: the one photograph that the splat explains
/// would count in its favour.
const CERTAINTY_THRESHOLD: f32 = 1.5;
/// Spacing, in units of its size, of a floater that no view shows.
const MIN_UNSEEN_SPACING: f32 = 6.0;

/// What suggests that a splat is in front of what views show.
struct InFrontEvidence {
    /// Share of views that see past it.
    share: f32,
    /// Spacing in units of its size.
    spacing: f32,
    /// The product of both.
    product: f32,
    opacity: f32,
    /// The largest sum of its blending weights in a view, as a share of the view's pixels.
    weight: f32,
}

/// The minimum of each. Fainter and smaller splats are numerous and harmless, and in a forward-facing capture of leaves they are leaves.
const MIN_IN_FRONT: InFrontEvidence = InFrontEvidence {
    share: 0.4,
    spacing: 2.5,
    product: 2.0,
    opacity: 0.05,
    weight: 1e-4,
};

impl InFrontEvidence {
    /// The smallest ratio to what is needed.
    fn ratio_to(&self, needed: &Self) -> f32 {
        let ratios = [
            self.share / needed.share,
            self.spacing / needed.spacing,
            self.product / needed.product,
            self.opacity / needed.opacity,
            self.weight / needed.weight,
        ];
        ratios.into_iter().fold(f32::INFINITY, f32::min)
    }
}

/// How strongly each reason suggests that a splat is a floater.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FloaterScores {
    /// Far from its neighbours, relative to its own size and to the scene's spacing.
    pub isolated: f32,
    /// Long and thin.
    pub needle: f32,
    /// Large relative to the distance of the nearest camera, or to the scene if cameras are not known.
    pub huge: f32,
    /// Seen in no view, and far from its neighbours.
    pub unseen: f32,
    /// In front of what the views show, near a camera or anywhere else in empty space.
    pub in_front: f32,
}

impl FloaterScores {
    /// The score of the strongest reason.
    pub fn score(&self) -> f32 {
        let mut scores = *self;
        scores.reasons().into_iter().fold(0.0, |most, reason| most.max(*reason))
    }

    /// The score of the strongest reason, to be changed.
    fn strongest(&mut self) -> &mut f32 {
        let [first, others @ ..] = self.reasons();
        others
            .into_iter()
            .fold(first, |most, reason| if *reason > *most { reason } else { most })
    }

    fn reasons(&mut self) -> [&mut f32; 5] {
        let Self {
            isolated,
            needle,
            huge,
            unseen,
            in_front,
        } = self;
        [isolated, needle, huge, unseen, in_front]
    }
}

/// The scores of every splat; those of hidden splats are 0.
pub fn floater_scores(draft: &Draft) -> Vec<FloaterScores> {
    let cloud = &draft.cloud;
    let shown = draft.visible();
    let indices = shown.indices();
    if indices.len() <= NEIGHBOUR_RANK {
        return vec![FloaterScores::default(); draft.len()];
    }
    let means: Vec<[f32; 3]> = indices.iter().map(|i| cloud.means[*i as usize]).collect();
    let spacings = spacings(&means);
    let median_spacing = median(spacings.clone()).max(f32::MIN_POSITIVE);
    // Without cameras, sizes are relative to the scene.
    let extent = draft.extent() as f32;
    let camera_distance = |mean: [f32; 3]| {
        let eyes = draft
            .cameras
            .iter()
            .map(|camera| camera.pose.position.distance(mean.into()));
        if draft.cameras.is_empty() {
            2.0 * extent
        } else {
            eyes.fold(f32::INFINITY, f32::min)
        }
    };
    let mut scores = vec![FloaterScores::default(); draft.len()];
    // Spacing in units of size.
    let mut relative_spacings = vec![0.0f32; draft.len()];
    let geometry: Vec<(FloaterScores, f32)> = (0..indices.len())
        .into_par_iter()
        .with_min_len(256)
        .map(|at| {
            let mut sizes = cloud.log_scales[indices[at] as usize].map(f32::exp);
            sizes.sort_unstable_by(f32::total_cmp);
            let [_, middle, largest] = sizes;
            let (spacing, camera_distance) = (spacings[at], camera_distance(means[at]).max(f32::MIN_POSITIVE));
            let relative_spacing = spacing / largest.max(f32::MIN_POSITIVE);
            let elongation = largest / middle.max(f32::MIN_POSITIVE);
            let scores = FloaterScores {
                isolated: (relative_spacing / MIN_ISOLATED_SIZES).min(spacing / median_spacing / MIN_ISOLATED_MEDIANS),
                needle: (elongation / MIN_NEEDLE_ELONGATION).min(largest / camera_distance / MIN_NEEDLE_SIZE),
                huge: (largest / camera_distance / MIN_HUGE_SIZE).max(
                    (largest / camera_distance / MIN_HUGE_AMONG_SMALL).min(1.0 / relative_spacing / MIN_HUGE_SPACINGS),
                ),
                ..FloaterScores::default()
            };
            (scores, relative_spacing)
        })
        .collect();
    for (i, (found, relative_spacing)) in indices.iter().zip(geometry) {
        (scores[*i as usize], relative_spacings[*i as usize]) = (found, relative_spacing);
    }
    if !draft.cameras.is_empty() {
        score_views(draft, &shown, &relative_spacings, &mut scores);
    }
    if let Some(photographs) = draft.photographs.as_ref().and_then(Photographs::load) {
        decide_by_photographs(draft, photographs, &shown, &mut scores);
    }
    scores
}

/// Photographs decide about huge splats and needles: by shape alone, part of a plain wall or of a table's edge looks like one, and a veil
/// far behind everything does not. They also decide about splats that are nearly floaters for other reasons.
fn decide_by_photographs(
    draft: &Draft,
    photographs: &LoadedPhotographs,
    shown: &Selection,
    scores: &mut [FloaterScores],
) {
    let shape = |scores: &FloaterScores| scores.huge.max(scores.needle);
    let other = |scores: &FloaterScores| scores.isolated.max(scores.unseen).max(scores.in_front);
    let is_certain = |scores: &FloaterScores| {
        scores
            .isolated
            .max(scores.unseen)
            .max(scores.in_front / CERTAINTY_THRESHOLD)
            >= 1.0
    };
    // Certain floaters are left out, since the fit of the suspects would compensate for them.
    let mut rest = Selection::of(draft.len(), |i| {
        shown.contains(i) && (!is_certain(&scores[i]) || shape(&scores[i]) >= SUSPICION_THRESHOLD)
    });
    for initial in [InitialOpacity::Hidden, InitialOpacity::Trained] {
        let is_suspect = |scores: &FloaterScores| match initial {
            // The shape of a floater, while no other splat can change to make room for it.
            InitialOpacity::Hidden => shape(scores) >= 1.0,
            // All suspects: also what those hid, without them.
            InitialOpacity::Trained => shape(scores).max(other(scores)) >= SUSPICION_THRESHOLD,
        };
        let suspects = Selection::of(draft.len(), |i| rest.contains(i) && is_suspect(&scores[i]));
        for (i, is_needed) in are_needed(draft, photographs, &rest, &suspects, initial) {
            let scores = &mut scores[i as usize];
            if !is_needed {
                *scores.strongest() = scores.score().max(1.0);
                rest.set(i as usize, false);
            } else if initial == InitialOpacity::Trained {
                for reason in [&mut scores.huge, &mut scores.needle, &mut scores.in_front] {
                    *reason = reason.min(SUSPICION_THRESHOLD);
                }
            }
        }
    }
}

/// Scores splats by the views: whether any sees them, and whether they are in front of what views show.
fn score_views(draft: &Draft, shown: &Selection, relative_spacings: &[f32], scores: &mut [FloaterScores]) {
    let cloud = &draft.cloud;
    // Huge splats and needles would veil everything else.
    let is_whole = |i: usize| shown.contains(i) && scores[i].huge.max(scores[i].needle) < 1.0;
    let whole = Selection::of(draft.len(), is_whole);
    let solid = Selection::of(draft.len(), |i| {
        whole.contains(i) && relative_spacings[i] <= MAX_SURFACE_SPACING
    });
    let (mut all, mut surfaces) = (Observer::new(draft, &whole), Observer::new(draft, &solid));
    let mut votes = vec![Votes::default(); draft.len()];
    for camera in &draft.cameras {
        let weights = all.weights(camera);
        let depths = surfaces.depths(camera);
        let pixels = depths.len() as f32;
        votes
            .par_iter_mut()
            .with_min_len(1024)
            .enumerate()
            .for_each(|(i, votes)| {
                votes.seen |= weights[i] >= MIN_VISIBLE_WEIGHT;
                votes.weight = votes.weight.max(weights[i] / pixels);
                if let Some([shown, own]) = depths.at(cloud.means[i].into()) {
                    let largest = cloud.log_scales[i].iter().fold(f32::NEG_INFINITY, |m, s| m.max(*s));
                    votes.count(shown, own, largest.exp());
                }
            });
    }
    for (i, (scores, votes)) in scores.iter_mut().zip(&votes).enumerate() {
        if whole.contains(i) {
            scores.unseen = if votes.seen {
                0.0
            } else {
                relative_spacings[i] / MIN_UNSEEN_SPACING
            };
            let opacity = sigmoid(cloud.opacity_logits[i]);
            let share = votes.in_front_share();
            let found = InFrontEvidence {
                share,
                spacing: relative_spacings[i],
                product: share * relative_spacings[i],
                opacity,
                weight: votes.weight,
            };
            scores.in_front = found.ratio_to(&MIN_IN_FRONT);
        }
    }
}

/// Votes of the views whose image contains the splat.
#[derive(Clone, Copy, Debug, Default)]
struct Votes {
    /// Views that see past it.
    in_front: u32,
    /// Views in which it is where the surface is.
    on_surface: u32,
    seen: bool,
    /// Its largest share of a view's pixels.
    weight: f32,
}

impl Votes {
    fn count(&mut self, shown: f32, own: f32, size: f32) {
        if !shown.is_finite() {
            return;
        }
        if 1.15 * own + 2.0 * size < shown {
            self.in_front += 1;
        } else if own < 1.05 * shown {
            self.on_surface += 1;
        }
    }

    fn in_front_share(&self) -> f32 {
        let votes = self.in_front + self.on_surface;
        self.in_front as f32 / votes.max(1) as f32
    }
}

/// Distance of each point to its sixth neighbour.
fn spacings(means: &[[f32; 3]]) -> Vec<f32> {
    let tree = Nearest::new(means);
    let spacing = |mean: &[f32; 3]| tree.of::<{ NEIGHBOUR_RANK + 1 }>(*mean)[NEIGHBOUR_RANK].0.sqrt();
    means.par_iter().with_min_len(256).map(spacing).collect()
}
