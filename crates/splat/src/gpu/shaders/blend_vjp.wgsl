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

// Four neighbours in a row each.
var<workgroup> transmittances: array<vec4f, 64>;
var<workgroup> rests: array<vec4f, 64>;
var<workgroup> v_red: array<vec4f, 64>;
var<workgroup> v_green: array<vec4f, 64>;
var<workgroup> v_blue: array<vec4f, 64>;
var<workgroup> v_depth: array<vec4f, 64>;
var<workgroup> errors: array<vec4f, 64>;

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
        transmittances[at / 4u][at % 4u] = t;
        rests[at / 4u][at % 4u] = rest;
        v_red[at / 4u][at % 4u] = v.x;
        v_green[at / 4u][at % 4u] = v.y;
        v_blue[at / 4u][at % 4u] = v.z;
        v_depth[at / 4u][at % 4u] = v.w;
        errors[at / 4u][at % 4u] = error;
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
        let t = transmittances[group_of_four];
        let dx = vec4f(0.0, 1.0, 2.0, 3.0) + (f32(4u * (group_of_four % 4u)) - xy.x);
        let dy = f32(group_of_four / 4u) - xy.y;
        let p = fma(fma(vec4f(quadratic.z), vec4f(dy), quadratic.y * dx), vec4f(dy), fma(quadratic.x * dx, dx, vec4f(log2_opacity)));
        let touched = (p >= vec4f(LOG2_ALPHA_MIN)) & (t > vec4f(0.0));
        if any(touched) {
            let raw = exp2(p);
            let alpha = min(raw, vec4f(ALPHA_MAX));
            let weight = alpha * t;
            let behind = t - weight;
            let is_visible = behind > vec4f(TRANSMITTANCE_MIN);
            let drawn = touched & is_visible;
            let w = select(vec4f(0.0), weight, drawn);
            let vr = v_red[group_of_four];
            let vg = v_green[group_of_four];
            let vb = v_blue[group_of_four];
            let vd = v_depth[group_of_four];
            let g = color.x * vr + color.y * vg + color.z * vb + color.w * vd;
            let rest = rests[group_of_four] - w * g;
            v_color += vec4f(dot(w, vr), dot(w, vg), dot(w, vb), dot(w, vd));
            let v_p = select(vec4f(0.0), (t * g - rest / (1.0 - alpha)) * alpha, drawn & (raw <= vec4f(ALPHA_MAX)));
            let v_dx = v_p * dx;
            let along = vec2f(dot(v_dx, vec4f(1.0)), dot(v_dx, dx));
            let sum = dot(v_p, vec4f(1.0));
            moment0 += sum;
            moments1 += vec2f(along.x, sum * dy);
            moments2 += vec3f(along.y, along.x * dy, sum * dy * dy);
            if has(flags, FLAG_GATHER_ABSOLUTE) {
                let slope_x = abs(2.0 * quadratic.x * dx + quadratic.y * dy);
                let slope_y = abs(quadratic.y * dx + 2.0 * quadratic.z * dy);
                gathered += vec2f(dot(abs(v_p), slope_x), dot(abs(v_p), slope_y));
            } else if has(flags, FLAG_GATHER_ERROR) {
                gathered += vec2f(dot(w, errors[group_of_four]), dot(w, vec4f(1.0)));
            }
            rests[group_of_four] = rest;
            transmittances[group_of_four] = select(t, select(-t, behind, is_visible), touched);
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
