// The vector-Jacobian product of blending, a segment of a tile by each workgroup of 32 threads. A thread holds a splat and its sums, and
// visits all pixels of the tile, four a turn, a turn after the thread before it: the state of a pixel, transmittance and light from behind,
// passes from thread to thread through shared memory. A thread that is through takes the splat 32 behind its own at once, since the last
// thread is by then ahead of the first. So there are no reductions over pixels and no atomics, and every sum has a fixed order
// (the scheme of Taming 3DGS, Mallick et al. 2024, section 5, with shared memory for the shuffles of a warp, whose width differs).
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

// Turns of a thread with one splat: the pixels of a tile, four at a time.
const TURNS: u32 = 64u;

var<workgroup> transmittances: array<f32, 256>;
var<workgroup> rests: array<f32, 256>;
// Gradients of red, green, blue and depth.
var<workgroup> v_pixels: array<vec4f, 256>;
var<workgroup> errors: array<f32, 256>;

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
        for (var k = lane; k < count; k += 32u) {
            for (var c = 0u; c < 12u; c++) {
                sums[slots[first + k] * 12u + c] = 0.0;
            }
        }
        return;
    }

    let flags = view.flags.x;
    let pixels = view.size.x * view.size.y;
    let corner = vec2u(tile % view.size.z, tile / view.size.z) * TILE;
    for (var at = lane; at < TILE_PIXELS; at += 32u) {
        let pixel = corner + vec2u(at % TILE, at / TILE);
        var state = vec4f(0.0);
        var t = 1.0;
        if of_tile > 0u {
            let s = segment * 5u * TILE_PIXELS + at;
            state = vec4f(states[s], states[s + TILE_PIXELS], states[s + 2u * TILE_PIXELS], states[s + 3u * TILE_PIXELS]);
            t = states[s + 4u * TILE_PIXELS];
        }
        var v = vec4f(0.0);
        var rest = 0.0;
        var error = 0.0;
        if all(pixel < view.size.xy) {
            let p = pixel.y * view.size.x + pixel.x;
            v = vec4f(v_frame[p], v_frame[pixels + p], v_frame[2u * pixels + p], 0.0);
            var total = vec4f(frame[p], frame[pixels + p], frame[2u * pixels + p], 0.0);
            if has(flags, FLAG_DEPTH) {
                v.w = v_frame[4u * pixels + p];
                total.w = frame[4u * pixels + p];
            }
            rest = dot(total, v) - dot(state, v);
            if has(flags, FLAG_ALPHA) {
                rest -= (1.0 - frame[3u * pixels + p]) * v_frame[3u * pixels + p];
            }
            if has(flags, FLAG_GATHER_ERROR) {
                error = v_frame[5u * pixels + p];
            }
        }
        transmittances[at] = t;
        rests[at] = rest;
        v_pixels[at] = v;
        errors[at] = error;
    }

    let origin = vec2f(corner) + 0.5;
    var slot = 0u;
    var xy = vec2f(0.0);
    var quadratic = vec3f(0.0);
    var log2_opacity = 0.0;
    var color = vec4f(0.0);
    var moment0 = 0.0;
    var moments1 = vec2f(0.0);
    var moments2 = vec3f(0.0);
    var v_color = vec4f(0.0);
    var gathered = vec2f(0.0);
    let turns = (count + 31u) / 32u * TURNS + 31u;
    for (var turn = 0u; turn < turns; turn++) {
        workgroupBarrier();
        // Before its first turn, this has wrapped around.
        let own = turn - lane;
        let k = own / TURNS * 32u + lane;
        if own >= turns || k >= count {
            continue;
        }
        let group_of_four = own % TURNS;
        if group_of_four == 0u {
            slot = slots[first + k];
            let i = splat_of_slot[slot];
            let a = footprints[3u * i];
            let b = footprints[3u * i + 1u];
            let c = footprints[3u * i + 2u];
            xy = a.xy - origin;
            quadratic = vec3f(a.zw, b.x);
            log2_opacity = b.y;
            color = vec4f(b.zw, c.x, c.y);
            moment0 = 0.0;
            moments1 = vec2f(0.0);
            moments2 = vec3f(0.0);
            v_color = vec4f(0.0);
            gathered = vec2f(0.0);
        }
        for (var q = 0u; q < 4u; q++) {
            let at = 4u * group_of_four + q;
            let t = transmittances[at];
            let d = vec2f(f32(at % TILE), f32(at / TILE)) - xy;
            let p = exponent(quadratic, log2_opacity, d);
            if t > 0.0 && LOG2_ALPHA_MIN <= p {
                let f = fragment(p, t);
                if f.drawn {
                    let v = v_pixels[at];
                    let g = dot(color, v);
                    let rest = rests[at] - f.weight * g;
                    v_color += f.weight * v;
                    var v_p = 0.0;
                    if !f.capped {
                        v_p = (t * g - rest / (1.0 - f.alpha)) * f.alpha;
                    }
                    moment0 += v_p;
                    moments1 += v_p * d;
                    moments2 += v_p * vec3f(d.x * d.x, d.x * d.y, d.y * d.y);
                    if has(flags, FLAG_GATHER_ABSOLUTE) {
                        let slope = vec2f(2.0 * quadratic.x * d.x + quadratic.y * d.y, quadratic.y * d.x + 2.0 * quadratic.z * d.y);
                        gathered += abs(v_p) * abs(slope);
                    } else if has(flags, FLAG_GATHER_ERROR) {
                        gathered += f.weight * vec2f(errors[at], 1.0);
                    }
                    rests[at] = rest;
                    transmittances[at] = f.transmittance;
                } else if f.ends {
                    transmittances[at] = -t;
                }
            }
        }
        if group_of_four == TURNS - 1u {
            let to = slot * 12u;
            sums[to] = moment0;
            sums[to + 1u] = moments1.x;
            sums[to + 2u] = moments1.y;
            sums[to + 3u] = moments2.x;
            sums[to + 4u] = moments2.y;
            sums[to + 5u] = moments2.z;
            sums[to + 6u] = v_color.x;
            sums[to + 7u] = v_color.y;
            sums[to + 8u] = v_color.z;
            sums[to + 9u] = v_color.w;
            sums[to + 10u] = gathered.x;
            sums[to + 11u] = gathered.y;
        }
    }
}
