// The gradients of a layer's weights and biases, summed over a chunk of samples: a workgroup computes a tile of 32 x 32 weights, a thread
// 4 x 4 of them. `update_nets` adds the chunks. Twin: `mlp::outer`.
@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> v_rows: array<f32>;
// [chunks, parameters].
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

const SIDE: u32 = 32u;
var<workgroup> xs: array<f32, 1024>;
var<workgroup> vs: array<f32, 1024>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let across = (layer.sizes.y + SIDE - 1u) / SIDE;
    let tiles = across * ((layer.sizes.x + SIDE - 1u) / SIDE);
    let index = group_index(group, groups);
    let chunk = index / tiles;
    if chunk * layer.samples.z >= layer.samples.x {
        return;
    }
    let tile = vec2u(index % tiles / across, index % across) * SIDE;
    let stride = layer.samples.y;
    let begin = chunk * layer.samples.z;
    let end = min(begin + layer.samples.z, layer.samples.x);
    let own = vec2u(at / 8u, at % 8u) * 4u;
    var products: array<vec4f, 4>;
    for (var i = 0u; i < 4u; i++) {
        products[i] = vec4f(0.0);
    }
    var bias = 0.0;
    for (var s = begin; s < end; s += SIDE) {
        workgroupBarrier();
        for (var k = at; k < SIDE * SIDE; k += 64u) {
            let row = k / SIDE;
            let sample = s + k % SIDE;
            var x = 0.0;
            var v = 0.0;
            if sample < end && tile.x + row < layer.sizes.x {
                x = rows[(layer.rows.x + tile.x + row) * stride + sample];
            }
            if sample < end && tile.y + row < layer.sizes.y {
                v = v_rows[(layer.rows.y + tile.y + row) * stride + sample];
            }
            // Sample-major, so that a thread's rows are contiguous.
            xs[k % SIDE * SIDE + row] = x;
            vs[k % SIDE * SIDE + row] = v;
        }
        workgroupBarrier();
        for (var k = 0u; k < SIDE; k++) {
            let to = k * SIDE + own.y;
            let v = vec4f(vs[to], vs[to + 1u], vs[to + 2u], vs[to + 3u]);
            for (var i = 0u; i < 4u; i++) {
                products[i] += xs[k * SIDE + own.x + i] * v;
            }
        }
        if at < SIDE {
            for (var k = 0u; k < SIDE; k++) {
                bias += vs[k * SIDE + at];
            }
        }
    }
    let to = chunk * layer.samples.w;
    for (var i = 0u; i < 4u; i++) {
        for (var o = 0u; o < 4u; o++) {
            let weight = tile + own + vec2u(i, o);
            if weight.x < layer.sizes.x && weight.y < layer.sizes.y {
                sums[to + layer.sizes.w + weight.x * layer.sizes.z + weight.y] = products[i][o];
            }
        }
    }
    if at < SIDE && tile.x == 0u && tile.y + at < layer.sizes.y {
        sums[to + layer.rows.w + tile.y + at] = bias;
    }
}
