//! Cases of lenses with distortion: the axis, strong distortion, the fold, wide angles.

use glam::DVec3;
use splat_ops::Lens;

use super::super::case::Case;
use super::super::measure::clear;
use super::super::sketch::{Sketch, about_z};
use crate::gradcheck::Scene;

pub(super) const CASES: [Case; 6] = [
    Case::scenes(
        39,
        "a mean exactly on the axis of a fisheye",
        "0/0, NaN in second derivatives",
        on_the_axis,
    ),
    Case::scenes(
        40,
        "strong barrel and pincushion",
        "Jacobian of the pinhole",
        strong,
    ),
    Case::scenes(
        41,
        "means near the fold-back radius",
        "means from beyond the fold appear inside",
        near_the_fold,
    ),
    Case::scenes(
        42,
        "90, 120 and 170 degrees off the axis",
        "1/z changes its sign at the image plane",
        off_the_axis,
    ),
    Case::scenes(
        43,
        "a needle across the edge of the domain",
        "fan of pixels from beyond the edge",
        needle_at_the_edge,
    ),
    Case::scenes(
        44,
        "anti-aliasing near the fold",
        "compensation -> 0, its gradient -> infinity",
        antialiased_fold,
    ),
];

const BARREL: Lens = Lens::OpenCv([-0.3, 0.0, 1e-3, -1e-3, 0.0, 0.0, 0.0, 0.0]);
const PINCUSHION: Lens = Lens::OpenCv([0.4, 0.1, -1e-3, 2e-3, 0.05, 0.0, 0.0, 0.0]);
const FOLDING: Lens = Lens::OpenCvFisheye([-0.1, 0.0, 0.0, 0.0]);
const WIDE: Lens = Lens::OpenCvFisheye([-0.01, 0.002, 0.0, 0.0]);

fn sketch(name: &'static str, lens: Lens, focal: f64, seed: u64) -> Sketch {
    let mut sketch = Sketch::new(name, 40, 40, seed);
    sketch.lens = lens;
    sketch.intrinsics[0] = focal;
    sketch.intrinsics[1] = focal;
    sketch
}

fn on_the_axis() -> Vec<Scene> {
    [WIDE, FOLDING, BARREL]
        .into_iter()
        .map(|lens| {
            clear(1e-5, |seed| {
                let mut sketch = sketch("on the axis", lens, 32.0, seed);
                sketch.scatter(8, (0.3, 0.8));
                for (i, x) in [0.0, 1e-30, 1e-12, 1e-6, 1e-3].into_iter().enumerate() {
                    let depth = 2.5 + 0.3 * i as f64;
                    sketch
                        .splat([20.0, 20.0], depth, [3.0, 2.0, 2.5], about_z(i as f64), 0.4)
                        .mean = DVec3::new(x, -x, depth);
                }
                sketch.scene()
            })
        })
        .collect()
}

fn strong() -> Vec<Scene> {
    [(BARREL, 40.0), (PINCUSHION, 24.0)]
        .into_iter()
        .map(|(lens, focal)| {
            clear(1e-5, |seed| {
                let mut sketch = sketch("strong distortion", lens, focal, seed).tilted();
                sketch.depth_loss = true;
                sketch.scatter(24, (0.2, 0.9));
                sketch.scene()
            })
        })
        .collect()
}

/// Means at 90 to 99 % of the limit, all around, whose splats reach into the image.
fn about_the_fold(lens: Lens, antialias: bool, axes: f64) -> Scene {
    clear(1e-5, |seed| {
        // The fold is at the middle of the image's sides.
        let probe = sketch("near the fold", lens, 1.0, seed);
        let limit = lens.domain(probe.intrinsics, probe.size).limit;
        let direction = |share: f64, angle: f64| {
            let (across, along) = match lens {
                Lens::OpenCvFisheye(_) => (limit * share).sin_cos(),
                _ => (limit * share, 1.0),
            };
            DVec3::new(across * angle.cos(), across * angle.sin(), along)
        };
        let edge = lens.distort(direction(0.999, 0.0).to_array());
        let edge = edge.map_or(1.0, |[a, b]| a.hypot(b));
        let mut sketch = sketch("near the fold", lens, 18.0 / edge, seed);
        sketch.antialias = antialias;
        for i in 0..4 {
            let (sin, cos) = (1.6 * f64::from(i)).sin_cos();
            let quat = sketch.turn();
            let pixel = [20.0 + 7.3 * cos, 20.0 + 7.3 * sin];
            sketch.splat(pixel, 1.5 + 0.1 * f64::from(i), [2.0, 3.0, 1.0], quat, 0.4);
        }
        for i in 0..12 {
            let share = 0.9 + 0.0075 * f64::from(i);
            let depth = 2.0 + 0.2 * f64::from(i);
            let quat = sketch.turn();
            let axes = [axes, axes * 0.8, axes * 1.2];
            let at = direction(share, 0.5 * f64::from(i)) * depth;
            sketch.splat([20.0, 20.0], depth, axes, quat, 0.5).mean = at;
        }
        sketch.scene()
    })
}

fn near_the_fold() -> Vec<Scene> {
    let lenses = [BARREL, FOLDING].into_iter();
    lenses
        .map(|lens| about_the_fold(lens, false, 2.0))
        .collect()
}

fn antialiased_fold() -> Vec<Scene> {
    let scenes = [(BARREL, 0.3), (BARREL, 2.0), (FOLDING, 0.3), (FOLDING, 2.0)].into_iter();
    scenes
        .map(|(lens, axes)| about_the_fold(lens, true, axes))
        .collect()
}

fn off_the_axis() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        // 170 degrees are 18 pixels from the middle.
        let mut sketch = sketch("off the axis", WIDE, 6.0, seed);
        sketch.depth_loss = true;
        for (i, degrees) in [90.0f64, 89.999, 90.001, 120.0, 150.0, 170.0, 60.0, 10.0]
            .into_iter()
            .enumerate()
        {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let (across, along) = (0.7 * i as f64).sin_cos();
            let depth = 2.0 + 0.3 * i as f64;
            let quat = sketch.turn();
            sketch
                .splat([20.0, 20.0], depth, [2.0, 1.5, 1.0], quat, 0.6)
                .mean = DVec3::new(sin * across, sin * along, cos) * depth;
        }
        sketch.scene()
    })]
}

fn needle_at_the_edge() -> Vec<Scene> {
    [(BARREL, 30.0), (WIDE, 7.0)]
        .into_iter()
        .map(|(lens, focal)| {
            clear(1e-5, |seed| {
                let mut sketch = sketch("needle at the edge", lens, focal, seed);
                sketch.scatter(3, (0.3, 0.6));
                let limit = lens.domain(sketch.intrinsics, sketch.size).limit;
                for (i, share) in [0.5, 0.8, 0.95].into_iter().enumerate() {
                    let depth = 2.0 + i as f64;
                    let (across, along) = match lens {
                        Lens::OpenCvFisheye(_) => (limit * share).sin_cos(),
                        _ => (limit * share, 1.0),
                    };
                    let quat = sketch.turn();
                    sketch
                        .splat([20.0, 20.0], depth, [400.0, 0.4, 0.4], quat, 0.7)
                        .mean = DVec3::new(across * 0.6, across * 0.8, along) * depth;
                }
                sketch.scene()
            })
        })
        .collect()
}
