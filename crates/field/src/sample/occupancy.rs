//! The occupancy grid, which lets ray marching skip empty space (Mueller et al. 2022, appendix E).
//!
//! A cell's density is a decaying maximum of the network's output. Occupancy is stored as bits, a brick of 4 x 4 x 4 cells per
//! word, and a block of 4 x 4 x 4 bricks per word of a second level: one test skips an empty brick or block.

use irradia_scene::Rng;

/// Cells of the unit cube with their densities.
#[derive(Clone, Debug, PartialEq)]
pub struct OccupancyGrid {
    /// Cells per side, a multiple of four.
    pub side: usize,
    /// Decaying maximum density of each cell, x fastest.
    pub density: Vec<f32>,
    /// Occupied cells, one word per brick, x fastest.
    bricks: Vec<u64>,
    /// Bricks with occupied cells, one word per block, x fastest.
    blocks: Vec<u64>,
}

/// The state of a point's cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cell {
    /// The cell may contain something.
    Occupied,
    /// The aligned cube of `cells` cells per side around it is empty: the cell itself, its brick or its block.
    Empty {
        /// Cells per side, 1, 4 or 16.
        cells: u32,
    },
}

impl OccupancyGrid {
    /// A grid with every cell occupied.
    pub fn new(side: usize) -> Self {
        let side = side.next_multiple_of(4).max(4);
        Self::all_occupied(side, vec![0.0; side.pow(3)])
    }

    /// A grid of given densities `[side^3]`; [`Self::threshold`] computes the bits.
    pub fn from_density(side: usize, density: Vec<f32>) -> Option<Self> {
        (side > 0 && side.is_multiple_of(4) && density.len() == side.pow(3)).then(|| Self::all_occupied(side, density))
    }

    fn all_occupied(side: usize, density: Vec<f32>) -> Self {
        Self {
            side,
            density,
            bricks: vec![u64::MAX; (side / 4).pow(3)],
            blocks: vec![u64::MAX; side.div_ceil(16).pow(3)],
        }
    }

    fn brick(&self, cell: [usize; 3]) -> (usize, u32) {
        word_of(cell, self.side / 4)
    }

    fn block(&self, brick: [usize; 3]) -> (usize, u32) {
        word_of(brick, self.side.div_ceil(16))
    }

    /// The cell of a point of the unit cube; points outside belong to the nearest cell.
    #[inline]
    pub fn at(&self, u: [f32; 3]) -> Cell {
        let top = self.side as f32 - 0.5;
        let cell = u.map(|v| (v * self.side as f32).clamp(0.0, top) as usize);
        let (block, bit) = self.block(cell.map(|c| c / 4));
        let word = self.blocks[block];
        if word == 0 {
            return Cell::Empty { cells: 16 };
        }
        if word >> bit & 1 == 0 {
            return Cell::Empty { cells: 4 };
        }
        let (brick, bit) = self.brick(cell);
        if self.bricks[brick] >> bit & 1 == 0 {
            Cell::Empty { cells: 1 }
        } else {
            Cell::Occupied
        }
    }

    /// The bits of all bricks, x fastest.
    #[cfg(feature = "gpu")]
    pub(crate) fn bricks(&self) -> &[u64] {
        &self.bricks
    }

    /// The coordinates of the cell with index `cell`.
    pub fn cell(&self, cell: usize) -> [usize; 3] {
        [
            cell % self.side,
            cell / self.side % self.side,
            cell / self.side / self.side,
        ]
    }

    /// Whether the cell with index `cell` is occupied.
    pub fn occupied(&self, cell: usize) -> bool {
        let (brick, bit) = self.brick(self.cell(cell));
        self.bricks[brick] >> bit & 1 == 1
    }

    /// The fraction of cells that are occupied.
    pub fn occupied_fraction(&self) -> f32 {
        let cells: u32 = self.bricks.iter().map(|b| b.count_ones()).sum();
        cells as f32 / self.density.len() as f32
    }

    /// Selects cells to update: all, or the occupied ones and a random fraction `1 / one_in` of the others; with a random
    /// point in each.
    pub fn sample_cells(&self, all: bool, one_in: u32, rng: &mut Rng) -> (Vec<u32>, Vec<[f32; 3]>) {
        let cells: Vec<u32> = (0..self.density.len())
            .filter(|c| all || self.occupied(*c) || rng.below(one_in) == 0)
            .map(|c| c as u32)
            .collect();
        let scale = 1.0 / self.side as f32;
        let points = cells
            .iter()
            .map(|c| self.cell(*c as usize).map(|x| (x as f32 + rng.uniform()) * scale))
            .collect();
        (cells, points)
    }

    /// Updates the densities of `cells` to `max(decay * old, new)`.
    pub fn update(&mut self, cells: &[u32], densities: &[f32], decay: f32) {
        for (cell, new) in cells.iter().zip(densities) {
            let old = &mut self.density[*cell as usize];
            *old = (*old * decay).max(*new);
        }
    }

    /// Marks the cells whose optical depth over a step (`step(u)` at the cell's centre) reaches `thickness`, or the mean over the
    /// grid if that is lower.
    pub fn threshold(&mut self, thickness: f32, step: impl Fn([f32; 3]) -> f32) {
        let scale = 1.0 / self.side as f32;
        let optical_depths: Vec<f32> = (0..self.density.len())
            .map(|c| self.density[c] * step(self.cell(c).map(|x| (x as f32 + 0.5) * scale)))
            .collect();
        let mean = optical_depths.iter().map(|t| f64::from(*t)).sum::<f64>() / optical_depths.len() as f64;
        let limit = thickness.min(mean as f32);
        self.bricks.fill(0);
        self.blocks.fill(0);
        for (c, optical_depth) in optical_depths.iter().enumerate() {
            if *optical_depth >= limit {
                let cell = self.cell(c);
                let (brick, bit) = self.brick(cell);
                self.bricks[brick] |= 1 << bit;
                let (block, bit) = self.block(cell.map(|c| c / 4));
                self.blocks[block] |= 1 << bit;
            }
        }
    }
}

/// The index of the word that contains `at`, in a grid of `side` words per side that hold 4 x 4 x 4 bits each, and of its bit.
#[inline]
fn word_of(at: [usize; 3], side: usize) -> (usize, u32) {
    let [x, y, z] = at;
    let word = x / 4 + side * (y / 4 + side * (z / 4));
    (word, (x % 4 + 4 * (y % 4) + 16 * (z % 4)) as u32)
}
