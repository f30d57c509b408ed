//! A deterministic synthetic capture with any number of points and pixels.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use splat_data::Capture;
use splat_data::{Lens, Point, Split, View};

/// Views.
const VIEWS: usize = 4;
/// Depths of the sheets of points, in world units.
const SHEETS: [f64; 4] = [3.0, 4.0, 5.0, 6.0];
/// Extent of the sheets beyond the view, relative to its size.
const MARGIN: f64 = 1.1;
/// Distance of the cameras from their middle along each axis.
const STEP: f64 = 0.05;

/// Size of the photos. As text, either a number of pixels (at 4:3), or width and height as in
/// 1920x1080.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PhotoSize {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
}

/// Largest width and height.
const SIDE_MAX: u32 = 1 << 16;

impl PhotoSize {
    /// A 4:3 size with approximately this many pixels; at least one.
    pub fn of_pixels(pixels: usize) -> Self {
        let pixels = pixels.max(1) as f64;
        let width = (pixels * 4.0 / 3.0).sqrt().round().max(1.0);
        Self {
            width: width as u32,
            height: (pixels / width).round().max(1.0) as u32,
        }
    }

    /// Number of pixels.
    pub fn pixels(self) -> usize {
        self.width as usize * self.height as usize
    }
}

impl fmt::Display for PhotoSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

impl FromStr for PhotoSize {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let sides = match text.split_once('x') {
            Some((width, height)) => width.parse().ok().zip(height.parse().ok()),
            None => text
                .parse()
                .ok()
                .filter(|pixels| *pixels > 0)
                .map(|pixels| {
                    let size = Self::of_pixels(pixels);
                    (size.width, size.height)
                }),
        };
        match sides {
            Some((width, height))
                if (1..=SIDE_MAX).contains(&width.min(height)) && width.max(height) <= SIDE_MAX =>
            {
                Ok(Self { width, height })
            }
            _ => Err(format!(
                "a number of pixels, or a size such as 1920x1080, each side from 1 to {SIDE_MAX}"
            )),
        }
    }
}

/// Random points on sheets across the view, equally dense on the screen in each, and four cameras
/// in front of them.
///
/// A Gaussian's initial size is the distance to its neighbours, so the number of Gaussians per
/// pixel, about 13 for each sheet, does not depend on their total, until they become smaller than a
/// pixel and the low-pass filter limits their size.
pub fn synthetic_capture(gaussians: usize, size: PhotoSize) -> Capture {
    capture(gaussians, size, MARGIN, [STEP; 2])
}

/// The same with larger sheets, of which each of the four cameras sees this share, and each another
/// one where the share is small.
pub fn partly_seen_capture(gaussians: usize, size: PhotoSize, share: f64) -> Capture {
    let margin = share.clamp(1e-6, 1.0).sqrt().recip();
    // The nearest sheet is the smallest.
    let step = (0.45 * (margin - 1.0) * SHEETS[0]).max(STEP * share);
    let aspect = f64::from(size.height) / f64::from(size.width);
    capture(gaussians, size, margin, [step, step * aspect])
}

fn capture(gaussians: usize, size: PhotoSize, margin: f64, step: [f64; 2]) -> Capture {
    let PhotoSize { width, height } = size;
    let aspect = f64::from(height) / f64::from(width);
    let views = (0..VIEWS)
        .map(|index| view(index, width, height, step))
        .collect();
    let mut rng = Pcg64Mcg::seed_from_u64(4);
    let half_height = 0.5 * margin * aspect;
    let points = (0..gaussians)
        .map(|index| {
            let z = SHEETS[index % SHEETS.len()];
            let x = rng.random_range(-0.5 * margin..0.5 * margin);
            let y = rng.random_range(-half_height..half_height);
            Point {
                position: [x * z, y * z, z],
                color: core::array::from_fn(|_| rng.random_range(0..=255)),
            }
        })
        .collect();
    Capture {
        name: "synthetic".to_owned(),
        root: PathBuf::from("synthetic"),
        photos: PathBuf::from("synthetic"),
        views,
        points,
        observations: vec![],
        background: None,
        split: Split {
            train: (0..VIEWS).collect(),
            test: vec![],
        },
        warnings: vec![],
    }
}

