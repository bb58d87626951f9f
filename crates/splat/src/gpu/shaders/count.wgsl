// Tiles touched by each visible splat, front to back, and its place in this order.
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> order: array<u32>;
@group(0) @binding(2) var<storage, read> touched: array<u32>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;
@group(0) @binding(4) var<storage, read_write> places: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let j = group_index(group, groups) * 256u + at;
    if j < view.found.x {
        let i = order[j];
        counts[j] = touched[i];
        places[i] = j;
    }
}
