//! Blur, exposure and texture of single photographs, relative to others of the same part of the scene.

use super::{Diagnosis, Evidence, Graph};
use crate::median;

/// Ratio of the neighbours' sharpness to that of a photograph above which it is blurred: up to 2.6 in sharp close-ups of plain
/// surfaces, 2.9 and more with camera shake.
const BLURRED: f64 = 2.7;
/// Number of neighbours with which a photograph is compared.
const NEIGHBOURS: usize = 6;
/// Number of photographs before and after, in the order of names, that are used as neighbours where there are fewer than three partners.
const IN_ORDER: usize = 3;

/// Difference from the neighbours, in stops, above which the exposure jumps: phones vary by half a stop from photograph to photograph.
const JUMP: f64 = 1.0;
/// Levels, of 255, at which a colour is evidence of the exposure.
const TELLS: std::ops::RangeInclusive<u8> = 10..=245;
/// Minimum number of matches for a pair to determine the difference in exposure.
const ENOUGH_COLORS: usize = 12;
/// Fractions of white and of black pixels, above the median over all photographs, beyond which a photograph is clipped.
const WHITE: f64 = 0.3;
const BLACK: f64 = 0.4;

/// A photograph has too few features if it has fewer than this number, or fewer than this fraction of the median.
const FEATURES: usize = 150;
pub(super) const FEATURES_BY_MEDIAN: f64 = 0.1;
/// Minimum hidden fraction of a photograph for its mask, rather than texture or light, to be the fault.
const HIDDEN: f32 = 0.9;

/// The photographs that share most with `photo`.
fn neighbours(evidence: &Evidence, graph: &Graph, photo: usize) -> Vec<usize> {
    let mut found: Vec<usize> = graph.partners[photo].iter().take(NEIGHBOURS).map(|p| p.0).collect();
    if found.len() < IN_ORDER && !graph.is_on_rig(photo) {
        let n = evidence.photos.len();
        let around = photo.saturating_sub(IN_ORDER)..(photo + IN_ORDER + 1).min(n);
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
            (own > 0.0 && usual > BLURRED * own).then(|| Diagnosis::Blurred {
                photo,
                times: usual / own,
                neighbours,
            })
        })
        .collect()
}

/// Linear light of an sRGB colour, up to a factor.
fn linear(color: [u8; 3]) -> f64 {
    let [r, g, b] = color.map(f64::from);
    (0.2126 * r + 0.7152 * g + 0.0722 * b).powf(2.2)
}

/// `[pairs]` how many stops the second photograph is brighter than the first at their matches; `None` if too few matches are usable.
fn differences(evidence: &Evidence) -> Vec<Option<f64>> {
    let tells = |color: &[u8; 3]| color.iter().all(|c| TELLS.contains(c));
    let difference = |pair: &crate::map::VerifiedPair| {
        let [a, b] = pair.photos.map(|p| &evidence.colors[p as usize]);
        let stops: Vec<f64> = pair
            .matches
            .iter()
            .map(|[i, j]| (a[*i as usize], b[*j as usize]))
            .filter(|(a, b)| tells(a) && tells(b))
            .map(|(a, b)| (linear(b) / linear(a)).log2())
            .collect();
        if stops.len() < ENOUGH_COLORS {
            None
        } else {
            median(stops)
        }
    };
    evidence.pairs.iter().map(difference).collect()
}

/// Photographs that are brighter or darker than their neighbours, or clipped.
pub(super) fn exposure(evidence: &Evidence, graph: &Graph) -> Vec<Diagnosis> {
    let differences = differences(evidence);
    let usual = |of: fn(&super::Appearance) -> f32| {
        median(evidence.appearances.iter().map(|a| f64::from(of(a))).collect()).unwrap_or(0.0)
    };
    let (white, black) = (usual(|a| a.white), usual(|a| a.black));
    let mut found = Vec::new();
    for photo in 0..evidence.photos.len() {
        let telling: Vec<(usize, f64)> = graph.partners[photo]
            .iter()
            .filter_map(|(other, pair)| {
                let difference = differences[*pair]?;
                Some((*other, if *other < photo { difference } else { -difference }))
            })
            .take(NEIGHBOURS)
            .collect();
        let stops = median(telling.iter().map(|t| t.1).collect());
        let own = evidence.appearances[photo];
        if let Some(stops) = stops.filter(|stops| stops.abs() > JUMP) {
            found.push(Diagnosis::ExposureJump {
                photo,
                stops,
                neighbours: telling.into_iter().map(|t| t.0).collect(),
            });
        } else if f64::from(own.white) > white + WHITE {
            found.push(Diagnosis::Clipped {
                photo,
                fraction: own.white.into(),
                bright: true,
            });
        } else if f64::from(own.black) > black + BLACK {
            found.push(Diagnosis::Clipped {
                photo,
                fraction: own.black.into(),
                bright: false,
            });
        } else if stops.is_none() && !graph.is_on_rig(photo) && own.hidden < HIDDEN {
            // Without matches, only the brightness of the whole photograph can be compared.
            let neighbours = neighbours(evidence, graph, photo);
            let brightness = |p: usize| f64::from(evidence.appearances[p].brightness.max(0.002));
            let around = median(neighbours.iter().map(|p| brightness(*p)).collect());
            let stops = around.map_or(0.0, |around| 2.2 * (brightness(photo) / around).log2());
            if stops.abs() > 2.0 * JUMP {
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
    let least = (FEATURES_BY_MEDIAN * median).max(FEATURES as f64);
    (0..counts.len())
        .filter(|photo| (counts[*photo] as f64) < least && !graph.is_on_rig(*photo))
        .map(|photo| match evidence.appearances[photo].hidden {
            hidden if hidden >= HIDDEN => Diagnosis::Hidden {
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
