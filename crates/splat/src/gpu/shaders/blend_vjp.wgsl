// The vector-Jacobian product of blending, one segment of a tile per workgroup of 32 threads. A thread holds eight pixels of a column,
// their transmittance and the light from behind, and visits the splats front to back; rows of pixels that a splat does not reach are
// skipped. Its sums over a splat's pixels go to shared memory, where those of all threads are added for a batch of splats at a time: no
// atomics, and every sum has a fixed order.
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
@group(0) @binding(3) var<storage, read> splat_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> footprints: array<vec4f>;
@group(0) @binding(5) var<storage, read> first_segments: array<u32>;
@group(0) @binding(6) var<storage, read> tile_of_segment: array<u32>;
@group(0) @binding(7) var<storage, read> reached: array<u32>;
@group(0) @binding(8) var<storage, read> states: array<f32>;
@group(0) @binding(9) var<storage, read> frame: array<f32>;
// Gradients of the frame's planes: red, green, blue, alpha, depth; then the error to gather.
@group(0) @binding(10) var<storage, read> v_frame: array<f32>;
// [slot, 12]: the moments 1, dx, dy, dx^2, dx dy, dy^2 of v_p / ln 2, gradients of red, green, blue and depth, two gathered sums.
@group(0) @binding(11) var<storage, read_write> sums: array<f32>;

const THREADS: u32 = 32u;
// Pixels of a thread: every other row of its column.
const PIXELS: u32 = 8u;
const SUMS: u32 = 12u;
// Splats whose sums are added together. Few, and shared memory holds nothing that fits in registers: the less of it a workgroup takes, the
// more workgroups run at once. An H100 took 3.0 ms with 8 splats and with gradients of depth and errors in shared memory, 1.6 with 4, 1.2
// with 2, and 0.9 with these gradients and errors in registers.
const BATCH: u32 = 2u;
// Quads in a row of sums, which holds one sum per thread; the last is padding, so that threads that read a row each cause no bank
// conflicts.
const QUADS: u32 = 9u;
// Margin beyond a splat's extent within which rows are still visited, for rounding, pixels.
const ROW_SLACK: f32 = 1e-2;

struct Held {
    // Centre relative to the tile's first pixel, a, b.
    place: vec4f,
    // c, log2 of the opacity, red, green.
    shape: vec4f,
    // Blue, depth, first and last row.
    rest: vec4f,
}

