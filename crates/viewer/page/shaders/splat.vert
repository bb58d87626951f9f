#version 300 es
// A quad around the ellipse of each splat in which alpha is at least 1/255.
precision highp float;
precision highp int;
precision highp usampler2D;

const int BATCH = 128; // splats per instance, as in js/local/webgl.js
uniform usampler2D u_order; // [rows, 1024]
uniform int u_drawn;
uniform usampler2D u_place;
uniform usampler2D u_look;
uniform vec2 u_size; // pixels
uniform int u_shape; // 0 splats, 1 ellipses, 2 rings, 3 points

flat out vec4 v_color;
out vec2 v_at; // standard deviations; pixels for points

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  v_at = vec2(0.0);
  v_color = vec4(0.0);
  int at = gl_InstanceID * BATCH + (gl_VertexID >> 2);
  if (at >= u_drawn) return;
  int splat = int(texelFetch(u_order, ivec2(at & 1023, at >> 10), 0).x);
  ivec2 texel = ivec2(splat & 1023, splat >> 10);
  uvec4 look = texelFetch(u_look, texel, 0);
  vec2 blue_opacity = unpackHalf2x16(look.y);
  if (blue_opacity.y == 0.0) return;
  uvec4 place = texelFetch(u_place, texel, 0);
  float reach = uintBitsToFloat(look.z);
  if (u_shape != 0) reach = u_shape == 3 ? 2.0 : min(reach, 1.55);
  vec2 corner = vec2((gl_VertexID & 1) == 0 ? -1.0 : 1.0, (gl_VertexID & 2) == 0 ? -1.0 : 1.0);
  v_at = reach * corner;
  vec2 pixel = uintBitsToFloat(place.xy);
  pixel += u_shape == 3 ? v_at : v_at.x * unpackHalf2x16(place.z) + v_at.y * unpackHalf2x16(place.w);
  v_color = vec4(unpackHalf2x16(look.x), blue_opacity);
  gl_Position = vec4(pixel.x / u_size.x * 2.0 - 1.0, 1.0 - pixel.y / u_size.y * 2.0, 0.0, 1.0);
}
