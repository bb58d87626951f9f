//! Density control that leaves harmonics and moments on the device.
//!
//! Density control depends on geometry and statistics; harmonics and moments, nine tenths of a state, are only kept, moved, copied and
//! set to zero. In the state that it edits here, each of their columns is a single plane with the number of each row. Code that moves
//! a column thus moves the numbers, and `move_rows.wgsl` then moves the rows of the column on the device in the same way.

use super::frame::GEOMETRY;
use super::training::GpuTraining;
use crate::{SplatState, Splats};
use irradia_compute::Planes;
use irradia_compute::gpu::{Array, Gpu, WORKGROUP_SIZE, Work};
use irradia_scene::sh;
use rayon::prelude::*;

/// Working memory for moving rows.
pub(super) struct Moves {
    /// Row numbers of the columns, plane by plane.
    numbers: Array,
    /// Destination of a moved column, which is then swapped with the column's own array.
    spare: Array,
}

impl Moves {
    pub fn new(gpu: &Gpu) -> Self {
        Self {
            numbers: Array::zeros(gpu, "row numbers", 0),
            spare: Array::zeros(gpu, "moved rows", 0),
        }
    }
}

/// A column of `count` rows that holds their numbers: the bits of 1 to `count`, so that 0 stands for a row of zeros.
fn numbered(count: usize) -> Planes {
    let mut planes = Planes::zeros(1, count);
    for (number, value) in (1..=count as u32).zip(planes.plane_mut(0)) {
        *value = f32::from_bits(number);
    }
    planes
}

/// Whether no row has moved.
fn is_unmoved(numbers: &Planes) -> bool {
    let of_rows = numbers.plane(0)[..numbers.len()].par_iter().enumerate();
    of_rows
        .with_min_len(4096)
        .all(|(i, number)| number.to_bits() == i as u32 + 1)
}

impl GpuTraining {
    /// The state with row numbers for harmonics and moments. Second moments have no planes, since they move like the first ones.
    pub fn download_numbered(&self) -> SplatState {
        let count = self.renderer.shape.count;
        let mut state = SplatState {
            splats: Splats {
                sh: numbered(count),
                ..Splats::zeros(count, 0)
            },
            moments: [
                Splats::from_columns(std::array::from_fn(|_| numbered(count))),
                Splats::from_columns(std::array::from_fn(|_| Planes::zeros(0, count))),
            ],
            ..SplatState::default()
        };
        self.download_density_columns(&mut state);
        state
    }

    /// Applies an edited state of [`Self::download_numbered`].
    pub fn upload_numbered(&mut self, state: &SplatState) {
        let before = self.renderer.shape;
        let columns = [&state.splats.sh].into_iter().chain(state.moments[0].columns());
        let columns: Vec<&Planes> = columns.collect();
        if state.len() != before.count || !columns.iter().all(|column| is_unmoved(column)) {
            self.move_rows(&columns, [state.len(), state.splats.stride(), before.stride]);
        }
        self.renderer
            .upload_geometry(&state.splats, state.filter.plane(0), before.degree);
        self.upload_statistics(state);
    }

    /// Moves the rows of harmonics and moments; `columns` are the row numbers of the harmonics, then of the moments' five columns.
    fn move_rows(&mut self, columns: &[&Planes], [count, stride, stride_before]: [usize; 3]) {
        let gpu = self.renderer.gpu.clone();
        let planes_of_harmonics = 3 * sh::coefficients(self.renderer.shape.degree);
        let Moves { numbers, spare } = &mut self.moves;
        numbers.reserve(&gpu, columns.len() * stride);
        for (i, column) in columns.iter().enumerate() {
            numbers.write(&gpu, i * stride, column.as_slice());
        }
        let mut work = Work::new(&gpu);
        let kernel = &self.renderer.kernels.move_rows;
        // Parts of an array: column of the numbers, first plane, number of planes.
        let mut gather = |array: &mut Array, parts: &[[usize; 3]]| {
            spare.reserve(&gpu, parts.iter().map(|[.., planes]| planes * stride).sum());
            for [column, first, planes] in parts {
                let words = [count, stride, stride_before, *planes, *first, column * stride, 0, 0];
                let params = Array::of(&gpu, "move", &words.map(|word| word as u32));
                let groups = stride.div_ceil(WORKGROUP_SIZE as usize);
                work.run(kernel, &[&params, numbers, array, spare], groups);
            }
            std::mem::swap(array, spare);
        };
        gather(&mut self.renderer.harmonics, &[[0, 0, planes_of_harmonics]]);
        for moments in &mut self.moments_harmonics {
            gather(moments, &[[5, 0, planes_of_harmonics]]);
        }
        let geometry = [0, GEOMETRY].map(|of| [[1, of, 3], [2, of + 3, 4], [3, of + 7, 3], [4, of + 10, 1]]);
        gather(&mut self.moments_geometry, geometry.as_flattened());
        work.submit();
    }
}
