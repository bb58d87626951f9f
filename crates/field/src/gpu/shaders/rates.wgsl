// How an update uses gradients.
struct Update {
    // The `rule` of `adam`.
    rule: vec4f,
    // Rate, divided by the bias correction of the first moment; unused.
    rate: vec4f,
    // Parameters; chunks of samples, or rays; unused.
    sizes: vec4u,
}

// A step of Adam on parameter i. The first moments of all parameters are followed by the second moments.
fn take_step(i: u32, gradient: f32) {
    let second = update.sizes.x + i;
    let stepped = adam(gradient, update.rate.x, parameters[i], moments[i], moments[second], update.rule);
    parameters[i] = stepped.x;
    moments[i] = stepped.y;
    moments[second] = stepped.z;
}
