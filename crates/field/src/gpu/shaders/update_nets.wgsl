// Adds up the chunks' gradients in order and takes a step of Adam, one thread per parameter of the networks.
@group(0) @binding(0) var<uniform> update: Update;
@group(0) @binding(1) var<storage, read> sums: array<f32>;
@group(0) @binding(2) var<storage, read_write> parameters: array<f32>;
// Both moments, [2, parameters].
@group(0) @binding(3) var<storage, read_write> moments: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let i = group_index(group, groups) * 64u + at;
    let count = update.sizes.x;
    if i >= count {
        return;
    }
    var gradient = 0.0;
    for (var chunk = 0u; chunk < update.sizes.y; chunk++) {
        gradient += sums[chunk * count + i];
    }
    take_step(i, gradient);
}
