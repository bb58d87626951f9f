// A splat's effect on a pixel: see `fragment` in `render/blend.rs`, whose symbols these kernels use.
const ALPHA_MAX: f32 = 0.99;
const TRANSMITTANCE_MIN: f32 = 1e-4;
const LOG2_ALPHA_MIN: f32 = -7.994353436858858;
