//! Transients: what is in one photograph and not in the others, such as people who walk through, cars or the photographer's shadow.
//!
//! From time to time all training views are rendered. Where a photograph differs from its frame by a patch of another colour, while other
//! photographs of the same surface agree with their frames, the patch shows something that was there only once, and is hidden from training
//! from then on. Surfaces that splats have not reached yet differ too, but in all views that see them, and detail averages out over a block
//! of pixels. A patch that the other photographs show too is not a transient: in the frame, a veil of floaters in front of the camera hides
//! it. Robust losses compare residuals within one photograph (RobustNeRF, Sabour et al. 2023; SpotLessSplats, Sabour et al. 2024), here
//! they are compared with those of other photographs at the same place: no fraction of outliers has to be assumed, and where there are
//! none, nothing is hidden.

use crate::audit::nearest;
use crate::photos::Prepared;
use glam::{Vec2, Vec3};
use irradia_scene::{Camera, Intrinsics};
use irradia_splat::FramePlanes;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::ops::Range;

/// Blocks along the longer side of a photograph.
const LONG_SIDE_BLOCKS: u32 = 48;
/// Minimum difference of a block's mean colour, sRGB, at which it may show a transient. With 0.08, soft shadows on the wall of fox count as
/// well.
const MIN_DIFFERENCE: f32 = 0.2;
/// Minimum factor over the difference at the same place in other views. A person pasted into 14 of 43 photographs of fox is found whole at
/// 3 or 4, and nothing is found in the photographs without a person.
const MIN_FACTOR: f32 = 3.0;
/// Quantile of the differences in other views that is taken for the difference at a place. With the median, unlearned surfaces at the
/// border of the scene count after a fifth of a run; with 0.75 and three witnesses, 25 of 62 photographs of can, whose background is hardly
/// known, lose 12 % of their pixels each, and held-out PSNR falls by 0.4 dB.
const WITNESS_QUANTILE: f32 = 0.9;
/// Fraction of both limits at which neighbours of a transient's blocks belong to it.
const GROWTH_THRESHOLD: f32 = 0.4;
/// Minimum number of other views that see a block's surface.
const MIN_WITNESSES: usize = 6;
/// Maximum number of views consulted about each place, the nearest ones.
const MAX_WITNESSES: usize = 24;
/// Depths that differ by less than this fraction are those of the same surface.
const DEPTH_TOLERANCE: f32 = 0.15;
/// Depth assumed where a frame is empty, in extents of the scene.
const EMPTY_DEPTH: f32 = 1000.0;
/// Minimum number of a transient's blocks beyond both limits; smaller transients average out over the photographs.
const MIN_BLOCKS: usize = 6;
/// Maximum hidden fraction of a photograph: beyond it, the photograph disagrees as a whole, and nothing of it is hidden.
const MAX_HIDDEN_FRACTION: f32 = 0.5;

/// A photograph divided into approximately square blocks. The grid depends on the full size of the photograph only.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Grid {
    columns: usize,
    rows: usize,
}

impl Grid {
    /// The grid of photographs with the full-size intrinsics `k`.
    fn from_intrinsics(k: &Intrinsics) -> Self {
        let blocks = |side: u32| (LONG_SIDE_BLOCKS * side).div_ceil(k.width.max(k.height)) as usize;
        Self {
            columns: blocks(k.width),
            rows: blocks(k.height),
        }
    }

    /// Number of blocks.
    fn len(self) -> usize {
        self.columns * self.rows
    }

    /// First pixel of column or row `block` on a side of `pixels` pixels in `blocks` blocks.
    fn start(block: usize, blocks: usize, pixels: usize) -> usize {
        (block * pixels).div_ceil(blocks)
    }

    /// The column or row that contains `pixel` on a side of `pixels` pixels in `blocks` blocks.
    fn block(pixel: usize, blocks: usize, pixels: usize) -> usize {
        pixel * blocks / pixels
    }

