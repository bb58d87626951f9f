//! Runs the GPU from any stage on, with the CPU's results as input: an error is located at the first stage that produces it from
//! correct input.

use super::GpuTraining;
use super::frame::{FRAME_PLANES, TILE};
use super::tests::{gpu, gradients, scene, usual_update};
use super::training::GRADIENTS;
use crate::engine::Update;
use crate::render::{Gather, OutputGradient};
use crate::shaders::{SHADERS, STAGES};
use crate::{Engine, RenderOptions, Renderer, SplatGradients, SplatState, Statistics, ViewParams};
use irradia_compute::Planes;
use irradia_compute::gpu::{Gpu, Kernel, Shader, Work};
use irradia_scene::{Camera, sh};
use std::sync::Arc;

/// Words of a footprint, and sums of a slot.
const WORDS: usize = 12;
/// Entries of a segment: with fewer in every tile, the backward pass needs no state of pixels between segments.
const SEGMENT: usize = 256;
/// Largest relative difference in a stage's results due to rounding, and to fragments at the threshold of 1/255 that only one side draws.
const ROUNDING_TOLERANCE: f64 = 1e-3;

/// One step of the CPU with the results of each stage, as the shaders arrange them.
struct Twin {
    before: SplatState,
    after: SplatState,
    camera: Camera,
    v_color: Vec<f32>,
    error: Vec<f32>,
    footprints: Vec<[f32; WORDS]>,
    visible: Vec<u32>,
    touched: Vec<u32>,
    /// Visible splats, front to back, with their first slots.
    order: Vec<u32>,
    firsts: Vec<u32>,
    splat_of_slot: Vec<u32>,
    /// Slots by tile, front to back, and the range of each tile.
    slots: Vec<u32>,
    ranges: Vec<[u32; 2]>,
    planes: Vec<f32>,
    sums: Vec<[f64; WORDS]>,
    gradients: SplatGradients,
}

/// The tiles of 16 x 16 pixels that a splat touches, column by column: as `tiles.wgsl` counts them.
fn tiles_of(s: &[f32; WORDS], tiles: [u32; 2]) -> Vec<u32> {
    const SLACK: f32 = 1e-2;
    const LOG2_ALPHA_MIN: f32 = -7.994_353_4;
    let [x, y, a, b, c, log2_opacity, .., extent_x, extent_y] = *s;
    let first = ((x - extent_x - SLACK - 15.5) / 16.0).ceil().max(0.0) as i32;
    let last = ((x + extent_x + SLACK - 0.5) / 16.0)
        .floor()
        .clamp(-1.0, tiles[0] as f32 - 1.0) as i32;
    let half_height_squared = -(log2_opacity - LOG2_ALPHA_MIN) / c;
    let x_at_top = -0.5 * b / a * extent_y;
    let mut found = Vec::new();
    for column in first..=last {
        let edge = column as f32 * 16.0 - x;
        let (left, right) = ((edge + 0.5).max(-extent_x), (edge + 15.5).min(extent_x));
        let end = |at_top: f32, side: f32| {
            let dx = at_top.min(right).max(left);
            let u = dx / extent_x.max(1e-6);
            y - 0.5 * b / c * dx + side * (half_height_squared * (1.0 - u * u).max(0.0)).sqrt()
        };
        let first_row = (end(-x_at_top, -1.0) - 0.5 - SLACK).ceil().max(0.0);
        let last_row = (end(x_at_top, 1.0) - 0.5 + SLACK)
            .floor()
            .min(tiles[1] as f32 * 16.0 - 1.0);
        if first_row <= last_row {
            let rows = first_row as u32 / TILE..=last_row as u32 / TILE;
            found.extend(rows.map(|row| row * tiles[0] + column as u32));
        }
    }
    found
}

