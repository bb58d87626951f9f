// A sample as compositing reads it.
struct Sample {
    middle: f32,
    // Length of its interval, field units, and its transmittance.
    length: f32,
    through: f32,
    // Derivative of the density with respect to the network's output.
    slope: f32,
    color: vec3f,
}

fn sample_at(s: u32) -> Sample {
    let stride = task.sizes.z;
    let middle = points[3u * stride + s];
    let output = vec3f(
        rows[task.rows.z * stride + s],
        rows[(task.rows.z + 1u) * stride + s],
        rows[(task.rows.z + 2u) * stride + s],
    );
    let length = step_around(middle);
    let density = density_of(rows[task.rows.x * stride + s]);
    return Sample(middle, length, exp(-density.x * length), density.y, sigmoid(output));
}

// exp(-|x|) does not overflow; negative values follow by symmetry.
fn sigmoid(x: vec3f) -> vec3f {
    let e = exp(-abs(x));
    let right = 1.0 / (1.0 + e);
    return select(1.0 - right, right, x >= vec3f(0.0));
}

// The background of a ray. Twin: `background_color`.
fn background_of(ray: Ray) -> vec3f {
    if task.space.w == 0u || ray.behind.w == 0.0 {
        return ray.behind.xyz;
    }
    var toward = basis(3u, ray.view);
    var sum = vec3f(0.0);
    for (var k = 0u; k < task.space.w; k++) {
        sum += toward[k] * vec3f(background[3u * k], background[3u * k + 1u], background[3u * k + 2u]);
    }
    return sigmoid(sum);
}
