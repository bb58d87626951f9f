// A step of Adam on the entries that a sample touched, one thread per parameter; resets their sums to zero.
@group(0) @binding(0) var<uniform> update: Update;
// Written by `scatter`, in units of 2^-50.
@group(0) @binding(1) var<storage, read_write> sums: array<vec2u>;
@group(0) @binding(2) var<storage, read_write> parameters: array<f32>;
// Both moments, [2, parameters].
@group(0) @binding(3) var<storage, read_write> moments: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let i = group_index(group, groups) * 256u + at;
    if i >= update.sizes.x {
        return;
    }
    var sum = sums[i];
    if (sum.x | sum.y) == 0u {
        return;
    }
    sums[i] = vec2u(0u);
    let is_negative = (sum.y >> 31u) == 1u;
    if is_negative {
        sum = vec2u(~sum.x + 1u, ~sum.y + select(0u, 1u, sum.x == 0u));
    }
    let size = f32(sum.y) * exp2(-18.0) + f32(sum.x) * exp2(-50.0);
    let gradient = select(size, -size, is_negative);
    take_step(i, gradient);
}
