// A fully connected layer over planes of samples, [rows, stride].
struct Layer {
    // Inputs; outputs; outputs as stored, padded to eight; first weight.
    sizes: vec4u,
    // First row of the inputs and of the outputs; whether the outputs go through a ReLU; first bias.
    rows: vec4u,
    // Samples; stride; samples of a chunk; parameters of all layers.
    samples: vec4u,
    // Inputs whose gradient is needed; whether they came through a ReLU; unused.
    back: vec4u,
}
