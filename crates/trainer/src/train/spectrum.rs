//! How large photos need to be at each step, from their spectra (Chen et al. 2025, *DashGaussian*,
//! section 4.1).

use std::f64::consts::LN_2;

use rayon::prelude::*;
use rustfft::FftPlanner;
use rustfft::num_complex::Complex;
use splat_data::{Capture, CaptureError, View};

/// No photo is made smaller than by this divisor.
const LARGEST_DIVISOR: f64 = 8.0;
/// The first photos have this share of the magnitudes.
const FIRST_SHARE: f64 = 0.25;
/// Steps between two of the divisors whose shares are kept, as a part of an octave.
const PER_OCTAVE: usize = 64;

/// Shares of the photos' magnitudes, by divisor of their sides.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Spectrum {
    /// Share of the sum of all magnitudes that photos keep when their sides are divided by
    /// `2^(i / PER_OCTAVE)`, the mean over the photos; it falls from 1.
    kept: Vec<f64>,
    /// The divisor of the first steps.
    first: f64,
}

impl Spectrum {
    /// The spectrum of the training views.
    pub(super) fn of(capture: &Capture) -> Result<Self, CaptureError> {
        let views: Vec<&View> = capture.train_views().collect();
        let kept = views
            .par_iter()
            .map(|view| Ok(kept_by_divisor(&*view.loaded()?)))
            .collect::<Result<Vec<_>, CaptureError>>()?;
        // The sharpest photo decides where to begin.
        let first = kept.iter().map(|kept| divisor_of_share(kept, FIRST_SHARE));
        let first = first.fold(LARGEST_DIVISOR, f64::min);
        let count = kept.len() as f64;
        let entries = kept.first().map_or(0, Vec::len);
        let mean = |i: usize| kept.iter().map(|kept| kept[i]).sum::<f64>() / count;
        Ok(Self {
            kept: (0..entries).map(mean).collect(),
            first,
        })
    }

    /// The divisor of the photos' sides after this share of the time in which they grow.
    ///
    /// The logarithm of the share of magnitudes that photos keep rises in proportion to time, from
    /// that of the first ones to all.
    pub(super) fn divisor(&self, time: f64) -> u32 {
        let at_first = share_at(&self.kept, self.first);
        if time >= 1.0 || !(at_first > 0.0) {
            return 1;
        }
        let share = at_first.powf(1.0 - time.max(0.0));
        divisor_of_share(&self.kept, share).min(self.first).floor() as u32
    }
}

/// The largest divisor with which a photo keeps this share.
fn divisor_of_share(kept: &[f64], share: f64) -> f64 {
    let enough = kept.iter().rposition(|kept| *kept >= share).unwrap_or(0);
    // Rounding must not make 2 of it what is 1.999.
    (enough as f64 / PER_OCTAVE as f64 * LN_2).exp() * (1.0 + 1e-12)
}

/// The share that a photo keeps with this divisor.
fn share_at(kept: &[f64], divisor: f64) -> f64 {
    let index = (divisor.log2() * PER_OCTAVE as f64).round() as usize;
    kept.get(index.min(kept.len().saturating_sub(1)))
        .copied()
        .unwrap_or(0.0)
}

/// The share of a photo's magnitudes that is left by each divisor.
fn kept_by_divisor(view: &View) -> Vec<f64> {
    let entries = PER_OCTAVE * LARGEST_DIVISOR.log2() as usize + 1;
    let (width, height) = (view.width as usize, view.height as usize);
    let mut sums = vec![0.0; entries];
    for (i, value) in transformed(view).iter().enumerate() {
        // A frequency is kept by divisors up to half the side over its number.
        let largest = |k: usize, side: usize| side as f64 / (2 * k.min(side - k)).max(1) as f64;
        let divisor = largest(i % width, width).min(largest(i / width, height));
        let entry = (divisor.max(1.0).log2() * PER_OCTAVE as f64 + 1e-9) as usize;
        sums[entry.min(entries - 1)] += f64::from(value.norm());
    }
    let total: f64 = sums.iter().sum();
    let mut left = 0.0;
    for sum in sums.iter_mut().rev() {
        left += *sum;
        *sum = if total > 0.0 { left / total } else { 1.0 };
    }
    sums
}

