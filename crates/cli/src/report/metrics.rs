//! The figures of a run: `metrics.json`.

use std::path::Path;

use serde::Serialize;

use super::{ReportError, write};
use splat_trainer::calibration::AlignedScores;
use splat_trainer::{Scores, ShReduced};

/// Contents of `metrics.json`, in the order of its fields.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Metrics {
    /// Scores on the held-out views: `psnr`, `ssim`, `views`. Undefined values (the mean over no
    /// view) and infinite ones (the PSNR of a perfect copy) are `null`.
    #[serde(flatten)]
    pub scores: Scores,
    /// The same with the poses of the held-out views aligned with the scene first; absent unless
    /// the run refined poses.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub aligned: Option<AlignedScores>,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// When degrees of spherical harmonics were lowered, and how many Gaussians had which then;
    /// absent if they were not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sh_reduction: Option<ShReduced>,
    /// Number of steps trained.
    pub steps: usize,
    /// Seconds spent training.
    pub seconds: f64,
    /// Mean seconds per step.
    pub seconds_per_step: f64,
    /// Peak resident memory; `null` if the system does not report it
    /// ([`super::memory::peak_rss_bytes`]).
    pub peak_rss_bytes: Option<u64>,
    /// Memory held by a CubeCL device's allocator at the end, including reserves; `null` elsewhere.
    pub device_bytes: Option<u64>,
    /// Name of the device.
    pub device: String,
    /// Seed of the run.
    pub seed: u64,
}

/// Writes `value` ([`Scores`], [`Metrics`] or anything else) as indented JSON.
///
/// # Errors
///
/// [`ReportError`], naming the file.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), ReportError> {
    let mut json = serde_json::to_string_pretty(value).map_err(|error| ReportError::Encode {
        path: path.to_path_buf(),
        reason: error.to_string(),
    })?;
    json.push('\n');
    write(path, json.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_trainer::ViewScore;

    #[test]
    fn the_fields_are_those_promised() {
        let view = |name: &str, psnr, ssim| ViewScore {
            name: name.to_owned(),
            psnr,
            ssim,
        };
        let metrics = Metrics {
            scores: Scores::of_views(vec![view("a", 20.0, 0.5), view("b", 23.0, 0.75)]),
            aligned: None,
            gaussians: 3,
            sh_reduction: None,
            steps: 10,
            seconds: 5.0,
            seconds_per_step: 0.5,
            peak_rss_bytes: None,
            device_bytes: None,
            device: "cpu".into(),
            seed: 7,
        };
        assert_eq!(
            serde_json::to_string(&metrics).unwrap(),
            r#"{"psnr":21.5,"ssim":0.625,"views":[{"name":"a","psnr":20.0,"ssim":0.5},{"name":"b","psnr":23.0,"ssim":0.75}],"gaussians":3,"steps":10,"seconds":5.0,"seconds_per_step":0.5,"peak_rss_bytes":null,"device_bytes":null,"device":"cpu","seed":7}"#
        );
        let none = serde_json::to_string(&Scores::of_views(vec![])).unwrap();
        assert_eq!(none, r#"{"psnr":null,"ssim":null,"views":[]}"#);
    }
}
