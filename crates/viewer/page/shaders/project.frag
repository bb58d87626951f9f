#version 300 es
// Projects a 3D Gaussian to its footprint: EWA splatting (Zwicker et al. 2001) as 3DGS uses it (Kerbl et al. 2023), the twin of
// crates/splat/src/render/project.rs. Reads the compact splats of crates/viewer/src/compact.rs.
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D u_cores; // [rows, 1024 * 2]
uniform usampler2D u_bands; // [rows, 1024 * degree]
uniform usampler2D u_selected; // [rows, 1024], 1 if selected
uniform bool u_highlight; // whether selected splats are tinted
uniform int u_degree;
uniform int u_count;
uniform mat3 u_rotation; // camera from world
uniform vec3 u_position; // camera, world
uniform vec2 u_focal; // pixels
uniform vec2 u_principal;
uniform vec2 u_size; // pixels
uniform vec4 u_limits; // smallest x/z, largest x/z, smallest y/z, largest y/z
uniform float u_near;
uniform bool u_antialias;
uniform vec3 u_low; // clipping box, world
uniform vec3 u_high;

layout(location = 0) out uvec4 place; // centre x, y; the two axes of the ellipse, pixels
layout(location = 1) out uvec4 look; // red, green; blue, opacity; reach, pixels per world unit; depth

const float DILATION = 0.3;
const float MAX_SIDES_OUTSIDE = 2.0; // as in crates/splat/src/render/view.rs
const vec3 SELECTED = vec3(1.0, 0.72, 0.0); // as in crates/viewer/src/palette.rs
const float SELECTED_SHARE = 0.6;
const float C1 = 0.4886025119029199;

// The 16, 32 or 48 bytes of a splat's higher bands, fetched once: one fetch per byte takes a third longer.
uvec4 bands[3];

uint byteAt(int n) {
  return (bands[n >> 4][(n >> 2) & 3] >> uint(8 * (n & 3))) & 255u;
}

// Coefficient k, 1 to 15, in units of the factor.
vec3 coefficient(int k) {
  vec3 value;
  for (int c = 0; c < 3; c++) {
    int bits = int(byteAt(2 + 3 * (k - 1) + c));
    value[c] = float(bits > 127 ? bits - 256 : bits);
  }
  return value / 127.0;
}

vec3 harmonics(int splat, int row, vec3 d) {
  for (int n = 0; n < 3; n++) bands[n] = n < u_degree ? texelFetch(u_bands, ivec2(splat * u_degree + n, row), 0) : uvec4(0u);
  float factor = unpackHalf2x16(bands[0].x).x;
  float x = d.x, y = d.y, z = d.z;
  vec3 sum = C1 * (-y * coefficient(1) + z * coefficient(2) - x * coefficient(3));
  if (u_degree > 1) {
    float xx = x * x, yy = y * y, zz = z * z;
    sum += 1.0925484305920792 * (x * y * coefficient(4) - y * z * coefficient(5)
      - x * z * coefficient(7));
    sum += 0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(6);
    sum += 0.5462742152960396 * (xx - yy) * coefficient(8);
    if (u_degree > 2) {
      sum += -0.5900435899266435 * (y * (3.0 * xx - yy) * coefficient(9)
        + x * (xx - 3.0 * yy) * coefficient(15));
      sum += 2.890611442640554 * x * y * z * coefficient(10);
      sum += -0.4570457994644658 * (4.0 * zz - xx - yy) * (y * coefficient(11) + x * coefficient(13));
      sum += 0.3731763325901154 * z * (2.0 * zz - 3.0 * (xx + yy)) * coefficient(12);
      sum += 1.445305721320277 * z * (xx - yy) * coefficient(14);
    }
  }
  return factor * sum;
}

// The quaternion w, x, y, z of 47 bits.
vec4 quaternion(uint low, uint high) {
  float unit = 1.4142135623730951 / 32767.0;
  vec3 others = vec3(((high & 0x1fffu) << 2) | (low >> 30), (low >> 15) & 0x7fffu, low & 0x7fffu) * unit - 0.7071067811865476;
  float largest = sqrt(max(1.0 - dot(others, others), 0.0));
  uint index = (high >> 13) & 3u;
  if (index == 0u) return vec4(largest, others);
  if (index == 1u) return vec4(others.x, largest, others.yz);
  if (index == 2u) return vec4(others.xy, largest, others.z);
  return vec4(others, largest);
}

