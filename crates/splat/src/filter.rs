//! The 3D smoothing filter of Mip-Splatting (Yu et al. 2024, section 5.1): no splat is finer than the training views'
//! sampling rate, so that closer cameras show no erosion artefacts.

use crate::{SplatState, Splats, ViewParams, logit, sigmoid};
use rayon::prelude::*;

/// Variance of the filter in units of the squared sampling interval (`s` in eq. 7; 0.2 in the paper).
const FILTER_VARIANCE: f64 = 0.2;
/// A view is included where a centre falls within its image extended by this fraction on each side (the authors' code).
const IMAGE_MARGIN: f64 = 0.15;

/// Sets `state.filter` from the highest sampling rate, focal length over depth, of each splat over `views`. Splats outside all
/// views get the coarsest filter of the others.
pub fn update(state: &mut SplatState, views: &[ViewParams]) {
    let n = state.len();
    let means = &state.splats.means;
    let variances: Vec<f32> = (0..n)
        .into_par_iter()
        .with_min_len(1024)
        .map(|i| {
            let mean: [f64; 3] = std::array::from_fn(|c| f64::from(means.get(c, i)));
            let sampling_rate = views
                .iter()
                .filter_map(|view| sampling_rate(view, mean))
                .fold(0.0f64, f64::max);
            if sampling_rate > 0.0 {
                (FILTER_VARIANCE / (sampling_rate * sampling_rate)) as f32
            } else {
                0.0
            }
        })
        .collect();
    let coarsest = variances.iter().copied().fold(0.0f32, f32::max);
    for (to, variance) in state.filter.plane_mut(0)[..n].iter_mut().zip(variances) {
        *to = if variance > 0.0 { variance } else { coarsest };
    }
}

/// Samples per world unit at `mean`, if `view` sees it.
fn sampling_rate(view: &ViewParams, mean: [f64; 3]) -> Option<f64> {
    let x: [f64; 3] =
        std::array::from_fn(|i| (0..3).map(|j| view.rotation[i][j] * mean[j]).sum::<f64>() + view.translation[i]);
    let (pixel, depth) = match &view.lens {
        Some(lens) => lens.project(x, view.focal, view.principal)?,
        None => (
            std::array::from_fn(|i| view.focal[i] * x[i] / x[2] + view.principal[i]),
            x[2],
        ),
    };
    let size = [f64::from(view.width), f64::from(view.height)];
    let inside = depth > view.near
        && (0..2).all(|i| (-IMAGE_MARGIN * size[i]..=(1.0 + IMAGE_MARGIN) * size[i]).contains(&pixel[i]));
    inside.then(|| view.focal[0].max(view.focal[1]) / depth)
}

/// The splats with the filter baked in, for files without a filter.
pub fn baked(state: &SplatState) -> Splats {
    let mut splats = state.splats.clone();
    for i in 0..splats.len() {
        let variance = state.filter.get(0, i);
        if variance == 0.0 {
            continue;
        }
        let mut thinning = 1.0;
        for c in 0..3 {
            let own = splats.log_scales.get(c, i).exp();
            let filtered = (own * own + variance).sqrt();
            thinning *= own / filtered;
            splats.log_scales.set(c, i, filtered.ln());
        }
        let opacity = sigmoid(splats.opacity_logits.get(0, i)) * thinning;
        splats.opacity_logits.set(0, i, logit(opacity.clamp(1e-6, 1.0 - 1e-6)));
    }
    splats
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RenderOptions, Renderer};

    fn view(z: f64) -> ViewParams {
        ViewParams {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0, 0.0, z],
            focal: [40.0, 40.0],
            principal: [16.0, 16.0],
            width: 32,
            height: 32,
            near: 0.01,
            lens: None,
        }
    }

    #[test]
    fn the_nearest_view_decides_and_a_baked_scene_renders_the_same() {
        let mut splats = Splats::zeros(2, 0);
        for (i, x) in [0.0f32, 50.0].into_iter().enumerate() {
            splats.means.set(0, i, x);
            splats.quats.set(0, i, 1.0);
            for (c, s) in [0.01f32, 0.3, 0.2].into_iter().enumerate() {
                splats.log_scales.set(c, i, s.ln());
            }
            splats.opacity_logits.set(0, i, 2.0);
            splats.sh.set(0, i, 1.0);
        }
        let mut state = SplatState::new(splats);
        update(&mut state, &[view(4.0), view(2.0), view(8.0)]);
        let want = (0.2 * (2.0f64 / 40.0).powi(2)) as f32;
        assert!(
            (0..2).all(|i| (state.filter.get(0, i) / want - 1.0).abs() < 1e-5),
            "the unseen one has the coarsest"
        );

        let mut renderer = Renderer::new();
        renderer.set_filter(state.filter.plane(0));
        renderer.render(&state.splats, &view(2.0), &RenderOptions::default());
        let filtered = renderer.color().to_vec();
        renderer.set_filter(&[]);
        renderer.render(&baked(&state), &view(2.0), &RenderOptions::default());
        let worst = filtered
            .iter()
            .zip(renderer.color())
            .map(|(a, b)| (a - b).abs())
            .fold(0.0f32, f32::max);
        assert!(worst < 1e-5 && filtered.iter().any(|v| *v > 0.1), "{worst}");
    }
}
