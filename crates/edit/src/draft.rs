use crate::{Photographs, Selection};
use glam::{DVec3, Vec3};
use irradia_scene::{Camera, GaussianCloud};
use rayon::prelude::*;
use std::borrow::Cow;

/// A scene that is being edited.
#[derive(Clone, Debug, PartialEq)]
pub struct Draft {
    /// The splats, hidden ones included.
    pub cloud: GaussianCloud,
    /// The training cameras, in the world of `cloud`; empty if they are not known. They move with the whole scene.
    pub cameras: Vec<Camera>,
    /// Splats that are neither drawn nor written nor selected.
    pub hidden: Selection,
    /// Splats that cannot be selected.
    pub locked: Selection,
    /// Splats that the last edit was applied to, or those that it added.
    pub last: Selection,
    /// Photographs of the cameras, as long as the remaining splats still match them.
    pub photographs: Option<Photographs>,
}

impl Draft {
    /// A scene with nothing hidden or locked; no `cameras` if they are not known.
    ///
    /// # Panics
    /// When the cloud's columns have unequal lengths.
    pub fn new(cloud: GaussianCloud, cameras: Vec<Camera>) -> Self {
        assert!(cloud.is_consistent(), "the columns of the cloud have unequal lengths");
        let n = cloud.len();
        Self {
            cloud,
            cameras,
            hidden: Selection::none(n),
            locked: Selection::none(n),
            last: Selection::none(n),
            photographs: None,
        }
    }

    /// Number of splats, hidden ones included.
    pub fn len(&self) -> usize {
        self.cloud.len()
    }

    /// Whether there are no splats.
    pub fn is_empty(&self) -> bool {
        self.cloud.is_empty()
    }

    /// The splats without the hidden ones, as they are drawn and written.
    pub fn visible_cloud(&self) -> Cow<'_, GaussianCloud> {
        if self.hidden.is_empty() {
            Cow::Borrowed(&self.cloud)
        } else {
            Cow::Owned(gather(&self.cloud, &self.visible().indices()))
        }
    }

    /// The splats that are not hidden.
    pub fn visible(&self) -> Selection {
        let mut visible = self.hidden.clone();
        visible.invert();
        visible
    }

    /// Median distance of the splats from their median, world units; 0 for a point.
    pub(crate) fn extent(&self) -> f64 {
        let means = &self.cloud.means;
        let center = Vec3::from_array([0, 1, 2].map(|c| median(means.iter().map(|mean| mean[c]).collect())));
        f64::from(median(
            means.iter().map(|mean| center.distance(Vec3::from(*mean))).collect(),
        ))
    }

    /// Centre of splat `i` in the coordinates of the dataset.
    pub(crate) fn position(&self, i: usize) -> DVec3 {
        let mean = DVec3::from(self.cloud.means[i].map(f64::from));
        self.cloud.world_from_dataset.invert(mean)
    }
}

/// The upper median; 0 if there are no values.
pub(crate) fn median(mut values: Vec<f32>) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() {
        0.0
    } else {
        *values.select_nth_unstable_by(middle, f32::total_cmp).1
    }
}

/// The splats `indices`, in that order.
pub(crate) fn gather(cloud: &GaussianCloud, indices: &[u32]) -> GaussianCloud {
    let width = 3 * cloud.sh_coefficients();
    let mut harmonics = vec![0.0; indices.len() * width];
    harmonics
        .par_chunks_mut(width)
        .with_min_len(1024)
        .zip(indices)
        .for_each(|(to, i)| to.copy_from_slice(&cloud.sh[*i as usize * width..][..width]));
    GaussianCloud {
        sh: harmonics,
        sh_degree: cloud.sh_degree,
        extra: cloud.extra.iter().map(|column| column.gather(indices)).collect(),
        ..gather_gray(cloud, indices)
    }
}

/// The splats `indices`, in that order, in grey and without extra columns: a quarter of the memory.
pub(crate) fn gather_gray(cloud: &GaussianCloud, indices: &[u32]) -> GaussianCloud {
    fn rows<T: Copy + Send + Sync>(column: &[T], indices: &[u32]) -> Vec<T> {
        indices
            .par_iter()
            .with_min_len(1024)
            .map(|i| column[*i as usize])
            .collect()
    }
    GaussianCloud {
        means: rows(&cloud.means, indices),
        quats: rows(&cloud.quats, indices),
        log_scales: rows(&cloud.log_scales, indices),
        opacity_logits: rows(&cloud.opacity_logits, indices),
        sh: vec![0.0; 3 * indices.len()],
        sh_degree: 0,
        antialiased: cloud.antialiased,
        world_from_dataset: cloud.world_from_dataset,
        extra: Vec::new(),
    }
}

/// Appends the splats of `other`, which has the same world and degree. Extra columns that only one of the two has are zero for the splats
/// of the other.
pub(crate) fn append(cloud: &mut GaussianCloud, other: &GaussianCloud) {
    assert_eq!(cloud.sh_degree, other.sh_degree, "clouds of the same degree");
    for column in &other.extra {
        // A column of the same name but another type is dropped: a file has one type per name.
        if cloud.extra.iter().all(|own| own.name != column.name) {
            cloud.extra.push(column.zeros(cloud.len()));
        }
    }
    for column in &mut cloud.extra {
        column.append(&other.extra, other.len());
    }
    cloud.means.extend_from_slice(&other.means);
    cloud.quats.extend_from_slice(&other.quats);
    cloud.log_scales.extend_from_slice(&other.log_scales);
    cloud.opacity_logits.extend_from_slice(&other.opacity_logits);
    cloud.sh.extend_from_slice(&other.sh);
}

/// Keeps the first `n` splats.
pub(crate) fn truncate(cloud: &mut GaussianCloud, n: usize) {
    let width = 3 * cloud.sh_coefficients();
    cloud.means.truncate(n);
    cloud.quats.truncate(n);
    cloud.log_scales.truncate(n);
    cloud.opacity_logits.truncate(n);
    cloud.sh.truncate(n * width);
    for column in &mut cloud.extra {
        column.bytes.truncate(n * column.scalar.size());
    }
}

/// Overwrites the splats `indices` with the rows of `from`.
pub(crate) fn scatter(cloud: &mut GaussianCloud, indices: &[u32], from: &GaussianCloud) {
    let width = 3 * cloud.sh_coefficients();
    for (row, i) in indices.iter().map(|i| *i as usize).enumerate() {
        cloud.means[i] = from.means[row];
        cloud.quats[i] = from.quats[row];
        cloud.log_scales[i] = from.log_scales[row];
        cloud.opacity_logits[i] = from.opacity_logits[row];
        cloud.sh[i * width..][..width].copy_from_slice(&from.sh[row * width..][..width]);
    }
    for (column, from) in cloud.extra.iter_mut().zip(&from.extra) {
        column.scatter(indices, from);
    }
}
