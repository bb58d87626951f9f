//! Constants of the real spherical harmonics, with the basis and signs of the Inria 3DGS code.

/// Highest degree that is trained and rendered.
pub const MAX_DEGREE: u32 = 3;

/// Number of coefficients in all bands up to `degree`.
pub const fn coefficients(degree: u32) -> usize {
    ((degree + 1) * (degree + 1)) as usize
}

/// Band 0: `1 / (2 sqrt(pi))`.
pub const C0: f64 = 0.282_094_791_773_878_14;
/// Band 1: `sqrt(3 / (4 pi))`.
pub const C1: f64 = 0.488_602_511_902_919_9;
/// Band 2, in order of the basis functions xy, yz, 3z^2-1, xz, x^2-y^2.
pub const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
/// Band 3.
pub const C3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    -0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_8,
    1.445_305_721_320_277,
    -0.590_043_589_926_643_5,
];

/// The DC coefficient for `color` in every direction.
pub fn dc_from_color(color: f32) -> f32 {
    (color - 0.5) / C0 as f32
}

/// The colour of a DC coefficient, before clamping.
pub fn color_from_dc(dc: f32) -> f32 {
    dc * C0 as f32 + 0.5
}
