//! A plain backdrop behind an object that turns, under slightly changing light: [`StillScene`](crate::StillScene) needs texture to
//! detect what stands still.
//!
//! Only for photographs from a camera that is known to be at rest: white paper looks the same to a moving camera.

use crate::connected_components;
use crate::still_scene::{adjacent, channel, patch_means, patch_variance, samples};
use rayon::prelude::*;

/// Maximum difference of a channel's mean around a pixel, of 255, for the same backdrop in other light: the white balance of a phone,
/// shadows of what turns.
const MAX_SHADE_DIFFERENCE: f32 = 30.0;
/// Maximum standard deviation of a channel around a pixel in a plain area, of 255.
const MAX_PLAIN_DEVIATION: f32 = 3.0;
/// Number of rounds in which the light of a photograph is estimated.
const GAIN_ITERATIONS: usize = 3;
/// Half the minimum width of a passage from the border, px: what turns merges with the backdrop in single pixels.
const MIN_PASSAGE_HALF_WIDTH: usize = 3;
/// Half the minimum width, px, of what looks the same in most photographs and turns nevertheless, such as a vase: anything thinner is
/// a line in the background, such as the rim of the plate.
const MIN_OBJECT_HALF_WIDTH: usize = 7;
/// Maximum variance of the difference from the backdrop, relative to that of the photograph, at an edge in the background: a camera at
/// rest moves by a fraction of a pixel.
const MAX_VARIANCE_RATIO: f32 = 0.25;
/// A region in front of the backdrop that is this many times smaller than the largest one is part of the backdrop, such as the edge of
/// the paper.
const MAX_SIZE_RATIO: usize = 20;

/// What most photographs from a camera show at each pixel.
pub struct Backdrop {
    width: usize,
    /// `[3][H, W]` of 255.
    color: [Vec<f32>; 3],
}

impl Backdrop {
    /// The backdrop of `pictures`, `[H, W, 3]`: their median.
    ///
    /// # Panics
    /// When there is no picture, or one does not have `width * height` pixels.
    pub fn from_pictures(width: usize, height: usize, pictures: &[impl AsRef<[u8]>]) -> Self {
        let samples = samples(width, height, pictures);
        let median = |at: usize| {
            let mut values: Vec<u8> = samples.iter().map(|sample| sample[at]).collect();
            *values.select_nth_unstable(samples.len() / 2).1
        };
        let medians: Vec<u8> = (0..3 * width * height).into_par_iter().map(median).collect();
        Self {
            width,
            color: [0, 1, 2].map(|c| channel(&medians, c)),
        }
    }