var<workgroup> held: array<Held, THREADS>;
var<workgroup> held_slots: array<u32, THREADS>;
// [splat of the batch, sum], of each thread.
var<workgroup> parts: array<vec4f, 216>;

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32) {
    let segment = group_index(group, groups);
    let tiles = view.size.z * view.size.w;
    if segment >= first_segments[tiles] {
        return;
    }
    let tile = tile_of_segment[segment];
    let of_tile = segment - first_segments[tile];
    let range = ranges[tile];
    let first = range.x + of_tile * 256u;
    let count = min(range.y - first, 256u);
    if of_tile >= reached[tile] {
        for (var k = lane; k < count; k += THREADS) {
            for (var c = 0u; c < SUMS; c++) {
                sums[slots[first + k] * SUMS + c] = 0.0;
            }
        }
        return;
    }

    let flags = view.flags.x;
    let has_depth = has(flags, FLAG_DEPTH);
    let pixels = view.size.x * view.size.y;
    let corner = vec2u(tile % view.size.z, tile / view.size.z) * TILE;
    let column = lane % TILE;
    let odd = lane / TILE;
    var t: array<f32, PIXELS>;
    var rest: array<f32, PIXELS>;
    var v_color: array<vec3f, PIXELS>;
    var errors: array<f32, PIXELS>;
    for (var q = 0u; q < PIXELS; q++) {
        let at = (2u * q + odd) * TILE + column;
        let pixel = corner + vec2u(column, 2u * q + odd);
        var state = vec4f(0.0);
        t[q] = 1.0;
        if of_tile > 0u {
            let s = segment * 5u * TILE_PIXELS + at;
            state = vec4f(states[s], states[s + TILE_PIXELS], states[s + 2u * TILE_PIXELS], states[s + 3u * TILE_PIXELS]);
            t[q] = states[s + 4u * TILE_PIXELS];
        }
        v_color[q] = vec3f(0.0);
        rest[q] = 0.0;
        errors[q] = 0.0;
        if all(pixel < view.size.xy) {
            let p = pixel.y * view.size.x + pixel.x;
            v_color[q] = vec3f(v_frame[p], v_frame[pixels + p], v_frame[2u * pixels + p]);
            let total = vec3f(frame[p], frame[pixels + p], frame[2u * pixels + p]);
            rest[q] = dot(total - state.xyz, v_color[q]);
            if has_depth {
                rest[q] += (frame[4u * pixels + p] - state.w) * v_frame[4u * pixels + p];
            }
            if has(flags, FLAG_ALPHA) {
                rest[q] -= (1.0 - frame[3u * pixels + p]) * v_frame[3u * pixels + p];
            }
            if has(flags, FLAG_GATHER_ERROR) {
                errors[q] = v_frame[5u * pixels + p];
            }
        }
    }

    let origin = vec2f(corner) + 0.5;
    for (var before = 0u; before < count; before += THREADS) {
        if before + lane < count {
            let slot = slots[first + before + lane];
            let i = splat_of_slot[slot];
            let a = footprints[3u * i];
            let c = footprints[3u * i + 2u];
            let y = a.y - origin.y;
            let rows = vec2f(y - c.w - ROW_SLACK, y + c.w + ROW_SLACK);
            held[lane] = Held(vec4f(a.x - origin.x, y, a.zw), footprints[3u * i + 1u], vec4f(c.xy, rows));
            held_slots[lane] = slot;
        }
        workgroupBarrier();
        let here = min(count - before, THREADS);
        for (var batch = 0u; batch < here; batch += BATCH) {
            let in_batch = min(here - batch, BATCH);
            for (var k = 0u; k < in_batch; k++) {
                let place = held[batch + k].place;
                let shape = held[batch + k].shape;
                let other = held[batch + k].rest;
                let color = vec3f(shape.zw, other.x);
                let dx = f32(column) - place.x;
                let linear = place.w * dx;
                let constant = fma(place.z * dx, dx, shape.y);
                // Moments 1, dy, dy^2 of v_p.
                var moments = vec3f(0.0);
                var v_own = vec4f(0.0);
                var gathered = vec2f(0.0);
                for (var q = 0u; q < PIXELS; q++) {
                    // The same for all threads.
                    if f32(2u * q + 1u) < other.z || f32(2u * q) > other.w {
                        continue;
                    }
                    let dy = f32(2u * q + odd) - place.y;
                    let p = fma(fma(shape.x, dy, linear), dy, constant);
                    let before_it = t[q];
                    if !(p >= LOG2_ALPHA_MIN && before_it > 0.0) {
                        continue;
                    }
                    let raw = exp2(p);
                    let alpha = min(raw, ALPHA_MAX);
                    let w = alpha * before_it;
                    let behind = before_it - w;
                    if !(behind > TRANSMITTANCE_MIN) {
                        t[q] = -before_it;
                        continue;
                    }
                    t[q] = behind;
                    var g = dot(color, v_color[q]);
                    if has_depth {
                        let pixel = corner + vec2u(column, 2u * q + odd);
                        if all(pixel < view.size.xy) {
                            let v_depth = v_frame[4u * pixels + pixel.y * view.size.x + pixel.x];
                            g = fma(other.y, v_depth, g);
                            v_own.w += w * v_depth;
                        }
                    }
                    let left = rest[q] - w * g;
                    rest[q] = left;
                    v_own += vec4f(w * v_color[q], 0.0);
                    var v_p = 0.0;
                    if raw <= ALPHA_MAX {
                        v_p = (before_it * g - left / (1.0 - alpha)) * alpha;
                    }
                    moments += v_p * vec3f(1.0, dy, dy * dy);
                    if has(flags, FLAG_GATHER_ABSOLUTE) {
                        gathered += abs(v_p) * abs(vec2f(fma(place.w, dy, 2.0 * place.z * dx), fma(2.0 * shape.x, dy, linear)));
                    } else if has(flags, FLAG_GATHER_ERROR) {
                        gathered += w * vec2f(errors[q], 1.0);
                    }
                }
                keep(k, 0u, lane, moments.x);
                keep(k, 1u, lane, moments.x * dx);
                keep(k, 2u, lane, moments.y);
                keep(k, 3u, lane, moments.x * dx * dx);
                keep(k, 4u, lane, moments.y * dx);
                keep(k, 5u, lane, moments.z);
                keep(k, 6u, lane, v_own.x);
                keep(k, 7u, lane, v_own.y);
                keep(k, 8u, lane, v_own.z);
                keep(k, 9u, lane, v_own.w);
                keep(k, 10u, lane, gathered.x);
                keep(k, 11u, lane, gathered.y);
            }
            workgroupBarrier();
            for (var row = lane; row < in_batch * SUMS; row += THREADS) {
                var sum = vec4f(0.0);
                for (var quad = 0u; quad < THREADS / 4u; quad++) {
                    sum += parts[row * QUADS + quad];
                }
                sums[held_slots[batch + row / SUMS] * SUMS + row % SUMS] = dot(sum, vec4f(1.0));
            }
            workgroupBarrier();
        }
    }
}

fn keep(k: u32, sum: u32, lane: u32, value: f32) {
    parts[(k * SUMS + sum) * QUADS + lane / 4u][lane % 4u] = value;
}
