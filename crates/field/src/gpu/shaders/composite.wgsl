// Colour and loss of each ray, and the gradients of the networks' outputs, one thread per ray.
// Twin: `Worker::backward`, up to the networks.
@group(0) @binding(0) var<uniform> task: Task;
@group(0) @binding(1) var<storage, read> rays: array<Ray>;
@group(0) @binding(2) var<storage, read> starts: array<u32>;
@group(0) @binding(3) var<storage, read> points: array<f32>;
@group(0) @binding(4) var<storage, read> rows: array<f32>;
@group(0) @binding(5) var<storage, read> background: array<f32>;
@group(0) @binding(6) var<storage, read_write> v_rows: array<f32>;
// Squared error of the colour, all losses, and the gradient of the learnt background before its sigmoid, [5, rays].
@group(0) @binding(7) var<storage, read_write> losses: array<f32>;

// Twin: `Space::spread`.
fn spread(t: f32) -> f32 {
    if task.space.y != IS_CONTRACTED {
        return t;
    }
    return select(1.0 - 0.5 / t, 0.5 * t, t < 1.0);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let r = group_index(group, groups) * 64u + at;
    let count = task.sizes.x;
    if r >= count {
        return;
    }
    let ray = rays[r];
    let first = starts[r];
    let end = starts[r + 1u];
    let known = ray.goal.w > 0.0 && task.loss.y > 0.0;
    let goal = spread(select(1.0, ray.goal.w, known));
    var color = vec3f(0.0);
    var transmittance = 1.0;
    var error = 0.0;
    for (var s = first; s < end; s++) {
        let sample = sample_at(s);
        let next = transmittance * sample.through;
        let weight = transmittance - next;
        color += weight * sample.color;
        // The mean over the weights, without the transmitted part of the ray.
        error += select(0.0, weight * (spread(sample.middle) - goal), known);
        transmittance = next;
    }
    let behind = background_of(ray);
    let miss = color + transmittance * behind - ray.goal.xyz;
    let v_color = (2.0 / 3.0 * task.loss.x) * miss;
    let squares = dot(miss, miss) / 3.0;
    losses[r] = squares;
    losses[count + r] = squares + task.loss.y * error * error / task.loss.x;
    let is_learnt = task.space.w > 0u && ray.behind.w != 0.0;
    let v_behind = select(vec3f(0.0), v_color * transmittance * behind * (1.0 - behind), is_learnt);
    for (var c = 0u; c < 3u; c++) {
        losses[(2u + c) * count + r] = v_behind[c];
    }

    // Twin: `weights_vjp`.
    let stride = task.sizes.z;
    let v_error = 2.0 * task.loss.y * error;
    var later = dot(v_color, color - (1.0 - transmittance) * behind) + v_error * error;
    transmittance = 1.0;
    for (var s = first; s < end; s++) {
        let sample = sample_at(s);
        let next = transmittance * sample.through;
        let weight = transmittance - next;
        let beyond = select(0.0, spread(sample.middle) - goal, known);
        let v_weight = dot(v_color, sample.color - behind) + v_error * beyond;
        later -= v_weight * weight;
        v_rows[task.rows.x * stride + s] = (v_weight * next - later) * sample.length * sample.slope;
        let v_output = weight * v_color * sample.color * (1.0 - sample.color);
        for (var c = 0u; c < 3u; c++) {
            v_rows[(task.rows.z + c) * stride + s] = v_output[c];
        }
        transmittance = next;
    }
}
