//! Segmentation of what stands still in the photographs of a camera while the rest moves: the background of a turntable, parts of what
//! carries the camera, text.
//!
//! Background subtraction, as for a camera at rest (Stauffer and Grimson, "Adaptive background mixture models", 1999, with the strongest
//! mode only), in patches and relative to their texture, so that plain surfaces that move are not mistaken for others that do not: a
//! patch without texture gets the label of its surroundings.

use crate::median;
use rayon::prelude::*;

/// Maximum number of photographs from which the background's colours are estimated.
const MAX_SAMPLED_PHOTOS: usize = 32;
/// Maximum difference of a channel between photographs that show the same at a pixel, of 255: noise, and slightly different light.
const MAX_COLOR_DIFFERENCE: u8 = 15;
/// Minimum fraction of the photographs that show the background's colour.
const MIN_SUPPORT: f32 = 0.25;
/// Number of pixels on each side of a patch's centre.
const PATCH_RADIUS: usize = 2;
/// Minimum standard deviation of a channel for a patch to have texture, and minimum difference for it to certainly differ, of 255.
const MIN_TEXTURE_DEVIATION: f32 = 5.0;
const MIN_MOVING_DIFFERENCE: f32 = 7.5;
/// Variance of the difference relative to that of the patch, up to which the patch stands still, and above which it moves.
const MAX_STILL_VARIANCE_RATIO: f32 = 0.15;
const MIN_MOVING_VARIANCE_RATIO: f32 = 0.5;
/// Maximum difference of a channel's mean, of 255, for what stands still in other light.
const MAX_SHADE_DIFFERENCE: f32 = 20.0;
/// A patch without texture is quiet if its difference, also between photographs, is up to this many times the median difference of
/// patches that stand still, which makes it noise, and if it has this support. A region of such patches stands still if more than this
/// fraction of the pixels around it do: a wall between twigs, but not a white floor on which everything moves.
const MAX_NOISE_RATIO: f64 = 3.0;
const MIN_QUIET_SUPPORT: f32 = 0.6;
const MIN_STILL_BORDER_FRACTION: f64 = 0.1;
/// A region of less than this fraction of the pixels is noise.
const MIN_REGION_FRACTION: f64 = 0.0008;

/// The state of a patch.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Label {
    Still,
    Moving,
    /// Without texture, and its difference is noise.
    Quiet,
    /// Undecided.
    Undecided,
}

/// What is the same in most photographs from a camera.
pub struct StillScene {
    width: usize,
    /// `[3][H, W]`
    color: [Vec<f32>; 3],
    /// `[H, W]` the variance around each pixel.
    texture: Vec<f32>,
    /// `[H, W]` the fraction of the photographs that show this colour.
    support: Vec<f32>,
    /// `[H, W]` whether enough photographs show this colour and differ only by noise.
    constant: Vec<bool>,
}

impl StillScene {
    /// What most of `pictures`, `[H, W, 3]`, show.
    ///
    /// # Panics
    /// When there is no picture, or one does not have `width * height` pixels.
    pub fn from_pictures(width: usize, height: usize, pictures: &[impl AsRef<[u8]>]) -> Self {
        let samples = samples(width, height, pictures);
        let at = |pixel: usize| {
            let colors: Vec<[u8; 3]> = (samples.iter().map(|s| [0, 1, 2].map(|c| s[3 * pixel + c]))).collect();
            Mode::from_colors(&colors)
        };
        let modes: Vec<Mode> = (0..width * height).into_par_iter().map(at).collect();
        let color = [0, 1, 2].map(|c| modes.iter().map(|mode| mode.color[c]).collect());
        let texture = patch_variance(width, &color);
        let variance = patch_means(width, &modes.iter().map(|mode| mode.variance).collect::<Vec<_>>());
        let has_support = |i: &usize| modes[*i].support >= MIN_QUIET_SUPPORT;
        let textured = (0..modes.len())
            .filter(|i| has_support(i) && texture[*i] > 3.0 * MIN_TEXTURE_DEVIATION * MIN_TEXTURE_DEVIATION);
        let noise = median(textured.map(|i| f64::from(variance[i])).collect()).unwrap_or(0.0);
        let constant = (0..modes.len()).map(|i| has_support(&i) && f64::from(variance[i]) < MAX_NOISE_RATIO * noise);
        Self {
            width,
            constant: constant.collect(),
            support: modes.iter().map(|mode| mode.support).collect(),
            texture,
            color,
        }
    }

