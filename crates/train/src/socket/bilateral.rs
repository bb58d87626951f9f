//! After blending, after the exposure: a bilateral grid of affine colour maps per photograph.
//!
//! Phones change colours locally (tone mapping, local contrast, vignetting), which one map per photograph cannot follow. Here a
//! photograph has a map `y = A x + b` for each position in the image and each brightness there: a coarse grid over both, interpolated
//! linearly (Wang et al., "Bilateral Guided Radiance Field Processing", 2024). The brightness is that of the rendered colour, so that the
//! gradient of a colour also passes through the choice of its map. Photographs saturate at 1, and so does `y`.
//!
//! `t` is a position in the grid, in cells from its first one; `w` is the weight of the cell after it, and 1 - w that of the cell before.

use super::exposure::IDENTITY;
use super::per_view::adam_step;
use super::{Occupant, pixel_chunks};
use crate::tensor_file::{NamedTensor, TensorSource, to_bytes};
use irradia_compute::adam::{Active, AdamRates, adam};
use irradia_compute::simd::{Kernel, Lanes, Simd};
use irradia_compute::{Level, Planes};
use rayon::prelude::*;

/// Numbers of cells down and across the image, and along the brightness; they are in memory in this order.
///
/// Wang et al. use 16 x 16 x 8, for tens of thousands of steps. Here a photograph is used 30 to 100 times in a run, which does not
/// determine more cells than this: on fox with synthetic gains, 16 x 16 x 8 ends 1.8 dB lower with their weight of the variation, and takes
/// eight times the memory.
const GRID_SIZE: [usize; 3] = [8, 8, 4];
const CELLS: usize = GRID_SIZE[0] * GRID_SIZE[1] * GRID_SIZE[2];
/// Cells of a row of the grid.
const ROW_CELLS: usize = GRID_SIZE[1] * GRID_SIZE[2];
/// Parameters of a cell: A row by row, then b.
const N: usize = IDENTITY.len();
/// Weights of a colour's channels in its brightness (Rec. 601).
const LUMA: [f32; 3] = [0.299, 0.587, 0.114];
/// Rows of pixels whose gradients are summed together: a fixed number, so that the sum does not depend on threads.
const ROWS_PER_TASK: usize = 8;

/// A cell in the layout in which it is applied: the factors of red, green, blue and 1, each for three channels and a lane of padding.
type Map = [f32; LANES];
const LANES: usize = 16;
const ZERO_MAP: Map = [0.0; LANES];

/// A grid of colour maps per view, initially the identity. As with exposures, the mean over the training views of each cell stays
/// the identity: a change common to all photographs belongs to the scene, which would otherwise drift to a look that no photograph has.
/// What all photographs have at the same position in the image, such as a lens's vignette, therefore stays in the scene as well: held-out
/// views, which have no grid, show it.
///
/// A view's grid is the identity, plus its own cells, minus the mean of all views' own cells; the mean follows each step, so that a
/// step touches two grids rather than all.
#[derive(Clone, Debug, PartialEq)]
pub struct BilateralGrid {
    /// Own cells and moments of the views that have made a step: 37 KB each.
    views: Vec<Option<ViewGrid>>,
    /// Mean of the training views' own cells, `[CELLS][N]`.
    mean: Vec<f32>,
    /// The training views.
    train: Vec<usize>,
}

/// What is learnt for a view.
#[derive(Clone, Debug, PartialEq)]
struct ViewGrid {
    /// One plane, `[CELLS][N]`.
    own: Planes,
    /// First and second moments, of the same shape.
    moments: [Planes; 2],
    /// Number of steps.
    steps: u64,
}

impl ViewGrid {
    fn new() -> Self {
        let zeros = || Planes::zeros(1, CELLS * N);
        Self {
            own: zeros(),
            moments: [zeros(), zeros()],
            steps: 0,
        }
    }
}

impl BilateralGrid {
    /// Name of the file beside the scene.
    pub const FILE: &str = "bilateral.safetensors";

