// Sums of the camera's gradients over 256 visible splats each, in a fixed order; the host adds these up.
@group(0) @binding(0) var<uniform> view: View;
// Planes, by place in `order`.
@group(0) @binding(1) var<storage, read> v_camera: array<f32>;
// [group, plane].
@group(0) @binding(2) var<storage, read_write> v_camera_sums: array<f32>;

const PLANES: u32 = 15u;
var<workgroup> shared_values: array<f32, 256>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let number = group_index(group, groups);
    let count = view.found.x;
    let j = number * 256u + at;
    for (var plane = 0u; plane < PLANES; plane++) {
        var own = 0.0;
        if j < count {
            own = v_camera[plane * count + j];
        }
        workgroupBarrier();
        shared_values[at] = own;
        for (var half = 128u; half > 0u; half /= 2u) {
            workgroupBarrier();
            if at < half {
                shared_values[at] += shared_values[at + half];
            }
        }
        if at == 0u && number * 256u < count {
            v_camera_sums[number * PLANES + plane] = shared_values[0];
        }
    }
}
