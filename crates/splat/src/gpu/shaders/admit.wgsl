// Passes the numbers of visible splats and of tile entries on to the later kernels. If there is no room for all entries, it passes zeros:
// the frame is empty, no splat has a gradient, no update takes place, and the host repeats the step with more room.
@group(0) @binding(0) var<storage, read> found: array<u32>;
@group(0) @binding(1) var<storage, read_write> view: View;
// Number of visible splats, and in a separate part that of entries, for the sorts.
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;

@compute @workgroup_size(1)
fn main() {
    var admitted = vec2u(found[0], found[1]);
    let is_void = admitted.y > view.found.z;
    if is_void {
        admitted = vec2u(0u);
    }
    view.found = vec4u(admitted, view.found.z, u32(is_void));
    counts[0] = admitted.x;
    counts[64] = admitted.y;
}
