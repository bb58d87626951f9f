// The sample and level of a thread, in kernels with one thread per sample and level.
struct Place {
    sample: u32,
    level: u32,
}

fn place(group: u32, at: u32) -> Place {
    return Place(group / LEVELS * 256u + at, group % LEVELS);
}

// The corners around the sample's point.
fn corners_at(place: Place) -> Corners {
    let stride = task.sizes.z;
    let s = place.sample;
    return corners(task.levels[place.level], vec3f(points[s], points[stride + s], points[2u * stride + s]));
}

// Where feature f of the sample is in the planes of the encoding.
fn feature_at(place: Place, f: u32) -> u32 {
    return (place.level * FEATURES + f) * task.sizes.z + place.sample;
}
