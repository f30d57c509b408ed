//! Plots of what the laboratory measures, as SVG.

pub(crate) mod accuracy;
pub(crate) mod scaling;
pub(crate) mod step;
