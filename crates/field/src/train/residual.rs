//! A field that adds a view-dependent colour to given points, such as splats, for reflections that harmonics of low degree cannot
//! represent. Only the colours of its network are used; the caller determines positions and visibility.

use super::worker::{Backward, Worker};
use super::{GROUPS, StepOptions, add_up, descend};
use crate::field::Field;
use crate::mlp::PANEL;
use crate::net::{NetParameters, set3};
use crate::pass::{Colors, DensitiesAtPoints};
use crate::query::{color_at, units};
use crate::state::FieldState;
use irradia_compute::Level;
use rayon::prelude::*;

/// Points per block, which stays in the cache.
const POINTS_PER_BLOCK: usize = 512;

/// A point and direction at which to evaluate a residual field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ResidualQuery {
    /// World position.
    pub point: [f32; 3],
    /// Unit direction: the view direction, or its reflection at the point.
    pub direction: [f32; 3],
}

/// The colours that `field` adds at `queries` with the appearance code of `image`, or the mean code: sRGB, within -1..1; zero outside
/// the field.
pub fn residual_at(field: &Field, queries: &[ResidualQuery], image: Option<u32>) -> Vec<[f32; 3]> {
    let (points, directions): (Vec<_>, Vec<_>) = queries.iter().map(|s| (s.point, s.direction)).unzip();
    let (_, inside) = units(field, &points);
    color_at(field, &points, &directions, image)
        .into_iter()
        .zip(inside)
        .map(|(color, inside)| if inside { color.map(residual_of) } else { [0.0; 3] })
        .collect()
}

/// The residual for a colour of the network.
fn residual_of(color: f32) -> f32 {
    2.0 * color - 1.0
}

/// Takes one step of Adam, given the gradients `v_added` of the colours added at `queries`. An added colour is the sum over `images` of
/// [`residual_at`] times the image's factor. The points receive no gradient; only the rates of `options` are used.
pub fn train_residual(
    state: &mut FieldState,
    queries: &[ResidualQuery],
    images: &[(Option<u32>, f32)],
    v_added: &[[f32; 3]],
    options: &StepOptions,
) {
    assert_eq!(queries.len(), v_added.len(), "one gradient per query");
    descend(state, options, |level, field, _, workers| {
        let transposed = field.transposed();
        let points: Vec<_> = queries.iter().map(|s| s.point).collect();
        let (units, inside) = units(field, &points);
        let reached: Vec<usize> = (0..queries.len()).filter(|i| inside[*i]).collect();
        let n = reached.len();
        workers.par_iter_mut().enumerate().for_each(|(group, worker)| {
            worker.clear(field);
            for chunk in reached[n * group / GROUPS..n * (group + 1) / GROUPS].chunks(POINTS_PER_BLOCK) {
                for (image, factor) in images {
                    let point = |i: &usize| (units[*i], queries[*i].direction, v_added[*i].map(|v| v * factor));
                    worker.points(level, field, &transposed, *image, chunk.iter().map(point));
                }
            }
        });
        add_up(workers)
    });
}

impl Worker {
    /// Forward and backward pass of a block: points of the unit cube, directions, and the gradients of the added colours.
    fn points(
        &mut self,
        level: Level,
        field: &Field,
        transposed: &[NetParameters<f32>],
        image: Option<u32>,
        points: impl ExactSizeIterator<Item = ([f32; 3], [f32; 3], [f32; 3])>,
    ) {
        let (net, parameters) = (&field.nets[0], &field.parameters[0]);
        let count = points.len();
        let block = &mut self.block;
        block.reset(count);
        let padded = block.panels() * PANEL;
        let rows = [
            (&mut block.directions, 3),
            (&mut block.v_rgb, 3),
            (&mut block.v_density, 1),
        ];
        for (rows, height) in rows {
            rows.clear();
            rows.resize(height * padded, 0.0);
        }
        for (i, (point, direction, v_added)) in points.enumerate() {
            set3(&mut block.points, i, point);
            set3(&mut block.directions, i, direction);
            set3(&mut block.v_rgb, i, v_added.map(|v| 2.0 * v)); // The slope of [`residual_of`].
        }
        block.fill_code(&field.code(image));
        level.run(DensitiesAtPoints { net, parameters, block });
        level.run(Colors { net, parameters, block });
        level.run(Backward {
            net,
            transposed: &transposed[0],
            block,
            grads: &mut self.grads[0],
            with_color: true,
        });
        let size = field.config.appearance();
        for k in 0..image.map_or(0, |_| size) {
            let sum: f32 = (0..count).map(|i| net.code_gradient(block, i, k)).sum();
            if let Some(to) = image.and_then(|image| self.codes.get_mut(image as usize * size + k)) {
                *to += sum;
            }
        }
        self.stored[0][0].extend_from_slice(&block.points);
        self.stored[0][1].extend_from_slice(&block.v_encoded);
    }
}