    /// The columns and rows of pixels of `block` in an image of this size.
    fn pixels(self, block: usize, width: usize, height: usize) -> [Range<usize>; 2] {
        [
            (block % self.columns, self.columns, width),
            (block / self.columns, self.rows, height),
        ]
        .map(|(at, blocks, side)| Self::start(at, blocks, side)..Self::start(at + 1, blocks, side))
    }

    /// The blocks around `block`, and itself.
    fn around(self, block: usize) -> impl Iterator<Item = usize> {
        let (column, row) = (block % self.columns, block / self.columns);
        let near = |at: usize, end: usize| at.saturating_sub(1)..(at + 2).min(end);
        near(row, self.rows).flat_map(move |r| near(column, self.columns).map(move |c| r * self.columns + c))
    }
}

/// How a training view differs from its photograph, block by block.
pub(crate) struct Difference {
    /// Camera of the photograph at full size.
    camera: Camera,
    grid: Grid,
    /// Difference of the mean colour minus that of the whole photograph, the largest over the channels; NaN where masked.
    color: Vec<f32>,
    /// Mean colour of the photograph minus the difference of the whole photograph; NaN where masked.
    photo: Vec<[f32; 3]>,
    /// Depth along +Z, world units; NaN where masked.
    depth: Vec<f32>,
}

impl Difference {
    /// The difference between `frame`, rendered with depth, and `photo`. `camera` is the photograph's camera at full size, `extent` that of
    /// the scene.
    pub fn new(frame: &FramePlanes, photo: &Prepared, camera: &Camera, extent: f32) -> Self {
        let (width, height) = (photo.width as usize, photo.height as usize);
        let pixels = width * height;
        let grid = Grid::from_intrinsics(&camera.intrinsics);
        let block = |i: usize| {
            let [columns, rows] = grid.pixels(i, width, height);
            let (mut color, mut photo_color, mut depth, mut alpha, mut count) =
                ([0.0f32; 3], [0.0; 3], 0.0, 0.0, 0.0f32);
            for at in rows.flat_map(|y| columns.clone().map(move |x| y * width + x)) {
                if photo.mask.as_ref().is_some_and(|mask| mask[at] == 0) {
                    continue;
                }
                for c in 0..3 {
                    let value = f32::from(photo.rgb[3 * at + c]) / 255.0;
                    photo_color[c] += value;
                    color[c] += value - frame.color[c * pixels + at];
                }
                depth += frame.depth[at];
                alpha += frame.alpha[at];
                count += 1.0;
            }
            let depth = if alpha >= 0.5 * count {
                depth / alpha
            } else {
                EMPTY_DEPTH * extent
            };
            let mean = |sums: [f32; 3]| sums.map(|sum| sum / count);
            (
                mean(color),
                mean(photo_color),
                if count > 0.0 { depth } else { f32::NAN },
            )
        };
        let blocks: Vec<([f32; 3], [f32; 3], f32)> = (0..grid.len()).into_par_iter().map(block).collect();
        // The difference of the photograph as a whole is its exposure.
        let whole: [f32; 3] = std::array::from_fn(|c| {
            let mut values: Vec<f32> = blocks.iter().map(|(color, ..)| color[c]).collect();
            quantile(&mut values, 0.5).unwrap_or(0.0)
        });
        let max_difference = |(color, ..): &([f32; 3], [f32; 3], f32)| {
            let difference = |c: usize| (color[c] - whole[c]).abs();
            // NaN in one channel is NaN in all, and `max` would drop it.
            difference(0)
                + (difference(1) - difference(0))
                    .max(difference(2) - difference(0))
                    .max(0.0)
        };
        Self {
            camera: *camera,
            grid,
            color: blocks.iter().map(max_difference).collect(),
            photo: blocks
                .iter()
                .map(|(_, photo_color, _)| std::array::from_fn(|c| photo_color[c] - whole[c]))
                .collect(),
            depth: blocks.iter().map(|(.., depth)| *depth).collect(),
        }
    }

    /// The place that block `i` shows, world.
    fn place(&self, i: usize) -> Vec3 {
        let k = &self.camera.intrinsics;
        let center = |at: usize, blocks: usize, side: u32| (at as f32 + 0.5) / blocks as f32 * side as f32;
        let x = center(i % self.grid.columns, self.grid.columns, k.width);
        let y = center(i / self.grid.columns, self.grid.rows, k.height);
        self.camera
            .pose
            .world_from_camera(k.ray(Vec2::new(x, y)) * self.depth[i])
    }

