// Comparison of a frame with a photograph; see `loss/mod.rs` for the formulas.
struct Target {
    // Width and height, pixels; columns of 16 x 16 tiles; tiles.
    size: vec4u,
    // Gains of L1, SSIM and squared error; weight of depth.
    gains: vec4f,
    // Bits of FLAG_*; samples of depth; gain of coverage (bits of a float); unused.
    flags: vec4u,
    // Weights of value k of a run of 14 values in the windows of four neighbours (of a run of 12 in the windows of two). Not a constant:
    // a compiler that does not unroll the loop over k would copy the whole array at each access.
    window: array<vec4f, 14>,
}

const FLAG_MASK: u32 = 1u;
const FLAG_SSIM: u32 = 2u;
const FLAG_ERROR: u32 = 4u;

const RADIUS: u32 = 5u;
const TILE: u32 = 16u;
// Side of the area that the windows of a tile cover, pixels.
const SEEN: u32 = 26u;
// Words from row to row, of the values that windows cover and of the result of the first pass: odd, so that threads that take a row
// each have no bank conflicts.
const SEEN_STRIDE: u32 = 27u;
const ROW_STRIDE: u32 = 17u;
