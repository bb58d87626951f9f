// How an update uses gradients.
struct Update {
    // As `adam` takes it.
    rule: vec4f,
    // Rate, divided by the bias correction of the first moment; unused.
    rate: vec4f,
    // Parameters; chunks of samples, or rays; unused.
    sizes: vec4u,
}
