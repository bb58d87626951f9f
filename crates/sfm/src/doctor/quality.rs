//! Blur, exposure and texture of single photographs, relative to others of the same part of the scene.

use super::{Diagnosis, Evidence, Graph};
use crate::median;

/// Ratio of the neighbours' sharpness to that of a photograph above which it is blurred: up to 2.6 in sharp close-ups of plain
/// surfaces, 2.9 and more with camera shake.
const MIN_BLUR_RATIO: f64 = 2.7;
/// Number of neighbours with which a photograph is compared.
const MAX_NEIGHBOURS: usize = 6;
/// Number of photographs before and after, in the order of names, that are used as neighbours where there are fewer than three partners.
const SEQUENCE_NEIGHBOURS: usize = 3;

/// Difference from the neighbours, in stops, above which the exposure jumps: phones vary by half a stop from photograph to photograph.
const MAX_EXPOSURE_STOPS: f64 = 1.0;
/// Levels, of 255, at which a colour is evidence of the exposure.
const UNCLIPPED_LEVELS: std::ops::RangeInclusive<u8> = 10..=245;
/// Minimum number of matches for a pair to determine the difference in exposure.
const MIN_COLOR_MATCHES: usize = 12;
/// Fractions of white and of black pixels, above the median over all photographs, beyond which a photograph is clipped.
const MAX_WHITE_EXCESS: f64 = 0.3;
const MAX_BLACK_EXCESS: f64 = 0.4;

/// A photograph has too few features if it has fewer than this number, or fewer than this fraction of the median.
const MIN_FEATURES: usize = 150;
pub(super) const MIN_FEATURE_RATIO: f64 = 0.1;
/// Minimum hidden fraction of a photograph for its mask, rather than texture or light, to be the fault.
const MIN_HIDDEN_FRACTION: f32 = 0.9;

/// The photographs that share most with `photo`.
fn neighbours(evidence: &Evidence, graph: &Graph, photo: usize) -> Vec<usize> {
    let mut found: Vec<usize> = graph.partners[photo].iter().take(MAX_NEIGHBOURS).map(|p| p.0).collect();
    if found.len() < SEQUENCE_NEIGHBOURS && !graph.is_on_rig(photo) {
        let n = evidence.photos.len();
        let around = photo.saturating_sub(SEQUENCE_NEIGHBOURS)..(photo + SEQUENCE_NEIGHBOURS + 1).min(n);
        for other in around.filter(|other| *other != photo) {
            if !found.contains(&other) {
                found.push(other);
            }
        }
    }
    found
}

/// Photographs that are less sharp than their neighbours.
pub(super) fn blurred(evidence: &Evidence, graph: &Graph) -> Vec<Diagnosis> {
    let sharpness = |photo: usize| f64::from(evidence.appearances[photo].sharpness);
    (0..evidence.photos.len())
        .filter_map(|photo| {
            let neighbours = neighbours(evidence, graph, photo);
            let usual = median(neighbours.iter().map(|p| sharpness(*p)).collect())?;
            let own = sharpness(photo);
            // No contrast at all is not blur.
            (own > 0.0 && usual > MIN_BLUR_RATIO * own).then(|| Diagnosis::Blurred {
                photo,
                times: usual / own,
                neighbours,
            })
        })
        .collect()
}

/// Linear light of an sRGB colour, up to a factor.
fn luminance(color: [u8; 3]) -> f64 {
    let [r, g, b] = color.map(f64::from);
    (0.2126 * r + 0.7152 * g + 0.0722 * b).powf(2.2)
}

