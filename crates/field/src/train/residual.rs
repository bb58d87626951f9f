//! A field that adds a view-dependent colour to points it is told, such as splats: reflections that harmonics of low degree
//! cannot hold. Only colour is used of its network; where the points are and how much of them shows is others' business.

use super::worker::{Backward, Worker};
use super::{GROUPS, StepOptions, add_up, descend};
use crate::field::Field;
use crate::look::{color_at, units};
use crate::mlp::PANEL;
use crate::net::{NetParameters, set3};
use crate::pass::{Colors, Density};
use crate::state::FieldState;
use irradia_compute::Level;
use rayon::prelude::*;

/// Points of a block, which stays in cache.
const CHUNK: usize = 512;

/// A point as a residual field sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sight {
    /// World position.
    pub point: [f32; 3],
    /// Unit direction: of view, or of what a mirror there would show.
    pub direction: [f32; 3],
}

/// What `field` adds to the colours of what is seen: sRGB, within -1..1; zeros where the field does not reach.
pub fn residual_at(field: &Field, sights: &[Sight]) -> Vec<[f32; 3]> {
    let (points, directions): (Vec<_>, Vec<_>) = sights.iter().map(|s| (s.point, s.direction)).unzip();
    let (_, inside) = units(field, &points);
    color_at(field, &points, &directions, None)
        .into_iter()
        .zip(inside)
        .map(|(color, inside)| if inside { color.map(added) } else { [0.0; 3] })
        .collect()
}

/// What a colour of the network's adds.
fn added(color: f32) -> f32 {
    2.0 * color - 1.0
}

/// One step of Adam for the gradients `v_added` of what [`residual_at`] gave for `sights`. The points get no gradient from it; of
/// `options` the rates count.
pub fn train_residual(state: &mut FieldState, sights: &[Sight], v_added: &[[f32; 3]], options: &StepOptions) {
    assert_eq!(sights.len(), v_added.len(), "a gradient for each");
    descend(state, options, |level, field, _, workers| {
        let turned = field.turned();
        let points: Vec<_> = sights.iter().map(|s| s.point).collect();
        let (units, inside) = units(field, &points);
        let reached: Vec<usize> = (0..sights.len()).filter(|i| inside[*i]).collect();
        let n = reached.len();
        workers.par_iter_mut().enumerate().for_each(|(group, worker)| {
            worker.clear(field);
            for chunk in reached[n * group / GROUPS..n * (group + 1) / GROUPS].chunks(CHUNK) {
                let points = chunk.iter().map(|i| (units[*i], sights[*i].direction, v_added[*i]));
                worker.points(level, field, &turned, points);
            }
        });
        add_up(workers)
    });
}

impl Worker {
    /// Forward and backward of a block: points of the unit cube, directions, and the gradient of what each adds.
    fn points(
        &mut self,
        level: Level,
        field: &Field,
        turned: &[NetParameters<f32>],
        points: impl ExactSizeIterator<Item = ([f32; 3], [f32; 3], [f32; 3])>,
    ) {
        let (net, parameters) = (&field.nets[0], &field.parameters[0]);
        let block = &mut self.block;
        block.reset(points.len());
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
            set3(&mut block.v_rgb, i, v_added.map(|v| 2.0 * v)); // As [`added`] has it.
        }
        block.share_code(&field.code(None));
        level.run(Density { net, parameters, block });
        level.run(Colors { net, parameters, block });
        level.run(Backward {
            net,
            turned: &turned[0],
            block,
            grads: &mut self.grads[0],
            with_color: true,
        });
        self.stored[0][0].extend_from_slice(&block.points);
        self.stored[0][1].extend_from_slice(&block.v_encoded);
    }
}