fn view(index: usize, width: u32, height: u32, step: [f64; 2]) -> View {
    let (w, h) = (f64::from(width), f64::from(height));
    let side = |bit: usize, step: f64| step * if index & bit == 0 { 1.0 } else { -1.0 };
    // Waves of a few dozen pixels, independent of the image size.
    let image = (0..height)
        .flat_map(|y| (0..width).map(move |x| (x, y)))
        .flat_map(|(x, y)| {
            let wave = |v: u32, period: f64| (f64::from(v) / period).sin();
            let (a, b) = (wave(x, 7.0), wave(y, 11.0));
            [a, b, a * b].map(|v| (127.5 + 127.5 * v) as u8)
        })
        .collect();
    View {
        name: format!("view {index}.png"),
        width,
        height,
        intrinsics: [w, w, 0.5 * w, 0.5 * h],
        viewmat: [
            [1.0, 0.0, 0.0, side(1, step[0])],
            [0.0, 1.0, 0.0, side(2, step[1])],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ],
        lens: Lens::Pinhole,
        image: Arc::new(image),
        mask: None,
        depth: None,
        on_disk: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_as_pixels_or_sides() {
        let size = |text: &str| text.parse::<PhotoSize>();
        let sides = |width, height| Ok(PhotoSize { width, height });
        assert_eq!(size("1920x1080"), sides(1920, 1080));
        assert_eq!(size("3072"), sides(64, 48));
        assert_eq!(
            size(&PhotoSize::of_pixels(100_000).to_string()),
            sides(365, 274)
        );
        for bad in [
            "0",
            "0x5",
            "5x0",
            "65537x1",
            "1x65537",
            "x",
            "12x",
            "-4",
            "1.5",
            "99999999999999999",
        ] {
            assert!(size(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn it_is_the_same_every_time_and_fills_its_views() {
        let [a, b] = [(), ()].map(|()| synthetic_capture(1000, PhotoSize::of_pixels(3000)));
        assert_eq!(a.points, b.points);
        assert_eq!(a.points.len(), 1000);
        let (width, height, count) = a.image_sizes()[0];
        assert_eq!((width, height, count), (63, 48, VIEWS));
        for view in a.train_views() {
            assert_eq!(view.image.len(), 3 * 63 * 48);
            let inside = a.points.iter().filter(|point| {
                let Some(([x, y], _)) = view.project(point.position) else {
                    return false;
                };
                (0.0..63.0).contains(&x) && (0.0..48.0).contains(&y)
            });
            // The margin is a tenth of each side.
            let share = inside.count() as f64 / 1000.0;
            assert!((0.75..0.9).contains(&share), "{share}");
        }
        // Each sees its share of a larger scene.
        for share in [0.05, 0.2, 1.0] {
            let capture = partly_seen_capture(20_000, PhotoSize::of_pixels(3000), share);
            for view in capture.train_views() {
                let seen = capture.points.iter().filter(|point| {
                    let Some(([x, y], _)) = view.project(point.position) else {
                        return false;
                    };
                    (0.0..63.0).contains(&x) && (0.0..48.0).contains(&y)
                });
                let seen = seen.count() as f64 / 20_000.0;
                assert!((0.85..1.15).contains(&(seen / share)), "{seen} of {share}");
            }
        }
        // An empty scene is not an error.
        let nothing = synthetic_capture(0, PhotoSize::of_pixels(0));
        assert_eq!(nothing.points.len(), 0);
        assert_eq!(nothing.image_sizes()[0], (1, 1, VIEWS));
    }
}
