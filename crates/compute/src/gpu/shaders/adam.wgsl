// Adam (Kingma and Ba 2015). Twin: `adam::AdamRule`.

// First moments below this are set to zero.
const FAINTEST_MOMENT: f32 = 1e-30;

// Parameter, first and second moment after the gradient g. The rate is divided by the bias correction of the first moment; `rule` has the
// decay of both moments, epsilon, and the inverse root of the bias correction of the second.
fn adam(g: f32, rate: f32, parameter: f32, first: f32, second: f32, rule: vec4f) -> vec3f {
    var m = fma(first, rule.x, (1.0 - rule.x) * g);
    let v = fma(second, rule.y, (1.0 - rule.y) * g * g);
    let p = parameter - rate * m / fma(sqrt(v), rule.w, rule.z);
    if abs(m) < FAINTEST_MOMENT {
        m = 0.0;
    }
    return vec3f(p, m, v);
}