    /// For `views` views, of which `train` are the training views.
    pub fn new(views: usize, train: &[usize]) -> Self {
        Self {
            views: vec![None; views],
            mean: vec![0.0; CELLS * N],
            train: train.to_vec(),
        }
    }

    /// The grid of `view`, `[CELLS][N]`.
    fn grid(&self, view: usize) -> Vec<f32> {
        let mut grid = IDENTITY.repeat(CELLS);
        if self.train.contains(&view) {
            grid.iter_mut().zip(&self.mean).for_each(|(value, mean)| *value -= mean);
        }
        if let Some(view_grid) = &self.views[view] {
            let own = view_grid.own.as_slice();
            grid.iter_mut().zip(own).for_each(|(value, own)| *value += own);
        }
        grid
    }

    /// Applies the grid of `view` to `color` `[3, H, W]`, of `width` columns; results are at most 1.
    pub fn apply(&self, view: usize, width: usize, color: &[f32], to: &mut Vec<f32>) {
        let grid = self.grid(view);
        to.resize(color.len(), 0.0);
        let (level, frame) = (Level::detect(), Frame::new(&grid, width, color));
        pixel_chunks(to, ROWS_PER_TASK * width)
            .enumerate()
            .for_each(|(piece, to)| {
                let first_row = piece * ROWS_PER_TASK;
                level.run(ApplyRows {
                    frame: &frame,
                    first_row,
                    to,
                });
            });
    }

    /// The vector-Jacobian product of [`Self::apply`]: `v` `[3, H, W]` becomes the gradient of `color`; returns that of the view's
    /// grid, `[CELLS][N]`. Where the output is saturated, only gradients that darken it pass.
    pub fn vjp(&self, view: usize, width: usize, color: &[f32], v: &mut [f32]) -> Vec<f32> {
        vjp(&self.grid(view), width, color, v)
    }

    /// [`Self::vjp`] and a step of Adam on `view` at `rate`, with `weight` times the total variation of its grid added to the loss.
    pub fn step(&mut self, view: usize, width: usize, color: &[f32], v: &mut [f32], rate: f32, weight: f32) {
        let grid = self.grid(view);
        let mut gradient = vjp(&grid, width, color, v);
        add_variation_gradient(&grid, weight, &mut gradient);
        if gradient.iter().any(|g| !g.is_finite()) {
            return;
        }
        let view_grid = self.views[view].get_or_insert_with(ViewGrid::new);
        view_grid.steps += 1;
        let before = view_grid.own.clone();
        let step = adam_step(view_grid.steps);
        let [first, second] = &mut view_grid.moments;
        let gradient = Planes::from_interleaved(1, &gradient);
        let (own, moments) = (&mut view_grid.own, [first, second]);
        let rates = AdamRates::of_planes(std::slice::from_ref(&rate));
        adam(Level::detect(), own, &gradient, moments, rates, Active::All, step);
        let share = 1.0 / self.train.len() as f32;
        let moved = own.as_slice().iter().zip(before.as_slice());
        for (mean, (own, before)) in self.mean.iter_mut().zip(moved) {
            *mean += share * (own - before);
        }
    }
}

/// The lane of a [`Map`] that has parameter `i` of a cell.
#[inline(always)]
fn lane(i: usize) -> usize {
    if i < 9 { 4 * (i % 3) + i / 3 } else { 3 + i }
}

/// The cell before position `i` of `count` along an axis of `size` cells, and the weight of the cell after it. The first and the last
/// cell are at the borders.
#[inline(always)]
fn cell(i: usize, count: usize, size: usize) -> (usize, f32) {
    let t = (i as f32 + 0.5) / count as f32 * (size - 1) as f32;
    let before = (t as usize).min(size - 2);
    (before, t - before as f32)
}

