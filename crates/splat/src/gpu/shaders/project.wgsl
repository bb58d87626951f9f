// Projects every splat, evaluates its colour, and counts the tiles that it touches.
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> geometry: array<f32>;
@group(0) @binding(2) var<storage, read> harmonics: array<f32>;
@group(0) @binding(3) var<storage, read> filter_variance: array<f32>;
@group(0) @binding(4) var<storage, read_write> footprints: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> visible: array<u32>;
@group(0) @binding(6) var<storage, read_write> touched: array<u32>;
// Numbers of visible splats and of tile entries.
@group(0) @binding(7) var<storage, read_write> found: array<atomic<u32>>;

var<workgroup> found_here: array<atomic<u32>, 2>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let i = group_index(group, groups) * 256u + at;
    if at < 2u {
        atomicStore(&found_here[at], 0u);
    }
    workgroupBarrier();
    if i < view.splats.x {
        var tiles = 0u;
        var is_visible = false;
        if i < view.splats.w {
            is_visible = project_splat(i, &tiles);
        }
        visible[i] = select(0u, 1u, is_visible);
        touched[i] = tiles;
        if is_visible {
            atomicAdd(&found_here[0], 1u);
            atomicAdd(&found_here[1], tiles);
        }
    }
    workgroupBarrier();
    // Sums of integers do not depend on their order.
    if at < 2u {
        atomicAdd(&found[at], atomicLoad(&found_here[at]));
    }
}

fn project_splat(i: u32, tiles: ptr<function, u32>) -> bool {
    let g = load_geometry(i);
    let f = project(g, load_variance(i));
    if !f.visible {
        return false;
    }
    let stride = view.splats.y;
    let degree = view.splats.z;
    let b = basis(degree, direction(g.mean).xyz);
    var color = vec3f(0.5);
    let coefficients = (degree + 1u) * (degree + 1u);
    for (var k = 0u; k < coefficients; k++) {
        let plane = 3u * k * stride + i;
        color += b[k] * vec3f(harmonics[plane], harmonics[plane + stride], harmonics[plane + 2u * stride]);
    }
    if has(view.flags.x, FLAG_CLAMP) {
        color = max(color, vec3f(0.0));
    }
    let quadratic = f.conic * vec3f(-0.5 * LOG2_E, -LOG2_E, -0.5 * LOG2_E);
    let log2_opacity = log2(f.opacity);
    // Splats that are not finite are not drawn.
    let sum = abs(f.xy.x) + abs(f.xy.y) + abs(quadratic.x) + abs(quadratic.y) + abs(quadratic.z) + abs(log2_opacity)
        + f.depth + f.extent.x + f.extent.y + abs(color.x) + abs(color.y) + abs(color.z);
    if !is_finite(sum) {
        return false;
    }
    footprints[3u * i] = vec4f(f.xy, quadratic.xy);
    footprints[3u * i + 1u] = vec4f(quadratic.z, log2_opacity, color.xy);
    footprints[3u * i + 2u] = vec4f(color.z, f.depth, f.extent);
    let s = outline_of(i);
    let columns = tile_columns(s);
    for (var column = columns.x; column <= columns.y; column++) {
        let rows = tile_rows(s, column);
        *tiles += u32(max(rows.y - rows.x + 1, 0));
    }
    return true;
}
