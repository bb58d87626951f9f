// How an update uses gradients.
struct Update {
    // As `adam` takes it.
    rule: vec4f,
    // Rate, divided by the bias correction of the first moment; unused.
    rate: vec4f,
    // Parameters; chunks of samples, or rays; unused.
    sizes: vec4u,
}

// A step of Adam on parameter i; both moments lie one behind the other.
fn take_step(i: u32, gradient: f32) {
    let second = update.sizes.x + i;
    let stepped = adam(gradient, update.rate.x, parameters[i], moments[i], moments[second], update.rule);
    parameters[i] = stepped.x;
    moments[i] = stepped.y;
    moments[second] = stepped.z;
}