/// The Fourier transform of the mean of a photo's channels.
fn transformed(view: &View) -> Vec<Complex<f32>> {
    let (width, height) = (view.width as usize, view.height as usize);
    let mut planner = FftPlanner::new();
    let grey = |pixel: &[u8]| pixel.iter().map(|x| f32::from(*x)).sum::<f32>() / (3.0 * 255.0);
    let mut values: Vec<Complex<f32>> = (view.image.chunks_exact(3))
        .map(|pixel| Complex::new(grey(pixel), 0.0))
        .collect();
    planner.plan_fft_forward(width).process(&mut values);
    let along = planner.plan_fft_forward(height);
    let mut column = vec![Complex::default(); height];
    let mut scratch = vec![Complex::default(); along.get_inplace_scratch_len()];
    for x in 0..width {
        for (y, value) in column.iter_mut().enumerate() {
            *value = values[y * width + x];
        }
        along.process_with_scratch(&mut column, &mut scratch);
        for (y, value) in column.iter().enumerate() {
            values[y * width + x] = *value;
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use splat_data::{CaptureSettings, Lens};

    fn view(width: u32, height: u32, value: impl Fn(u32, u32) -> u8) -> View {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        View {
            name: "test".into(),
            width,
            height,
            intrinsics: [1.0; 4],
            viewmat: [[0.0; 4]; 4],
            lens: Lens::Pinhole,
            image: Arc::new(pixels.flat_map(|(x, y)| [value(x, y); 3]).collect()),
            mask: None,
            depth: None,
            on_disk: None,
        }
    }

    #[test]
    fn one_frequency_is_kept_by_the_divisors_that_can_show_it() {
        // Period 8 in 64 pixels: shown by photos of up to a quarter of the side.
        let wave =
            |x: u32| (127.5 + 120.0 * (std::f64::consts::TAU * f64::from(x) / 8.0).sin()) as u8;
        let kept = kept_by_divisor(&view(64, 32, |x, _| wave(x)));
        assert!((kept[0] - 1.0).abs() < 1e-9);
        let by = |divisor: f64| share_at(&kept, divisor);
        assert!(by(3.9) > 0.95 && by(4.2) < 0.7, "{} {}", by(3.9), by(4.2));
        // A photo of one colour is the same at every size.
        let flat = kept_by_divisor(&view(33, 20, |_, _| 90));
        assert!(flat.iter().all(|share| *share > 0.999));
        let black = kept_by_divisor(&view(12, 12, |_, _| 0));
        assert!(black.iter().all(|share| *share == 1.0));
    }

    #[test]
    fn photos_grow_from_the_first_to_the_whole() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
        let capture = Capture::load(folder, &CaptureSettings::new().with_downscale(2)).unwrap();
        let spectrum = Spectrum::of(&capture).unwrap();
        let divisors: Vec<u32> = (0..=100)
            .map(|i| spectrum.divisor(f64::from(i) / 100.0))
            .collect();
        assert!(divisors[0] >= 2, "{spectrum:?}");
        assert_eq!(divisors[0], spectrum.first.floor() as u32);
        assert_eq!(divisors[100], 1);
        assert!(
            divisors.windows(2).all(|pair| pair[1] <= pair[0]),
            "{divisors:?}"
        );
        assert_eq!(Spectrum::of(&capture).unwrap(), spectrum);
    }

    #[test]
    fn nothing_to_see_needs_no_schedule() {
        let spectrum = Spectrum {
            kept: vec![0.0],
            first: 8.0,
        };
        assert_eq!(spectrum.divisor(0.0), 1);
    }
}
