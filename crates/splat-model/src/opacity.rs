//! An opacity and its logit, on the host.

pub(crate) fn sigmoid(logit: f64) -> f64 {
    1.0 / (1.0 + (-logit).exp())
}

pub(crate) fn logit(opacity: f64) -> f64 {
    (opacity / (1.0 - opacity)).ln()
}