    /// The block in which this view sees the surface at `place`; `None` if the place is out of view, or the view shows another surface
    /// there.
    fn sees(&self, place: Vec3) -> Option<usize> {
        let (Vec2 { x, y }, depth) = self.camera.project(place)?;
        let k = &self.camera.intrinsics;
        if !((0.0..k.width as f32).contains(&x) && (0.0..k.height as f32).contains(&y)) {
            return None;
        }
        let column = Grid::block(x as usize, self.grid.columns, k.width as usize);
        let row = Grid::block(y as usize, self.grid.rows, k.height as usize);
        let block = row * self.grid.columns + column;
        ((self.depth[block] / depth - 1.0).abs() < DEPTH_TOLERANCE).then_some(block)
    }
}

/// The quantile `q` of `values`, without those that are NaN; `None` if there are none.
fn quantile(values: &mut Vec<f32>, q: f32) -> Option<f32> {
    values.retain(|v| !v.is_nan());
    let at = ((values.len() as f32 * q) as usize).min(values.len().saturating_sub(1));
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(at, f32::total_cmp).1)
}

/// Whether each block of a training view is hidden from training, by view. Views with nothing hidden are absent.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Hidden(BTreeMap<usize, Vec<bool>>);

impl Hidden {
    /// Finds what only one of `views` shows. Blocks that are hidden `already` are not used as witnesses. A move by
    /// `length_unit` counts as much as a turn by one radian.
    pub fn find(views: &[(usize, Difference)], length_unit: f32, already: &Self) -> Self {
        let found = |(view, own): &(usize, Difference)| {
            let others = views.iter().enumerate().filter(|(_, (other, _))| other != view);
            let others = others.map(|(i, (_, other))| (other.camera.pose, i));
            let others = nearest(&own.camera.pose, others, MAX_WITNESSES, length_unit);
            let excess = |i: usize| {
                let place = own.place(i);
                let witness = |other: &usize| {
                    let (view, difference) = &views[*other];
                    let block = difference.sees(place)?;
                    (!already.contains(*view, block)).then_some((difference.color[block], difference.photo[block]))
                };
                let (mut differences, colors): (Vec<f32>, Vec<[f32; 3]>) = others.iter().filter_map(witness).unzip();
                if differences.len() < MIN_WITNESSES {
                    return 0.0;
                }
                // A veil in front of this camera makes its frame differ, but the photograph still looks like the others.
                let median = |c: usize| quantile(&mut colors.iter().map(|color| color[c]).collect(), 0.5);
                let color_differences = (0..3).filter_map(|c| Some((own.photo[i][c] - median(c)?).abs()));
                let threshold =
                    MIN_DIFFERENCE.max(MIN_FACTOR * quantile(&mut differences, WITNESS_QUANTILE).unwrap_or(0.0));
                (own.color[i] / threshold).min(color_differences.fold(0.0, f32::max) / MIN_DIFFERENCE)
            };
            let excess: Vec<f32> = (0..own.grid.len()).map(excess).collect();
            (*view, patches(own.grid, &excess))
        };
        let found: Vec<(usize, Vec<bool>)> = views.par_iter().map(found).collect();
        Self(found.into_iter().filter(|(_, blocks)| blocks.contains(&true)).collect())
    }

    /// Number of views with something hidden.
    pub fn views(&self) -> usize {
        self.0.len()
    }

    /// Mean hidden fraction of those views.
    pub fn share(&self) -> f64 {
        let share = |blocks: &Vec<bool>| blocks.iter().filter(|hidden| **hidden).count() as f64 / blocks.len() as f64;
        self.0.values().map(share).sum::<f64>() / self.0.len().max(1) as f64
    }

    fn contains(&self, view: usize, block: usize) -> bool {
        self.0.get(&view).is_some_and(|blocks| blocks[block])
    }

