#version 300 es
// A fragment of a splat, with the thresholds of crates/splat/src/render/blend.rs. Colours are premultiplied by alpha.
precision highp float;
precision highp int;

flat in vec4 v_color;
in vec2 v_at;
out vec4 color;

void main() {
  float alpha = v_color.a * exp(-0.5 * dot(v_at, v_at));
  if (alpha < 1.0 / 255.0) discard;
  alpha = min(alpha, 0.99);
  color = vec4(v_color.rgb * alpha, alpha);
}
