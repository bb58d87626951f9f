//! Colour maps: from a number in \[0, 1\] to a colour; they are also readable in greyscale.

/// Anchors of the map for depth and counts, evenly spaced: dark violet through teal to yellow, close to matplotlib's viridis
/// (van der Walt and Smith, CC0), whose lightness grows evenly.
const SEQUENTIAL: [[f32; 3]; 9] = [
    [0.267, 0.005, 0.329],
    [0.279, 0.175, 0.483],
    [0.230, 0.322, 0.546],
    [0.173, 0.449, 0.558],
    [0.128, 0.567, 0.551],
    [0.158, 0.684, 0.502],
    [0.369, 0.789, 0.383],
    [0.678, 0.864, 0.190],
    [0.993, 0.906, 0.144],
];

/// Anchors of the map for errors: black through red to white.
const HEAT: [[f32; 3]; 5] = [
    [0.02, 0.02, 0.06],
    [0.45, 0.06, 0.32],
    [0.86, 0.22, 0.20],
    [0.99, 0.65, 0.22],
    [1.0, 0.98, 0.85],
];

/// The tint of selected splats, sRGB, and its share.
pub const SELECTED: [f32; 3] = [1.0, 0.72, 0.0];
pub const SELECTED_SHARE: f32 = 0.6;

fn interpolate(anchors: &[[f32; 3]], value: f32) -> [f32; 3] {
    // NaN becomes 0.
    let at = value.clamp(0.0, 1.0).max(0.0) * (anchors.len() - 1) as f32;
    let low = (at as usize).min(anchors.len() - 2);
    let part = at - low as f32;
    std::array::from_fn(|c| anchors[low][c] * (1.0 - part) + anchors[low + 1][c] * part)
}

/// For depth and counts.
pub fn sequential(value: f32) -> [f32; 3] {
    interpolate(&SEQUENTIAL, value)
}

/// For errors.
pub fn heat(value: f32) -> [f32; 3] {
    interpolate(&HEAT, value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_begin_and_end_at_their_anchors_and_grow_lighter() {
        for (map, anchors) in [(sequential as fn(f32) -> [f32; 3], &SEQUENTIAL[..]), (heat, &HEAT[..])] {
            assert_eq!((map(0.0), map(1.0)), (anchors[0], anchors[anchors.len() - 1]));
            assert_eq!((map(-3.0), map(7.0), map(f32::NAN)), (map(0.0), map(1.0), map(0.0)));
            let light = |v: f32| {
                let [r, g, b] = map(v);
                0.2126 * r + 0.7152 * g + 0.0722 * b
            };
            assert!((0..20).all(|i| light(i as f32 / 20.0) < light((i + 1) as f32 / 20.0)));
        }
    }
}
