use glam::{Quat, Vec3};
use irradia_compute::Planes;
use irradia_scene::{GaussianCloud, sh};
use rayon::prelude::*;
use std::borrow::Cow;

/// The surface element that a splat represents.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// The splat's mean, world.
    pub mean: [f32; 3],
    /// Its shortest axis, unit length, world; of arbitrary sign.
    pub normal: [f32; 3],
}

/// 3D Gaussians during training: five planar columns of the same N. Gradients and both Adam moments have this shape, too, so
/// that gather, sort and append are written once.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Splats {
    /// Centres, 3 planes `[N]`, world.
    pub means: Planes,
    /// Rotations w, x, y, z, raw, 4 planes.
    pub quats: Planes,
    /// ln of the standard deviations, 3 planes, world.
    pub log_scales: Planes,
    /// Opacity before the sigmoid, 1 plane.
    pub opacity_logits: Planes,
    /// Spherical harmonics, plane `3 k + c` is coefficient k of channel c; `3 (degree + 1)^2` planes.
    pub sh: Planes,
}

impl From<Splats> for Cow<'_, Splats> {
    fn from(splats: Splats) -> Self {
        Cow::Owned(splats)
    }
}

impl<'a> From<&'a Splats> for Cow<'a, Splats> {
    fn from(splats: &'a Splats) -> Self {
        Cow::Borrowed(splats)
    }
}

/// Names of the columns, in the order of [`Splats::columns`].
pub const COLUMN_NAMES: [&str; 5] = ["means", "quats", "log_scales", "opacity_logits", "sh"];

impl Splats {
    /// `n` splats of zeros with room for SH of `degree`.
    pub fn zeros(n: usize, degree: u32) -> Self {
        Self {
            means: Planes::zeros(3, n),
            quats: Planes::zeros(4, n),
            log_scales: Planes::zeros(3, n),
            opacity_logits: Planes::zeros(1, n),
            sh: Planes::zeros(3 * sh::coefficients(degree), n),
        }
    }

    /// From a point cloud of Gaussians. Bands above [`sh::MAX_DEGREE`] are dropped.
    pub fn from_cloud(cloud: &GaussianCloud) -> Self {
        let per_item = 3 * cloud.sh_coefficients();
        let kept = 3 * sh::coefficients(cloud.sh_degree.min(sh::MAX_DEGREE));
        let sh = if kept == per_item {
            Planes::from_interleaved(kept, &cloud.sh)
        } else {
            let values: Vec<f32> = cloud
                .sh
                .chunks_exact(per_item)
                .flat_map(|item| &item[..kept])
                .copied()
                .collect();
            Planes::from_interleaved(kept, &values)
        };
        Self {
            means: Planes::from_interleaved(3, cloud.means.as_flattened()),
            quats: Planes::from_interleaved(4, cloud.quats.as_flattened()),
            log_scales: Planes::from_interleaved(3, cloud.log_scales.as_flattened()),
            opacity_logits: Planes::from_interleaved(1, &cloud.opacity_logits),
            sh,
        }
    }

    /// To a cloud of Gaussians, bit for bit.
    pub fn to_cloud(&self) -> GaussianCloud {
        GaussianCloud {
            means: self.means.to_interleaved().as_chunks().0.to_vec(),
            quats: self.quats.to_interleaved().as_chunks().0.to_vec(),
            log_scales: self.log_scales.to_interleaved().as_chunks().0.to_vec(),
            opacity_logits: self.opacity_logits.to_interleaved(),
            sh: self.sh.to_interleaved(),
            sh_degree: self.sh_degree(),
            ..GaussianCloud::default()
        }
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Length of every plane with padding.
    pub fn stride(&self) -> usize {
        self.means.stride()
    }

    /// Highest SH degree that fits.
    pub fn sh_degree(&self) -> u32 {
        (0..=sh::MAX_DEGREE)
            .find(|d| 3 * sh::coefficients(*d) == self.sh.count())
            .unwrap_or(0)
    }

    /// Highest SH degree with a coefficient other than zero.
    pub fn used_sh_degree(&self) -> u32 {
        let is_used = |degree: &u32| {
            let mut planes = 3 * sh::coefficients(degree - 1)..3 * sh::coefficients(*degree);
            planes.any(|c| self.sh.plane(c)[..self.len()].iter().any(|v| *v != 0.0))
        };
        (1..=self.sh_degree()).rev().find(is_used).unwrap_or(0)
    }

    pub(crate) fn from_columns([means, quats, log_scales, opacity_logits, sh]: [Planes; 5]) -> Self {
        Self {
            means,
            quats,
            log_scales,
            opacity_logits,
            sh,
        }
    }

    /// The five columns.
    pub fn columns(&self) -> [&Planes; 5] {
        [
            &self.means,
            &self.quats,
            &self.log_scales,
            &self.opacity_logits,
            &self.sh,
        ]
    }

    /// The five columns, mutable.
    pub fn columns_mut(&mut self) -> [&mut Planes; 5] {
        [
            &mut self.means,
            &mut self.quats,
            &mut self.log_scales,
            &mut self.opacity_logits,
            &mut self.sh,
        ]
    }

    /// The splats `indices`, in that order.
    pub fn gather(&self, indices: &[u32]) -> Self {
        Self::from_columns(self.columns().map(|c| c.gather(indices)))
    }

    /// Centre of splat `i`, world units.
    pub fn mean(&self, i: usize) -> [f32; 3] {
        std::array::from_fn(|c| self.means.plane(c)[i])
    }

    /// The unit axis along which splat `i` is thinnest, world: for flat splats the normal, of arbitrary sign.
    pub fn shortest_axis(&self, i: usize) -> [f32; 3] {
        let [w, x, y, z] = std::array::from_fn(|c| self.quats.plane(c)[i]);
        let scale = |axis: &usize| self.log_scales.plane(*axis)[i];
        let thinnest = (0..3).min_by(|a, b| scale(a).total_cmp(&scale(b))).unwrap_or(0);
        let normal = Quat::from_xyzw(x, y, z, w) * Vec3::AXES[thinnest];
        normal.normalize_or(Vec3::Z).to_array()
    }

    /// The surface elements of the splats `indices`, in that order.
    pub fn surfaces(&self, indices: &[u32]) -> Vec<Surface> {
        let surface = |i: &u32| Surface {
            mean: self.mean(*i as usize),
            normal: self.shortest_axis(*i as usize),
        };
        indices.par_iter().with_min_len(1024).map(surface).collect()
    }

    /// Allocated bytes.
    pub fn bytes(&self) -> usize {
        self.columns().iter().map(|c| c.bytes()).sum()
    }

    /// Opacity of splat `i`, in (0, 1).
    pub fn opacity(&self, i: usize) -> f32 {
        sigmoid(self.opacity_logits.get(0, i))
    }
}

/// `1 / (1 + e^-x)`.
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// The inverse of [`sigmoid`].
pub fn logit(p: f32) -> f32 {
    (p / (1.0 - p)).ln()
}