    /// The parts of `picture`, `[H, W, 3]`, that show this scene.
    ///
    /// # Panics
    /// When the picture has another size.
    pub fn segment(&self, picture: &[u8]) -> Segmentation {
        assert_eq!(picture.len(), 3 * self.texture.len());
        let color = [0, 1, 2].map(|c| channel(picture, c));
        let texture = patch_variance(self.width, &color);
        let labels = self.label_patches([1.0; 3], &color, &texture);
        Segmentation {
            width: self.width,
            labels: self.label_patches(self.channel_gains(&color, &labels), &color, &texture),
        }
    }

    /// `[H, W]` the label of each patch of a photograph in which this scene is `gains` times as bright.
    fn label_patches(&self, gains: [f32; 3], color: &[Vec<f32>; 3], texture: &[f32]) -> Vec<Label> {
        let difference = [0, 1, 2].map(|c| -> Vec<f32> {
            let both = color[c].iter().zip(&self.color[c]);
            both.map(|(a, b)| a - gains[c] * b).collect()
        });
        let shade = difference.each_ref().map(|d| patch_means(self.width, d));
        let difference_variance = patch_variance(self.width, &difference);
        let square = |i: usize| difference_variance[i] + shade.iter().map(|s| s[i] * s[i]).sum::<f32>();
        let label = |i: usize| {
            let texture = texture[i].max(self.texture[i]);
            let is_shaded = shade.iter().all(|s| s[i].abs() < MAX_SHADE_DIFFERENCE);
            if difference_variance[i] < MAX_STILL_VARIANCE_RATIO * texture
                && texture > 3.0 * MIN_TEXTURE_DEVIATION * MIN_TEXTURE_DEVIATION
                && is_shaded
                && self.support[i] >= MIN_SUPPORT
            {
                Label::Still
            } else if square(i) > MIN_MOVING_VARIANCE_RATIO * texture
                && square(i) > 3.0 * MIN_MOVING_DIFFERENCE * MIN_MOVING_DIFFERENCE
            {
                Label::Moving
            } else {
                Label::Undecided
            }
        };
        let mut labels: Vec<Label> = (0..texture.len()).map(label).collect();
        let of_still = (0..labels.len()).filter(|i| labels[*i] == Label::Still).map(square);
        if let Some(noise) = median(of_still.map(f64::from).collect()) {
            for (i, label) in labels.iter_mut().enumerate() {
                if *label == Label::Undecided && self.constant[i] && f64::from(square(i)) < MAX_NOISE_RATIO * noise {
                    *label = Label::Quiet;
                }
            }
        }
        labels
    }

    /// Brightness of each channel of a photograph relative to this scene, where the photograph shows it.
    fn channel_gains(&self, color: &[Vec<f32>; 3], labels: &[Label]) -> [f32; 3] {
        // In single precision, a sum over a photograph would round each of its last summands to a multiple of 2 or more.
        let sum = |values: &[f32]| -> f64 {
            let of = values.iter().zip(labels).filter(|v| *v.1 == Label::Still);
            of.map(|v| f64::from(*v.0)).sum()
        };
        [0, 1, 2].map(|c| {
            let here = sum(&color[c]);
            if here > 0.0 {
                (here / sum(&self.color[c]).max(1.0)) as f32
            } else {
                1.0
            }
        })
    }
}

/// The parts of a photograph that show a [`StillScene`].
pub struct Segmentation {
    width: usize,
    /// `[H, W]`
    labels: Vec<Label>,
}

impl Segmentation {
    /// The fraction of the pixels that stand still with the texture of the scene.
    pub fn still_fraction(&self) -> f64 {
        let still = self.labels.iter().filter(|label| **label == Label::Still).count();
        still as f64 / self.labels.len() as f64
    }

