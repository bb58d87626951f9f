//! Volume rendering: from samples to pixels, and the gradients back to the samples.

pub mod quadrature;
pub mod view;
