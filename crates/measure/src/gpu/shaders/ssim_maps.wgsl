// SSIM of a tile in one channel, and its derivatives with respect to mu_x, the mean of squares (halved) and the mean of products, as in
// `differentiate` of `loss/ssim.rs`.
@group(0) @binding(0) var<uniform> task: Target;
@group(0) @binding(1) var<storage, read> frame: array<f32>;
@group(0) @binding(2) var<storage, read> photo: array<u32>;
@group(0) @binding(3) var<storage, read> mask: array<u32>;
// [channel, 3, pixel].
@group(0) @binding(4) var<storage, read_write> maps: array<f32>;
// [group, 3]: sums of absolute and squared differences, of 1 - SSIM.
@group(0) @binding(5) var<storage, read_write> sums: array<f32>;

const C1: f32 = 0.0001;
const C2: f32 = 0.0009;

var<workgroup> pairs: array<vec2f, 702>;
// After the window along x: render, truth, squares, products.
var<workgroup> rows: array<vec4f, 442>;
var<workgroup> shared_values: array<vec3f, 128>;

@compute @workgroup_size(128)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let tile = tile_of(group, groups);
    // A constant number of iterations, so that the loads of several overlap.
    for (var turn = 0u; turn < SEEN_TURNS; turn++) {
        let i = turn * THREADS + at;
        let pixel = seen_pixel(tile, i);
        var pair = vec2f(0.0);
        if pixel >= 0 {
            pair = pair_at(u32(pixel), tile.channel);
        }
        if i < SEEN * SEEN {
            pairs[(i / SEEN) * SEEN_STRIDE + i % SEEN] = pair;
        }
    }
    workgroupBarrier();
    // Four neighbours at a time: 14 values serve 4 windows.
    for (var i = at; i < SEEN * TILE / 4u; i += THREADS) {
        let row = i % SEEN;
        let column = 4u * (i / SEEN);
        var x = vec4f(0.0);
        var y = vec4f(0.0);
        var squares = vec4f(0.0);
        var products = vec4f(0.0);
        for (var k = 0u; k < 14u; k++) {
            let xy = pairs[row * SEEN_STRIDE + column + k];
            let weights = task.window[k];
            x += weights * xy.x;
            y += weights * xy.y;
            squares += weights * dot(xy, xy);
            products += weights * (xy.x * xy.y);
        }
        let to = row * ROW_STRIDE + column;
        rows[to] = vec4f(x.x, y.x, squares.x, products.x);
        rows[to + 1u] = vec4f(x.y, y.y, squares.y, products.y);
        rows[to + 2u] = vec4f(x.z, y.z, squares.z, products.z);
        rows[to + 3u] = vec4f(x.w, y.w, squares.w, products.w);
    }
    workgroupBarrier();
    let column = at % TILE;
    let row = 2u * (at / TILE);
    var means = array<vec4f, 2>();
    for (var k = 0u; k < 12u; k++) {
        let moments = rows[(row + k) * ROW_STRIDE + column];
        let weights = task.window[k];
        means[0] += weights.x * moments;
        means[1] += weights.y * moments;
    }
    var dissimilarity = 0.0;
    for (var q = 0u; q < 2u; q++) {
        let pixel = own_pixel(tile, column, row + q);
        if pixel >= 0 {
            dissimilarity += differentiate(means[q], u32(pixel), tile.channel);
        }
    }
    let sum = sum_group(vec3f(0.0, 0.0, dissimilarity), at);
    if at == 0u && tile.channel < 3u {
        sums[3u * tile.number + 2u] = sum.z;
    }
}

// Writes the derivatives at a pixel, from the window's means; returns its weighted 1 - SSIM.
fn differentiate(mean: vec4f, to: u32, channel: u32) -> f32 {
    let m = weight_at(to);
    let product = mean.x * mean.y;
    let squares = mean.x * mean.x + mean.y * mean.y;
    let n1 = 2.0 * product + C1;
    let d1 = squares + C1;
    let n2 = 2.0 * (mean.w - product) + C2;
    let d2 = max(mean.z - squares, 0.0) + C2;
    let inverse = 1.0 / (d1 * d2);
    let scale = m * inverse;
    let ssim = n1 * n2 * scale;
    let by_d2 = ssim * (d1 * inverse);
    let by_d1 = ssim * (d2 * inverse);
    let pixels = task.size.x * task.size.y;
    let plane = 3u * channel * pixels + to;
    maps[plane] = mean.y * scale * (n2 - n1) + mean.x * (by_d2 - by_d1);
    maps[plane + pixels] = -by_d2;
    maps[plane + 2u * pixels] = n1 * scale;
    return m - ssim;
}
