use super::assert_same_size;
use irradia_scene::Image;

/// Peak signal-to-noise ratio in dB for values in \[0, 1\]: `-10 log10(mean squared error over all values)`.
///
/// Equal images give infinity.
///
/// # Panics
/// When sizes differ.
pub fn psnr(render: &Image, truth: &Image) -> f64 {
    psnr_masked(render, truth, None)
}

/// [`psnr`] over the pixels at which `mask [H, W]` is not 0; infinity if there are none.
///
/// # Panics
/// When sizes differ.
pub fn psnr_masked(render: &Image, truth: &Image, mask: Option<&[u8]>) -> f64 {
    assert_same_size(render, truth, mask);
    let channels = truth.channels as usize;
    let pixels = render
        .data
        .chunks_exact(channels)
        .zip(truth.data.chunks_exact(channels));
    let (mut sum, mut count) = (0.0f64, 0usize);
    for (i, (a, b)) in pixels.enumerate() {
        if mask.is_none_or(|mask| mask[i] != 0) {
            let squares = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2));
            sum += squares.sum::<f64>();
            count += channels;
        }
    }
    // A sum of 0 gives +infinity, for any count.
    -10.0 * (sum / count.max(1) as f64).log10()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_difference_of_a_tenth_is_twenty_decibels() {
        let truth = Image::new(4, 3, 3, vec![0.25; 36]);
        let render = Image::new(4, 3, 3, vec![0.35; 36]);
        // 0.35 - 0.25 in f32 is a tenth to within 1e-7, or 1e-5 dB.
        assert!((psnr(&render, &truth) - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&truth, &truth), f64::INFINITY);
    }

    #[test]
    fn masked_pixels_do_not_count() {
        let truth = Image::zeros(2, 1, 3);
        let render = Image::new(2, 1, 3, vec![0.5, 0.5, 0.5, 1.0, 1.0, 1.0]);
        let only_first = psnr_masked(&render, &truth, Some(&[255, 0]));
        assert!((only_first - 20.0 * 2f64.log10()).abs() < 1e-12);
        assert_eq!(psnr_masked(&render, &truth, Some(&[0, 0])), f64::INFINITY);
    }
}