    /// `[H, W]` whether each pixel shows the scene.
    pub fn mask(mut self) -> Vec<bool> {
        let (width, labels) = (self.width, &mut self.labels);
        let min_pixels = (MIN_REGION_FRACTION * labels.len() as f64) as usize;
        relabel_regions(width, labels, MIN_STILL_BORDER_FRACTION, |label, _| {
            label == Label::Quiet
        });
        // The remaining quiet regions have no labelled pixels around them.
        (labels.iter_mut().filter(|label| **label == Label::Quiet)).for_each(|label| *label = Label::Undecided);
        relabel_regions(width, labels, 0.5, |label, _| label == Label::Undecided);
        majority_filter(width, labels);
        relabel_regions(width, labels, 0.5, |_, pixels| pixels < min_pixels);
        dilated(width, labels)
    }
}

/// The most frequent colour at a pixel.
struct Mode {
    color: [f32; 3],
    /// The fraction of the photographs that have it; 0 for fewer than three photographs.
    support: f32,
    /// Variance among those, summed over the channels.
    variance: f32,
}

impl Mode {
    /// The mode of `colors`, the first of several equal ones.
    fn from_colors(colors: &[[u8; 3]]) -> Self {
        let same = |a: &[u8; 3], b: &[u8; 3]| a.iter().zip(b).all(|(a, b)| a.abs_diff(*b) <= MAX_COLOR_DIFFERENCE);
        let count = |a: &[u8; 3]| colors.iter().filter(|b| same(a, b)).count();
        let more = |most: (usize, [u8; 3]), next: (usize, [u8; 3])| if next.0 > most.0 { next } else { most };
        let (n, center) = colors.iter().map(|a| (count(a), *a)).fold((0, [0; 3]), more);
        let (mut color, mut variance) = ([0.0; 3], 0.0);
        for c in 0..3 {
            let values = || colors.iter().filter(|b| same(&center, b)).map(|b| f32::from(b[c]));
            color[c] = values().sum::<f32>() / n as f32;
            variance += values().map(|v| (v - color[c]).powi(2)).sum::<f32>() / n as f32;
        }
        let support = if n > 2 { n as f32 / colors.len() as f32 } else { 0.0 };
        Self {
            color,
            support,
            variance,
        }
    }
}

/// Some of `pictures`, `[H, W, 3]`, evenly selected: enough to determine the background.
///
/// # Panics
/// When there is no picture, or one does not have `width * height` pixels.
pub(crate) fn samples(width: usize, height: usize, pictures: &[impl AsRef<[u8]>]) -> Vec<&[u8]> {
    assert!(!pictures.is_empty() && pictures.iter().all(|p| p.as_ref().len() == 3 * width * height));
    let count = pictures.len().min(MAX_SAMPLED_PHOTOS);
    let even = (0..count).map(|i| pictures[i * pictures.len() / count].as_ref());
    even.collect()
}

pub(crate) fn channel(picture: &[u8], c: usize) -> Vec<f32> {
    picture.iter().skip(c).step_by(3).map(|v| f32::from(*v)).collect()
}

/// `[H, W]` the mean over the patch around each pixel.
pub(crate) fn patch_means(width: usize, values: &[f32]) -> Vec<f32> {
    let height = values.len() / width;
    let patch = |at: usize, of: usize| at.saturating_sub(PATCH_RADIUS)..(at + PATCH_RADIUS + 1).min(of);
    let mut rows = Vec::with_capacity(values.len());
    for row in values.chunks_exact(width) {
        rows.extend((0..width).map(|x| {
            let near = &row[patch(x, width)];
            near.iter().sum::<f32>() / near.len() as f32
        }));
    }
    let mut both = vec![0.0; values.len()];
    for (y, mean) in both.chunks_exact_mut(width).enumerate() {
        let near = patch(y, height);
        let part = 1.0 / near.len() as f32;
        for row in near.map(|y| &rows[y * width..][..width]) {
            mean.iter_mut().zip(row).for_each(|(mean, value)| *mean += part * value);
        }
    }
    both
}

