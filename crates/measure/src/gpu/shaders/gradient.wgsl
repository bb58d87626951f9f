// The gradient of the loss in a tile and a channel: `finish` in `loss/ssim.rs`. Gradients of depth are initialised to zero, those of
// alpha to the gradient of the coverage term.
@group(0) @binding(0) var<uniform> task: Target;
@group(0) @binding(1) var<storage, read> frame: array<f32>;
@group(0) @binding(2) var<storage, read> photo: array<u32>;
@group(0) @binding(3) var<storage, read> mask: array<u32>;
@group(0) @binding(4) var<storage, read> maps: array<f32>;
@group(0) @binding(5) var<storage, read_write> sums: array<f32>;
// Planes: red, green, blue, alpha, depth, error.
@group(0) @binding(6) var<storage, read_write> v_frame: array<f32>;

// Derivatives with respect to mu_x and the squares, and with respect to the products: a vec3f would take the space of a vec4f.
var<workgroup> derivatives: array<vec2f, 702>;
var<workgroup> third_derivatives: array<f32, 702>;
var<workgroup> rows: array<vec2f, 442>;
var<workgroup> third_rows: array<f32, 442>;
var<workgroup> shared_values: array<vec3f, 128>;

@compute @workgroup_size(128)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let tile = tile_of(group, groups);
    let pixels = task.size.x * task.size.y;
    let has_ssim = (task.flags.x & FLAG_SSIM) != 0u;
    let column = at % TILE;
    let row = 2u * (at / TILE);
    var adjoint = array<vec3f, 2>();
    if has_ssim {
        // A constant number of iterations, so that the loads of several overlap.
        for (var turn = 0u; turn < SEEN_TURNS; turn++) {
            let i = turn * THREADS + at;
            let pixel = seen_pixel(tile, i);
            var abc = vec3f(0.0);
            if pixel >= 0 {
                let plane = 3u * tile.channel * pixels + u32(pixel);
                abc = vec3f(maps[plane], maps[plane + pixels], maps[plane + 2u * pixels]);
            }
            if i < SEEN * SEEN {
                derivatives[(i / SEEN) * SEEN_STRIDE + i % SEEN] = abc.xy;
                third_derivatives[(i / SEEN) * SEEN_STRIDE + i % SEEN] = abc.z;
            }
        }
        workgroupBarrier();
        // Four neighbours at a time: 14 values serve 4 windows.
        for (var i = at; i < SEEN * TILE / 4u; i += THREADS) {
            let along = i % SEEN;
            let first = 4u * (i / SEEN);
            var a = vec4f(0.0);
            var b = vec4f(0.0);
            var c = vec4f(0.0);
            for (var k = 0u; k < 14u; k++) {
                let ab = derivatives[along * SEEN_STRIDE + first + k];
                let weights = task.window[k];
                a += weights * ab.x;
                b += weights * ab.y;
                c += weights * third_derivatives[along * SEEN_STRIDE + first + k];
            }
            let to = along * ROW_STRIDE + first;
            rows[to] = vec2f(a.x, b.x);
            rows[to + 1u] = vec2f(a.y, b.y);
            rows[to + 2u] = vec2f(a.z, b.z);
            rows[to + 3u] = vec2f(a.w, b.w);
            third_rows[to] = c.x;
            third_rows[to + 1u] = c.y;
            third_rows[to + 2u] = c.z;
            third_rows[to + 3u] = c.w;
        }
        workgroupBarrier();
        for (var k = 0u; k < 12u; k++) {
            let place = (row + k) * ROW_STRIDE + column;
            let abc = vec3f(rows[place], third_rows[place]);
            let weights = task.window[k];
            adjoint[0] += weights.x * abc;
            adjoint[1] += weights.y * abc;
        }
    }
    var differences = vec2f(0.0);
    for (var q = 0u; q < 2u; q++) {
        let pixel = own_pixel(tile, column, row + q);
        if pixel >= 0 {
            differences += finish(adjoint[q], u32(pixel), tile.channel);
        }
    }
    let sum = sum_group(vec3f(differences, 0.0), at);
    if at == 0u && tile.channel < 3u {
        sums[3u * tile.number] = sum.x;
        sums[3u * tile.number + 1u] = sum.y;
        if !has_ssim {
            sums[3u * tile.number + 2u] = 0.0;
        }
    }
}

// Writes the gradient at a pixel; returns its absolute and squared difference.
fn finish(abc: vec3f, to: u32, channel: u32) -> vec2f {
    let pixels = task.size.x * task.size.y;
    let xy = pair_at(to, channel);
    let d = xy.x - xy.y;
    let v = task.gains.x * sign(d) + task.gains.z * d;
    let v_ssim = abc.x + xy.x * abc.y + xy.y * abc.z;
    v_frame[channel * pixels + to] = weight_at(to) * (2.0 * task.gains.y * v_ssim + v);
    if channel == 0u {
        v_frame[3u * pixels + to] = -bitcast<f32>(task.flags.z) * weight_at(to);
        v_frame[4u * pixels + to] = 0.0;
        if (task.flags.x & FLAG_ERROR) != 0u {
            // The mean absolute difference, for density control; 0 for masked pixels.
            var error = 0.0;
            if weight_at(to) > 0.0 {
                for (var c = 0u; c < 3u; c++) {
                    error += abs(frame[c * pixels + to] - truth_at(to, c));
                }
            }
            v_frame[5u * pixels + to] = error / 3.0;
        }
    }
    return vec2f(abs(d), d * d);
}