/// The maps at a row of pixels, between two rows of the grid, `[ROW_CELLS]`.
#[inline(always)]
fn maps_of_row(grid: &[f32], (before, w): (usize, f32), to: &mut Vec<Map>) {
    let rows = grid.as_chunks::<N>().0;
    let (upper, lower) = (
        &rows[before * ROW_CELLS..][..ROW_CELLS],
        &rows[(before + 1) * ROW_CELLS..][..ROW_CELLS],
    );
    to.clear();
    to.extend(upper.iter().zip(lower).map(|(upper, lower)| {
        let mut map = ZERO_MAP;
        for (i, (upper, lower)) in upper.iter().zip(lower).enumerate() {
            map[lane(i)] = upper + w * (lower - upper);
        }
        map
    }));
}

/// The four cells of a row around a pixel: of the columns before and after it, the darker and the brighter one.
struct Slice {
    /// Index of the darker cell in the column before; the brighter one is next to it.
    at: usize,
    /// Weight of the column after.
    w_column: f32,
    /// Weight of the brighter cells.
    w_bright: f32,
    /// The derivative of `w_bright` with respect to the brightness.
    slope: f32,
}

impl Slice {
    #[inline(always)]
    fn new((column, w_column): (usize, f32), x: [f32; 3]) -> Self {
        let luma = LUMA[0] * x[0] + LUMA[1] * x[1] + LUMA[2] * x[2];
        let most = (GRID_SIZE[2] - 1) as f32;
        let t = luma.clamp(0.0, 1.0) * most;
        let before = (t as usize).min(GRID_SIZE[2] - 2);
        Self {
            at: column * GRID_SIZE[2] + before,
            w_column,
            w_bright: t - before as f32,
            slope: if (0.0..=1.0).contains(&luma) { most } else { 0.0 },
        }
    }

    /// The maps between the darker cells, and between the brighter ones.
    #[inline(always)]
    fn maps(&self, maps: &[Map]) -> [Map; 2] {
        let (before, after) = (&maps[self.at..][..2], &maps[self.at + GRID_SIZE[2]..][..2]);
        [0, 1].map(|i| mix(&before[i], &after[i], self.w_column))
    }

    /// Applies the map of the pixel to `x`.
    #[inline(always)]
    fn apply(&self, maps: &[Map], x: [f32; 3]) -> [f32; 4] {
        let [dark, bright] = self.maps(maps);
        apply_map(&mix(&dark, &bright, self.w_bright), x)
    }

    /// The VJP of [`Self::apply`] and of saturation at 1: from the gradient `v` of their result, returns that of `x`, and adds that of the
    /// row's maps to `v_maps`.
    #[inline(always)]
    fn vjp(&self, maps: &[Map], x: [f32; 3], v: [f32; 3], v_maps: &mut [Map]) -> [f32; 3] {
        let [dark, bright] = self.maps(maps);
        let map = mix(&dark, &bright, self.w_bright);
        let (y, from_dark, from_bright) = (apply_map(&map, x), apply_map(&dark, x), apply_map(&bright, x));
        let passes = |c: usize| if y[c] > 1.0 { v[c].max(0.0) } else { v[c] };
        let v = [passes(0), passes(1), passes(2), 0.0];
        let v_luma = self.slope * (0..3).map(|c| v[c] * (from_bright[c] - from_dark[c])).sum::<f32>();
        let v_x = std::array::from_fn(|k| {
            let row = &map[4 * k..][..3];
            row[0] * v[0] + row[1] * v[1] + row[2] * v[2] + LUMA[k] * v_luma
        });
        let (terms, mut v_map) = ([x[0], x[1], x[2], 1.0], ZERO_MAP);
        for i in 0..LANES {
            v_map[i] = terms[i / 4] * v[i % 4];
        }
        for (after, w) in [(0, 1.0 - self.w_column), (GRID_SIZE[2], self.w_column)] {
            for (brighter, w) in [(0, w * (1.0 - self.w_bright)), (1, w * self.w_bright)] {
                let sum = &mut v_maps[self.at + after + brighter];
                for i in 0..LANES {
                    sum[i] += w * v_map[i];
                }
            }
        }
        v_x
    }
}

