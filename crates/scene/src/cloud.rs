use crate::{ExtraColumn, Similarity, sh};
use glam::DVec3;

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
    /// Further values that the file has for each splat, `[N]` each, with distinct names.
    pub extra: Vec<ExtraColumn>,
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
            && self.extra.iter().all(|column| column.len() == n)
    }

    /// Sets the degree of the harmonics: higher bands are dropped, new ones are zero.
    pub fn set_degree(&mut self, degree: u32) {
        if self.sh_degree == degree {
            return;
        }
        let (old, new) = (3 * self.sh_coefficients(), 3 * sh::coefficients(degree));
        let common = old.min(new);
        let mut harmonics = vec![0.0; self.len() * new];
        for (to, from) in harmonics.chunks_exact_mut(new).zip(self.sh.chunks_exact(old)) {
            to[..common].copy_from_slice(&from[..common]);
        }
        (self.sh, self.sh_degree) = (harmonics, degree);
    }

    /// Converts the splats to another world of the same dataset.
    pub fn bring_to_world(&mut self, world_from_dataset: Similarity) {
        let from = self.world_from_dataset;
        if from == world_from_dataset {
            return;
        }
        for mean in &mut self.means {
            let position = from.invert(DVec3::from(mean.map(f64::from)));
            *mean = world_from_dataset.apply(position).as_vec3().to_array();
        }
        let log_ratio = (world_from_dataset.scale / from.scale).ln();
        for scale in self.log_scales.as_flattened_mut() {
            *scale = (f64::from(*scale) + log_ratio) as f32;
        }
        self.world_from_dataset = world_from_dataset;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud() -> GaussianCloud {
        GaussianCloud {
            means: vec![[1.0, 2.0, 3.0], [-4.0, 0.5, 0.0]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            log_scales: vec![[0.0, 1.0, 2.0]; 2],
            opacity_logits: vec![0.0; 2],
            sh: (0..24).map(|i| i as f32).collect(),
            sh_degree: 1,
            ..GaussianCloud::default()
        }
    }

    #[test]
    fn another_degree_keeps_the_common_bands() {
        let mut changed = cloud();
        changed.set_degree(3);
        assert!(changed.is_consistent());
        assert_eq!((changed.sh[11], changed.sh[12], changed.sh[48]), (11.0, 0.0, 12.0));
        changed.set_degree(1);
        assert_eq!(changed, cloud());
        changed.set_degree(0);
        assert_eq!(changed.sh, [0.0, 1.0, 2.0, 12.0, 13.0, 14.0]);
    }

    #[test]
    fn another_world_has_the_same_splats_in_the_dataset() {
        let world = Similarity {
            scale: 0.5,
            center: DVec3::new(10.0, 0.0, 0.0),
        };
        let mut moved = cloud();
        moved.bring_to_world(world);
        assert_eq!(moved.means[0], [-4.5, 1.0, 1.5]);
        assert!((moved.log_scales[0][1] - 0.5f32.ln() - 1.0).abs() < 1e-6);
        moved.bring_to_world(Similarity::IDENTITY);
        assert_eq!(moved.means, cloud().means);
    }
}
