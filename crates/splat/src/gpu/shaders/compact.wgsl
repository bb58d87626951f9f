// Lists the visible splats with their depths, in ascending order of splats.
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> visible: array<u32>;
@group(0) @binding(2) var<storage, read> places: array<u32>;
@group(0) @binding(3) var<storage, read> footprints: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> depths: array<u32>;
@group(0) @binding(5) var<storage, read_write> order: array<u32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let i = group_index(group, groups) * 256u + at;
    if i < view.splats.x && visible[i] != 0u {
        // The bits of positive floats have the same order as the floats.
        depths[places[i]] = bitcast<u32>(footprints[3u * i + 2u].y);
        order[places[i]] = i;
    }
}
