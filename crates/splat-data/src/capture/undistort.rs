//! Photos as a pinhole camera would have taken them, for viewers that know no other.

use std::sync::Arc;

use rayon::prelude::*;
use splat_core::{CameraModel, Lens};

use super::{Capture, CaptureError, View};

impl Capture {
    /// The capture with every photo undistorted and in memory, see [`View::undistorted`].
    ///
    /// # Errors
    /// When a photo that is on the disk cannot be read.
    pub fn undistorted(&self) -> Result<Self, CaptureError> {
        let views = self.views.par_iter().map(View::undistorted);
        Ok(Self {
            views: views.collect::<Result<_, _>>()?,
            ..self.clone()
        })
    }
}

impl View {
    /// The view as a pinhole camera of the same size, focal lengths and principal point would have
    /// taken it. What the pinhole sees and the photo does not is black and masked; what lies
    /// outside of the pinhole's image is lost.
    ///
    /// # Errors
    /// When a photo that is on the disk cannot be read.
    pub fn undistorted(&self) -> Result<Self, CaptureError> {
        let view = self.loaded()?.into_owned();
        Ok(match view.lens.model() {
            CameraModel::Pinhole => view,
            _ => view.straightened(),
        })
    }

    /// [`undistorted`](Self::undistorted), of a photo in memory.
    fn straightened(&self) -> Self {
        let (w, h) = (self.width as usize, self.height as usize);
        let [fx, fy, cx, cy] = self.intrinsics;
        let lens = self.lens.bounded();
        let (mut image, mut mask) = (vec![0; 3 * w * h], vec![0; w * h]);
        let rows = image.par_chunks_mut(3 * w).zip(mask.par_chunks_mut(w));
        rows.enumerate().for_each(|(y, (image, mask))| {
            for (x, (color, kept)) in image.chunks_exact_mut(3).zip(mask).enumerate() {
                let (a, b) = ((x as f64 + 0.5 - cx) / fx, (y as f64 + 0.5 - cy) / fy);
                let Some([a, b]) = lens.distort([a, b, 1.0]) else {
                    continue;
                };
                if let Some((sample, share)) = self.sample(fx * a + cx, fy * b + cy) {
                    color.copy_from_slice(&sample);
                    *kept = share;
                }
            }
        });
        let whole = mask.iter().all(|kept| *kept == 255);
        Self {
            lens: Lens::Pinhole,
            image: Arc::new(image),
            mask: (!whole).then(|| Arc::new(mask)),
            ..self.clone()
        }
    }

    /// The photo between its pixels, in pixels, with the mask there; `None` outside of the photo.
    fn sample(&self, x: f64, y: f64) -> Option<([u8; 3], u8)> {
        let (w, h) = (self.width as usize, self.height as usize);
        if !(0.0..=w as f64).contains(&x) || !(0.0..=h as f64).contains(&y) {
            return None;
        }
        // Pixel centres are at 0.5; the outer half of the outermost pixels has their colour.
        let (x, y) = (
            (x - 0.5).clamp(0.0, w as f64 - 1.0),
            (y - 0.5).clamp(0.0, h as f64 - 1.0),
        );
        let (i, j) = (x as usize, y as usize);
        let (u, v) = (x - i as f64, y - j as f64);
        let (right, below) = ((i + 1).min(w - 1), (j + 1).min(h - 1));
        let corners = [
            ((1.0 - u) * (1.0 - v), j * w + i),
            (u * (1.0 - v), j * w + right),
            ((1.0 - u) * v, below * w + i),
            (u * v, below * w + right),
        ];
        let mean = |value: &dyn Fn(usize) -> u8| {
            let sum: f64 = corners
                .iter()
                .map(|(share, at)| share * f64::from(value(*at)))
                .sum();
            sum.round() as u8
        };
        let color = std::array::from_fn(|channel| mean(&|at| self.image[3 * at + channel]));
        let kept = (self.mask.as_ref()).map_or(255, |values| mean(&|at| values[at]));
        Some((color, kept))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A photo of a plane of waves, taken by a lens.
    fn taken(lens: Lens) -> View {
        let (width, height) = (80, 60);
        let intrinsics = [70.0, 72.0, 41.0, 29.0];
        let [fx, fy, cx, cy] = intrinsics;
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let image = pixels.flat_map(|(x, y)| {
            let (a, b) = (
                (f64::from(x) + 0.5 - cx) / fx,
                (f64::from(y) + 0.5 - cy) / fy,
            );
            let direction = lens.undistort([a, b]);
            let level = direction.map_or(0.0, |[a, b, z]| {
                127.5 + 60.0 * (9.0 * a / z).sin() + 60.0 * (7.0 * b / z).cos()
            });
            [level as u8; 3]
        });
        View {
            name: "waves".into(),
            width: width as u32,
            height: height as u32,
            intrinsics,
            viewmat: [[0.0; 4]; 4],
            lens,
            image: Arc::new(image.collect()),
            mask: None,
            depth: None,
            on_disk: None,
        }
    }

    #[test]
    fn an_undistorted_photo_is_that_of_a_pinhole() {
        let straight = taken(Lens::Pinhole);
        let barrel = Lens::OpenCv([-0.15, 0.02, 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let pincushion = Lens::OpenCv([0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let fisheye = Lens::OpenCvFisheye([0.05, 0.0, 0.0, 0.0]);
        for (lens, covers) in [(barrel, true), (pincushion, false), (fisheye, true)] {
            let view = taken(lens).undistorted().unwrap();
            assert_eq!(view.lens, Lens::Pinhole);
            let mask = |at: usize| view.mask.as_ref().is_none_or(|mask| mask[at] == 255);
            let kept = (0..80 * 60).filter(|at| mask(*at));
            assert_eq!(kept.clone().count() == 80 * 60, covers, "{lens:?}");
            let off = kept.map(|at| view.image[3 * at].abs_diff(straight.image[3 * at]));
            let off: Vec<u8> = off.collect();
            assert!(off.len() > 3_000);
            assert!(
                off.iter().all(|off| *off <= 3),
                "{lens:?}: {:?}",
                off.iter().max()
            );
        }
        assert_eq!(straight.undistorted().unwrap().image, straight.image);
    }
}
