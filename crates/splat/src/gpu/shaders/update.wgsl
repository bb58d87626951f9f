// How an update uses the gradients.
struct Update {
    // Learning rates of means, quaternions, ln scales, opacity logits; divided by the first moment's bias correction.
    rates: vec4f,
    // Learning rates of SH DC and of the other coefficients; logarithm of the angle cap; unused.
    sh_rates: vec4f,
    // Decay of the moments, epsilon, inverse root of the second moment's bias correction.
    adam: vec4f,
    // Weights of opacity, its square, standard deviations, covariance; still to be divided by the number of splats that count.
    regularizers: vec4f,
    // Screen pixels to normalised device coordinates; size below which position and shape are frozen; amount of noise.
    scales: vec4f,
    // Splats, stride, SH coefficients trained, planes of SH.
    splats: vec4u,
    // Bits of UPDATE_*, seed of the noise, largest span of ln scales by the condition cap (bits of a float), unused.
    flags: vec4u,
}

const UPDATE_DENSE: u32 = 1u;
// Regularisers act on all splats.
const UPDATE_ALL: u32 = 2u;
const UPDATE_NOISE: u32 = 4u;
const UPDATE_CAP: u32 = 8u;
const UPDATE_FREEZE: u32 = 16u;
// Statistics: norms of screen gradients, their absolute sums, errors and weights.
const UPDATE_GRADIENT: u32 = 32u;
const UPDATE_ABSOLUTE: u32 = 64u;
const UPDATE_ERROR: u32 = 128u;
// The rate of the means is relative to the distance from the camera.
const UPDATE_DISTANCE: u32 = 256u;
const UPDATE_ANGLE: u32 = 512u;
