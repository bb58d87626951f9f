use crate::{Similarity, sh};

/// 3D Gaussians on the host, in the parameterisation of splat files. All columns have the same N.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GaussianCloud {
    /// Centres, `[N, 3]` world.
    pub means: Vec<[f32; 3]>,
    /// Rotations `w, x, y, z`, not necessarily normalised, `[N, 4]`.
    pub quats: Vec<[f32; 4]>,
    /// Natural logarithms of the standard deviations, `[N, 3]`.
    pub log_scales: Vec<[f32; 3]>,
    /// Opacity before the sigmoid, `[N]`.
    pub opacity_logits: Vec<f32>,
    /// Spherical harmonics, `[N, (degree + 1)^2, 3]`, flat; DC first; colour = SH + 0.5 clamped at 0.
    pub sh: Vec<f32>,
    /// Degree of `sh`, 0 to 4.
    pub sh_degree: u32,
    /// Whether the scene was trained with the Mip-Splatting filters, which rendering must then apply.
    pub antialiased: bool,
    /// From the coordinates of the dataset, in which files are written, to those of `means` and `log_scales`.
    pub world_from_dataset: Similarity,
}

impl GaussianCloud {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Coefficients per Gaussian and colour channel: `(degree + 1)^2`.
    pub fn sh_coefficients(&self) -> usize {
        sh::coefficients(self.sh_degree)
    }

    /// Whether all columns have matching lengths.
    pub fn is_consistent(&self) -> bool {
        let n = self.len();
        self.quats.len() == n
            && self.log_scales.len() == n
            && self.opacity_logits.len() == n
            && self.sh.len() == n * self.sh_coefficients() * 3
    }
}
