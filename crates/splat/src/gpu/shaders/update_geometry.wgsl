// Statistics of density control, regularisers, Adam, noise and the caps, in this order, on everything but colours.
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> update: Update;
@group(0) @binding(2) var<storage, read> visible: array<u32>;
@group(0) @binding(3) var<storage, read> footprints: array<vec4f>;
@group(0) @binding(4) var<storage, read> v_splats: array<f32>;
@group(0) @binding(5) var<storage, read_write> geometry: array<f32>;
// First moments, then second ones.
@group(0) @binding(6) var<storage, read_write> moments: array<f32>;
// Planes: gradient, frames seen, extent, error, weight.
@group(0) @binding(7) var<storage, read_write> statistics: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) thread: u32) {
    let i = group_index(group, groups) * 256u + thread;
    if i >= update.splats.x || view.found.w != 0u {
        return;
    }
    let flags = update.flags.x;
    let is_active = visible[i] != 0u;
    let is_dense = has(flags, UPDATE_DENSE);
    let shapes_all = has(flags, UPDATE_ALL);
    let stride = update.splats.y;
    if is_active && has(flags, UPDATE_GRADIENT | UPDATE_ABSOLUTE | UPDATE_ERROR) {
        gather_statistics(i, stride, flags);
    }
    if is_active || is_dense || shapes_all {
        optimize(i, stride, is_active, is_dense, shapes_all, flags);
    }
    if has(flags, UPDATE_NOISE) {
        add_noise(i, stride);
    }
    if has(flags, UPDATE_CAP) {
        let at = 7u * stride + i;
        let scales = vec3f(geometry[at], geometry[at + stride], geometry[at + 2u * stride]);
        let low = max(scales.x, max(scales.y, scales.z)) - bitcast<f32>(update.flags.z);
        geometry[at] = max(scales.x, low);
        geometry[at + stride] = max(scales.y, low);
        geometry[at + 2u * stride] = max(scales.z, low);
    }
    if has(flags, UPDATE_ANGLE) {
        let mean = vec3f(geometry[i], geometry[stride + i], geometry[2u * stride + i]);
        let largest = log(distance(mean, view.center.xyz)) + update.sh_rates.z;
        // A splat at the camera itself has no finite limit.
        if is_finite(largest) {
            for (var p = 7u; p < 10u; p++) {
                geometry[p * stride + i] = min(geometry[p * stride + i], largest);
            }
        }
    }
}

fn gather_statistics(i: u32, stride: u32, flags: u32) {
    let plane = select(14u, 16u, has(flags, UPDATE_ABSOLUTE));
    let screen = vec2f(v_splats[plane * stride + i], v_splats[(plane + 1u) * stride + i]);
    statistics[i] += length(screen * update.scales.xy);
    statistics[stride + i] += 1.0;
    let extent = footprints[3u * i + 2u].zw;
    statistics[2u * stride + i] = max(statistics[2u * stride + i], max(extent.x, extent.y));
    if has(flags, UPDATE_ERROR) {
        statistics[3u * stride + i] += v_splats[16u * stride + i];
        statistics[4u * stride + i] += v_splats[17u * stride + i];
    }
}

