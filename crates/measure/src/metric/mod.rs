//! Metrics for reports: PSNR, SSIM and LPIPS of a render against its photograph.

mod affine;
mod lpips;
mod psnr;
mod ssim;

pub use affine::Affine;
pub use lpips::{ImportedTensor, Lpips, LpipsError, LpipsNet, to_weights_file};
pub(crate) use lpips::{Map, Network};
pub use psnr::{psnr, psnr_masked};
pub use ssim::{ssim, ssim_masked};

use irradia_scene::Image;

/// The metrics of one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Evaluation {
    /// Peak signal-to-noise ratio, dB; infinite where the images are equal.
    pub psnr: f64,
    /// PSNR, dB, after the best affine colour map from render to photograph, which removes differences in exposure and white balance. Not
    /// comparable with the figures of others: the map of multinerf's `color_correct` is quadratic, that of gsplat's `color_correct_affine`
    /// has no terms between channels.
    pub psnr_corrected: f64,
    /// Mean structural similarity, at most 1.
    pub ssim: f64,
    /// Learned perceptual distance, 0 for equal images; `None` without weights or for images below [`LpipsNet::min_side`].
    pub lpips: Option<f64>,
    /// LPIPS by [`Networks::unseen`].
    pub unseen_lpips: Option<f64>,
    /// PSNR in dB over the right half of the view, after fitting exposure or pose on its left half; `None` if not requested.
    /// [`evaluate`] returns `None`.
    pub half_fit_psnr: Option<f64>,
}

/// The networks that compute LPIPS.
#[derive(Clone, Copy, Default)]
pub struct Networks<'a> {
    /// The network that a recipe's perceptual loss uses, if it has one.
    pub first: Option<&'a Lpips>,
    /// A network that training does not see: a scene trained on one network's distance is flattered by the same network.
    pub unseen: Option<&'a Lpips>,
}

impl Networks<'_> {
    /// Whether there is any network.
    pub fn any(&self) -> bool {
        self.first.is_some() || self.unseen.is_some()
    }
}

/// All metrics of `render` against `truth`, both `[H, W, 3]` and first rounded to 8 bits, as for published figures.
///
/// Pixels where `mask [H, W]` is 0 are excluded: PSNR and SSIM do not count them, and the render takes the truth's colours
/// there, so that SSIM's windows and LPIPS see no difference. LPIPS remains a mean over the whole image.
///
/// # Panics
/// When sizes differ: a bug in the caller.
pub fn evaluate(render: &Image, truth: &Image, mask: Option<&[u8]>, networks: Networks) -> Evaluation {
    assert_same_size(render, truth, mask);
    let (mut render, truth) = (render.rounded_to_8_bits(), truth.rounded_to_8_bits());
    if let Some(mask) = mask {
        render = with_truth_where_masked(&render, &truth, mask);
    }
    let corrected = Affine::fit(&render, &truth, |i| mask.is_none_or(|mask| mask[i] != 0)).apply_to(&render);
    let distance = |lpips: Option<&Lpips>| lpips.and_then(|net| net.distance(&render, &truth).ok());
    Evaluation {
        psnr: psnr_masked(&render, &truth, mask),
        psnr_corrected: psnr_masked(&corrected.rounded_to_8_bits(), &truth, mask),
        ssim: ssim_masked(&render, &truth, mask),
        lpips: distance(networks.first),
        unseen_lpips: distance(networks.unseen),
        half_fit_psnr: None,
    }
}

fn with_truth_where_masked(render: &Image, truth: &Image, mask: &[u8]) -> Image {
    let mut out = render.clone();
    let channels = out.channels as usize;
    let pixels = out
        .data
        .chunks_exact_mut(channels)
        .zip(truth.data.chunks_exact(channels));
    for ((pixel, truth), _) in pixels.zip(mask).filter(|(_, m)| **m == 0) {
        pixel.copy_from_slice(truth);
    }
    out
}

fn assert_same_size(render: &Image, truth: &Image, mask: Option<&[u8]>) {
    let size = |image: &Image| (image.width, image.height, image.channels);
    assert_eq!(size(render), size(truth), "render and truth have the same size");
    if let Some(mask) = mask {
        let pixels = truth.width as usize * truth.height as usize;
        assert_eq!(mask.len(), pixels, "the mask has one value per pixel");
    }
}