impl Twin {
    fn new() -> Self {
        let (splats, camera) = scene(900, 2, 80);
        let view = ViewParams::new(&camera);
        let [v_color, .., error] = gradients(&camera, 4);
        let before = SplatState::new(splats);
        let n = before.len();
        let options = options();
        let v_out = v_out(&v_color, &error);

        let (mut renderer, mut gradients) = (Renderer::new(), SplatGradients::default());
        renderer.render(&before.splats, &view, &options);
        renderer.backward(&before.splats, &v_out, &mut gradients);
        let mut engine = Engine::new(before.clone());
        engine.render(camera.into(), &options);
        engine.backward(&v_out);
        engine.update(&update());

        let tiles = [view.width, view.height].map(|size| size.div_ceil(TILE));
        let seen: Vec<Option<[f32; WORDS]>> = (0..n).map(|i| renderer.footprint_words(i)).collect();
        let tiles_of_splat: Vec<Vec<u32>> = seen
            .iter()
            .map(|s| s.map_or_else(Vec::new, |s| tiles_of(&s, tiles)))
            .collect();
        let mut order: Vec<u32> = (0..n as u32).filter(|i| seen[*i as usize].is_some()).collect();
        order.sort_by_key(|i| seen[*i as usize].map(|s| s[9].to_bits()));
        let (mut firsts, mut splat_of_slot) = (Vec::new(), Vec::new());
        let mut tile_of_slot: Vec<u32> = Vec::new();
        for i in &order {
            firsts.push(splat_of_slot.len() as u32);
            let touched = &tiles_of_splat[*i as usize];
            splat_of_slot.extend(touched.iter().map(|_| *i));
            tile_of_slot.extend(touched);
        }
        let mut slots: Vec<u32> = (0..tile_of_slot.len() as u32).collect();
        slots.sort_by_key(|slot| tile_of_slot[*slot as usize]);
        let mut ranges = vec![[0; 2]; (tiles[0] * tiles[1]) as usize + 1];
        for (at, slot) in (0u32..).zip(&slots) {
            let range: &mut [u32; 2] = &mut ranges[tile_of_slot[*slot as usize] as usize];
            if range[1] == 0 {
                range[0] = at;
            }
            range[1] = at + 1;
        }
        assert!(ranges.iter().all(|[from, to]| ((to - from) as usize) < SEGMENT));
        let frame = renderer.frame();
        Self {
            visible: seen.iter().map(|s| u32::from(s.is_some())).collect(),
            touched: tiles_of_splat.iter().map(|tiles| tiles.len() as u32).collect(),
            footprints: seen.iter().map(|s| s.unwrap_or_default()).collect(),
            planes: [frame.color, frame.alpha, frame.depth].concat(),
            sums: renderer.sums_by_splat(),
            after: engine.state().clone(),
            before,
            camera,
            v_color,
            error,
            order,
            firsts,
            splat_of_slot,
            slots,
            ranges,
            gradients,
        }
    }

    /// Puts the results of `stage` on the device.
    fn inject(&self, stage: &str, to: &mut GpuTraining) {
        let (gpu, r) = (to.renderer.gpu.clone(), &to.renderer);
        let found = [self.order.len() as u32, self.slots.len() as u32];
        match stage {
            "project" => {
                r.footprints.write(&gpu, 0, &self.footprints);
                r.visible.write(&gpu, 0, &self.visible);
                r.touched.write(&gpu, 0, &self.touched);
                r.found.write(&gpu, 0, &found);
            }
            "bin" => {
                let mut places = vec![0u32; self.before.len()];
                for (place, i) in (0..).zip(&self.order) {
                    places[*i as usize] = place;
                }
                r.places.write(&gpu, 0, &places);
                r.order.write(&gpu, 0, &self.order);
                r.firsts.write(&gpu, 0, &self.firsts);
                r.slots.write(&gpu, 0, &self.slots);
                r.splat_of_slot.write(&gpu, 0, &self.splat_of_slot);
                r.ranges.write(&gpu, 0, &self.ranges);
                r.first_segments.write(&gpu, 0, &self.segments());
                r.view.write(&gpu, 36, &found);
            }
            "blend" => {
                r.planes.write(&gpu, 0, &self.planes);
                let reached: Vec<u32> = self.ranges.iter().map(|[from, to]| u32::from(to > from)).collect();
                let tiles: Vec<u32> = (0u32..)
                    .zip(&reached)
                    .filter(|(_, n)| **n > 0)
                    .map(|(tile, _)| tile)
                    .collect();
                r.reached.write(&gpu, 0, &reached);
                r.tile_of_segment.write(&gpu, 0, &tiles);
            }
            "blend_vjp" => {
                let mut sums = vec![[0.0f32; WORDS]; self.slots.len()];
                for (i, first) in self.order.iter().zip(&self.firsts) {
                    if self.touched[*i as usize] > 0 {
                        sums[*first as usize] = self.sums[*i as usize].map(|sum| sum as f32);
                    }
                }
                to.sums.write(&gpu, 0, &sums);
            }
            "project_vjp" => {
                to.v_splats.write(&gpu, 0, &self.v_splats());
                let active: Vec<u32> = self.gradients.active.iter().map(|a| u32::from(*a > 0.0)).collect();
                r.visible.write(&gpu, 0, &active[..self.before.len()]);
            }
            other => panic!("{other} has no results for a later stage"),
        }
    }

