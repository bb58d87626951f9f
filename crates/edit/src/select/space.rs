//! Selections by neighbourhood: growing, connection and clusters. The last two work on the cells of a grid, so that the cost is linear in
//! the number of splats.

use crate::draft::median;
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
    /// Splats that do not take part are in a component of their own, which has size 0.
    labels: Vec<u32>,
    sizes: Vec<usize>,
}

/// The components of the splats `present`.
fn components(draft: &Draft, present: &Selection, gap: Option<f64>) -> Components {
    let indices = present.indices();
    let side = gap
        .unwrap_or_else(|| DEFAULT_GAP_FACTOR * median_neighbour_distance(draft, &indices))
        .max(f64::MIN_POSITIVE);
    let mut numbers: HashMap<Cell, u32> = HashMap::new();
    let mut cells: Vec<Cell> = Vec::new();
    let cell_of_splat: Vec<u32> = indices
        .iter()
        .map(|i| {
            let cell = cell_of(draft.position(*i as usize), side);
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
    let (mut labels, mut sizes) = (vec![count; draft.len()], vec![0; count as usize + 1]);
    for (i, cell) in indices.iter().zip(cell_of_splat) {
        let label = component[cell as usize];
        labels[*i as usize] = label;
        sizes[label as usize] += 1;
    }
    Components { labels, sizes }
}

/// The selection, and everything connected to it by the splats `present`.
pub(super) fn connected(draft: &Draft, present: &Selection, selected: &Selection, gap: Option<f64>) -> Selection {
    let components = components(draft, present, gap);
    let mut reached = vec![false; components.sizes.len()];
    for i in selected.indices() {
        reached[components.labels[i as usize] as usize] = true;
    }
    Selection::of(draft.len(), |i| reached[components.labels[i] as usize])
}

/// The splats in components of `min` to `max` of the splats `present`.
pub(super) fn clusters(
    draft: &Draft,
    present: &Selection,
    [min, max]: [Option<usize>; 2],
    gap: Option<f64>,
) -> Selection {
    let components = components(draft, present, gap);
    let range = min.unwrap_or(0)..=max.unwrap_or(usize::MAX);
    Selection::of(draft.len(), |i| {
        range.contains(&components.sizes[components.labels[i] as usize])
    })
}

/// Median distance of the splats `indices` to their nearest neighbours among them, dataset units; 1 if there are fewer than two.
fn median_neighbour_distance(draft: &Draft, indices: &[u32]) -> f64 {
    if indices.len() < 2 {
        return 1.0;
    }
    let means: Vec<[f32; 3]> = indices.iter().map(|i| draft.cloud.means[*i as usize]).collect();
    let tree = Nearest::new(&means);
    let squares = means.par_iter().with_min_len(1024).map(|mean| tree.of::<2>(*mean)[1].0);
    f64::from(median(squares.collect())).sqrt().max(1e-9) / draft.cloud.world_from_dataset.scale
}