    /// `[H, W]` whether `picture`, `[H, W, 3]`, shows the backdrop: areas that are plain, of its colour and connected to the border.
    ///
    /// # Panics
    /// When the picture has another size.
    pub fn mask(&self, picture: &[u8]) -> Vec<bool> {
        assert_eq!(picture.len(), 3 * self.color[0].len());
        let color = [0, 1, 2].map(|c| channel(picture, c));
        let gains = self.channel_gains(&color);
        let difference = [0, 1, 2].map(|c| -> Vec<f32> {
            let both = color[c].iter().zip(&self.color[c]);
            both.map(|(here, behind)| here - gains[c] * behind).collect()
        });
        let shade = difference.each_ref().map(|d| patch_means(self.width, d));
        let (difference_variance, texture) = (
            patch_variance(self.width, &difference),
            patch_variance(self.width, &color),
        );
        let max_plain_variance = 3.0 * MAX_PLAIN_DEVIATION * MAX_PLAIN_DEVIATION;
        let is_similar = |i: usize, max_variance: f32| {
            shade.iter().all(|s| s[i].abs() < MAX_SHADE_DIFFERENCE) && difference_variance[i] < max_variance
        };
        let is_backdrop = |i: usize| is_similar(i, max_plain_variance) && texture[i] < max_plain_variance;
        let mut mask: Vec<bool> = (0..texture.len()).map(is_backdrop).collect();
        mask = self.dilate_or_erode(mask, MIN_PASSAGE_HALF_WIDTH, false);
        for region in self.regions(&mask) {
            let reaches_border = region.iter().any(|at| self.is_border(*at));
            region.into_iter().for_each(|at| mask[at] &= reaches_border);
        }
        mask = self.dilate_or_erode(mask, MIN_PASSAGE_HALF_WIDTH, true);
        let foreground = mask.iter().map(|covered| !covered).collect();
        let thick_foreground = self.dilate_or_erode(
            self.dilate_or_erode(foreground, MIN_OBJECT_HALF_WIDTH, false),
            MIN_OBJECT_HALF_WIDTH,
            true,
        );
        let is_line = |at: usize| {
            is_similar(at, max_plain_variance.max(MAX_VARIANCE_RATIO * texture[at]))
                && !thick_foreground[at]
                && !mask[at]
        };
        let lines: Vec<bool> = (0..mask.len()).map(is_line).collect();
        // A line that reaches the border is in the background: a stem that looks the same from all sides ends inside the photograph.
        for line in self.regions(&lines) {
            let reaches_border = lines[line[0]] && line.iter().any(|at| self.is_border(*at));
            line.into_iter().for_each(|at| mask[at] |= reaches_border);
        }
        let mut foreground_regions = self.regions(&mask);
        foreground_regions.retain(|region| !mask[region[0]]);
        let largest = foreground_regions.first().map_or(0, Vec::len);
        for speck in foreground_regions
            .into_iter()
            .filter(|region| region.len() < largest / MAX_SIZE_RATIO)
        {
            speck.into_iter().for_each(|at| mask[at] = true);
        }
        mask
    }

    /// The fraction of a photograph's border where `mask` shows the backdrop.
    pub fn border_fraction(&self, mask: &[bool]) -> f64 {
        let border = || (0..mask.len()).filter(|at| self.is_border(*at));
        border().filter(|at| mask[*at]).count() as f64 / border().count().max(1) as f64
    }

    /// Range of the backdrop's colour where `mask` shows it, of 255, without the lowest and highest twentieth: the maximum over the
    /// channels.
    pub fn color_range(&self, mask: &[bool]) -> f32 {
        let range = |color: &Vec<f32>| {
            let mut values: Vec<f32> = color.iter().zip(mask).filter(|v| *v.1).map(|v| *v.0).collect();
            values.sort_by(f32::total_cmp);
            match values.len() {
                0 => 0.0,
                n => values[n - 1 - n / 20] - values[n / 20],
            }
        };
        self.color.iter().map(range).fold(0.0, f32::max)
    }

    /// Brightness of each channel of a photograph relative to the backdrop.
    fn channel_gains(&self, color: &[Vec<f32>; 3]) -> [f32; 3] {
        let mut gains = [0, 1, 2].map(|c| {
            let both = color[c].iter().zip(&self.color[c]);
            let mut ratios: Vec<f32> = both.map(|(here, behind)| here / behind.max(1.0)).collect();
            let middle = ratios.len() / 2;
            *ratios.select_nth_unstable_by(middle, f32::total_cmp).1
        });
        for _ in 0..GAIN_ITERATIONS {
            let (mut here, mut behind) = ([0.0f64; 3], [0.0f64; 3]);
            for i in 0..color[0].len() {
                if (0..3).all(|c| (color[c][i] - gains[c] * self.color[c][i]).abs() < MAX_SHADE_DIFFERENCE) {
                    for c in 0..3 {
                        here[c] += f64::from(color[c][i]);
                        behind[c] += f64::from(self.color[c][i]);
                    }
                }
            }
            if behind.iter().all(|sum| *sum > 0.0) {
                gains = [0, 1, 2].map(|c| (here[c] / behind[c]) as f32);
            }
        }
        gains
    }

    /// Dilates `mask` by `pixels` if `dilates`, else erodes it by `pixels`.
    fn dilate_or_erode(&self, mut mask: Vec<bool>, pixels: usize, dilates: bool) -> Vec<bool> {
        for _ in 0..pixels {
            let neighbours = |at: usize| adjacent(self.width, mask.len(), at);
            let all = 0..mask.len();
            mask = if dilates {
                all.map(|at| mask[at] || neighbours(at).any(|to| mask[to])).collect()
            } else {
                all.map(|at| mask[at] && neighbours(at).all(|to| mask[to])).collect()
            };
        }
        mask
    }

