//! How far pictures and gradients are from the truth.

pub mod model_error;
