// Which tiles a splat touches: in each column of tiles, its ellipse (alpha >= 1/255) spans one exact interval of y. The twin of
// `render/touch.rs`.
const SLACK: f32 = 1e-2;
const LOG2_ALPHA_MIN: f32 = -7.994353436858858;

struct Outline {
    xy: vec2f,
    extent: vec2f,
    quadratic: vec3f,
    log2_opacity: f32,
}

// First and last column of tiles; first > last if none.
fn tile_columns(s: Outline) -> vec2i {
    let first = ceil((s.xy.x - s.extent.x - SLACK - 15.5) / 16.0);
    let last = floor((s.xy.x + s.extent.x + SLACK - 0.5) / 16.0);
    return vec2i(i32(max(first, 0.0)), i32(clamp(last, -1.0, f32(view.size.z) - 1.0)));
}

// First and last row of tiles in a column; first > last if none.
fn tile_rows(s: Outline, column: i32) -> vec2i {
    let t = s.log2_opacity - LOG2_ALPHA_MIN;
    let inv_ex = 1.0 / max(s.extent.x, 1e-6);
    let middle_slope = -0.5 * s.quadratic.y / s.quadratic.z;
    let half_height_squared = -t / s.quadratic.z;
    let x_at_top = -0.5 * s.quadratic.y / s.quadratic.x * s.extent.y;
    let edge = f32(column) * 16.0 - s.xy.x;
    let left = max(edge + 0.5, -s.extent.x);
    let right = min(edge + 15.5, s.extent.x);
    let dx_high = max(min(x_at_top, right), left);
    let dx_low = max(min(-x_at_top, right), left);
    let u_high = dx_high * inv_ex;
    let u_low = dx_low * inv_ex;
    let high = middle_slope * dx_high + sqrt(half_height_squared * max(1.0 - u_high * u_high, 0.0));
    let low = middle_slope * dx_low - sqrt(half_height_squared * max(1.0 - u_low * u_low, 0.0));
    let first_row = max(ceil(s.xy.y + low - 0.5 - SLACK), 0.0);
    let last_row = min(floor(s.xy.y + high - 0.5 + SLACK), f32(view.size.w) * 16.0 - 1.0);
    if !(first_row <= last_row) {
        return vec2i(1, 0);
    }
    return vec2i(i32(first_row) / 16, i32(last_row) / 16);
}

fn outline_of(i: u32) -> Outline {
    let a = footprints[3u * i];
    let b = footprints[3u * i + 1u];
    let c = footprints[3u * i + 2u];
    return Outline(a.xy, c.zw, vec3f(a.zw, b.x), b.y);
}