    /// Connected regions of pixels that are all true or all false in `mask`, largest first.
    fn regions(&self, mask: &[bool]) -> Vec<Vec<usize>> {
        let with_same_value = |at: usize| adjacent(self.width, mask.len(), at).filter(move |to| mask[*to] == mask[at]);
        connected_components(mask.len(), with_same_value)
    }

    fn is_border(&self, at: usize) -> bool {
        let x = at % self.width;
        x == 0 || x + 1 == self.width || at < self.width || at + self.width >= self.color[0].len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [64, 48];

    /// A striped box whose left edge is at `left`, in front of paper that gets darker to the right, with the brightness `light`; its core
    /// has the colour of the paper.
    fn picture(left: usize, light: f32) -> Vec<u8> {
        let pixel = |i: usize| {
            let (x, y) = (i % SIZE[0], i / SIZE[0]);
            let paper = light * (220.0 - x as f32);
            let is_box = (left..left + 20).contains(&x) && (12..36).contains(&y);
            let is_core = (left + 7..left + 13).contains(&x) && (20..28).contains(&y);
            let value = if is_box && !is_core {
                [60.0, 120.0][y / 2 % 2]
            } else {
                paper
            };
            [value as u8, (0.9 * value) as u8, (0.8 * value) as u8]
        };
        (0..SIZE[0] * SIZE[1]).flat_map(pixel).collect()
    }

    #[test]
    fn paper_is_shown_and_what_it_surrounds_is_not() {
        let pictures: Vec<Vec<u8>> = (0..8).map(|i| picture(8 + 4 * i, 1.0 - 0.02 * i as f32)).collect();
        let backdrop = Backdrop::from_pictures(SIZE[0], SIZE[1], &pictures);
        let shown = backdrop.mask(&pictures[5]);
        let at = |x: usize, y: usize| shown[y * SIZE[0] + x];
        assert!(at(2, 2) && at(10, 24) && at(60, 24) && at(38, 44));
        assert!(!at(30, 24) && !at(38, 24) && !at(46, 30));
        assert!(backdrop.border_fraction(&shown) > 0.99);
        let range = backdrop.color_range(&shown);
        assert!((40.0..64.0).contains(&range), "{range}");
    }

    #[test]
    fn a_line_that_stays_is_of_the_backdrop_and_what_is_thick_is_not() {
        let with_line = |mut picture: Vec<u8>| {
            for y in 0..SIZE[1] {
                picture[3 * (y * SIZE[0] + 8)..][..6].fill(90);
            }
            picture
        };
        let pictures: Vec<Vec<u8>> = (0..6).map(|i| with_line(picture(16 + 4 * i, 1.0))).collect();
        let shown = Backdrop::from_pictures(SIZE[0], SIZE[1], &pictures).mask(&pictures[5]);
        let at = |x: usize, y: usize| shown[y * SIZE[0] + x];
        assert!(at(2, 24) && at(8, 24) && at(9, 40) && at(14, 24));
        // Five of six photographs show the box there.
        assert!(!at(38, 15));
    }

    #[test]
    fn what_has_texture_is_no_backdrop() {
        let pictures: Vec<Vec<u8>> = (0..6)
            .map(|i| {
                let value = |at: usize| {
                    if ((at / 3 + 7 * i) / 4).is_multiple_of(2) {
                        90
                    } else {
                        160
                    }
                };
                (0..3 * SIZE[0] * SIZE[1]).map(value).collect()
            })
            .collect();
        let backdrop = Backdrop::from_pictures(SIZE[0], SIZE[1], &pictures);
        let shown = backdrop.mask(&pictures[0]);
        assert_eq!(backdrop.border_fraction(&shown), 0.0);
        assert_eq!(backdrop.color_range(&shown), 0.0);
    }
}
