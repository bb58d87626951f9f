// The camera and the options of a frame. Matrices are row-major; x_cam = R x + t.
struct View {
    // Rows of R, with t in their last components.
    rows: array<vec4f, 3>,
    // The camera's centre, world; near plane.
    center: vec4f,
    // fx, fy, cx, cy, pixels.
    lens: vec4f,
    // Minimum and maximum of X / Z, and of Y / Z.
    limits: vec4f,
    background: vec4f,
    // Width and height, pixels; columns and rows of tiles.
    size: vec4u,
    // Splats, stride of a plane, SH degree in use, splats drawn.
    splats: vec4u,
    // Numbers of visible splats and of tile entries, known after projection; entries for which there is room, and whether there are more.
    found: vec4u,
    // Bits of FLAG_*.
    flags: vec4u,
}

const FLAG_ANTIALIAS: u32 = 1u;
const FLAG_FILTER: u32 = 2u;
const FLAG_CLAMP: u32 = 4u;
const FLAG_TRAINS: u32 = 8u;
const FLAG_DEPTH: u32 = 16u;
const FLAG_ALPHA: u32 = 32u;
const FLAG_GATHER_ABSOLUTE: u32 = 64u;
const FLAG_GATHER_ERROR: u32 = 128u;
const FLAG_CAMERA: u32 = 256u;

const TILE: u32 = 16u;
const TILE_PIXELS: u32 = 256u;

fn has(flags: u32, flag: u32) -> bool {
    return (flags & flag) != 0u;
}

// Whether v is a finite number, by its bits: compilers may assume that floats are finite.
fn is_finite(v: f32) -> bool {
    return (bitcast<u32>(v) & 0x7f800000u) != 0x7f800000u;
}

// Planes of the geometry: means 0..3, quaternions 3..7, ln scales 7..10, opacity logit 10.
const GEOMETRY: u32 = 11u;
