// Inputs and functions shared by the kernels of a field.
struct Task {
    // Rays; samples; stride of the planes of samples; most samples of a ray.
    sizes: vec4u,
    // Cells of the occupancy grid along a side; whether space is contracted; activation of the density; coefficients of the background.
    space: vec4u,
    // Rows of the density, of the encoded direction and of the colour; rays of the last march.
    rows: vec4u,
    // Shortest step; its fraction of the distance; bias of the density; unused.
    march: vec4f,
    // Weight of a ray and of a known distance in the loss; unused.
    loss: vec4f,
    // Cells along a side; first entry; entries; whether corners are stored directly.
    levels: array<vec4u, 32>,
}

const IS_CONTRACTED: u32 = 1u;

// Twin: `Steps::at`.
fn step_at(t: f32) -> f32 {
    return max(task.march.x, t * task.march.y);
}

// The length of the step with this middle.
fn step_around(middle: f32) -> f32 {
    return max(task.march.x, task.march.y * middle / (1.0 + 0.5 * task.march.y));
}

// From field space to the unit cube. Twin: `Space::unit`.
fn unit(p: vec3f) -> vec3f {
    if task.space.y != IS_CONTRACTED {
        return 0.5 * p + 0.5;
    }
    let m = max(max(abs(p.x), abs(p.y)), abs(p.z));
    if m < 1.0 {
        return 0.25 * p + 0.5;
    }
    return 0.25 * (p * ((2.0 - 1.0 / m) / m)) + 0.5;
}

// The density and its derivative with respect to the network's output. Twin: `Net::density`.
fn density_of(output: f32) -> vec2f {
    let x = output + task.march.z;
    if task.space.z == 0u {
        let y = exp(min(x, 10.0));
        return vec2f(y, y);
    }
    if task.space.z == 1u {
        let e = exp(-abs(x));
        let slope = 1.0 / (1.0 + e);
        return vec2f(max(x, 0.0) + log(1.0 + e), select(1.0 - slope, slope, x >= 0.0));
    }
    return vec2f(max(x, 0.0), select(0.0, 1.0, x > 0.0));
}