    /// First segments of the tiles, none of which has more than one.
    fn segments(&self) -> Vec<u32> {
        let counts = self.ranges.iter().map(|[from, to]| u32::from(to > from));
        counts
            .scan(0, |sum, n| {
                *sum += n;
                Some(*sum - n)
            })
            .collect()
    }

    /// Gradients of the splats: geometry, colour, screen, gathered.
    fn v_splats(&self) -> Vec<f32> {
        let g = &self.gradients;
        let stride = self.before.splats.stride();
        let columns = [
            &g.splats.means,
            &g.splats.quats,
            &g.splats.log_scales,
            &g.splats.opacity_logits,
        ];
        let mut planes: Vec<f32> = columns.iter().flat_map(|column| column.as_slice()).copied().collect();
        let colors = &g.splats.sh.as_slice()[..3 * stride];
        planes.extend(colors.iter().map(|v| v / sh::C0 as f32));
        planes.extend(g.screen.as_slice().iter().chain(g.gathered.as_slice()));
        planes
    }

    /// Difference between the results of `stage` on the device and these, relative to the size of these.
    fn distance(&self, stage: &str, of: &GpuTraining) -> f64 {
        let (gpu, r) = (&of.renderer.gpu, &of.renderer);
        let n = self.before.len();
        let share = |a: &[u32], b: &[u32]| {
            let differing = a.iter().zip(b).filter(|(a, b)| a != b).count();
            differing as f64 / b.len() as f64
        };
        let slots = self.slots.len();
        match stage {
            "project" => {
                let got: Vec<[f32; WORDS]> = r.footprints.to_vec(gpu, WORDS * n);
                let word = |list: &[[f32; WORDS]], word: usize| -> Vec<f64> {
                    let seen = list.iter().zip(&self.visible).filter(|(_, visible)| **visible > 0);
                    seen.map(|(s, _)| f64::from(s[word])).collect()
                };
                let words = (0..WORDS).map(|w| relative_difference(&word(&got, w), &word(&self.footprints, w)));
                words
                    .fold(share(&r.visible.to_vec(gpu, n), &self.visible), f64::max)
                    .max(share(&r.touched.to_vec(gpu, n), &self.touched))
            }
            "bin" => {
                let splats = |slots: &[u32], splat_of_slot: &[u32]| -> Vec<u32> {
                    slots
                        .iter()
                        .map(|slot| splat_of_slot.get(*slot as usize).copied().unwrap_or(u32::MAX))
                        .collect()
                };
                let got = splats(&r.slots.to_vec(gpu, slots), &r.splat_of_slot.to_vec(gpu, slots));
                let ranges: Vec<u32> = r.ranges.to_vec(gpu, 2 * self.ranges.len());
                share(&r.order.to_vec(gpu, self.order.len()), &self.order)
                    .max(share(&got, &splats(&self.slots, &self.splat_of_slot)))
                    .max(share(&ranges, self.ranges.as_flattened()))
                    .max(share(
                        &r.first_segments.to_vec(gpu, self.ranges.len()),
                        &self.segments(),
                    ))
            }
            "blend" => {
                let pixels = self.planes.len() / FRAME_PLANES;
                let got: Vec<f32> = r.planes.to_vec(gpu, self.planes.len());
                let planes = got.chunks(pixels).zip(self.planes.chunks(pixels));
                planes
                    .map(|(a, b)| relative_difference(&widen(a), &widen(b)))
                    .fold(0.0, f64::max)
            }
            "blend_vjp" => {
                let of_slots: Vec<[f32; WORDS]> = of.sums.to_vec(gpu, WORDS * slots);
                let mut got = vec![[0.0; WORDS]; n];
                for (i, sums) in r.splat_of_slot.to_vec::<u32>(gpu, slots).iter().zip(&of_slots) {
                    for (to, sum) in got[(*i as usize).min(n - 1)].iter_mut().zip(sums) {
                        *to += f64::from(*sum);
                    }
                }
                let word = |list: &[[f64; WORDS]], word: usize| -> Vec<f64> { list.iter().map(|s| s[word]).collect() };
                let words = (0..WORDS).map(|w| relative_difference(&word(&got, w), &word(&self.sums[..n], w)));
                words.fold(0.0, f64::max)
            }
            "project_vjp" => {
                let stride = self.before.splats.stride();
                let got: Vec<f32> = of.v_splats.to_vec(gpu, GRADIENTS * stride);
                let active = |plane: &[f32]| -> Vec<f64> {
                    let pairs = plane.iter().zip(&self.gradients.active);
                    pairs.filter(|(_, a)| **a > 0.0).map(|(v, _)| f64::from(*v)).collect()
                };
                let expected = self.v_splats();
                let planes = got.chunks(stride).zip(expected.chunks(stride));
                planes
                    .map(|(a, b)| relative_difference(&active(a), &active(b)))
                    .fold(0.0, f64::max)
            }
            _ => {
                let got = of.download();
                let [before, after] = [&self.before, &self.after];
                let columns = |state: &SplatState| -> Vec<Planes> {
                    let all = [&state.splats, &state.moments[0], &state.moments[1]].map(|splats| splats.columns());
                    all.as_flattened()
                        .iter()
                        .copied()
                        .chain([&state.statistics])
                        .cloned()
                        .collect()
                };
                // The changes by the update rather than the values after it.
                let (before, after, got) = (columns(before), columns(after), columns(&got));
                let changes = |of: &Planes, before: &Planes| -> Vec<f64> {
                    let pairs = of.as_slice().iter().zip(before.as_slice());
                    pairs.map(|(a, b)| f64::from(*a) - f64::from(*b)).collect()
                };
                let each = got.iter().zip(&after).zip(&before);
                each.map(|((got, after), before)| relative_difference(&changes(got, before), &changes(after, before)))
                    .fold(0.0, f64::max)
            }
        }
    }
}

fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}

/// The norm of the difference relative to that of `b`; infinite for NaN.
fn relative_difference(a: &[f64], b: &[f64]) -> f64 {
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
    let difference = norm(&mut a.iter().zip(b).map(|(a, b)| a - b));
    match difference {
        0.0 => 0.0,
        d if d.is_nan() => f64::INFINITY,
        d => d / norm(&mut b.iter().copied()).max(f64::MIN_POSITIVE),
    }
}

fn options() -> RenderOptions {
    RenderOptions {
        antialias: true,
        depth: true,
        background: [0.1, 0.6, 0.3],
        ..RenderOptions::default()
    }
}

fn update() -> Update {
    Update {
        statistics: Some(Statistics::Error),
        ..usual_update()
    }
}

fn v_out<'a>(v_color: &'a [f32], error: &'a [f32]) -> OutputGradient<'a> {
    OutputGradient {
        gather: Gather::Error(error),
        ..OutputGradient::of_color(v_color)
    }
}

/// The first stage, if any, whose results differ from the twin's although its input does not; and a line per stage with the differences
/// of this and all later results when the GPU runs from this stage on.
fn locate_fault(gpu: &Arc<Gpu>, faulty: Option<(&str, &str, &str)>) -> (Option<&'static str>, String) {
    let twin = Twin::new();
    let mut training = GpuTraining::new(gpu.clone()).unwrap();
    if let Some((kernel, text, instead)) = faulty {
        let source = SHADERS.iter().find(|shader| shader.name == kernel).unwrap().source();
        assert!(source.contains(text), "{kernel} has {text}");
        let shader = Shader {
            name: "faulty",
            parts: Vec::leak(vec![&*source.replace(text, instead).leak()]),
        };
        let kernels = &mut training.renderer.kernels;
        *match kernel {
            "project" => &mut kernels.project,
            "emit" => &mut kernels.emit,
            "blend" => &mut kernels.blend,
            "blend_vjp" => &mut kernels.blend_vjp,
            "project_vjp" => &mut kernels.project_vjp,
            "update_harmonics" => &mut kernels.update_harmonics,
            other => panic!("{other}"),
        } = Kernel::new(gpu, &shader);
    }
    let (mut first, mut lines) = (None, String::new());
    for (at, from) in STAGES.iter().enumerate() {
        // A whole step, which allocates everything and sets the flags.
        training.upload(&twin.before, false);
        training.render(&ViewParams::new(&twin.camera), &options());
        training.backward(&v_out(&twin.v_color, &twin.error));
        for before in &STAGES[..at] {
            twin.inject(before.name, &mut training);
        }
        let last = training.renderer.last.clone().unwrap();
        lines += &format!("{:<12}", from.name);
        for stage in &STAGES[at..] {
            let mut work = Work::new(gpu);
            match stage.name {
                "project" => training.renderer.project(&mut work),
                "bin" => training.renderer.bin(&mut work, &last),
                "blend" => training.renderer.blend(&mut work, &last),
                "blend_vjp" => training.blend_vjp(&mut work, &last),
                "project_vjp" => training.project_vjp(&mut work),
                _ => training.update(&update()),
            }
            work.submit();
            let distance = twin.distance(stage.name, &training);
            lines += &format!(" {}: {distance:.1e}", stage.name);
            if stage.name == from.name && distance > ROUNDING_TOLERANCE {
                first.get_or_insert(from.name);
            }
        }
        lines += "\n";
        if first.is_some() {
            break;
        }
    }
    gpu.check().unwrap();
    (first, lines)
}

