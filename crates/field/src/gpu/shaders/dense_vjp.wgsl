// Twin: one layer of `Mlp::pull_back`; a thread computes the gradients of eight inputs of a sample.
@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> parameters: array<f32>;
@group(0) @binding(2) var<storage, read> rows: array<f32>;
@group(0) @binding(3) var<storage, read_write> v_rows: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let index = group_index(group, groups);
    let tiles = (layer.back.x + 7u) / 8u;
    let s = index / tiles * 256u + at;
    let first = index % tiles * 8u;
    if s >= layer.samples.x {
        return;
    }
    let stride = layer.samples.y;
    var sums: array<f32, 8>;
    for (var i = 0u; i < 8u; i++) {
        sums[i] = 0.0;
    }
    for (var o = 0u; o < layer.sizes.y; o++) {
        let v = v_rows[(layer.rows.y + o) * stride + s];
        for (var i = 0u; i < 8u; i++) {
            sums[i] += v * parameters[layer.sizes.w + (first + i) * layer.sizes.z + o];
        }
    }
    for (var i = 0u; i < 8u; i++) {
        if first + i < layer.back.x {
            let row = (layer.rows.x + first + i) * stride + s;
            v_rows[row] = select(sums[i], 0.0, layer.back.y != 0u && rows[row] <= 0.0);
        }
    }
}
