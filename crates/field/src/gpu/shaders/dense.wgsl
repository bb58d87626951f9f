// Twin: one layer of `Mlp::forward`; a thread computes eight outputs of a sample.
@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> parameters: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> rows: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let index = group_index(group, groups);
    let tiles = layer.sizes.z / 8u;
    let s = index / tiles * 256u + at;
    let tile = index % tiles;
    if s >= layer.samples.x {
        return;
    }
    let stride = layer.samples.y;
    let quads = layer.sizes.z / 4u;
    let bias = layer.rows.w / 4u + 2u * tile;
    var sums = array<vec4f, 2>(parameters[bias], parameters[bias + 1u]);
    let first = layer.sizes.w / 4u + 2u * tile;
    for (var i = 0u; i < layer.sizes.x; i++) {
        let x = rows[(layer.rows.x + i) * stride + s];
        sums[0] += x * parameters[first + i * quads];
        sums[1] += x * parameters[first + i * quads + 1u];
    }
    for (var o = 0u; o < 8u; o++) {
        let y = sums[o / 4u][o % 4u];
        if 8u * tile + o < layer.sizes.y {
            rows[(layer.rows.y + 8u * tile + o) * stride + s] = select(y, max(y, 0.0), layer.rows.z != 0u);
        }
    }
}
