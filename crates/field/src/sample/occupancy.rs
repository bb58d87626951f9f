//! The occupancy grid: where a field is empty nothing is evaluated (Mueller et al. 2022, appendix E).
//!
//! A cell's density is an exponential moving maximum of what the network says. Cells are kept as bits, bricks of 4 x 4 x 4 in
//! one word: one test skips an empty brick.

use irradia_scene::Rng;

/// Cells of the unit cube with their remembered densities.
#[derive(Clone, Debug, PartialEq)]
pub struct OccupancyGrid {
    /// Cells a side, a multiple of four.
    pub side: usize,
    /// Remembered density of each cell, x fastest.
    pub density: Vec<f32>,
    /// Occupied cells, a word a brick, x fastest.
    bricks: Vec<u64>,
}

/// What a point's cell says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cell {
    /// There may be something.
    Occupied,
    /// This cell is empty.
    Empty,
    /// All 64 cells of the brick are.
    EmptyBrick,
}

impl OccupancyGrid {
    /// Everything occupied, since nothing is known.
    pub fn new(side: usize) -> Self {
        let side = side.next_multiple_of(4).max(4);
        Self {
            side,
            density: vec![0.0; side.pow(3)],
            bricks: vec![u64::MAX; (side / 4).pow(3)],
        }
    }

    /// From remembered densities `[side^3]`; [`Self::threshold`] makes the bits.
    pub fn from_density(side: usize, density: Vec<f32>) -> Option<Self> {
        (side > 0 && side.is_multiple_of(4) && density.len() == side.pow(3)).then(|| Self {
            side,
            density,
            bricks: vec![u64::MAX; (side / 4).pow(3)],
        })
    }

    fn brick(&self, [x, y, z]: [usize; 3]) -> (usize, u32) {
        let bricks = self.side / 4;
        let brick = x / 4 + bricks * (y / 4 + bricks * (z / 4));
        (brick, (x % 4 + 4 * (y % 4) + 16 * (z % 4)) as u32)
    }

    /// The cell of a point of the unit cube; points outside belong to the nearest cell.
    #[inline]
    pub fn at(&self, u: [f32; 3]) -> Cell {
        let top = self.side as f32 - 0.5;
        let (brick, bit) = self.brick(u.map(|v| (v * self.side as f32).clamp(0.0, top) as usize));
        let word = self.bricks[brick];
        if word == 0 {
            Cell::EmptyBrick
        } else if word >> bit & 1 == 0 {
            Cell::Empty
        } else {
            Cell::Occupied
        }
    }

    /// The coordinates of cell number `cell`.
    pub fn cell(&self, cell: usize) -> [usize; 3] {
        [
            cell % self.side,
            cell / self.side % self.side,
            cell / self.side / self.side,
        ]
    }

    /// Whether cell number `cell` is occupied.
    pub fn occupied(&self, cell: usize) -> bool {
        let (brick, bit) = self.brick(self.cell(cell));
        self.bricks[brick] >> bit & 1 == 1
    }

    /// The share of cells that are occupied.
    pub fn share(&self) -> f32 {
        let cells: u32 = self.bricks.iter().map(|b| b.count_ones()).sum();
        cells as f32 / self.density.len() as f32
    }

    /// The cells to look at again: all, or the occupied ones and a random share `1 / one_in` of the others; with a random point
    /// in each.
    pub fn choose(&self, all: bool, one_in: u32, rng: &mut Rng) -> (Vec<u32>, Vec<[f32; 3]>) {
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

    /// Remembers densities seen: `max(decay * old, new)`, for the cells looked at.
    pub fn remember(&mut self, cells: &[u32], densities: &[f32], decay: f32) {
        for (cell, new) in cells.iter().zip(densities) {
            let old = &mut self.density[*cell as usize];
            *old = (*old * decay).max(*new);
        }
    }

    /// Marks the cells whose density, times the step there (`step(u)` at the cell's centre), reaches `thickness` or, where the
    /// whole grid is thinner, its mean.
    pub fn threshold(&mut self, thickness: f32, step: impl Fn([f32; 3]) -> f32) {
        let scale = 1.0 / self.side as f32;
        let thick: Vec<f32> = (0..self.density.len())
            .map(|c| self.density[c] * step(self.cell(c).map(|x| (x as f32 + 0.5) * scale)))
            .collect();
        let mean = thick.iter().map(|t| f64::from(*t)).sum::<f64>() / thick.len() as f64;
        let limit = thickness.min(mean as f32);
        self.bricks.fill(0);
        for (c, thick) in thick.iter().enumerate() {
            if *thick >= limit {
                let (brick, bit) = self.brick(self.cell(c));
                self.bricks[brick] |= 1 << bit;
            }
        }
    }
}
