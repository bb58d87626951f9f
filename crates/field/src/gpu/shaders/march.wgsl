// Marches a ray through the occupied cells until it is opaque, one thread per ray. Densities come from the first output of the network,
// evaluated in registers. FEATURES, LEVELS, WIDTH and HIDDEN (layers) are constants of the field, prepended to this source.
@group(0) @binding(0) var<uniform> task: Task;
@group(0) @binding(1) var<storage, read> rays: array<Ray>;
// A brick of 4 x 4 x 4 cells is two words.
@group(0) @binding(2) var<storage, read> bricks: array<u32>;
@group(0) @binding(3) var<storage, read> table: array<f32>;
@group(0) @binding(4) var<storage, read> parameters: array<vec4f>;
// Middles of the samples, [most samples, rays of the march].
@group(0) @binding(5) var<storage, read_write> middles: array<f32>;
@group(0) @binding(6) var<storage, read_write> counts: array<u32>;

const TRANSMITTANCE_MIN: f32 = 1e-4;
const QUADS: u32 = WIDTH / 4u;

fn network(point: vec3f) -> f32 {
    var at = INPUTS * QUADS;
    var hidden: array<vec4f, QUADS>;
    for (var q = 0u; q < QUADS; q++) {
        hidden[q] = parameters[at + q];
    }
    for (var l = 0u; l < LEVELS; l++) {
        var c = corners(task.levels[l], point);
        for (var f = 0u; f < FEATURES; f++) {
            var x = 0.0;
            for (var k = 0u; k < 8u; k++) {
                x += table[c.entry[k] * FEATURES + f] * c.weight[k];
            }
            let row = (l * FEATURES + f) * QUADS;
            for (var q = 0u; q < QUADS; q++) {
                hidden[q] += x * parameters[row + q];
            }
        }
    }
    at += QUADS;
    for (var layer = 1u; layer < HIDDEN; layer++) {
        var next: array<vec4f, QUADS>;
        for (var q = 0u; q < QUADS; q++) {
            next[q] = parameters[at + WIDTH * QUADS + q];
        }
        for (var i = 0u; i < WIDTH; i++) {
            let x = max(hidden[i / 4u][i % 4u], 0.0);
            for (var q = 0u; q < QUADS; q++) {
                next[q] += x * parameters[at + i * QUADS + q];
            }
        }
        hidden = next;
        at += (WIDTH + 1u) * QUADS;
    }
    let outputs = OUTPUTS / 4u;
    var y = parameters[at + WIDTH * outputs].x;
    for (var q = 0u; q < QUADS; q++) {
        let x = max(hidden[q], vec4f(0.0));
        let row = at + 4u * q * outputs;
        y += x.x * parameters[row].x + x.y * parameters[row + outputs].x;
        y += x.z * parameters[row + 2u * outputs].x + x.w * parameters[row + 3u * outputs].x;
    }
    return y;
}

// Cells along a side of the empty cube around a point, 0 where its cell is occupied. Twin: `OccupancyGrid::at`,
// which also knows empty blocks of bricks.
fn empty(u: vec3f) -> f32 {
    let side = task.space.x;
    let cell = vec3u(clamp(u * f32(side), vec3f(0.0), vec3f(f32(side) - 0.5)));
    let brick = cell / 4u;
    let word = 2u * (brick.x + side / 4u * (brick.y + side / 4u * brick.z));
    let bits = vec2u(bricks[word], bricks[word + 1u]);
    if (bits.x | bits.y) == 0u {
        return 4.0;
    }
    let inner = cell % 4u;
    let half = select(bits.x, bits.y, inner.z >= 2u);
    return select(1.0, 0.0, ((half >> (inner.x + 4u * inner.y + 16u * (inner.z % 2u))) & 1u) == 1u);
}

// Whole steps to the end of the empty cube around a point of a straight ray.
fn steps_out(u: vec3f, direction: vec3f, cells: f32, step: f32) -> f32 {
    let width = cells / f32(task.space.x);
    let slope = direction * select(0.5, 0.25, task.space.y == IS_CONTRACTED);
    let cell = floor(u / width);
    let face = select(cell, cell + 1.0, slope > vec3f(0.0)) * width;
    var exit = 1e30;
    for (var c = 0u; c < 3u; c++) {
        if slope[c] != 0.0 {
            exit = min(exit, (face[c] - u[c]) / slope[c]);
        }
    }
    return max(ceil(exit / step), 1.0);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let r = group_index(group, groups) * 64u + at;
    if r >= task.sizes.x {
        return;
    }
    let ray = rays[r];
    let straight = task.space.y != IS_CONTRACTED;
    var t = ray.near + (ray.offset - 0.5) * step_at(ray.near);
    var transmittance = 1.0;
    var count = 0u;
    while t < ray.far && count < task.sizes.w && transmittance >= TRANSMITTANCE_MIN {
        let step = step_at(t);
        let middle = t + 0.5 * step;
        let p = ray.origin + middle * ray.direction;
        let u = unit(p);
        let cells = empty(u);
        if cells == 0.0 {
            if middle > ray.near && middle < ray.far {
                middles[count * task.rows.w + r] = middle;
                count++;
                transmittance *= exp(-density_of(network(u)).x * step);
            }
            t += step;
            continue;
        }
        // By whole steps, so that samples do not depend on what is skipped. In contracted space rays are straight only in the inner cube.
        let inner = straight || all(abs(p) < vec3f(1.0));
        if inner && t * task.march.y <= task.march.x {
            t += step * steps_out(u, ray.direction, cells, step);
        } else {
            t += step;
        }
    }
    counts[r] = count;
}
