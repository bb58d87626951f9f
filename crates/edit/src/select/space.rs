//! Selections by neighbourhood: growing, connection and clusters. The last two work on the cells of a grid, so that the cost is linear in
//! the number of splats.

use crate::{Draft, Selection};
use glam::DVec3;
use irradia_splat::Nearest;
use rayon::prelude::*;
use std::collections::HashMap;

/// Default gap, in units of the median distance to the nearest neighbour.
const DEFAULT_GAP_FACTOR: f64 = 4.0;

/// A cell of a grid: the position of its lower corner in units of its side.
type Cell = [i64; 3];

fn cell_of(position: DVec3, side: f64) -> Cell {
    // Saturates, so that distant splats share a cell.
    (position / side).floor().to_array().map(|v| v as i64)
}

/// The cells that touch `cell`, itself included.
fn neighbour_cells(cell: Cell) -> impl Iterator<Item = Cell> {
    (0..27).map(move |i| {
        let step = [i % 3, i / 3 % 3, i / 9];
        std::array::from_fn(|c| cell[c].saturating_add(step[c] - 1))
    })
}

/// The selection, and all splats within `by` of it, dataset units. A search for the nearest selected splat takes as long for any distance,
/// whereas cells of side `by` may each contain most of the selection.
pub(super) fn grow(draft: &Draft, selected: &Selection, by: f64) -> Selection {
    if selected.is_empty() {
        return selected.clone();
    }
    let means = &draft.cloud.means;
    let seeds: Vec<[f32; 3]> = selected.indices().iter().map(|i| means[*i as usize]).collect();
    let tree = Nearest::new(&seeds);
    let by = by * draft.cloud.world_from_dataset.scale;
    Selection::of(means.len(), |i| {
        selected.contains(i) || f64::from(tree.of::<1>(means[i])[0].0).sqrt() <= by
    })
}

/// The connected component of each splat, and the number of splats in each component; touching cells of side `gap` are connected.
struct Components {
    labels: Vec<u32>,
    sizes: Vec<usize>,
}

fn components(draft: &Draft, gap: Option<f64>) -> Components {
    let side = gap
        .unwrap_or_else(|| DEFAULT_GAP_FACTOR * median_neighbour_distance(draft))
        .max(f64::MIN_POSITIVE);
    let mut numbers: HashMap<Cell, u32> = HashMap::new();
    let mut cells: Vec<Cell> = Vec::new();
    let cell_of_splat: Vec<u32> = (0..draft.len())
        .map(|i| {
            let cell = cell_of(draft.position(i), side);
            *numbers.entry(cell).or_insert_with(|| {
                cells.push(cell);
                cells.len() as u32 - 1
            })
        })
        .collect();
    // Flood from cell to cell, in the order of the splats.
    let mut component = vec![u32::MAX; cells.len()];
    let mut count = 0;
    for start in 0..cells.len() {
        if component[start] != u32::MAX {
            continue;
        }
        component[start] = count;
        let mut pending_cells = vec![start];
        while let Some(cell) = pending_cells.pop() {
            for next in neighbour_cells(cells[cell]).filter_map(|near| numbers.get(&near)) {
                let next = *next as usize;
                if component[next] == u32::MAX {
                    component[next] = count;
                    pending_cells.push(next);
                }
            }
        }
        count += 1;
    }
    let labels: Vec<u32> = cell_of_splat.iter().map(|cell| component[*cell as usize]).collect();
    let mut sizes = vec![0; count as usize];
    labels.iter().for_each(|component| sizes[*component as usize] += 1);
    Components { labels, sizes }
}

/// The selection, and everything connected to it.
pub(super) fn connected(draft: &Draft, selected: &Selection, gap: Option<f64>) -> Selection {
    let components = components(draft, gap);
    let mut reached = vec![false; components.sizes.len()];
    for i in selected.indices() {
        reached[components.labels[i as usize] as usize] = true;
    }
    Selection::of(draft.len(), |i| reached[components.labels[i] as usize])
}

/// The splats in components of `min` to `max` splats.
pub(super) fn clusters(draft: &Draft, min: Option<usize>, max: Option<usize>, gap: Option<f64>) -> Selection {
    let components = components(draft, gap);
    let range = min.unwrap_or(0)..=max.unwrap_or(usize::MAX);
    Selection::of(draft.len(), |i| {
        range.contains(&components.sizes[components.labels[i] as usize])
    })
}

/// Median distance of splats to their nearest neighbours, dataset units; 1 if there are fewer than two.
pub(crate) fn median_neighbour_distance(draft: &Draft) -> f64 {
    let means = &draft.cloud.means;
    if means.len() < 2 {
        return 1.0;
    }
    let tree = Nearest::new(means);
    let mut squares: Vec<f32> = means
        .par_iter()
        .with_min_len(1024)
        .map(|mean| tree.of::<2>(*mean)[1].0)
        .collect();
    let middle = squares.len() / 2;
    let square = *squares.select_nth_unstable_by(middle, f32::total_cmp).1;
    f64::from(square).sqrt().max(1e-9) / draft.cloud.world_from_dataset.scale
}
