//! Queries of a field: densities and colours at points, and updates of the occupancy grid.

use crate::config::Sampler;
use crate::field::Field;
use crate::mlp::PANEL;
use crate::net::{Block, get3, set3};
use crate::pass::{Colors, DensitiesAtPoints};
use crate::space::Outside;
use crate::state::FieldState;
use crate::train::STREAM_OCCUPANCY;
use irradia_compute::Level;
use irradia_scene::Rng;
use rayon::prelude::*;

/// Points per task.
const POINTS_PER_TASK: usize = 1024;

/// Updates cells of the occupancy grid: all of them, or the occupied ones and a random fraction `1 / one_in` of the others.
/// Does nothing for other samplers.
pub fn update_occupancy(state: &mut FieldState, all: bool, one_in: u32, seed: u64) {
    update_occupancy_by(state, all, one_in, seed, |field, points| {
        let mut densities = vec![0.0; points.len()];
        query(field, points, &mut densities, |block, _, to| {
            to.copy_from_slice(&block.density[..to.len()])
        });
        densities
    });
}

/// Like [`update_occupancy`], but `densities` evaluates the densities at points in the unit cube.
pub(crate) fn update_occupancy_by(
    state: &mut FieldState,
    all: bool,
    one_in: u32,
    seed: u64,
    densities: impl FnOnce(&Field, &[[f32; 3]]) -> Vec<f32>,
) {
    let field = &mut state.field;
    let Sampler::Occupancy(options) = field.config.sampler else {
        return;
    };
    let Some(mut grid) = field.occupancy.take() else {
        return;
    };
    let mut rng = Rng::new(seed, (state.step << 8) + STREAM_OCCUPANCY);
    let (cells, points) = grid.sample_cells(all, one_in, &mut rng);
    grid.update(&cells, &densities(field, &points), options.decay);
    field.occupancy = Some(grid);
    field.mark_occupied();
}

/// Densities at world points, in inverse world units (inverse field units in normalised device coordinates); 0 outside the
/// field.
pub fn density_at(field: &Field, points: &[[f32; 3]]) -> Vec<f32> {
    let (units, inside) = units(field, points);
    let mut densities = vec![0.0; points.len()];
    query(field, &units, &mut densities, |block, _, to| {
        to.copy_from_slice(&block.density[..to.len()])
    });
    let scale = field.space.scale;
    densities
        .iter()
        .zip(inside)
        .map(|(d, inside)| if inside { d * scale } else { 0.0 })
        .collect()
}

/// Colours at world points viewed along unit `directions` (one per point), sRGB in \[0, 1\], with the appearance code of
/// `image` or the mean code.
pub fn color_at(field: &Field, points: &[[f32; 3]], directions: &[[f32; 3]], image: Option<u32>) -> Vec<[f32; 3]> {
    let (units, _) = units(field, points);
    let last = field.nets.len() - 1;
    let mut colors = vec![[0.0; 3]; points.len()];
    query(field, &units, &mut colors, |block, begin, to| {
        let panels = block.panels();
        block.directions.clear();
        block.directions.resize(panels * 3 * PANEL, 0.0);
        for i in 0..to.len() {
            if let Some(direction) = directions.get(begin + i) {
                set3(&mut block.directions, i, *direction);
            }
        }
        block.fill_code(&field.code(image));
        Level::detect().run(Colors {
            net: &field.nets[last],
            parameters: &field.parameters[last],
            block,
        });
        for (i, to) in to.iter_mut().enumerate() {
            *to = get3(&block.rgb, i);
        }
    });
    colors
}

/// Maps world points to the unit cube, with flags for those inside the field.
pub(crate) fn units(field: &Field, points: &[[f32; 3]]) -> (Vec<[f32; 3]>, Vec<bool>) {
    let unit = |world: &[f32; 3]| {
        let at = field.space.from_world(*world).unwrap_or([f32::NAN; 3]);
        let unbounded = field.space.outside == Outside::Contracted;
        let inside = at.iter().all(|v| v.is_finite() && (unbounded || v.abs() <= 1.0));
        (if inside { field.space.unit(at) } else { [0.5; 3] }, inside)
    };
    points.iter().map(unit).unzip()
}

/// Evaluates the last network's densities at points of the unit cube in blocks and passes each block to `read`.
fn query<T: Send>(
    field: &Field,
    points: &[[f32; 3]],
    to: &mut [T],
    read: impl Fn(&mut Block<f32>, usize, &mut [T]) + Sync,
) {
    let level = Level::detect();
    let last = field.nets.len() - 1;
    to.par_chunks_mut(POINTS_PER_TASK)
        .zip(points.par_chunks(POINTS_PER_TASK))
        .enumerate()
        .for_each_init(Block::default, |block, (chunk, (to, points))| {
            block.reset(points.len());
            for (i, point) in points.iter().enumerate() {
                set3(&mut block.points, i, *point);
            }
            level.run(DensitiesAtPoints {
                net: &field.nets[last],
                parameters: &field.parameters[last],
                block,
            });
            read(block, chunk * POINTS_PER_TASK, to);
        });
}
