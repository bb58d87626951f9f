//! Image quality: losses with gradients for training ([`loss`]) and metrics for reports ([`metric`]).
//!
//! Symbols: render is the image being assessed, truth the photograph; H, W are rows and columns; colour is sRGB-encoded in
//! \[0, 1\]. Losses and metrics are separate code on purpose: losses are fast and in single precision, metrics simple and in
//! double precision, and each verifies the other.
#![forbid(unsafe_code)]

#[cfg(feature = "gpu")]
pub mod gpu;
pub mod loss;
pub mod metric;
mod real;
mod window;

pub use loss::coarse::CoarseLoss;
pub use loss::depth::{DepthKind, DepthLoss, DepthSample};
pub use loss::normal::{NormalLoss, NormalSample};
pub use loss::perceptual::{Crop, perceptual};
pub use loss::smooth::{SmoothLoss, Smoothed};
pub use loss::{DepthGradient, DepthPlanes, LossValues, LossWeights, PhotometricLoss, Target, Truth};
pub use metric::{
    Affine, Evaluation, ImportedTensor, Lpips, LpipsError, LpipsNet, Networks, evaluate, psnr, psnr_masked, ssim,
    ssim_masked, to_weights_file,
};
