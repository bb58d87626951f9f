//! The end of a step: scatters the tables' gradients and applies Adam.

use super::{Scratch, StepOptions};
use crate::encoding::PositionEncoding;
use crate::encoding::hash_grid::{GridLevel, HashGrid, LevelPanels, encode_level_vjp};
use crate::optimise::Adam;
use crate::state::FieldState;
use irradia_compute::Level;
use irradia_compute::adam::AdamStep;
use irradia_compute::simd::{Kernel, Lanes, Simd};
use rayon::prelude::*;

/// Scatters the tables' gradients and takes a step of Adam on all parameters.
pub(super) fn update(
    level: Level,
    state: &mut FieldState,
    scratch: &mut Scratch,
    options: &StepOptions,
    step: AdamStep,
) {
    let FieldState {
        field,
        moments: [firsts, seconds],
        code_moments: [code_first, code_second],
        background_moments: [background_first, background_second],
        ..
    } = state;
    let (workers, tables) = (&scratch.workers, &mut scratch.tables);
    tables.resize_with(field.nets.len(), Vec::new);
    for (n, net) in field.nets.iter().enumerate() {
        let (parameters, grads) = (&mut field.parameters[n], &workers[0].grads[n]);
        let (first, second) = (&mut firsts[n], &mut seconds[n]);
        if let PositionEncoding::HashGrid(grid) = &net.shape.encoding {
            tables[n].resize(parameters.table.len(), 0.0);
            let mut levels = Vec::new();
            let mut rest = (
                &mut parameters.table[..],
                &mut tables[n][..],
                &mut first.table[..],
                &mut second.table[..],
            );
            for (l, at) in net.levels.iter().enumerate() {
                let length = at.entries * grid.features;
                let p = rest.0.split_at_mut(length);
                let g = rest.1.split_at_mut(length);
                let m = rest.2.split_at_mut(length);
                let v = rest.3.split_at_mut(length);
                rest = (p.1, g.1, m.1, v.1);
                levels.push((l, at, p.0, g.0, m.0, v.0));
            }
            levels
                .into_par_iter()
                .for_each(|(l, at, parameters, gradients, first, second)| {
                    for worker in workers {
                        let [points, v] = &worker.stored[n];
                        level.run(Scatter {
                            grid,
                            level: at,
                            panels: LevelPanels {
                                points,
                                row: l * grid.features,
                                rows: net.encoded_rows(),
                            },
                            v,
                            grads: gradients,
                        });
                    }
                    level.run(Adam {
                        parameters,
                        gradients,
                        first,
                        second,
                        rate: options.table_rate,
                        step,
                        sparse: true,
                    });
                    gradients.fill(0.0);
                });
        }
        let parts = [
            (
                &mut parameters.density,
                &grads.density,
                &mut first.density,
                &mut second.density,
            ),
            (&mut parameters.color, &grads.color, &mut first.color, &mut second.color),
        ];
        for (parameters, gradients, first, second) in parts {
            level.run(Adam {
                parameters,
                gradients,
                first,
                second,
                rate: options.net_rate,
                step,
                sparse: false,
            });
        }
    }
    level.run(Adam {
        parameters: &mut field.codes,
        gradients: &workers[0].codes,
        first: code_first,
        second: code_second,
        rate: options.code_rate,
        step,
        sparse: true,
    });
    level.run(Adam {
        parameters: &mut field.background,
        gradients: &workers[0].background,
        first: background_first,
        second: background_second,
        rate: options.net_rate,
        step,
        sparse: false,
    });
}

struct Scatter<'a> {
    grid: &'a HashGrid,
    level: &'a GridLevel,
    panels: LevelPanels<'a, f32>,
    v: &'a [f32],
    grads: &'a mut [f32],
}

impl Kernel for Scatter<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        encode_level_vjp(simd, self.grid, self.level, self.panels, self.v, self.grads);
    }
}
