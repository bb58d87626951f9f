//! Intersection of a ray and a box (Kay and Kajiya 1986, slabs).

/// The distances along the ray at which it enters and leaves the box, clamped to 0; `None` if it misses or is not finite.
pub fn intersect(origin: [f32; 3], direction: [f32; 3], low: [f32; 3], high: [f32; 3]) -> Option<[f32; 2]> {
    let (mut near, mut far) = (0.0f32, f32::INFINITY);
    for c in 0..3 {
        if direction[c] == 0.0 {
            // Parallel to the slab: the ray lies entirely inside or outside.
            if origin[c] < low[c] || origin[c] > high[c] {
                return None;
            }
            continue;
        }
        let inverse = 1.0 / direction[c];
        let (a, b) = ((low[c] - origin[c]) * inverse, (high[c] - origin[c]) * inverse);
        near = near.max(a.min(b));
        far = far.min(a.max(b));
    }
    (near < far && far < f32::INFINITY).then_some([near, far])
}
