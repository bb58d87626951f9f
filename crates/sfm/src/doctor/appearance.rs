//! Sharpness and exposure of a photograph, measured from its pixels.

/// Levels, of 255, at and above (white) or at and below (black) which a pixel has no detail left.
const MIN_WHITE_LEVEL: u8 = 250;
const MAX_BLACK_LEVEL: u8 = 4;
/// Side of the blocks in which sharpness is measured, px.
const BLOCK_SIDE: usize = 32;
/// Fraction of the blocks that count, the sharpest: a near subject in front of an unfocused background is sharp.
const SHARPEST_FRACTION: f64 = 0.2;
/// Distance between the pixels of a coarse difference, px.
const COARSE_STEP: usize = 8;
/// The photograph is reduced until its long side is at most this, px: a blur of single pixels in large photographs does no harm.
const MAX_LONG_SIDE: usize = 1000;

/// Measurements of a photograph's pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Appearance {
    /// Energy of differences over one pixel relative to that over eight, in the direction where it is smallest, within the sharpest
    /// fifth of the photograph: about 0.12 on sharp edges, and less the wider they are. It depends little on what is shown
    /// (after Crete et al., "The blur effect", 2007, who compare an image with a blurred copy). 0 if there is no contrast.
    pub sharpness: f32,
    /// Mean brightness in \[0, 1\].
    pub brightness: f32,
    /// Fraction of the pixels that are white.
    pub white: f32,
    /// Fraction of the pixels that are black.
    pub black: f32,
    /// Fraction of the pixels that are masked; the other figures leave them out.
    pub hidden: f32,
}

impl Appearance {
    /// The figures as they are stored.
    pub fn to_array(self) -> [f32; 5] {
        [self.sharpness, self.brightness, self.white, self.black, self.hidden]
    }

    /// From the figures as they are stored.
    pub fn from_array([sharpness, brightness, white, black, hidden]: [f32; 5]) -> Self {
        Self {
            sharpness,
            brightness,
            white,
            black,
            hidden,
        }
    }

    /// Measures grey pixels `[H, W]`; those where `mask` is below 128 are ignored.
    ///
    /// # Panics
    /// When the length of the pixels or of the mask is not width times height.
    pub fn measure(width: usize, height: usize, grey: &[u8], mask: Option<&[u8]>) -> Self {
        assert_eq!(grey.len(), width * height);
        let is_visible = |i: usize| mask.is_none_or(|mask| mask[i] >= 128);
        let (mut count, mut sum, mut white, mut black) = (0u64, 0u64, 0u64, 0u64);
        for (_, value) in grey.iter().enumerate().filter(|(i, _)| is_visible(*i)) {
            count += 1;
            sum += u64::from(*value);
            white += u64::from(*value >= MIN_WHITE_LEVEL);
            black += u64::from(*value <= MAX_BLACK_LEVEL);
        }
        let fraction = |part: u64| (part as f64 / count.max(1) as f64) as f32;
        let reduced = ReducedPhoto::new(width, height, grey, mask);
        Self {
            sharpness: reduced.sharpness(),
            brightness: fraction(sum) / 255.0,
            white: fraction(white),
            black: fraction(black),
            hidden: ((grey.len() as u64 - count) as f64 / grey.len().max(1) as f64) as f32,
        }
    }
}

/// A photograph at the size at which sharpness is measured.
struct ReducedPhoto {
    width: usize,
    height: usize,
    /// Means of the pixels that were reduced to one; `NAN` where masked.
    grey: Vec<f32>,
}

impl ReducedPhoto {
    fn new(width: usize, height: usize, grey: &[u8], mask: Option<&[u8]>) -> Self {
        let factor = width.max(height).div_ceil(MAX_LONG_SIDE).max(1);
        let (w, h) = (width / factor, height / factor);
        let mean = |x: usize, y: usize| {
            let mut sum = 0.0;
            for row in y * factor..(y + 1) * factor {
                for i in row * width + x * factor..row * width + (x + 1) * factor {
                    if mask.is_some_and(|mask| mask[i] < 128) {
                        return f32::NAN;
                    }
                    sum += f32::from(grey[i]);
                }
            }
            sum / (factor * factor) as f32
        };
        let grey = (0..w * h).map(|i| mean(i % w, i / w)).collect();
        Self {
            width: w,
            height: h,
            grey,
        }
    }

