//! Measurements of steps at one setting.

use serde::Serialize;

use super::Spread;

/// Steps at one setting.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StepRow {
    /// Degree of spherical harmonics.
    pub sh_degree: usize,
    /// Threads.
    pub threads: usize,
    /// Steps measured.
    pub steps: usize,
    /// Time of a step.
    pub milliseconds: Spread,
    /// Median time of each stage, in the order of completion, and finally the time outside all
    /// stages.
    pub stages: Vec<(String, f64)>,
    /// Processor time of all threads per step; on an idle machine, the time of the step times the
    /// number of busy threads. Absent if the system does not report it.
    pub cpu_milliseconds: Option<f64>,
    /// Pages of fresh memory per step.
    pub page_faults: Option<f64>,
}