void main() {
  place = uvec4(0u);
  look = uvec4(0u);
  ivec2 at = ivec2(gl_FragCoord.xy);
  if (at.y * 1024 + at.x >= u_count) return;
  uvec4 first = texelFetch(u_cores, ivec2(2 * at.x, at.y), 0);
  uvec4 second = texelFetch(u_cores, ivec2(2 * at.x + 1, at.y), 0);
  vec3 mean = uintBitsToFloat(first.xyz);
  if (any(lessThan(mean, u_low)) || any(greaterThan(mean, u_high))) return;
  vec3 x = u_rotation * (mean - u_position);
  if (!(x.z > u_near)) return;
  vec2 center = u_focal * x.xy / x.z + u_principal;
  float margin = MAX_SIDES_OUTSIDE * max(u_size.x, u_size.y);
  if (any(lessThan(center, vec2(-margin))) || any(greaterThan(center, u_size + margin))) return;

  vec2 thirdScaleAndOpacity = unpackHalf2x16(second.x);
  vec3 scale = exp(vec3(unpackHalf2x16(first.w), thirdScaleAndOpacity.x));
  float opacity = thirdScaleAndOpacity.y;
  vec4 q = quaternion(second.y, second.z & 0xffffu);
  vec3 color = vec3(unpackHalf2x16(second.z).y, unpackHalf2x16(second.w));

  float w = q.x, i = q.y, j = q.z, k = q.w;
  mat3 rot = mat3(
    1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j + w * k), 2.0 * (i * k - w * j),
    2.0 * (i * j - w * k), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k + w * i),
    2.0 * (i * k + w * j), 2.0 * (j * k - w * i), 1.0 - 2.0 * (i * i + j * j));
  vec2 tangent = clamp(x.xy / x.z, u_limits.xz, u_limits.yw);
  mat3 m = u_rotation * rot;
  // Rows of J times the splat's axes in the camera, times its standard deviations.
  vec3 row2 = vec3(m[0].z, m[1].z, m[2].z);
  vec3 v0 = u_focal.x / x.z * (vec3(m[0].x, m[1].x, m[2].x) - tangent.x * row2) * scale;
  vec3 v1 = u_focal.y / x.z * (vec3(m[0].y, m[1].y, m[2].y) - tangent.y * row2) * scale;
  vec3 crossed = cross(v0, v1);
  float determinant = dot(crossed, crossed);
  float a = dot(v0, v0), b = dot(v0, v1), c = dot(v1, v1);
  float dilated = determinant + DILATION * (a + c) + DILATION * DILATION;
  if (u_antialias) opacity *= sqrt(max(determinant / dilated, 0.000025));
  if (!(opacity >= 1.0 / 255.0) || !(dilated < 1e30)) return;
  a += DILATION;
  c += DILATION;
  // Axes of the ellipse: eigenvectors times roots of the eigenvalues.
  float middle = 0.5 * (a + c);
  float half_gap = length(vec2(0.5 * (a - c), b));
  float large = middle + half_gap;
  float small = max(dilated / large, 1e-6);
  vec2 direction = half_gap < 1e-9 * middle ? vec2(1.0, 0.0) : a >= c ? vec2(large - c, b) : vec2(b, large - a);
  direction = normalize(direction);

  if (u_degree > 0) color += harmonics(at.x, at.y, normalize(mean - u_position));
  if (u_highlight && texelFetch(u_selected, at, 0).x != 0u) color = mix(color, SELECTED, SELECTED_SHARE);
  color = max(color, 0.0);
  float reach = sqrt(2.0 * log(255.0 * opacity));
  place = uvec4(floatBitsToUint(center), packHalf2x16(clamp(direction * sqrt(large), -6e4, 6e4)),
    packHalf2x16(vec2(-direction.y, direction.x) * sqrt(small)));
  look = uvec4(packHalf2x16(color.rg), packHalf2x16(vec2(color.b, opacity)), floatBitsToUint(reach), floatBitsToUint(x.z));
}