/// `[H, W]` the variance over the patch around each pixel, summed over the channels.
pub(crate) fn patch_variance(width: usize, color: &[Vec<f32>; 3]) -> Vec<f32> {
    let squares: Vec<f32> = (0..color[0].len())
        .map(|i| color.iter().map(|c| c[i] * c[i]).sum())
        .collect();
    let (mut variance, means) = (
        patch_means(width, &squares),
        color.each_ref().map(|c| patch_means(width, c)),
    );
    for (i, variance) in variance.iter_mut().enumerate() {
        *variance = (*variance - means.iter().map(|m| m[i] * m[i]).sum::<f32>()).max(0.0);
    }
    variance
}

/// Relabels each connected region of one label for which `is_weak(label, pixels)` is true: it stands still if more than
/// `min_still_fraction` of the labelled pixels around it do, otherwise it moves.
fn relabel_regions(
    width: usize,
    labels: &mut [Label],
    min_still_fraction: f64,
    is_weak: impl Fn(Label, usize) -> bool,
) {
    let mut seen = vec![false; labels.len()];
    for start in 0..labels.len() {
        if seen[start] {
            continue;
        }
        let label = labels[start];
        let (mut region, mut next) = (vec![start], 0);
        let mut around = [0usize; 2];
        seen[start] = true;
        while let Some(&at) = region.get(next) {
            next += 1;
            for to in adjacent(width, labels.len(), at) {
                match labels[to] {
                    other if other == label => {
                        if !std::mem::replace(&mut seen[to], true) {
                            region.push(to);
                        }
                    }
                    Label::Still => around[0] += 1,
                    Label::Moving => around[1] += 1,
                    Label::Quiet | Label::Undecided => {}
                }
            }
        }
        if is_weak(label, region.len()) && around != [0; 2] {
            let still = around[0] as f64 > min_still_fraction * (around[0] + around[1]) as f64;
            let joined = if still { Label::Still } else { Label::Moving };
            region.into_iter().for_each(|at| labels[at] = joined);
        }
    }
}

/// The up to four neighbours of the pixel `at`, out of `pixels`.
pub(crate) fn adjacent(width: usize, pixels: usize, at: usize) -> impl Iterator<Item = usize> {
    let x = at % width;
    let to = [
        (x > 0).then(|| at - 1),
        (x + 1 < width).then_some(at + 1),
        at.checked_sub(width),
        (at + width < pixels).then_some(at + width),
    ];
    to.into_iter().flatten()
}

/// Gives each pixel the label of the majority of itself and its four neighbours.
fn majority_filter(width: usize, labels: &mut [Label]) {
    let before = labels.to_vec();
    for (at, label) in labels.iter_mut().enumerate() {
        let (mut same, mut other) = (1, 0);
        for to in adjacent(width, before.len(), at) {
            if before[to] == *label {
                same += 1;
            } else {
                other += 1;
            }
        }
        if other > same {
            *label = match *label {
                Label::Still => Label::Moving,
                _ => Label::Still,
            };
        }
    }
}