fn optimize(i: u32, stride: u32, is_active: bool, is_dense: bool, shapes_all: bool, flags: u32) {
    var g: array<f32, 11>;
    for (var p = 0u; p < GEOMETRY; p++) {
        g[p] = 0.0;
        if is_active {
            g[p] = v_splats[p * stride + i];
        }
    }
    let at = 7u * stride + i;
    let log_scale = vec3f(geometry[at], geometry[at + stride], geometry[at + 2u * stride]);
    if is_active || shapes_all {
        let s = exp(log_scale);
        let squares = s * s;
        let o = 1.0 / (1.0 + exp(-geometry[10u * stride + i]));
        // Averages are over all splats, or over the visible ones.
        let count = select(view.found.x, update.splats.x, shapes_all);
        let w = update.regularizers / f32(max(count, 1u));
        let v_scale = w.z * s + 4.0 * w.w * squares * squares;
        g[7] += v_scale.x;
        g[8] += v_scale.y;
        g[9] += v_scale.z;
        g[10] += (w.x + 2.0 * w.y * o) * o * (1.0 - o);
    }
    if has(flags, UPDATE_FREEZE) && max(log_scale.x, max(log_scale.y, log_scale.z)) < update.scales.z {
        for (var p = 0u; p < 10u; p++) {
            g[p] = 0.0;
        }
    }
    var rate_of_means = update.rates.x;
    if has(flags, UPDATE_DISTANCE) {
        let mean = vec3f(geometry[i], geometry[stride + i], geometry[2u * stride + i]);
        rate_of_means *= distance(mean, view.center.xyz);
    }
    // Position and rotation move only if they have a gradient, or in dense steps.
    let first = select(7u, 0u, is_active || is_dense);
    // In dense steps, splats without a gradient step with a gradient of zero.
    for (var p = first; p < GEOMETRY; p++) {
        var rate = rate_of_means;
        if p >= 3u {
            rate = update.rates.y;
        }
        if p >= 7u {
            rate = update.rates.z;
        }
        if p == 10u {
            rate = update.rates.w;
        }
        if rate != 0.0 {
            let place = p * stride + i;
            let second = (GEOMETRY + p) * stride + i;
            let next = adam(g[p], rate, geometry[place], moments[place], moments[second], update.adam);
            geometry[place] = next.x;
            moments[place] = next.y;
            moments[second] = next.z;
        }
    }
}

// Noise of 3DGS-MCMC (Kheradmand et al. 2024, eq. 8): Gaussian, shaped by the covariance, on faint splats.
fn add_noise(i: u32, stride: u32) {
    let opacity = 1.0 / (1.0 + exp(-geometry[10u * stride + i]));
    let strength = 1.0 / (1.0 + exp(NOISE_STEEPNESS * (opacity - NOISE_OPACITY)));
    // Below this the offset is lost in rounding.
    if strength <= 1e-6 {
        return;
    }
    let normal = vec3f(normal_number(i, 0u), normal_number(i, 1u), normal_number(i, 2u));
    let raw = vec4f(geometry[3u * stride + i], geometry[4u * stride + i], geometry[5u * stride + i], geometry[6u * stride + i]);
    let q = raw / sqrt(dot(raw, raw));
    let at = 7u * stride + i;
    let variance = exp(2.0 * vec3f(geometry[at], geometry[at + stride], geometry[at + 2u * stride]));
    let local = rotate(vec4f(q.x, -q.yzw), normal) * variance;
    let offset = rotate(q, local) * strength * update.scales.w;
    for (var c = 0u; c < 3u; c++) {
        let moved = geometry[c * stride + i] + offset[c];
        if is_finite(moved) {
            geometry[c * stride + i] = moved;
        }
    }
}

fn rotate(q: vec4f, v: vec3f) -> vec3f {
    let t = 2.0 * cross(q.yzw, v);
    return v + q.x * t + cross(q.yzw, t);
}

const NOISE_STEEPNESS: f32 = 100.0;
const NOISE_OPACITY: f32 = 0.005;

// PCG's output function (Jarzynski and Olano 2020, "Hash Functions for GPU Rendering").
fn hash(v: u32) -> u32 {
    let state = v * 747796405u + 2891336453u;
    let word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
    return (word >> 22u) ^ word;
}

// A standard normal number, determined by the seed of this step, the splat and the axis (Box and Muller 1958).
fn normal_number(i: u32, axis: u32) -> f32 {
    let a = hash(update.flags.y ^ hash(3u * i + axis));
    let b = hash(a);
    let uniform_a = (f32(a >> 8u) + 0.5) / 16777216.0;
    let uniform_b = f32(b >> 8u) / 16777216.0;
    return sqrt(-2.0 * log(uniform_a)) * cos(6.283185307179586 * uniform_b);
}
