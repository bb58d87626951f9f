//! From samples to pixels and back.

pub mod quadrature;
pub mod view;