#[test]
fn every_stage_makes_of_the_twins_input_the_twins_results() {
    let Some(gpu) = gpu() else { return };
    let (first, lines) = locate_fault(&gpu, None);
    println!("{lines}");
    assert_eq!(first, None, "\n{lines}");
}

#[test]
fn a_fault_is_found_at_its_stage() {
    let Some(gpu) = gpu() else { return };
    for (kernel, text, instead, stage) in [
        ("project", "color = vec3f(0.5)", "color = vec3f(0.6)", "project"),
        ("emit", "row <= rows.y", "row < rows.y", "bin"),
        ("blend", "min(exp2(p)", "min(0.9 * exp2(p)", "blend"),
        ("blend_vjp", "alpha * before_it;", "alpha;", "blend_vjp"),
        ("project_vjp", "v_x.z += v_depth", "v_x.z -= 0.1 * v_x.x", "project_vjp"),
        ("update_harmonics", "b[k] * v_color[c]", "v_color[c]", "update"),
    ] {
        let (first, lines) = locate_fault(&gpu, Some((kernel, text, instead)));
        assert_eq!(first, Some(stage), "{kernel}\n{lines}");
    }
}

#[test]
fn every_kernel_belongs_to_a_stage() {
    let staged: Vec<&str> = STAGES.iter().flat_map(|stage| stage.kernels).copied().collect();
    for shader in SHADERS.iter().filter(|shader| shader.name != "move_rows") {
        assert_eq!(
            staged.iter().filter(|name| **name == shader.name).count(),
            1,
            "{}",
            shader.name
        );
    }
}
