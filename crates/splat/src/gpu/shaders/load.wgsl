fn load_geometry(i: u32) -> Geometry {
    let stride = view.splats.y;
    return Geometry(
        vec3f(geometry[i], geometry[stride + i], geometry[2u * stride + i]),
        vec4f(geometry[3u * stride + i], geometry[4u * stride + i], geometry[5u * stride + i], geometry[6u * stride + i]),
        vec3f(geometry[7u * stride + i], geometry[8u * stride + i], geometry[9u * stride + i]),
        geometry[10u * stride + i],
    );
}

fn load_variance(i: u32) -> f32 {
    if has(view.flags.x, FLAG_FILTER) {
        return filter_variance[i];
    }
    return 0.0;
}