    /// `photo` of `view` with its hidden blocks masked; `None` if there are none. `camera` is that of the view at full size.
    pub fn apply(&self, view: usize, camera: &Camera, photo: &Prepared) -> Option<Prepared> {
        let blocks = self.0.get(&view)?;
        let grid = Grid::from_intrinsics(&camera.intrinsics);
        let (width, height) = (photo.width as usize, photo.height as usize);
        let mut shown = photo.clone();
        let mask = shown.mask.get_or_insert_with(|| vec![255; width * height]);
        for (block, _) in blocks.iter().enumerate().filter(|(_, hidden)| **hidden) {
            let [columns, rows] = grid.pixels(block, width, height);
            for y in rows {
                mask[y * width..][columns.clone()].fill(0);
            }
        }
        Some(shown)
    }

    /// For a checkpoint: view number and block number of every hidden block.
    pub fn to_pairs(&self) -> Vec<u64> {
        let blocks = |(view, blocks): (&usize, &Vec<bool>)| {
            let hidden = blocks.iter().enumerate().filter(|(_, hidden)| **hidden);
            let view = *view as u64;
            hidden
                .flat_map(move |(block, _)| [view, block as u64])
                .collect::<Vec<_>>()
        };
        self.0.iter().flat_map(blocks).collect()
    }

    /// From [`Self::to_pairs`], for views with these full-size cameras; `None` if a view or block does not exist.
    pub fn from_pairs<'a>(pairs: &[u64], camera: impl Fn(usize) -> Option<&'a Camera>) -> Option<Self> {
        let mut hidden = BTreeMap::new();
        let (pairs, []) = pairs.as_chunks() else { return None };
        for [view, block] in pairs {
            let view = *view as usize;
            let blocks = Grid::from_intrinsics(&camera(view)?.intrinsics).len();
            let blocks = hidden.entry(view).or_insert_with(|| vec![false; blocks]);
            *blocks.get_mut(*block as usize)? = true;
        }
        Some(Self(hidden))
    }
}

