use super::assert_same_size;
use crate::window::{C1, C2, RADIUS, half_window};
use irradia_scene::Image;
use rayon::prelude::*;

/// Mean structural similarity (Wang et al. 2004, eq. 13) over pixels and channels: 11x11 Gaussian window of sigma 1.5,
/// zeros beyond the border, as in the Inria code.
///
/// # Panics
/// When sizes differ.
pub fn ssim(render: &Image, truth: &Image) -> f64 {
    ssim_masked(render, truth, None)
}

/// [`ssim`] as a mean over the pixels at which `mask [H, W]` is not 0; 1 if there are none. Windows include masked pixels
/// of the render.
///
/// # Panics
/// When sizes differ.
pub fn ssim_masked(render: &Image, truth: &Image, mask: Option<&[u8]>) -> f64 {
    assert_same_size(render, truth, mask);
    let (width, channels) = (truth.width as usize, truth.channels as usize);
    let counts = |x: usize, y: usize| mask.is_none_or(|mask| mask[y * width + x] != 0);
    // Rows are collected before they are summed, so that the order of the sum does not depend on the number of threads.
    let rows: Vec<(f64, usize)> = (0..truth.height as usize)
        .into_par_iter()
        .map_init(
            || Row::new(width),
            |row, y| {
                let (mut sum, mut count) = (0.0, 0);
                for channel in 0..channels {
                    row.blur_vertically(render, truth, channel, y);
                    for x in (0..width).filter(|x| counts(*x, y)) {
                        sum += row.similarity(x);
                        count += 1;
                    }
                }
                (sum, count)
            },
        )
        .collect();
    let (sum, count) = rows
        .into_iter()
        .fold((0.0, 0), |(s, n), (sum, count)| (s + sum, n + count));
    if count == 0 { 1.0 } else { sum / count as f64 }
}

/// The five moments x, y, x^2, y^2, xy along one row, with the window applied along y and [`RADIUS`] zeros at both ends.
struct Row {
    half: [f64; RADIUS + 1],
    moments: Vec<[f64; 5]>,
}

impl Row {
    fn new(width: usize) -> Self {
        Self {
            half: half_window(),
            moments: vec![[0.0; 5]; width + 2 * RADIUS],
        }
    }

    fn blur_vertically(&mut self, render: &Image, truth: &Image, channel: usize, y: usize) {
        let (width, height, channels) = (truth.width as usize, truth.height as usize, truth.channels as usize);
        let inner = RADIUS..RADIUS + width;
        self.moments[inner.clone()].fill([0.0; 5]);
        for row in y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(height) {
            let weight = self.half[row.abs_diff(y)];
            let span = row * width * channels..(row + 1) * width * channels;
            let pairs = render.data[span.clone()]
                .chunks_exact(channels)
                .zip(truth.data[span].chunks_exact(channels));
            for (moments, (a, b)) in self.moments[inner.clone()].iter_mut().zip(pairs) {
                let (a, b) = (f64::from(a[channel]), f64::from(b[channel]));
                for (moment, value) in moments.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                    *moment += weight * value;
                }
            }
        }
    }

    fn similarity(&self, x: usize) -> f64 {
        let mut blurred = [0.0; 5];
        for (k, moments) in self.moments[x..x + 2 * RADIUS + 1].iter().enumerate() {
            let weight = self.half[k.abs_diff(RADIUS)];
            for (sum, moment) in blurred.iter_mut().zip(moments) {
                *sum += weight * moment;
            }
        }
        let [a, b, aa, bb, ab] = blurred;
        let (variances, covariance) = (aa - a * a + bb - b * b, ab - a * b);
        (2.0 * a * b + C1) * (2.0 * covariance + C2) / ((a * a + b * b + C1) * (variances + C2))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_images_score_one_and_inverted_ones_below_zero() {
        let stripes: Vec<f32> = (0..64 * 64 * 3).map(|i| ((i / 3) % 2) as f32).collect();
        let truth = Image::new(64, 64, 3, stripes);
        let mut render = truth.clone();
        assert!((ssim(&render, &truth) - 1.0).abs() < 1e-12);
        render.data.iter_mut().for_each(|v| *v = 1.0 - *v);
        // -1 except within five pixels of the border, where both windows contain the same zeros.
        let opposite = ssim(&render, &truth);
        assert!(opposite < -0.6, "{opposite}");
    }

    #[test]
    fn a_single_pixel_matches_the_formula() {
        // One pixel surrounded by zeros: every moment is the value times w0^2.
        let (a, b) = (0.5f64, 0.25);
        let w = half_window()[0] * half_window()[0];
        let image = |v: f64| Image::new(1, 1, 3, vec![v as f32; 3]);
        let luminance = (2.0 * w * w * a * b + C1) / (w * w * (a * a + b * b) + C1);
        let structure = (2.0 * (w - w * w) * a * b + C2) / ((w - w * w) * (a * a + b * b) + C2);
        assert!((ssim(&image(a), &image(b)) - luminance * structure).abs() < 1e-12);
    }

    #[test]
    fn masked_pixels_are_excluded_from_the_mean() {
        let truth = Image::new(40, 1, 3, vec![0.5; 120]);
        let mut render = truth.clone();
        render.data[..3].fill(0.0);
        let mut mask = vec![255u8; 40];
        assert!(ssim_masked(&render, &truth, Some(&mask)) < 0.999);
        // The window reaches five pixels.
        mask[..6].fill(0);
        assert!((ssim_masked(&render, &truth, Some(&mask)) - 1.0).abs() < 1e-12);
        assert_eq!(ssim_masked(&render, &truth, Some(&[0; 40])), 1.0);
    }
}
