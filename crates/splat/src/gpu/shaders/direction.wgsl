// Unit direction from the camera to the mean, and the inverse of the distance.
fn direction(mean: vec3f) -> vec4f {
    let d = mean - view.center.xyz;
    let inv = 1.0 / sqrt(max(dot(d, d), 1e-24));
    return vec4f(d * inv, inv);
}
