//! What was measured of steps at one setting.

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
    /// Median time of each stage, in the order in which they end; last what no stage covers.
    pub stages: Vec<(String, f64)>,
    /// Processor time of all threads per step; on an idle machine, that of the step times the
    /// threads, as far as these have work. Absent where the system does not say.
    pub cpu_milliseconds: Option<f64>,
    /// Pages of fresh memory per step.
    pub page_faults: Option<f64>,
}
