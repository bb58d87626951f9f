use super::descriptor::describe;
use super::extrema::{Extremum, find_extrema};
use super::frontal::frontal_patch;
use super::orientation::orientations;
use super::scale_space::{FIRST_SCALE, Octave, Plane};
use super::spread::select_spread;
use super::{Extractor, GreyPhoto};
use crate::keypoints::NO_DESCRIPTOR;
use crate::{DESCRIPTOR_BYTES, Features, Keypoint};
use irradia_compute::Level;
use irradia_scene::resize_area;

/// Minimum mask value that keeps a feature, as everywhere else.
const MASK_THRESHOLD: u8 = 128;

/// Scale-invariant features (Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", 2004) with RootSIFT descriptors
/// (Arandjelovic and Zisserman 2012).
#[derive(Clone, Debug, PartialEq)]
pub struct Sift {
    /// Larger photographs are reduced until their longer side has this many pixels. Default 1600.
    pub max_side: u32,
    /// Maximum number of features in a photograph. Default 4096.
    pub max_features: usize,
    /// Minimum difference of Gaussians at an extremum, for pixels in \[0, 1\]. Default 0.02 / 3, as in COLMAP.
    pub peak_threshold: f32,
    /// Maximum ratio of principal curvatures. Default 10, as in Lowe (2004) and COLMAP.
    pub edge_threshold: f32,
    /// Whether features also have frontal descriptors. Default false: extraction takes three times as long, which pays off only where
    /// views differ so much that the usual descriptors do not match.
    pub frontal: bool,
    /// The result of [`Level::detect`]; tests choose others.
    pub level: Level,
}

impl Default for Sift {
    fn default() -> Self {
        Self {
            max_side: 1600,
            max_features: 4096,
            peak_threshold: 0.02 / 3.0,
            edge_threshold: 10.0,
            frontal: false,
            level: Level::detect(),
        }
    }
}

impl Extractor for Sift {
    fn extract(&self, photo: &GreyPhoto) -> Features {
        let (width, height) = (photo.width as usize, photo.height as usize);
        assert_eq!(photo.data.len(), width * height, "a byte for each pixel");
        assert!(photo.mask.is_none_or(|mask| mask.len() == width * height));
        if width == 0 || height == 0 {
            return Features::default();
        }
        let long = photo.width.max(photo.height);
        let reduced = if long > self.max_side {
            let side =
                |side: u32| ((f64::from(side) * f64::from(self.max_side) / f64::from(long)).round() as u32).max(1);
            let to = [photo.width, photo.height].map(side);
            Plane::from_bytes(&resize_area(photo.data, 1, [photo.width, photo.height], to), to)
        } else {
            Plane::from_bytes(photo.data, [photo.width, photo.height])
        };
        let enlarge = [
            width as f32 / reduced.width as f32,
            height as f32 / reduced.height as f32,
        ];
        self.extract_from(&reduced, |[x, y]| {
            let at = |v: f32, enlarge: f32, side: usize| ((v * enlarge) as usize).min(side - 1);
            let pixel = at(y, enlarge[1], height) * width + at(x, enlarge[0], width);
            photo.mask.is_none_or(|mask| mask[pixel] >= MASK_THRESHOLD)
        })
        .scaled(enlarge)
    }
}

impl Sift {
    /// The features of `photo` at the positions for which `keep` returns true, in its pixels.
    fn extract_from(&self, photo: &Plane, keep: impl Fn([f32; 2]) -> bool) -> Features {
        let mut octaves: Vec<Vec<Plane>> = Vec::new();
        let mut extrema: Vec<Extremum> = Vec::new();
        // `[x, y, scale]` in the photograph's pixels.
        let mut places: Vec<[f32; 3]> = Vec::new();
        let mut next = Octave::first(self.level, photo);
        while let Some(octave) = next {
            for extremum in find_extrema(self, &octave, octaves.len()) {
                let place = [extremum.x, extremum.y, extremum.sigma].map(|v| v * octave.pixel);
                if keep([place[0], place[1]]) {
                    extrema.push(extremum);
                    places.push(place);
                }
            }
            let (described, halved) = octave.halved(self.level);
            octaves.push(described);
            next = halved;
        }
        let mut found: Vec<(Keypoint, [u8; DESCRIPTOR_BYTES], [u8; DESCRIPTOR_BYTES])> = Vec::new();
        // The product of scale and peak: large blobs are repeatable, strong ones are well localised.
        let importance: Vec<[f32; 3]> = places
            .iter()
            .zip(&extrema)
            .map(|([x, y, scale], extremum)| [*x, *y, scale * extremum.peak])
            .collect();
        for i in select_spread(&importance, [photo.width, photo.height], self.max_features) {
            let (extremum, [x, y, scale]) = (&extrema[i], places[i]);
            let plane = &octaves[extremum.octave][extremum.level - FIRST_SCALE];
            let described = self.describe(plane, extremum);
            let frontal = if self.frontal {
                let (patch, centre) = frontal_patch(&octaves, extremum);
                self.describe(&patch, &centre)
            } else {
                [None, None]
            };
            for (described, frontal) in described.into_iter().zip(frontal) {
                let Some((angle, _)) = described.or(frontal) else {
                    continue;
                };
                // If a feature has only a frontal descriptor, its angle is the one in its patch.
                let [descriptor, frontal] = [described, frontal].map(|d| d.map_or(NO_DESCRIPTOR, |d| d.1));
                found.push((Keypoint { x, y, scale, angle }, descriptor, frontal));
            }
            if found.len() >= self.max_features {
                break;
            }
        }
        found.truncate(self.max_features);
        let order = |k: &Keypoint| [-k.scale, k.y, k.x, k.angle];
        found.sort_by(|(a, ..), (b, ..)| order(a).partial_cmp(&order(b)).expect("finite keypoints"));
        let frontal = found.iter().map(|(.., frontal)| *frontal);
        Features {
            frontal: if self.frontal { frontal.collect() } else { Vec::new() },
            keypoints: found.iter().map(|(keypoint, ..)| *keypoint).collect(),
            descriptors: found.iter().map(|(_, descriptor, _)| *descriptor).collect(),
        }
    }

    /// The angles and descriptors at `extremum`, strongest first.
    fn describe(&self, plane: &Plane, extremum: &Extremum) -> [Option<(f32, [u8; DESCRIPTOR_BYTES])>; 2] {
        orientations(self.level, plane, extremum)
            .map(|angle| angle.and_then(|angle| Some((angle, describe(self.level, plane, extremum, angle)?))))
    }
}

impl Features {
    /// The same features in a photograph enlarged by the factors `[x, y]`.
    pub fn scaled(mut self, [x, y]: [f32; 2]) -> Self {
        for keypoint in &mut self.keypoints {
            keypoint.x *= x;
            keypoint.y *= y;
            keypoint.scale *= (x * y).sqrt();
        }
        self
    }
}
