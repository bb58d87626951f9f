// A photograph against a frame; see `loss/mod.rs` for the formulas.
struct Target {
    // Width and height, pixels; columns of tiles of 16 x 16; tiles.
    size: vec4u,
    // Gains of L1, of SSIM and of squares, weight of depth.
    gains: vec4f,
    // Bits of FLAG_*; samples of depth; gain of coverage (bits of a float); unused.
    flags: vec4u,
    // Weights of value k of a run of 14 in the windows of four neighbours, of 12 in those of two. Not a constant: where a compiler does not unroll the loop over
    // k, each access would make a copy of the whole.
    window: array<vec4f, 14>,
}

const FLAG_MASK: u32 = 1u;
const FLAG_SSIM: u32 = 2u;
const FLAG_ERROR: u32 = 4u;

const RADIUS: u32 = 5u;
const TILE: u32 = 16u;
// Side of a tile with what its windows see.
const SEEN: u32 = 26u;
// Words between rows of what windows see, and of what one pass leaves of them: odd, so that threads that take a row each meet in no bank.
const SEEN_STRIDE: u32 = 27u;
const ROW_STRIDE: u32 = 17u;
