// The eight corners around a point of the unit cube: entries of the table and weights. Twin: `encoding::hash_grid::find_corners`.
struct Corners {
    entry: array<u32, 8>,
    weight: array<f32, 8>,
}

const PRIMES: vec2u = vec2u(2654435761u, 805459861u);

fn corners(level: vec4u, point: vec3f) -> Corners {
    let scaled = clamp(point, vec3f(0.0), vec3f(1.0)) * f32(level.x);
    // A point on the far face belongs to the last cell.
    let whole = min(floor(scaled), vec3f(f32(level.x - 1u)));
    let high = scaled - whole;
    let low = 1.0 - high;
    let cell = vec3u(whole);
    var found: Corners;
    for (var k = 0u; k < 8u; k++) {
        let corner = vec3u(k & 1u, (k >> 1u) & 1u, k >> 2u);
        let share = select(low, high, corner == vec3u(1u));
        let p = cell + corner;
        let side = level.x + 1u;
        let hashed = (p.x ^ (p.y * PRIMES.x) ^ (p.z * PRIMES.y)) & (level.z - 1u);
        let direct = p.x + side * (p.y + side * p.z);
        found.entry[k] = level.y + select(hashed, direct, level.w != 0u);
        found.weight[k] = share.x * (share.y * share.z);
    }
    return found;
}
