// Features of points, one thread per sample and level. Twin: `encoding::hash_grid::encode_level`.
@group(0) @binding(0) var<uniform> task: Task;
@group(0) @binding(1) var<storage, read> points: array<f32>;
@group(0) @binding(2) var<storage, read> table: array<f32>;
@group(0) @binding(3) var<storage, read_write> rows: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let own = place(group_index(group, groups), at);
    if own.sample >= task.sizes.y {
        return;
    }
    var c = corners_at(own);
    for (var f = 0u; f < FEATURES; f++) {
        var x = 0.0;
        for (var k = 0u; k < 8u; k++) {
            x += table[c.entry[k] * FEATURES + f] * c.weight[k];
        }
        rows[feature_at(own, f)] = x;
    }
}
