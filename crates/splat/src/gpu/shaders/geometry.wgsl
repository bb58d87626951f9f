// From a 3D Gaussian to its footprint on the image, and back: the twin of `render/project.rs`, with its symbols.
const DILATION: f32 = 0.3;
const ALPHA_MIN: f32 = 1.0 / 255.0;
const COMPENSATION_FLOOR: f32 = 0.000025;
// As in `render/view.rs`.
const MAX_SIDES_OUTSIDE: f32 = 2.0;
const LOG2_E: f32 = 1.4426950408889634;
const LN_2: f32 = 0.6931471805599453;

struct Geometry {
    mean: vec3f,
    quat: vec4f, // w, x, y, z
    log_scale: vec3f,
    opacity_logit: f32,
}

struct Footprint {
    xy: vec2f,
    depth: f32,
    conic: vec3f,
    opacity: f32,
    extent: vec2f,
    visible: bool,
}

struct Intermediate {
    x: vec3f,
    inv_z: f32,
    tangent: vec2f,
    q: vec4f,
    inv_q_norm: f32,
    // Rows of the rotation.
    rot: array<vec3f, 3>,
    scale: vec3f,
    fraction: vec3f,
    jr: array<vec3f, 2>,
    v: array<vec3f, 2>,
    cov: vec3f,
    det: f32,
    cov_dilated: vec3f,
    det_dilated: f32,
    sigmoid: f32,
    thinning: f32,
}

// `variance` is that of the 3D smoothing filter; 0 for none.
fn intermediate(g: Geometry, variance: f32) -> Intermediate {
    var at: Intermediate;
    at.x = vec3f(
        dot(view.rows[0].xyz, g.mean) + view.rows[0].w,
        dot(view.rows[1].xyz, g.mean) + view.rows[1].w,
        dot(view.rows[2].xyz, g.mean) + view.rows[2].w,
    );
    at.inv_z = 1.0 / at.x.z;
    at.tangent = clamp(at.x.xy * at.inv_z, view.limits.xz, view.limits.yw);
    at.inv_q_norm = 1.0 / sqrt(dot(g.quat, g.quat));
    at.q = g.quat * at.inv_q_norm;
    let w = at.q.x;
    let i = at.q.y;
    let j = at.q.z;
    let k = at.q.w;
    at.rot[0] = vec3f(1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j - w * k), 2.0 * (i * k + w * j));
    at.rot[1] = vec3f(2.0 * (i * j + w * k), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k - w * i));
    at.rot[2] = vec3f(2.0 * (i * k - w * j), 2.0 * (j * k + w * i), 1.0 - 2.0 * (i * i + j * j));
    let own_scale = exp(g.log_scale);
    at.scale = own_scale;
    at.fraction = vec3f(1.0);
    at.thinning = 1.0;
    if has(view.flags.x, FLAG_FILTER) {
        at.scale = sqrt(own_scale * own_scale + variance);
        let ratio = own_scale / at.scale;
        at.fraction = ratio * ratio;
        at.thinning = ratio.x * ratio.y * ratio.z;
    }
    for (var r = 0; r < 2; r++) {
        let j_scale = view.lens[r] * at.inv_z;
        at.jr[r] = j_scale * (view.rows[r].xyz - at.tangent[r] * view.rows[2].xyz);
        let u = at.jr[r].x * at.rot[0] + at.jr[r].y * at.rot[1] + at.jr[r].z * at.rot[2];
        at.v[r] = u * at.scale;
    }
    at.cov = vec3f(dot(at.v[0], at.v[0]), dot(at.v[0], at.v[1]), dot(at.v[1], at.v[1]));
    // |V0 x V1|^2 instead of a c - b^2, which loses needles to rounding.
    let across = cross(at.v[0], at.v[1]);
    at.det = dot(across, across);
    at.det_dilated = at.det + DILATION * (at.cov.x + at.cov.z) + DILATION * DILATION;
    at.cov_dilated = at.cov + vec3f(DILATION, 0.0, DILATION);
    at.sigmoid = 1.0 / (1.0 + exp(-g.opacity_logit));
    return at;
}

fn project(g: Geometry, variance: f32) -> Footprint {
    let at = intermediate(g, variance);
    let own_opacity = at.sigmoid * at.thinning;
    let inv_det = 1.0 / at.det_dilated;
    var f: Footprint;
    f.opacity = own_opacity;
    if has(view.flags.x, FLAG_ANTIALIAS) {
        f.opacity *= sqrt(max(at.det * inv_det, COMPENSATION_FLOOR));
    }
    f.xy = view.lens.xy * at.x.xy * at.inv_z + view.lens.zw;
    let reach = 2.0 * log(max(f.opacity / ALPHA_MIN, 1.0));
    f.extent = sqrt(reach * at.cov_dilated.xz);
    f.depth = at.x.z;
    f.conic = vec3f(at.cov_dilated.z, -at.cov_dilated.y, at.cov_dilated.x) * inv_det;
    let image = vec2f(view.size.xy);
    let margin = MAX_SIDES_OUTSIDE * max(image.x, image.y);
    f.visible = view.center.w < at.x.z && ALPHA_MIN <= f.opacity
        && all(f.xy - f.extent <= image - 0.5) && all(f.xy + f.extent >= vec2f(0.5))
        && all(f.xy >= vec2f(-margin)) && all(f.xy <= image + margin)
        && at.det_dilated > 0.0 && at.det_dilated < 1e30;
    return f;
}
