// Pixels of a view: colour, alpha, depth and median depth, [6, rays], one thread per ray. Twin: `render::view::pixel`.
@group(0) @binding(0) var<uniform> task: Task;
@group(0) @binding(1) var<storage, read> rays: array<Ray>;
@group(0) @binding(2) var<storage, read> starts: array<u32>;
@group(0) @binding(3) var<storage, read> points: array<f32>;
@group(0) @binding(4) var<storage, read> rows: array<f32>;
@group(0) @binding(5) var<storage, read> background: array<f32>;
@group(0) @binding(6) var<storage, read_write> pixels: array<f32>;

// Twin: `Ray::world_distance`.
fn world_distance(ray: Ray, t: f32) -> f32 {
    if ray.goal.w != 0.0 {
        return t * ray.goal.x;
    }
    let fraction = min(t / ray.goal.z, 0.9999);
    return ray.goal.x + ray.goal.y * fraction / (1.0 - fraction);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let r = group_index(group, groups) * 64u + at;
    let count = task.sizes.x;
    if r >= count {
        return;
    }
    let ray = rays[r];
    var color = vec3f(0.0);
    var transmittance = 1.0;
    var depth = 0.0;
    var median = 0.0;
    for (var s = starts[r]; s < starts[r + 1u]; s++) {
        let sample = sample_at(s);
        let next = transmittance * sample.through;
        let weight = transmittance - next;
        let distance = world_distance(ray, sample.middle);
        color += weight * sample.color;
        depth += weight * distance;
        if transmittance > 0.5 && next <= 0.5 {
            median = distance;
        }
        transmittance = next;
    }
    color += transmittance * background_of(ray);
    let alpha = 1.0 - transmittance;
    pixels[r] = color.x;
    pixels[count + r] = color.y;
    pixels[2u * count + r] = color.z;
    pixels[3u * count + r] = alpha;
    pixels[4u * count + r] = select(0.0, depth / alpha, alpha > 0.0);
    pixels[5u * count + r] = median;
}
