#version 300 es
// A fragment of a splat, with the thresholds of crates/splat/src/render/blend.rs; colour is multiplied by alpha.
precision highp float;
precision highp int;

flat in vec4 v_color;
in vec2 v_at;
uniform int u_shape;
out vec4 color;

void main() {
  float m = dot(v_at, v_at);
  float alpha = v_color.a * exp(-0.5 * m);
  float shade = 1.0;
  if (u_shape == 0) {
    if (alpha < 1.0 / 255.0) discard;
    alpha = min(alpha, 0.99);
  } else if (u_shape == 3) {
    if (m > 2.25) discard;
    alpha = 1.0;
  } else {
    bool rim = m >= 1.69;
    if (m > 2.25 || (u_shape == 2 && !rim)) discard;
    alpha = u_shape == 2 ? 0.6 : 1.0;
    shade = u_shape == 1 && rim ? 0.7 : 1.0;
  }
  color = vec4(v_color.rgb * alpha * shade, alpha);
}
