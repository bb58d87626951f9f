// A photograph against a frame; see `loss/mod.rs` for the formulas.
struct Target {
    // Width and height, pixels; columns of tiles of 16 x 16; tiles.
    size: vec4u,
    // Gains of L1, of SSIM and of squares, weight of depth.
    gains: vec4f,
    // Bits of FLAG_*; samples of depth; gain of coverage (bits of a float); unused.
    flags: vec4u,
}

const FLAG_MASK: u32 = 1u;
const FLAG_SSIM: u32 = 2u;
const FLAG_ERROR: u32 = 4u;

// Weights of the window, with three zeros on either side.
const WINDOW: array<f32, 17> = array(
    0.0, 0.0, 0.0, 0.0010283801, 0.0075987581, 0.0360007721, 0.1093606895, 0.2130055377, 0.2660117249,
    0.2130055377, 0.1093606895, 0.0360007721, 0.0075987581, 0.0010283801, 0.0, 0.0, 0.0,
);
const RADIUS: u32 = 5u;
const TILE: u32 = 16u;
// Side of a tile with what its windows see.
const SEEN: u32 = 26u;

// Weight of the value k behind the first of a run of 14, in the window of neighbour q of four.
fn window_weight(k: u32, q: u32) -> f32 {
    return WINDOW[3u + k - q];
}
