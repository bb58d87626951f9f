// Where each tile's entries begin and end; both are 0 on entry.
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> tiles: array<u32>;
@group(0) @binding(2) var<storage, read_write> ranges: array<vec2u>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let e = group_index(group, groups) * 256u + at;
    let count = view.found.y;
    if e >= count {
        return;
    }
    let tile = tiles[e];
    if e == 0u || tiles[max(e, 1u) - 1u] != tile {
        ranges[tile].x = e;
    }
    if e + 1u == count || tiles[e + 1u] != tile {
        ranges[tile].y = e + 1u;
    }
}