/// Marks patches of connected blocks with an `excess` of at least [`GROWTH_THRESHOLD`], of which at least [`MIN_BLOCKS`] have one of at
/// least 1, and the blocks around them.
fn patches(grid: Grid, excess: &[f32]) -> Vec<bool> {
    let mut is_hidden = vec![false; excess.len()];
    let mut is_visited = vec![false; excess.len()];
    for seed in 0..excess.len() {
        if excess[seed] < 1.0 || excess[seed].is_nan() || is_visited[seed] {
            continue;
        }
        is_visited[seed] = true;
        let (mut patch, mut next) = (vec![seed], 0);
        while let Some(block) = patch.get(next).copied() {
            next += 1;
            for near in grid.around(block) {
                if excess[near] >= GROWTH_THRESHOLD && !is_visited[near] {
                    is_visited[near] = true;
                    patch.push(near);
                }
            }
        }
        if patch.iter().filter(|block| excess[**block] >= 1.0).count() >= MIN_BLOCKS {
            let all = patch.iter().flat_map(|block| grid.around(*block));
            all.for_each(|block| is_hidden[block] = true);
        }
    }
    let count = is_hidden.iter().filter(|hidden| **hidden).count();
    if count as f32 > MAX_HIDDEN_FRACTION * excess.len() as f32 {
        is_hidden.fill(false);
    }
    is_hidden
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_scene::Pose;

    /// Photographs of a grey wall from `count` places side by side, 96 x 48 pixels, and their differences, which are 0.
    fn wall(count: usize) -> Vec<(usize, Difference)> {
        let difference = |view: usize| {
            let pose = Pose::look_at(
                Vec3::new(0.02 * view as f32, 0.0, 0.0),
                Vec3::new(0.02 * view as f32, 0.0, 4.0),
                Vec3::NEG_Y,
            );
            let camera = Camera::new(pose, Intrinsics::from_fov_x(96, 48, 1.0));
            (view, of_frame(&camera, |_, _| 0.5))
        };
        (0..count).map(difference).collect()
    }

    /// The difference between a grey frame 4 units away and a photograph of grey values.
    fn of_frame(camera: &Camera, value: impl Fn(usize, usize) -> f32) -> Difference {
        let photo = photo(value);
        let pixels = photo.rgb.len() / 3;
        let (color, alpha, depth) = (vec![0.5; 3 * pixels], vec![1.0; pixels], vec![4.0; pixels]);
        let frame = FramePlanes {
            color: &color,
            alpha: &alpha,
            depth: &depth,
        };
        Difference::new(&frame, &photo, camera, 1.0)
    }

    fn photo(value: impl Fn(usize, usize) -> f32) -> Prepared {
        let (width, height) = (96, 48);
        let grey = (0..width * height).map(|i| (255.0 * value(i % width, i / width)).round() as u8);
        Prepared {
            width: width as u32,
            height: height as u32,
            rgb: grey.flat_map(|v| [v; 3]).collect(),
            alpha: None,
            mask: None,
            background: [0.0; 3],
        }
    }

    /// A dark box on the wall.
    fn person(x: usize, y: usize) -> f32 {
        if (40..60).contains(&x) && (10..40).contains(&y) {
            0.1
        } else {
            0.5
        }
    }

    #[test]
    fn what_stands_in_one_photograph_is_hidden_and_nothing_else() {
        let mut views = wall(8);
        assert_eq!(Hidden::find(&views, 1.0, &Hidden::default()), Hidden::default());
        let camera = views[3].1.camera;
        views[3].1 = of_frame(&camera, person);
        let hidden = Hidden::find(&views, 1.0, &Hidden::default());
        assert_eq!(hidden.views(), 1);
        let shown = hidden.apply(3, &camera, &photo(person)).unwrap();
        let mask = shown.mask.unwrap();
        for (i, value) in mask.iter().enumerate() {
            let (x, y) = (i % 96, i / 96);
            // A block is two pixels wide; the blocks around a patch belong to it.
            let is_near = (38..62).contains(&x) && (8..42).contains(&y);
            assert_eq!(*value == 0, is_near, "({x}, {y})");
        }
        assert!(hidden.apply(2, &camera, &photo(person)).is_none());
        let again = Hidden::from_pairs(&hidden.to_pairs(), |view| (view == 3).then_some(&camera)).unwrap();
        assert_eq!(again, hidden);
        assert!(Hidden::from_pairs(&[4, 0], |view| (view == 3).then_some(&camera)).is_none());
        assert!(Hidden::from_pairs(&[3, 1 << 40], |_| Some(&camera)).is_none());
    }

    #[test]
    fn what_a_veil_before_one_camera_covers_is_not_hidden() {
        let veiled = |(view, wall): (usize, Difference)| {
            let mut difference = of_frame(&wall.camera, person);
            if view != 3 {
                difference.color.fill(0.0);
            }
            (view, difference)
        };
        let views: Vec<(usize, Difference)> = wall(8).into_iter().map(veiled).collect();
        assert_eq!(Hidden::find(&views, 1.0, &Hidden::default()), Hidden::default());
    }

    #[test]
    fn what_all_photographs_show_or_few_see_is_not_hidden() {
        let mut views = wall(8);
        // A surface that splats have not reached: every view differs there.
        for (_, difference) in &mut views {
            let camera = difference.camera;
            *difference = of_frame(&camera, person);
        }
        assert_eq!(Hidden::find(&views, 1.0, &Hidden::default()), Hidden::default());
        // A whole photograph that is darker differs in exposure.
        let mut views = wall(8);
        let camera = views[3].1.camera;
        views[3].1 = of_frame(&camera, |_, _| 0.2);
        assert_eq!(Hidden::find(&views, 1.0, &Hidden::default()), Hidden::default());
        // Five witnesses are too few, and views that see another surface are not witnesses.
        views[3].1 = of_frame(&camera, person);
        assert_eq!(Hidden::find(&views[0..6], 1.0, &Hidden::default()), Hidden::default());
        views[3].1.depth.fill(2.0);
        assert_eq!(Hidden::find(&views, 1.0, &Hidden::default()), Hidden::default());
    }
}
