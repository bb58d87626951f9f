// Stores the samples of all rays contiguously: points in the unit cube, middles and encoded directions, one thread per ray.
@group(0) @binding(0) var<uniform> task: Task;
@group(0) @binding(1) var<storage, read> rays: array<Ray>;
@group(0) @binding(2) var<storage, read> middles: array<f32>;
@group(0) @binding(3) var<storage, read> starts: array<u32>;
// x, y, z, middle, [4, stride].
@group(0) @binding(4) var<storage, read_write> points: array<f32>;
@group(0) @binding(5) var<storage, read_write> rows: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let r = group_index(group, groups) * 64u + at;
    if r >= task.sizes.x {
        return;
    }
    let ray = rays[r];
    var toward = basis(3u, ray.view);
    let first = starts[r];
    let count = starts[r + 1u] - first;
    let stride = task.sizes.z;
    for (var i = 0u; i < count; i++) {
        let s = first + i;
        let middle = middles[i * task.rows.w + r];
        let u = unit(ray.origin + middle * ray.direction);
        points[s] = u.x;
        points[stride + s] = u.y;
        points[2u * stride + s] = u.z;
        points[3u * stride + s] = middle;
        for (var k = 0u; k < 16u; k++) {
            rows[(task.rows.y + k) * stride + s] = toward[k];
        }
    }
}
