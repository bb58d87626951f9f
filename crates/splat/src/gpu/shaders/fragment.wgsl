// A splat's effect on one pixel: the twin of `fragment` in `render/blend.rs`, with its symbols.
const ALPHA_MAX: f32 = 0.99;
const TRANSMITTANCE_MIN: f32 = 1e-4;
const LOG2_ALPHA_MIN: f32 = -7.994353436858858;

struct Fragment {
    alpha: f32,
    weight: f32,
    transmittance: f32,
    drawn: bool,
    ends: bool,
    capped: bool,
}

fn exponent(quadratic: vec3f, log2_opacity: f32, d: vec2f) -> f32 {
    return fma(fma(quadratic.z, d.y, quadratic.y * d.x), d.y, fma(quadratic.x * d.x, d.x, log2_opacity));
}

fn fragment(p: f32, transmittance: f32) -> Fragment {
    let raw = exp2(p);
    let alpha = min(raw, ALPHA_MAX);
    let weight = alpha * transmittance;
    let behind = transmittance - weight;
    let is_touched = LOG2_ALPHA_MIN <= p;
    let is_visible = TRANSMITTANCE_MIN < behind;
    return Fragment(alpha, weight, behind, is_touched && is_visible, is_touched && !is_visible, ALPHA_MAX < raw);
}
