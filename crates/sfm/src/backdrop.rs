//! A plain backdrop behind an object that turns, under slightly changing light: [`StillScene`](crate::StillScene) needs texture to
//! detect what stands still.
//!
//! Only for photographs from a camera that is known to be at rest: white paper looks the same to a moving camera.

use crate::connected;
use crate::still_scene::{adjacent, channel, means, samples, variance};
use rayon::prelude::*;

/// Maximum difference of a channel's mean around a pixel, of 255, for the same backdrop in other light: the white balance of a phone,
/// shadows of what turns.
const SHADE: f32 = 30.0;
/// Maximum standard deviation of a channel around a pixel in a plain area, of 255.
const PLAIN: f32 = 3.0;
/// Number of rounds in which the light of a photograph is estimated.
const ROUNDS: usize = 3;
/// Half the minimum width of a passage from the border, px: what turns merges with the backdrop in single pixels.
const PASSAGE: usize = 3;
/// Half the minimum width, px, of what looks the same in most photographs and turns nevertheless, such as a vase: anything thinner is
/// a line in the background, such as the rim of the plate.
const THIN: usize = 7;
/// Maximum variance of the difference from the backdrop, relative to that of the photograph, at an edge in the background: a camera at
/// rest moves by a fraction of a pixel.
const ALIKE: f32 = 0.25;
/// A region in front of the backdrop that is this many times smaller than the largest one is part of the backdrop, such as the edge of
/// the paper.
const SPECK: usize = 20;

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
    pub fn of(width: usize, height: usize, pictures: &[impl AsRef<[u8]>]) -> Self {
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
    pub fn shown(&self, picture: &[u8]) -> Vec<bool> {
        assert_eq!(picture.len(), 3 * self.color[0].len());
        let color = [0, 1, 2].map(|c| channel(picture, c));
        let light = self.light(&color);
        let difference = [0, 1, 2].map(|c| -> Vec<f32> {
            let both = color[c].iter().zip(&self.color[c]);
            both.map(|(here, behind)| here - light[c] * behind).collect()
        });
        let shade = difference.each_ref().map(|d| means(self.width, d));
        let (varies, texture) = (variance(self.width, &difference), variance(self.width, &color));
        let plain = 3.0 * PLAIN * PLAIN;
        let is_alike = |i: usize, most: f32| shade.iter().all(|s| s[i].abs() < SHADE) && varies[i] < most;
        let is_shown = |i: usize| is_alike(i, plain) && texture[i] < plain;
        let mut shown: Vec<bool> = (0..texture.len()).map(is_shown).collect();
        shown = self.spread(shown, PASSAGE, false);
        for region in self.regions(&shown) {
            let is_joined = region.iter().any(|at| self.is_border(*at));
            region.into_iter().for_each(|at| shown[at] &= is_joined);
        }
        shown = self.spread(shown, PASSAGE, true);
        let hides = shown.iter().map(|shown| !shown).collect();
        let thick = self.spread(self.spread(hides, THIN, false), THIN, true);
        let is_line = |at: usize| is_alike(at, plain.max(ALIKE * texture[at])) && !thick[at] && !shown[at];
        let lines: Vec<bool> = (0..shown.len()).map(is_line).collect();
        // A line that reaches the border is in the background: a stem that looks the same from all sides ends inside the photograph.
        for line in self.regions(&lines) {
            let leads_out = lines[line[0]] && line.iter().any(|at| self.is_border(*at));
            line.into_iter().for_each(|at| shown[at] |= leads_out);
        }
        let mut hidden = self.regions(&shown);
        hidden.retain(|region| !shown[region[0]]);
        let largest = hidden.first().map_or(0, Vec::len);
        for speck in hidden.into_iter().filter(|region| region.len() < largest / SPECK) {
            speck.into_iter().for_each(|at| shown[at] = true);
        }
        shown
    }

    /// The fraction of a photograph's border where the backdrop is `shown`.
    pub fn surrounds(&self, shown: &[bool]) -> f64 {
        let border = || (0..shown.len()).filter(|at| self.is_border(*at));
        border().filter(|at| shown[*at]).count() as f64 / border().count().max(1) as f64
    }

    /// Range of the backdrop's colour where it is `shown`, of 255, without the lowest and highest twentieth: the maximum over the channels.
    pub fn range(&self, shown: &[bool]) -> f32 {
        let range = |color: &Vec<f32>| {
            let mut values: Vec<f32> = color.iter().zip(shown).filter(|v| *v.1).map(|v| *v.0).collect();
            values.sort_by(f32::total_cmp);
            match values.len() {
                0 => 0.0,
                n => values[n - 1 - n / 20] - values[n / 20],
            }
        };
        self.color.iter().map(range).fold(0.0, f32::max)
    }

    /// Brightness of each channel of a photograph relative to the backdrop.
    fn light(&self, color: &[Vec<f32>; 3]) -> [f32; 3] {
        let mut light = [0, 1, 2].map(|c| {
            let both = color[c].iter().zip(&self.color[c]);
            let mut ratios: Vec<f32> = both.map(|(here, behind)| here / behind.max(1.0)).collect();
            let middle = ratios.len() / 2;
            *ratios.select_nth_unstable_by(middle, f32::total_cmp).1
        });
        for _ in 0..ROUNDS {
            let (mut here, mut behind) = ([0.0f64; 3], [0.0f64; 3]);
            for i in 0..color[0].len() {
                if (0..3).all(|c| (color[c][i] - light[c] * self.color[c][i]).abs() < SHADE) {
                    for c in 0..3 {
                        here[c] += f64::from(color[c][i]);
                        behind[c] += f64::from(self.color[c][i]);
                    }
                }
            }
            if behind.iter().all(|sum| *sum > 0.0) {
                light = [0, 1, 2].map(|c| (here[c] / behind[c]) as f32);
            }
        }
        light
    }

    /// Dilates `shown` by `pixels` if it `grows`, else erodes it by `pixels`.
    fn spread(&self, mut shown: Vec<bool>, pixels: usize, grows: bool) -> Vec<bool> {
        for _ in 0..pixels {
            let beside = |at: usize| adjacent(self.width, shown.len(), at);
            let all = 0..shown.len();
            shown = match grows {
                true => all.map(|at| shown[at] || beside(at).any(|to| shown[to])).collect(),
                false => all.map(|at| shown[at] && beside(at).all(|to| shown[to])).collect(),
            };
        }
        shown
    }

    /// Connected regions of pixels that are all `shown` or all not `shown`, largest first.
    fn regions(&self, shown: &[bool]) -> Vec<Vec<usize>> {
        let alike = |at: usize| adjacent(self.width, shown.len(), at).filter(move |to| shown[*to] == shown[at]);
        connected(shown.len(), alike)
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
        let backdrop = Backdrop::of(SIZE[0], SIZE[1], &pictures);
        let shown = backdrop.shown(&pictures[5]);
        let at = |x: usize, y: usize| shown[y * SIZE[0] + x];
        assert!(at(2, 2) && at(10, 24) && at(60, 24) && at(38, 44));
        assert!(!at(30, 24) && !at(38, 24) && !at(46, 30));
        assert!(backdrop.surrounds(&shown) > 0.99);
        let range = backdrop.range(&shown);
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
        let shown = Backdrop::of(SIZE[0], SIZE[1], &pictures).shown(&pictures[5]);
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
        let backdrop = Backdrop::of(SIZE[0], SIZE[1], &pictures);
        let shown = backdrop.shown(&pictures[0]);
        assert_eq!(backdrop.surrounds(&shown), 0.0);
        assert_eq!(backdrop.range(&shown), 0.0);
    }
}