#[inline(always)]
fn mix(a: &Map, b: &Map, w: f32) -> Map {
    let mut mixed = ZERO_MAP;
    for i in 0..LANES {
        mixed[i] = a[i] + w * (b[i] - a[i]);
    }
    mixed
}

#[inline(always)]
fn apply_map(map: &Map, x: [f32; 3]) -> [f32; 4] {
    let (terms, mut products) = ([x[0], x[1], x[2], 1.0], ZERO_MAP);
    for i in 0..LANES {
        products[i] = map[i] * terms[i / 4];
    }
    std::array::from_fn(|c| products[c] + products[4 + c] + products[8 + c] + products[12 + c])
}

/// A frame and the grid of its photograph.
struct Frame<'a> {
    /// `[CELLS][N]`.
    grid: &'a [f32],
    /// `[3, H, W]`.
    color: &'a [f32],
    height: usize,
    /// [`cell`] of each column.
    columns: Vec<(usize, f32)>,
}

impl<'a> Frame<'a> {
    fn new(grid: &'a [f32], width: usize, color: &'a [f32]) -> Self {
        Self {
            grid,
            color,
            height: color.len() / 3 / width.max(1),
            columns: (0..width).map(|column| cell(column, width, GRID_SIZE[1])).collect(),
        }
    }

    #[inline(always)]
    fn color(&self, pixel: usize) -> [f32; 3] {
        let pixels = self.color.len() / 3;
        [
            self.color[pixel],
            self.color[pixels + pixel],
            self.color[2 * pixels + pixel],
        ]
    }
}

/// [`BilateralGrid::apply`] for a piece of rows that begins at `first_row`.
struct ApplyRows<'a> {
    frame: &'a Frame<'a>,
    first_row: usize,
    to: [&'a mut [f32]; 3],
}

impl Kernel for ApplyRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S)
    where
        S::F: Lanes<Scalar = f32>,
    {
        let (Frame { columns, .. }, [red, green, blue]) = (self.frame, self.to);
        let mut maps = Vec::new();
        for i in 0..red.len() / columns.len() {
            let row = self.first_row + i;
            maps_of_row(self.frame.grid, cell(row, self.frame.height, GRID_SIZE[0]), &mut maps);
            for (column, place) in columns.iter().enumerate() {
                let at = i * columns.len() + column;
                let x = self.frame.color(row * columns.len() + column);
                let y = Slice::new(*place, x).apply(&maps, x);
                (red[at], green[at], blue[at]) = (y[0].min(1.0), y[1].min(1.0), y[2].min(1.0));
            }
        }
    }
}

/// [`BilateralGrid::vjp`] for such a piece. Returns the first row of the grid that it touches, and the gradients of the maps from there on.
struct VjpRows<'a> {
    frame: &'a Frame<'a>,
    first_row: usize,
    v: [&'a mut [f32]; 3],
}

impl Kernel for VjpRows<'_> {
    type Output = (usize, Vec<Map>);

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> Self::Output
    where
        S::F: Lanes<Scalar = f32>,
    {
        let (Frame { columns, height, .. }, [red, green, blue]) = (self.frame, self.v);
        let rows = self.first_row..self.first_row + red.len() / columns.len();
        let first = cell(rows.start, *height, GRID_SIZE[0]).0;
        let last = cell(rows.end - 1, *height, GRID_SIZE[0]).0 + 1;
        let mut sum = vec![ZERO_MAP; (last + 1 - first) * ROW_CELLS];
        let (mut maps, mut v_maps) = (Vec::new(), vec![ZERO_MAP; ROW_CELLS]);
        for (i, row) in rows.enumerate() {
            let (before, w) = cell(row, *height, GRID_SIZE[0]);
            maps_of_row(self.frame.grid, (before, w), &mut maps);
            v_maps.fill(ZERO_MAP);
            for (column, place) in columns.iter().enumerate() {
                let at = i * columns.len() + column;
                let x = self.frame.color(row * columns.len() + column);
                let v_y = [red[at], green[at], blue[at]];
                [red[at], green[at], blue[at]] = Slice::new(*place, x).vjp(&maps, x, v_y, &mut v_maps);
            }
            for (below, w) in [(0, 1.0 - w), (1, w)] {
                let sum = &mut sum[(before - first + below) * ROW_CELLS..][..ROW_CELLS];
                let values = sum.as_flattened_mut().iter_mut();
                for (sum, v) in values.zip(v_maps.as_flattened()) {
                    *sum += w * v;
                }
            }
        }
        (first, sum)
    }
}

