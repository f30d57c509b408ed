//! Coarse-to-fine training: the first steps see small photos (3DGS section 7.1).

use std::collections::HashMap;

use splat_model::strategy::StepInfo;

use super::TrainSettings;
use super::spectrum::Spectrum;
use splat_data::{Capture, View};

/// Divisor of the photos at a step.
pub(super) fn factor(config: &TrainSettings, spectrum: Option<&Spectrum>, at: &StepInfo) -> u32 {
    if let Some(spectrum) = spectrum {
        let grown = at.run.milestone(config.spectral_until);
        return spectrum.divisor(at.step as f64 / grown as f64);
    }
    let stages = at.step / at.run.milestone(config.coarse_every);
    let left = (config.coarse_halvings as usize).saturating_sub(stages);
    1 << left
}

/// Downscaled photos of the current stage, made on demand.
#[derive(Default)]
pub(super) struct CoarseViews {
    factor: u32,
    views: HashMap<usize, View>,
}

impl CoarseViews {
    /// A downscaled view of the capture.
    pub(super) fn view(&mut self, capture: &Capture, index: usize, factor: u32) -> View {
        if self.factor != factor {
            self.factor = factor;
            self.views = HashMap::new();
        }
        let whole = &capture.views[index];
        if factor == 1 {
            return whole.clone();
        }
        let make = || whole.downscaled(factor);
        self.views.entry(index).or_insert_with(make).clone()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use splat_model::SceneScale;
    use splat_model::strategy::RunSchedule;

    use splat_data::CaptureSettings;

    #[test]
    fn resolution_doubles_at_every_milestone() {
        let factors = |steps: usize, at: [usize; 6]| {
            let config = TrainSettings {
                steps,
                coarse_halvings: 2,
                ..TrainSettings::default()
            };
            let run = RunSchedule {
                steps,
                scene_scale: SceneScale::new(1.0).unwrap(),
                seed: 0,
            };
            at.map(|step| factor(&config, None, &StepInfo { step, run }))
        };
        let expected = [4, 4, 2, 2, 1, 1];
        assert_eq!(factors(30_000, [0, 249, 250, 499, 500, 29_999]), expected);
        assert_eq!(factors(3_000, [0, 24, 25, 49, 50, 2_999]), expected);
        let run = RunSchedule {
            steps: 100,
            scene_scale: SceneScale::new(1.0).unwrap(),
            seed: 0,
        };
        assert_eq!(
            factor(&TrainSettings::default(), None, &StepInfo { step: 0, run }),
            1
        );
    }

    #[test]
    fn a_small_view_sees_the_same_and_is_made_once() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
        let options = CaptureSettings {
            downscale: 4,
            ..CaptureSettings::default()
        };
        let capture = Capture::load(folder, &options).unwrap();
        let mut views = CoarseViews::default();
        let small = views.view(&capture, 3, 2);
        let whole = &capture.views[3];
        assert_eq!(
            [small.width, small.height],
            [whole.width / 2, whole.height / 2]
        );
        assert_eq!(small.image.len(), 3 * (small.width * small.height) as usize);
        let point = capture.points[7].position;
        let ([x, y], depth) = whole.project(point).unwrap();
        let ([u, v], small_depth) = small.project(point).unwrap();
        assert!((2.0 * u - x).abs() < 1e-9 && (2.0 * v - y).abs() < 1e-9);
        assert_eq!(depth, small_depth);

        assert!(Arc::ptr_eq(&small.image, &views.view(&capture, 3, 2).image));
        assert!(Arc::ptr_eq(&whole.image, &views.view(&capture, 3, 1).image));
        assert!(!Arc::ptr_eq(
            &small.image,
            &views.view(&capture, 3, 2).image
        ));
        // No photo becomes smaller than the window of SSIM.
        let least = views.view(&capture, 3, 1 << 8);
        let shorter = least.width.min(least.height);
        assert!((11..22).contains(&shorter), "{shorter}");
    }
}
