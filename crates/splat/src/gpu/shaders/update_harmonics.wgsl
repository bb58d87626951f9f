// Adam on spherical harmonics, whose gradients, the basis times that of the colour, are never stored. Runs before the means move.
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> update: Update;
@group(0) @binding(2) var<storage, read> visible: array<u32>;
@group(0) @binding(3) var<storage, read> geometry: array<f32>;
@group(0) @binding(4) var<storage, read> v_splats: array<f32>;
@group(0) @binding(5) var<storage, read_write> harmonics: array<f32>;
@group(0) @binding(6) var<storage, read_write> first_moments: array<f32>;
@group(0) @binding(7) var<storage, read_write> second_moments: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * 256u + thread;
    if i >= update.splats.x || view.found.w != 0u {
        return;
    }
    let is_active = visible[i] != 0u;
    if !is_active && !has(update.flags.x, UPDATE_DENSE) {
        return;
    }
    let stride = update.splats.y;
    var v_color = vec3f(0.0);
    if is_active {
        v_color = vec3f(v_splats[11u * stride + i], v_splats[12u * stride + i], v_splats[13u * stride + i]);
    }
    let mean = vec3f(geometry[i], geometry[stride + i], geometry[2u * stride + i]);
    let b = basis(view.splats.z, direction(mean).xyz);
    for (var k = 0u; k < update.splats.z; k++) {
        let rate = select(update.sh_rates.y, update.sh_rates.x, k == 0u);
        if rate == 0.0 {
            continue;
        }
        for (var c = 0u; c < 3u; c++) {
            let at = (3u * k + c) * stride + i;
            let next = adam(b[k] * v_color[c], rate, harmonics[at], first_moments[at], second_moments[at], update.adam);
            harmonics[at] = next.x;
            first_moments[at] = next.y;
            second_moments[at] = next.z;
        }
    }
}
