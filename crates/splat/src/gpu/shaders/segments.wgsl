// Number of segments of 256 entries in each tile; 0 for the entries that belong to no tile.
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ranges: array<vec2u>;
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let tile = group_index(group, groups) * 256u + at;
    let tiles = view.size.z * view.size.w;
    if tile < tiles {
        counts[tile] = (ranges[tile].y - ranges[tile].x + 255u) / 256u;
    } else if tile == tiles {
        counts[tile] = 0u;
    }
}