/// `[pairs]` how many stops the second photograph is brighter than the first at their matches; `None` if too few matches are usable.
fn exposure_differences(evidence: &Evidence) -> Vec<Option<f64>> {
    let is_unclipped = |color: &[u8; 3]| color.iter().all(|c| UNCLIPPED_LEVELS.contains(c));
    let difference = |pair: &crate::map::VerifiedPair| {
        let [a, b] = pair.photos.map(|p| &evidence.colors[p as usize]);
        let stops: Vec<f64> = pair
            .matches
            .iter()
            .map(|[i, j]| (a[*i as usize], b[*j as usize]))
            .filter(|(a, b)| is_unclipped(a) && is_unclipped(b))
            .map(|(a, b)| (luminance(b) / luminance(a)).log2())
            .collect();
        if stops.len() < MIN_COLOR_MATCHES {
            None
        } else {
            median(stops)
        }
    };
    evidence.pairs.iter().map(difference).collect()
}

/// Photographs that are brighter or darker than their neighbours, or clipped.
pub(super) fn exposure(evidence: &Evidence, graph: &Graph) -> Vec<Diagnosis> {
    let differences = exposure_differences(evidence);
    let usual = |of: fn(&super::Appearance) -> f32| {
        median(evidence.appearances.iter().map(|a| f64::from(of(a))).collect()).unwrap_or(0.0)
    };
    let (white, black) = (usual(|a| a.white), usual(|a| a.black));
    let mut found = Vec::new();
    for photo in 0..evidence.photos.len() {
        let comparisons: Vec<(usize, f64)> = graph.partners[photo]
            .iter()
            .filter_map(|(other, pair)| {
                let difference = differences[*pair]?;
                Some((*other, if *other < photo { difference } else { -difference }))
            })
            .take(MAX_NEIGHBOURS)
            .collect();
        let stops = median(comparisons.iter().map(|c| c.1).collect());
        let own = evidence.appearances[photo];
        if let Some(stops) = stops.filter(|stops| stops.abs() > MAX_EXPOSURE_STOPS) {
            found.push(Diagnosis::ExposureJump {
                photo,
                stops,
                neighbours: comparisons.into_iter().map(|c| c.0).collect(),
            });
        } else if f64::from(own.white) > white + MAX_WHITE_EXCESS {
            found.push(Diagnosis::Clipped {
                photo,
                fraction: own.white.into(),
                bright: true,
            });
        } else if f64::from(own.black) > black + MAX_BLACK_EXCESS {
            found.push(Diagnosis::Clipped {
                photo,
                fraction: own.black.into(),
                bright: false,
            });
        } else if stops.is_none() && !graph.is_on_rig(photo) && own.hidden < MIN_HIDDEN_FRACTION {
            // Without matches, only the brightness of the whole photograph can be compared.
            let neighbours = neighbours(evidence, graph, photo);
            let brightness = |p: usize| f64::from(evidence.appearances[p].brightness.max(0.002));
            let around = median(neighbours.iter().map(|p| brightness(*p)).collect());
            let stops = around.map_or(0.0, |around| 2.2 * (brightness(photo) / around).log2());
            if stops.abs() > 2.0 * MAX_EXPOSURE_STOPS {
                found.push(Diagnosis::ExposureJump {
                    photo,
                    stops,
                    neighbours,
                });
            }
        }
    }
    found
}

/// Photographs with little texture, or with most of their area hidden.
pub(super) fn few_features(evidence: &Evidence, graph: &Graph) -> Vec<Diagnosis> {
    let counts: Vec<usize> = evidence.features.iter().map(|f| f.keypoints.len()).collect();
    let median = median(counts.iter().map(|c| *c as f64).collect()).unwrap_or(0.0);
    let min_features = (MIN_FEATURE_RATIO * median).max(MIN_FEATURES as f64);
    (0..counts.len())
        .filter(|photo| (counts[*photo] as f64) < min_features && !graph.is_on_rig(*photo))
        .map(|photo| match evidence.appearances[photo].hidden {
            hidden if hidden >= MIN_HIDDEN_FRACTION => Diagnosis::Hidden {
                photo,
                fraction: hidden.into(),
            },
            _ => Diagnosis::FewFeatures {
                photo,
                features: counts[photo],
                median: median as usize,
            },
        })
        .collect()
}
