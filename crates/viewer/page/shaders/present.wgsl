// Copies the planes of a frame to the canvas: one triangle over everything.
@group(0) @binding(0) var<uniform> size: vec2u; // pixels
@group(0) @binding(1) var<storage, read> frame: array<f32>; // planes: red, green, blue, ..

@vertex
fn corner(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
    return vec4f(select(-1.0, 3.0, i == 1u), select(-1.0, 3.0, i == 2u), 0.0, 1.0);
}

@fragment
fn color(@builtin(position) at: vec4f) -> @location(0) vec4f {
    let pixel = u32(at.y) * size.x + u32(at.x);
    let pixels = size.x * size.y;
    return vec4f(frame[pixel], frame[pixels + pixel], frame[2u * pixels + pixel], 1.0);
}