    /// Energy of fine and of coarse differences in four directions, in the block from `x0, y0`.
    fn energies(&self, x0: usize, y0: usize) -> [[f64; 2]; 4] {
        let mut sums = [[0.0; 2]; 4];
        for y in y0..y0 + BLOCK_SIDE {
            for x in x0..x0 + BLOCK_SIDE {
                let at = |dx: usize, dy: usize| self.grey[(y + dy) * self.width + x + dx];
                // Both diagonals start in the same rows, so that all directions use the same pixels.
                for (sum, [from, near, far]) in sums.iter_mut().zip([
                    [at(0, 0), at(1, 0), at(COARSE_STEP, 0)],
                    [at(0, 0), at(0, 1), at(0, COARSE_STEP)],
                    [at(0, 0), at(1, 1), at(COARSE_STEP, COARSE_STEP)],
                    [at(COARSE_STEP, 0), at(COARSE_STEP - 1, 1), at(0, COARSE_STEP)],
                ]) {
                    let (fine, coarse) = (near - from, far - from);
                    if coarse.is_finite() && fine.is_finite() {
                        sum[0] += f64::from(fine * fine);
                        sum[1] += f64::from(coarse * coarse);
                    }
                }
            }
        }
        sums
    }

    fn sharpness(&self) -> f32 {
        let mut blocks: Vec<[[f64; 2]; 4]> = Vec::new();
        let starts = |side: usize| (0..(side + 1).saturating_sub(BLOCK_SIDE + COARSE_STEP)).step_by(BLOCK_SIDE);
        for y in starts(self.height) {
            for x in starts(self.width) {
                blocks.push(self.energies(x, y));
            }
        }
        let fine = |block: &[[f64; 2]; 4]| block.iter().map(|sums| sums[0]).sum::<f64>();
        blocks.sort_by(|a, b| fine(b).total_cmp(&fine(a)));
        blocks.truncate(((blocks.len() as f64 * SHARPEST_FRACTION) as usize).max(4));
        let ratio = |direction: usize| {
            let [fine, coarse] = [0, 1].map(|scale| blocks.iter().map(|block| block[direction][scale]).sum::<f64>());
            // Noise of one grey level in every pixel is not contrast.
            let noise_energy = (blocks.len() * BLOCK_SIDE * BLOCK_SIDE) as f64;
            if coarse > noise_energy { fine / coarse } else { 0.0 }
        };
        (0..4).map(ratio).fold(f64::INFINITY, f64::min) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;

    /// Random patches of 12 px, smeared along x over `smear` px.
    fn patches(smear: usize) -> Vec<u8> {
        let (w, h) = (320usize, 240usize);
        let mut rng = Rng::new(5, 1);
        let levels: Vec<f32> = (0..60 * 40).map(|_| rng.range(20.0, 230.0)).collect();
        let at = |x: usize, y: usize| levels[(y / 12) * 60 + x / 12];
        (0..w * h)
            .map(|i| {
                let (x, y) = (i % w, i / w);
                ((0..smear).map(|s| at(x + s, y)).sum::<f32>() / smear as f32) as u8
            })
            .collect()
    }

    #[test]
    fn the_wider_the_smear_the_less_sharp() {
        let sharpness: Vec<f32> = [1, 3, 6, 12]
            .map(|smear| Appearance::measure(320, 240, &patches(smear), None).sharpness)
            .to_vec();
        // A step of height 1 has one fine and eight coarse differences along its normal.
        assert!((0.1..0.18).contains(&sharpness[0]), "{sharpness:?}");
        assert!(sharpness.windows(2).all(|s| s[1] < 0.8 * s[0]), "{sharpness:?}");
    }

    #[test]
    fn masked_pixels_and_plain_pictures_do_not_count() {
        let mut grey = vec![255u8; 64 * 48];
        let mask: Vec<u8> = (0..64 * 48).map(|i| if i % 64 < 32 { 0 } else { 255 }).collect();
        grey.iter_mut()
            .enumerate()
            .filter(|(i, _)| i % 64 >= 32)
            .for_each(|(_, v)| *v = 100);
        let seen = Appearance::measure(64, 48, &grey, Some(&mask));
        assert_eq!(
            (seen.white, seen.black, seen.sharpness, seen.hidden),
            (0.0, 0.0, 0.0, 0.5)
        );
        assert!((seen.brightness - 100.0 / 255.0).abs() < 1e-6);
        assert_eq!(Appearance::measure(0, 0, &[], None), Appearance::default());
        assert_eq!(Appearance::measure(3, 1, &[0, 255, 9], None).white, 1.0 / 3.0);
        // The smallest photograph with a block: coarse differences are eight times the fine ones, in all directions.
        let ramp: Vec<u8> = (0..40 * 40).map(|i| (2 * (i % 40) + i / 40) as u8).collect();
        assert_eq!(Appearance::measure(40, 40, &ramp, None).sharpness, 1.0 / 64.0);
    }
}
