#version 300 es
// A fragment of a splat drawn as an ellipse, a ring or a point. Separate from splat.frag, which dominates the cost of a picture.
precision highp float;
precision highp int;

flat in vec4 v_color;
in vec2 v_at;
uniform int u_shape; // 1 ellipses, 2 rings, 3 points
out vec4 color;

void main() {
  float m = dot(v_at, v_at);
  bool rim = m >= 1.69;
  if (m > 2.25 || (u_shape == 2 && !rim)) discard;
  float alpha = u_shape == 2 ? 0.6 : 1.0;
  float shade = u_shape == 1 && rim ? 0.7 : 1.0;
  color = vec4(v_color.rgb * alpha * shade, alpha);
}