/// `[H, W]` the pixels that stand still and their neighbours, which show a little of the still scene.
fn dilated(width: usize, labels: &[Label]) -> Vec<bool> {
    let is_still = |at: usize| labels[at] == Label::Still;
    let all = 0..labels.len();
    all.map(|at| is_still(at) || adjacent(width, labels.len(), at).any(is_still))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 120;

    fn noise(seed: u32, x: usize, y: usize) -> u8 {
        let hash = (seed ^ (x as u32).wrapping_mul(0x9e37_79b9) ^ (y as u32).wrapping_mul(0x85eb_ca6b))
            .wrapping_mul(0xc2b2_ae35);
        (hash >> 24) as u8
    }

    fn center(picture: usize) -> f32 {
        40.0 + 2.0 * picture as f32
    }

    /// A disc 60 pixels wide that moves across the background `behind` and has a single colour at its centre, in `light`.
    fn turntable(
        pictures: usize,
        behind: impl Fn(usize, usize, usize) -> u8,
        light: impl Fn(usize) -> f32,
    ) -> Vec<Vec<u8>> {
        let picture = |i: usize| {
            let pixel = |at: usize| {
                let (x, y) = (at % SIDE, at / SIDE);
                let away = (x as f32 - center(i)).hypot(y as f32 - 60.0);
                let value = match away {
                    ..12.0 => 90,
                    ..30.0 => noise(1, (x + 120 - 2 * i) / 3, y / 3) / 2 + 60,
                    _ => behind(x, y, i),
                };
                [(light(i) * f32::from(value)) as u8 + noise(i as u32, x, y) % 3; 3]
            };
            (0..SIDE * SIDE).flat_map(pixel).collect()
        };
        (0..pictures).map(picture).collect()
    }

    fn masks(pictures: &[Vec<u8>]) -> Vec<Vec<bool>> {
        let still = StillScene::from_pictures(SIDE, SIDE, pictures);
        pictures.iter().map(|picture| still.segment(picture).mask()).collect()
    }

    /// The fractions of the background and of the disc that are masked.
    fn masked(pictures: &[Vec<u8>]) -> [f64; 2] {
        let masks = masks(pictures);
        let (mut still, mut of) = ([0usize; 2], [0usize; 2]);
        for (i, mask) in masks.iter().enumerate() {
            for (at, is) in mask.iter().enumerate() {
                let away = ((at % SIDE) as f32 - center(i)).hypot((at / SIDE) as f32 - 60.0);
                let part = match away {
                    ..28.0 => 1,
                    34.0.. => 0,
                    _ => continue,
                };
                of[part] += 1;
                still[part] += usize::from(*is);
            }
        }
        [0, 1].map(|part| still[part] as f64 / of[part] as f64)
    }

    #[test]
    fn what_stands_still_is_masked_and_what_moves_before_it_is_not() {
        let textured = |x: usize, y: usize, _: usize| noise(2, x / 4, y / 4).min(250);
        let [behind, disc] = masked(&turntable(20, textured, |_| 1.0));
        assert!(behind > 0.98 && disc < 0.02, "{behind} {disc}");
        let pictures = turntable(20, textured, |_| 1.0);
        let still = StillScene::from_pictures(SIDE, SIDE, &pictures);
        let other = turntable(1, |x, y, _| noise(3, x / 4, y / 4).min(250), |_| 1.0).remove(0);
        let shares = [&pictures[7], &other].map(|picture| still.segment(picture).still_fraction());
        assert!(shares[0] > 0.5 && shares[1] < 0.05, "{shares:?}");
        // In light that changes from photograph to photograph, and with a plain part surrounded by texture.
        let plain = |x: usize, y: usize, _: usize| {
            if (40..110).contains(&x) && y < 25 {
                120
            } else {
                noise(2, x / 4, y / 4).min(250)
            }
        };
        let [behind, disc] = masked(&turntable(20, plain, |i| [0.9, 0.95, 1.0][i % 3]));
        assert!(behind > 0.97 && disc < 0.02, "{behind} {disc}");
    }

    #[test]
    fn the_light_of_a_large_photograph_is_exact() {
        const PIXELS: usize = 1_000_000;
        let plane = |value: f32| [0; 3].map(|_| vec![value; PIXELS]);
        let still = StillScene {
            width: 1000,
            color: plane(100.0),
            texture: Vec::new(),
            support: Vec::new(),
            constant: Vec::new(),
        };
        let gains = still.channel_gains(&plane(101.0), &vec![Label::Still; PIXELS]);
        assert_eq!(gains, [1.01; 3]);
    }

    #[test]
    fn a_plain_floor_that_moves_is_not_masked() {
        // Only a label in the corner stands still; the floor, 14,000 pixels, is plain except for its shading, and what moves on it has
        // texture.
        let shaded = |x: usize, i: usize| (120 + (x + 2 * i) / 8) as u8;
        let corner = |x: usize, y: usize, i: usize| {
            if x < 20 && y < 20 {
                noise(2, x / 3, y / 3).min(250)
            } else {
                shaded(x, i)
            }
        };
        let masks = masks(&turntable(20, corner, |_| 1.0));
        let in_corner = |at: usize| at % SIDE < 18 && at / SIDE < 18;
        for mask in masks {
            let still = |inside: bool| {
                (0..SIDE * SIDE)
                    .filter(|at| mask[*at] && in_corner(*at) == inside)
                    .count()
            };
            assert!(still(true) > 300, "{}", still(true));
            assert!(still(false) < 500, "{}", still(false));
        }
    }
}
