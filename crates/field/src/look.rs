//! Looking at a trained field: densities and colours at points, and the occupancy grid's memory of them.

use crate::config::Sampler;
use crate::field::Field;
use crate::mlp::PANEL;
use crate::net::{Block, get3, set3};
use crate::pass::{Colors, Density};
use crate::space::Outside;
use crate::state::FieldState;
use crate::train::STREAM_LOOK;
use irradia_compute::Level;
use irradia_scene::Rng;
use rayon::prelude::*;

/// Points of one task.
const CHUNK: usize = 1024;

/// Looks at the cells of the occupancy grid again: all of them, or those that are occupied and a share `1 / one_in` of the
/// others. Does nothing for other samplers.
pub fn update_occupancy(state: &mut FieldState, all: bool, one_in: u32, seed: u64) {
    let field = &mut state.field;
    let Sampler::Occupancy(options) = field.config.sampler else {
        return;
    };
    let Some(mut grid) = field.occupancy.take() else {
        return;
    };
    let mut rng = Rng::new(seed, (state.step << 8) + STREAM_LOOK);
    let (cells, points) = grid.choose(all, one_in, &mut rng);
    let mut densities = vec![0.0; points.len()];
    look(field, &points, &mut densities, |block, _, to| {
        to.copy_from_slice(&block.density[..to.len()])
    });
    grid.remember(&cells, &densities, options.decay);
    field.occupancy = Some(grid);
    field.mark_occupied();
}

/// Densities at world points, one over world units (one over field units in normalised device coordinates); 0 where the field
/// does not reach.
pub fn density_at(field: &Field, points: &[[f32; 3]]) -> Vec<f32> {
    let (units, inside) = units(field, points);
    let mut densities = vec![0.0; points.len()];
    look(field, &units, &mut densities, |block, _, to| {
        to.copy_from_slice(&block.density[..to.len()])
    });
    let scale = field.space.scale;
    densities
        .iter()
        .zip(inside)
        .map(|(d, inside)| if inside { d * scale } else { 0.0 })
        .collect()
}

/// Colours at world points seen along unit `directions` (one a point), sRGB in \[0, 1\], with a photograph's appearance or the
/// mean one.
pub fn color_at(field: &Field, points: &[[f32; 3]], directions: &[[f32; 3]], image: Option<u32>) -> Vec<[f32; 3]> {
    let (units, _) = units(field, points);
    let last = field.nets.len() - 1;
    let mut colors = vec![[0.0; 3]; points.len()];
    look(field, &units, &mut colors, |block, begin, to| {
        let panels = block.panels();
        block.directions.clear();
        block.directions.resize(panels * 3 * PANEL, 0.0);
        for i in 0..to.len() {
            if let Some(direction) = directions.get(begin + i) {
                set3(&mut block.directions, i, *direction);
            }
        }
        block.share_code(&field.code(image));
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

/// World points in the unit cube, and whether the field reaches there.
pub(crate) fn units(field: &Field, points: &[[f32; 3]]) -> (Vec<[f32; 3]>, Vec<bool>) {
    let unit = |world: &[f32; 3]| {
        let at = field.space.from_world(*world).unwrap_or([f32::NAN; 3]);
        let everywhere = field.space.outside == Outside::Contracted;
        let inside = at.iter().all(|v| v.is_finite() && (everywhere || v.abs() <= 1.0));
        (if inside { field.space.unit(at) } else { [0.5; 3] }, inside)
    };
    points.iter().map(unit).unzip()
}

/// Has `read` take what it wants of blocks of the last network's densities at points of the unit cube.
fn look<T: Send>(
    field: &Field,
    points: &[[f32; 3]],
    to: &mut [T],
    read: impl Fn(&mut Block<f32>, usize, &mut [T]) + Sync,
) {
    let level = Level::detect();
    let last = field.nets.len() - 1;
    to.par_chunks_mut(CHUNK)
        .zip(points.par_chunks(CHUNK))
        .enumerate()
        .for_each_init(Block::default, |block, (chunk, (to, points))| {
            block.reset(points.len());
            for (i, point) in points.iter().enumerate() {
                set3(&mut block.points, i, *point);
            }
            level.run(Density {
                net: &field.nets[last],
                parameters: &field.parameters[last],
                block,
            });
            read(block, chunk * CHUNK, to);
        });
}
