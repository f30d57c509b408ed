//! `docs/PERFORMANCE.md`.

use serde::Serialize;

use super::rasterize::RasterizeReport;
use super::scaling::ScalingReport;
use super::step::StepReport;

/// All measurements.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PerformanceReport {
    /// The training step.
    pub step: StepReport,
    /// The rasteriser.
    pub rasterize: RasterizeReport,
    /// Growth with Gaussians and pixels.
    pub scaling: ScalingReport,
}

impl PerformanceReport {
    /// The page. `arguments` are those of the command that writes it, of `bench step`, and of
    /// `bench rasterize`, each with a leading space.
    pub fn markdown(&self, arguments: [&str; 3]) -> String {
        let [all, step, rasterize] = arguments;
        let bench = "cargo run --release -- bench";
        format!(
            "# Performance on the CPU\n\n\
             [GPU.md](GPU.md) lists the measurements that need a GPU.\n\n\
             Written by `{bench} performance{all}`. Everything in single precision, exact.\n\n\
             Machine: {}\n\n\
             ## Training step\n\n`{bench} step{step}`. {}\n\
             ![a step by stages](performance_step.svg)\n\n\
             ## Rasteriser\n\n`{bench} rasterize{rasterize}`. {}\n\
             ## Growth\n\n`{bench} scaling`. {}\n\
             ![step time and memory against Gaussians and pixels](performance_scaling.svg)\n",
            self.step.machine.line(),
            self.step.markdown(),
            self.rasterize.markdown(),
            self.scaling.markdown()
        )
    }
}
