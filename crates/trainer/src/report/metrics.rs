//! The figures of a run: `metrics.json`.

use std::path::Path;

use serde::Serialize;

use super::{ReportError, atomic};

/// Quality on a set of views: what `splat eval` reports, and the first part of [`Metrics`].
///
/// A figure that does not exist (the mean over no view) or is infinite (the PSNR of a perfect copy) is `null` in JSON.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// Mean over the views of [`ViewMetrics::psnr`], in dB.
    pub psnr: f64,
    /// Mean over the views of [`ViewMetrics::ssim`].
    pub ssim: f64,
    /// The views, by name.
    pub views: Vec<ViewMetrics>,
}

/// Quality on one view, on images clamped to `[0, 1]` in float.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewMetrics {
    /// Name of the photo.
    pub name: String,
    /// `10 log10(1 / mse)`, in dB.
    pub psnr: f64,
    /// SSIM with the usual 11 x 11 Gaussian window of sigma 1.5.
    pub ssim: f64,
}

/// Everything in `metrics.json`, in the order of its fields.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Metrics {
    /// Quality on the held-out views.
    #[serde(flatten)]
    pub evaluation: Evaluation,
    /// Number of Gaussians of the scene.
    pub gaussians: usize,
    /// Number of steps trained.
    pub steps: usize,
    /// Seconds spent training.
    pub seconds: f64,
    /// Seconds a step took on average.
    pub seconds_per_step: f64,
    /// Most memory that was resident, `null` where the system does not say ([`super::memory::peak_rss_bytes`]).
    pub peak_rss_bytes: Option<u64>,
    /// What was computed on.
    pub device: String,
    /// Seed of the run.
    pub seed: u64,
}

impl Evaluation {
    /// Means over `views`; NaN where there is none.
    pub fn from_views(views: Vec<ViewMetrics>) -> Self {
        let mean = |value: fn(&ViewMetrics) -> f64| {
            views.iter().map(value).sum::<f64>() / views.len() as f64
        };
        Self {
            psnr: mean(|view| view.psnr),
            ssim: mean(|view| view.ssim),
            views,
        }
    }
}

/// Writes `value` (an [`Evaluation`], [`Metrics`] or anything else) as indented JSON.
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
    atomic::write(path, json.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fields_are_those_promised() {
        let view = |name: &str, psnr, ssim| ViewMetrics {
            name: name.to_owned(),
            psnr,
            ssim,
        };
        let metrics = Metrics {
            evaluation: Evaluation::from_views(vec![view("a", 20.0, 0.5), view("b", 23.0, 0.75)]),
            gaussians: 3,
            steps: 10,
            seconds: 5.0,
            seconds_per_step: 0.5,
            peak_rss_bytes: None,
            device: "cpu".into(),
            seed: 7,
        };
        assert_eq!(
            serde_json::to_string(&metrics).unwrap(),
            r#"{"psnr":21.5,"ssim":0.625,"views":[{"name":"a","psnr":20.0,"ssim":0.5},{"name":"b","psnr":23.0,"ssim":0.75}],"gaussians":3,"steps":10,"seconds":5.0,"seconds_per_step":0.5,"peak_rss_bytes":null,"device":"cpu","seed":7}"#
        );
        let none = serde_json::to_string(&Evaluation::from_views(vec![])).unwrap();
        assert_eq!(none, r#"{"psnr":null,"ssim":null,"views":[]}"#);
    }
}
