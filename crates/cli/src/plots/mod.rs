//! Plots of the laboratory's measurements, as SVG.

pub(crate) mod accuracy;
pub(crate) mod scaling;
pub(crate) mod step;
