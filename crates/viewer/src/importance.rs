//! The order of splats by importance, for when not all of them can be drawn at once.

use irradia_splat::Splats;
use irradia_splat::render::ALPHA_MIN;
use rayon::prelude::*;

/// Indices of `splats` by the light that each may cover, its opacity times the area of its largest cross section, largest first.
/// Splats that can never be seen are left out.
pub(crate) fn by_importance(splats: &Splats) -> Vec<u32> {
    let importance = |i: usize| {
        let mut scales: [f32; 3] = std::array::from_fn(|c| splats.log_scales.get(c, i));
        scales.sort_unstable_by(f32::total_cmp);
        splats.opacity(i).ln() + scales[2] + scales[1]
    };
    let is_drawn = |i: &u32| {
        let i = *i as usize;
        let values = splats
            .columns()
            .into_iter()
            .take(4)
            .flat_map(|column| (0..column.count()).map(move |c| column.get(c, i)));
        splats.opacity(i) >= ALPHA_MIN as f32 && values.into_iter().all(f32::is_finite)
    };
    let mut order: Vec<(f32, u32)> = (0..splats.len() as u32)
        .into_par_iter()
        .filter(is_drawn)
        .map(|i| (importance(i as usize), i))
        .collect();
    order.par_sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    order.into_iter().map(|(_, i)| i).collect()
}