/// See [`BilateralGrid::vjp`].
fn vjp(grid: &[f32], width: usize, color: &[f32], v: &mut [f32]) -> Vec<f32> {
    let (level, frame) = (Level::detect(), Frame::new(grid, width, color));
    let sums: Vec<(usize, Vec<Map>)> = pixel_chunks(v, ROWS_PER_TASK * width)
        .enumerate()
        .map(|(piece, v)| {
            let first_row = piece * ROWS_PER_TASK;
            level.run(VjpRows {
                frame: &frame,
                first_row,
                v,
            })
        })
        .collect();
    let mut total = vec![0.0; CELLS * N];
    for (first, sum) in sums {
        let cells = total.as_chunks_mut::<N>().0[first * ROW_CELLS..].iter_mut();
        for (total, map) in cells.zip(sum) {
            for (i, total) in total.iter_mut().enumerate() {
                *total += map[lane(i)];
            }
        }
    }
    total
}

/// Adds the gradient of `weight` times the total variation of `grid`: for each axis the mean squared difference of adjacent cells.
fn add_variation_gradient(grid: &[f32], weight: f32, to: &mut [f32]) {
    for axis in 0..GRID_SIZE.len() {
        // Distances in memory from a value to that of the next cell along the axis, and from one line of such cells to the next.
        let stride = GRID_SIZE[axis + 1..].iter().product::<usize>() * N;
        let block = GRID_SIZE[axis] * stride;
        let pairs = (CELLS * N / GRID_SIZE[axis]) * (GRID_SIZE[axis] - 1);
        let factor = 2.0 * weight / pairs as f32;
        for (grid, to) in grid.chunks_exact(block).zip(to.chunks_exact_mut(block)) {
            for i in 0..block - stride {
                let v = factor * (grid[i + stride] - grid[i]);
                to[i] -= v;
                to[i + stride] += v;
            }
        }
    }
}

