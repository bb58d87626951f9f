// Unpacks compact splats, in the format of crates/viewer/src/compact.rs, to the planes of crates/splat/src/gpu/shaders/project.wgsl.
// Selected splats are tinted; those outside the clipping box become invisible.
struct Params {
    low: vec3f, // clipping box, world
    first: u32,
    high: vec3f,
    end: u32,
    stride: u32, // of a plane
    degree: u32,
    highlight: u32, // whether selected splats are tinted
    start: u32, // first splat in cores and bands: of the scene, or of a level of detail
}
@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> cores: array<vec4u>; // [splat, 2]
@group(0) @binding(2) var<storage, read> bands: array<vec4u>; // [splat, degree]
@group(0) @binding(3) var<storage, read> selected: array<u32>; // one bit per splat
@group(0) @binding(4) var<storage, read_write> geometry: array<f32>;
@group(0) @binding(5) var<storage, read_write> harmonics: array<f32>;

const SELECTED = vec3f(1.0, 0.72, 0.0); // as in crates/viewer/src/palette.rs
const SELECTED_SHARE = 0.6;
const C0 = 0.28209479177387814;
const INVISIBLE = -30.0; // logit

// The quaternion w, x, y, z of 47 bits.
fn quaternion(low: u32, high: u32) -> vec4f {
    let packed = vec3u(((high & 0x1fffu) << 2u) | (low >> 30u), (low >> 15u) & 0x7fffu, low & 0x7fffu);
    let others = vec3f(packed) * (1.4142135623730951 / 32767.0) - 0.7071067811865476;
    let largest = sqrt(max(1.0 - dot(others, others), 0.0));
    switch (high >> 13u) & 3u {
        case 0u: { return vec4f(largest, others); }
        case 1u: { return vec4f(others.x, largest, others.yz); }
        case 2u: { return vec4f(others.xy, largest, others.z); }
        default: { return vec4f(others, largest); }
    }
}

// Byte n of a splat's higher bands, with its sign.
fn band_byte(i: u32, n: u32) -> f32 {
    let word = bands[(params.start + i) * params.degree + n / 16u][(n / 4u) % 4u];
    return f32(i32(word << (24u - 8u * (n % 4u))) >> 24u);
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) at: u32) {
    let i = params.first + (group.y * groups.x + group.x) * 256u + at;
    if i >= params.end {
        return;
    }
    let a = cores[2u * (params.start + i)];
    let b = cores[2u * (params.start + i) + 1u];
    let mean = bitcast<vec3f>(a.xyz);
    let third_scale_and_opacity = unpack2x16float(b.x);
    let log_scale = vec3f(unpack2x16float(a.w), third_scale_and_opacity.x);
    let opacity = clamp(third_scale_and_opacity.y, 1e-6, 1.0 - 1e-6);
    let quat = quaternion(b.y, b.z & 0xffffu);
    var color = vec3f(unpack2x16float(b.z).y, unpack2x16float(b.w));

    let is_clipped = any(mean < params.low) || any(mean > params.high);
    let stride = params.stride;
    for (var c = 0u; c < 3u; c++) {
        geometry[c * stride + i] = mean[c];
        geometry[(7u + c) * stride + i] = log_scale[c];
    }
    for (var c = 0u; c < 4u; c++) {
        geometry[(3u + c) * stride + i] = quat[c];
    }
    geometry[10u * stride + i] = select(log(opacity / (1.0 - opacity)), INVISIBLE, is_clipped);

    // Colours are linear in the coefficients, and so is the tint.
    var kept = 1.0;
    if params.highlight != 0u && ((selected[i / 32u] >> (i % 32u)) & 1u) != 0u {
        kept = 1.0 - SELECTED_SHARE;
        color = mix(color, SELECTED, SELECTED_SHARE);
    }
    for (var c = 0u; c < 3u; c++) {
        harmonics[c * stride + i] = (color[c] - 0.5) / C0;
    }
    if params.degree > 0u {
        let unit = kept * unpack2x16float(bands[(params.start + i) * params.degree].x).x / 127.0;
        let count = 3u * ((params.degree + 1u) * (params.degree + 1u) - 1u);
        for (var n = 0u; n < count; n++) {
            harmonics[(3u + n) * stride + i] = unit * band_byte(i, 2u + n);
        }
    }
}
