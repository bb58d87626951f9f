// Twin: `space::Ray`, with its target.
struct Ray {
    origin: vec3f,
    near: f32,
    direction: vec3f,
    far: f32,
    // Unit direction in the world; fraction of a step by which samples are shifted.
    view: vec3f,
    offset: f32,
    // In training the target colour and the known distance, 0 if unknown. In rendering [start, near, length, 0] of
    // normalised device coordinates, or [scale, 0, 0, 1].
    goal: vec4f,
    // Background; whether a learnt one takes precedence.
    behind: vec4f,
}