impl Occupant for BilateralGrid {
    fn name(&self) -> &'static str {
        "bilateral"
    }

    fn tensors(&self) -> Vec<NamedTensor> {
        let view_grid = || self.views.iter().flatten();
        let views = self
            .views
            .iter()
            .enumerate()
            .filter(|(_, view_grid)| view_grid.is_some());
        let views: Vec<u64> = views.map(|(view, _)| view as u64).collect();
        let planes = |name: &str, planes: fn(&ViewGrid) -> &Planes| {
            let values: Vec<f32> = view_grid()
                .flat_map(|view_grid| planes(view_grid).as_slice())
                .copied()
                .collect();
            NamedTensor::f32s(name, vec![views.len(), CELLS, N], &values)
        };
        vec![
            NamedTensor::f32s("mean", vec![CELLS, N], &self.mean),
            planes("own", |view_grid| &view_grid.own),
            planes("first_moments", |view_grid| &view_grid.moments[0]),
            planes("second_moments", |view_grid| &view_grid.moments[1]),
            NamedTensor::u64s(
                "steps",
                &view_grid().map(|view_grid| view_grid.steps).collect::<Vec<_>>(),
            ),
            NamedTensor::u64s("views", &views),
        ]
    }

    fn restore(&mut self, tensors: TensorSource) -> Result<(), String> {
        let views = tensors.u64s("views").ok_or("views is missing")?;
        let steps = tensors.u64s("steps").filter(|steps| steps.len() == views.len());
        let steps = steps.ok_or("steps is missing or has the wrong length")?;
        let reals = |name: &str, grids: usize| {
            let values = tensors.f32s(name).filter(|values| values.len() == grids * CELLS * N);
            values.ok_or(format!("{name} is missing or has the wrong length"))
        };
        self.mean = reals("mean", 1)?;
        let own = reals("own", views.len())?;
        let moments = [
            reals("first_moments", views.len())?,
            reals("second_moments", views.len())?,
        ];
        self.views.fill(None);
        for (i, (view, steps)) in views.iter().zip(steps).enumerate() {
            let plane = |values: &[f32]| Planes::from_interleaved(1, &values[i * CELLS * N..][..CELLS * N]);
            let place = self.views.get_mut(*view as usize);
            *place.ok_or("views contains one that the dataset does not have")? = Some(ViewGrid {
                own: plane(&own),
                moments: [plane(&moments[0]), plane(&moments[1])],
                steps,
            });
        }
        Ok(())
    }

    /// The grids of the training views, `[views, rows, columns, brightnesses, N]`, and which views these are.
    fn export(&self) -> Option<Vec<u8>> {
        let grids: Vec<f32> = self.train.iter().flat_map(|view| self.grid(*view)).collect();
        let views: Vec<u64> = self.train.iter().map(|view| *view as u64).collect();
        let shape = vec![views.len(), GRID_SIZE[0], GRID_SIZE[1], GRID_SIZE[2], N];
        let tensors = [
            NamedTensor::f32s("grids", shape, &grids),
            NamedTensor::u64s("views", &views),
        ];
        Some(to_bytes(&tensors, ("irradia_bilateral", "1".into())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Rng;
    use safetensors::SafeTensors;

    const WIDTH: usize = 23;
    const HEIGHT: usize = 19;
    const PIXELS: usize = WIDTH * HEIGHT;
    /// Step of finite differences.
    const H: f32 = 2e-3;

    /// Colours below saturation, whose brightnesses a step of finite differences does not move into another cell.
    fn colors(rng: &mut Rng) -> Vec<f32> {
        let mut color = vec![0.0; 3 * PIXELS];
        for i in 0..PIXELS {
            loop {
                let x = [0; 3].map(|_| rng.range(0.05, 0.6));
                let t = (LUMA[0] * x[0] + LUMA[1] * x[1] + LUMA[2] * x[2]) * (GRID_SIZE[2] - 1) as f32;
                if (t - t.round()).abs() > 2.0 * H * GRID_SIZE[2] as f32 {
                    (color[i], color[PIXELS + i], color[2 * PIXELS + i]) = (x[0], x[1], x[2]);
                    break;
                }
            }
        }
        color
    }

    /// Two training views, the second with a random grid; colours, and weights of a sum that is the loss.
    fn example() -> (BilateralGrid, Vec<f32>, Vec<f32>) {
        let mut rng = Rng::new(3, 3);
        let mut grid = BilateralGrid::new(3, &[0, 1]);
        let mut view_grid = ViewGrid::new();
        view_grid.own.as_mut_slice().fill_with(|| rng.range(-0.1, 0.1));
        grid.views[1] = Some(view_grid);
        let color = colors(&mut rng);
        let weights = (0..3 * PIXELS).map(|_| rng.range(-1.0, 1.0)).collect();
        (grid, color, weights)
    }

    fn loss(grid: &BilateralGrid, color: &[f32], weights: &[f32]) -> f64 {
        let mut y = Vec::new();
        grid.apply(1, WIDTH, color, &mut y);
        y.iter().zip(weights).map(|(y, w)| f64::from(*y) * f64::from(*w)).sum()
    }

    #[test]
    fn an_untrained_view_is_unchanged_and_a_view_held_out_stays_so() {
        let (mut grid, color, _) = example();
        let unchanged = |grid: &BilateralGrid, view: usize| {
            let mut y = Vec::new();
            grid.apply(view, WIDTH, &color, &mut y);
            y.iter().zip(&color).all(|(y, x)| (y - x).abs() < 1e-6)
        };
        assert!(unchanged(&grid, 0) && !unchanged(&grid, 1) && unchanged(&grid, 2));
        for _ in 0..3 {
            grid.step(1, WIDTH, &color, &mut color.clone(), 0.01, 0.0);
        }
        assert!(!unchanged(&grid, 0), "the mean of the training views is held");
        assert!(unchanged(&grid, 2));
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let (grid, color, weights) = example();
        let mut v = weights.clone();
        let of_grid = grid.vjp(1, WIDTH, &color, &mut v);
        let mut touched = 0;
        for i in (0..CELLS * N).step_by(7) {
            let at = |sign: f32| {
                let mut moved = grid.clone();
                moved.views[1].as_mut().unwrap().own.as_mut_slice()[i] += sign * 0.1;
                loss(&moved, &color, &weights)
            };
            // The result is linear in the grid: a large step costs only rounding.
            let want = (at(1.0) - at(-1.0)) / 0.2;
            touched += usize::from(want != 0.0);
            assert!(
                (f64::from(of_grid[i]) - want).abs() < 1e-4,
                "{i}: {} and {want}",
                of_grid[i]
            );
        }
        assert!(touched > 100, "only {touched} cells have a gradient");
        let (mut largest, mut worst) = (0.0f64, 0.0f64);
        for i in (0..color.len()).step_by(7) {
            let at = |sign: f32| {
                let mut moved = color.clone();
                moved[i] += sign * H;
                loss(&grid, &moved, &weights)
            };
            let want = (at(1.0) - at(-1.0)) / f64::from(2.0 * H);
            // Cells are a third of brightness apart and differ by 0.2: quadratic terms are odd, and cancel; rounding is 1e-7 / H.
            worst = worst.max((f64::from(v[i]) - want).abs());
            largest = largest.max((want - f64::from(weights[i])).abs());
        }
        assert!(worst < 1e-3 && largest > 0.3, "{worst} of {largest}");
    }

    #[test]
    fn the_gradient_of_the_variation_agrees_with_finite_differences() {
        let variation = |grid: &[f32]| -> f64 {
            let at = |y: usize, x: usize, z: usize, i: usize| {
                f64::from(grid[((y * GRID_SIZE[1] + x) * GRID_SIZE[2] + z) * N + i])
            };
            let (mut sums, mut pairs) = ([0.0; 3], [0.0; 3]);
            for (y, x, z, i) in (0..CELLS * N).map(|i| {
                let cell = i / N;
                (
                    cell / ROW_CELLS,
                    cell / GRID_SIZE[2] % GRID_SIZE[1],
                    cell % GRID_SIZE[2],
                    i % N,
                )
            }) {
                let next = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
                for (axis, [dy, dx, dz]) in next.into_iter().enumerate() {
                    if y + dy < GRID_SIZE[0] && x + dx < GRID_SIZE[1] && z + dz < GRID_SIZE[2] {
                        sums[axis] += (at(y + dy, x + dx, z + dz, i) - at(y, x, z, i)).powi(2);
                        pairs[axis] += 1.0;
                    }
                }
            }
            (0..3).map(|axis| sums[axis] / pairs[axis]).sum()
        };
        let mut rng = Rng::new(5, 5);
        let grid: Vec<f32> = (0..CELLS * N).map(|_| rng.range(-1.0, 1.0)).collect();
        let mut gradient = vec![0.0; CELLS * N];
        add_variation_gradient(&grid, 3.0, &mut gradient);
        for i in (0..CELLS * N).step_by(4001) {
            let at = |sign: f32| {
                let mut moved = grid.clone();
                moved[i] += sign * 0.5;
                3.0 * variation(&moved)
            };
            let want = at(1.0) - at(-1.0);
            // Both are quadratic; gradients are about 1e-3.
            assert!(
                (f64::from(gradient[i]) - want).abs() < 1e-7,
                "{i}: {} and {want}",
                gradient[i]
            );
        }
    }

    #[test]
    fn saturated_pixels_are_only_darkened() {
        let grid = BilateralGrid::new(1, &[0]);
        let color = [1.5, 1.5, 0.5];
        let mut y = Vec::new();
        grid.apply(0, 1, &color, &mut y);
        assert_eq!(y, [1.0, 1.0, 0.5]);
        let mut v = [-1.0, 2.0, -1.0];
        grid.vjp(0, 1, &color, &mut v);
        assert_eq!(v, [0.0, 2.0, -1.0]);
    }

    /// Steps to a gain of 0.7 at the left and 1.3 at the right in one view, and the reverse in the other.
    fn trained() -> (BilateralGrid, Vec<f32>) {
        let mut rng = Rng::new(4, 4);
        let color: Vec<f32> = (0..3 * PIXELS).map(|_| rng.range(0.05, 0.6)).collect();
        let mut grid = BilateralGrid::new(3, &[0, 2]);
        for step in 0..300 {
            // The last steps are small, as in a run.
            let rate = if step < 200 { 0.02 } else { 0.002 };
            for view in [0, 2] {
                let mut y = Vec::new();
                grid.apply(view, WIDTH, &color, &mut y);
                let wanted = (0..3 * PIXELS).map(|i| gain(view, i % WIDTH) * color[i]);
                let mut v: Vec<f32> = y.iter().zip(wanted).map(|(y, wanted)| y - wanted).collect();
                grid.step(view, WIDTH, &color, &mut v, rate, 0.0);
            }
        }
        (grid, color)
    }

    fn gain(view: usize, column: usize) -> f32 {
        let across = 0.6 * (column as f32 / (WIDTH - 1) as f32 - 0.5);
        1.0 + if view == 0 { across } else { -across }
    }

    #[test]
    fn steps_recover_local_gains_and_preserve_their_mean() {
        let (grid, color) = trained();
        let mut y = Vec::new();
        for view in [0, 2] {
            grid.apply(view, WIDTH, &color, &mut y);
            let off = |i: usize| (y[i] - gain(view, i % WIDTH) * color[i]).abs();
            let worst = (0..3 * PIXELS).map(off).fold(0.0, f32::max);
            assert!(worst < 0.02, "{view}: {worst}");
        }
        let [a, b] = [0, 2].map(|view| grid.grid(view));
        let common = a.iter().zip(&b).zip(IDENTITY.repeat(CELLS));
        let drift = common
            .map(|((a, b), one)| (0.5 * (a + b) - one).abs())
            .fold(0.0, f32::max);
        // Rounding of 600 sums.
        assert!(drift < 1e-4, "{drift}");
    }

    #[test]
    fn threads_do_not_change_a_byte() {
        let all = trained().0;
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert!(one.install(trained).0 == all);
    }

    #[test]
    fn restored_grids_are_the_same_and_incomplete_ones_are_refused() {
        let (grid, _) = trained();
        let tensors = grid.tensors();
        let restored = |tensors: &[NamedTensor]| {
            let bytes = to_bytes(tensors, ("test", String::new()));
            let mut again = BilateralGrid::new(3, &[0, 2]);
            let file = SafeTensors::deserialize(&bytes).unwrap();
            again.restore(TensorSource::new(&file, "")).map(|()| again)
        };
        assert!(restored(&tensors).unwrap() == grid);
        assert!(restored(&BilateralGrid::new(3, &[0, 2]).tensors()).is_ok());
        let error = restored(&tensors[..5]).unwrap_err();
        assert!(error.contains("views"), "{error}");
        let mut elsewhere = tensors.clone();
        elsewhere[5] = NamedTensor::u64s("views", &[0, 7]);
        assert!(restored(&elsewhere).is_err());
        elsewhere[5] = NamedTensor::u64s("views", &[0]);
        assert!(restored(&elsewhere).is_err());
    }
}
