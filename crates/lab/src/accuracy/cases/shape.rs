//! Cases of shape: needles, pancakes, extreme scales, quaternions.

use burn::tensor::Device;

use super::super::case::{Case, Check};
use super::super::measure::{AccuracyError, Outcome, against_double, clear, single};
use super::super::sketch::{Sketch, about_z};
use crate::gradcheck::{Scene, relative_l2};

pub(super) const CASES: [Case; 10] = [
    Case::scenes(
        7,
        "needles of 1000 x 0.1 px at 45 degrees",
        "determinant 28 % off",
        || needles(1_000.0, 0.1),
    ),
    Case::scenes(
        8,
        "needles of 10,000 x 1 px at 45 degrees",
        "determinant negative",
        || needles(10_000.0, 1.0),
    ),
    Case::scenes(
        9,
        "pancake (1, 1, 1e-5) seen edge-on",
        "exponent error 0.1",
        pancake,
    ),
    Case::scenes(
        10,
        "splats far smaller than a pixel, anti-aliased",
        "compensation -> 0, its gradient -> infinity",
        sub_pixel,
    ),
    Case::scenes(
        11,
        "log-scales -20, +20, +88",
        "underflow, Inf, determinant overflow",
        extreme_scales,
    ),
    Case::own(
        12,
        "quaternion of length 0, 1e-20, 1e20",
        "NaN, silent zero",
        "length 0: as if absent, its gradient zero",
        extreme_quaternions,
    ),
    Case::own(
        13,
        "q, -q, 5q",
        "another image",
        "the same image, radial gradient zero",
        quaternion_multiples,
    ),
    Case {
        number: 14,
        name: "equal scales",
        naive: "rotation gradient is not zero",
        demand: "rotation gradient zero",
        check: Check::Scenes(spheres, &["quats"]),
    },
    Case::scenes(
        19,
        "needle just outside the view",
        "rotated into a fan",
        needle_outside,
    ),
    Case::own(
        38,
        "MCMC relocation with opacity -> 1 and 51 copies",
        "NaN",
        "1e-12 of the series in 90 digits",
        relocation,
    ),
];

fn needles(long: f64, short: f64) -> Vec<Scene> {
    let quarter = std::f64::consts::FRAC_PI_4;
    vec![clear(1e-4, |seed| {
        let mut sketch = Sketch::new("needles", 64, 64, seed);
        for (i, angle) in [quarter, -quarter, 1.2].into_iter().enumerate() {
            let pixel = [sketch.uniform(20.0, 44.0), sketch.uniform(20.0, 44.0)];
            let axes = [long, short, short];
            sketch.splat(pixel, 2.0 + i as f64, axes, about_z(angle), 0.8);
        }
        // And one in a random direction in space.
        let quat = sketch.turn();
        sketch.splat([32.0, 32.0], 6.0, [short, long, short], quat, 0.7);
        sketch.scene()
    })]
}

fn pancake() -> Vec<Scene> {
    vec![clear(1e-4, |seed| {
        let mut sketch = Sketch::new("pancakes edge-on", 64, 64, seed);
        for i in 0..3 {
            // Thin along the camera's x, so that one looks along the disc; then rotated about the
            // camera's axis.
            let pixel = [32.0 + 2.0 * f64::from(i), 32.0];
            let blob = sketch.splat(pixel, 2.0, [1.0; 3], about_z(0.3 * f64::from(i)), 0.9);
            blob.scale = [1e-5, 1.0, 1.0];
            blob.mean.z += f64::from(i);
        }
        sketch.scene()
    })]
}

fn sub_pixel() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("sub-pixel", 24, 24, seed);
        sketch.antialias = true;
        for i in 0..40 {
            let size = 10f64.powf(sketch.uniform(-1.0, 0.3));
            let pixel = [sketch.uniform(2.0, 22.0), sketch.uniform(2.0, 22.0)];
            let quat = sketch.turn();
            sketch.splat(
                pixel,
                2.0 + 0.05 * f64::from(i),
                [size, size * 0.8, size],
                quat,
                0.95,
            );
        }
        // Far below a pixel: invisible, but nothing may be infinite.
        for size in [1e-3, 1e-6, 1e-10, 1e-15] {
            let pixel = [sketch.uniform(2.0, 22.0), sketch.uniform(2.0, 22.0)];
            sketch.splat(pixel, 5.0, [size; 3], about_z(0.1), 0.95);
        }
        sketch.scene()
    })]
}

fn extreme_scales() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("log-scales -20, 20, 88", 32, 32, seed);
        sketch.scatter(10, (0.2, 0.7));
        for (i, log_scale) in [-20.0f64, 20.0, 88.0].into_iter().enumerate() {
            let pixel = [sketch.uniform(8.0, 24.0), sketch.uniform(8.0, 24.0)];
            let quat = sketch.turn();
            let blob = sketch.splat(pixel, 3.1 + i as f64, [1.0; 3], quat, 0.4);
            blob.scale = [log_scale.exp(); 3];
        }
        // Huge along one axis.
        let quat = sketch.turn();
        let blob = sketch.splat([16.0, 16.0], 7.0, [2.0; 3], quat, 0.4);
        blob.scale[1] = 20f64.exp();
        sketch.scene()
    })]
}

fn extreme_quaternions(device: &Device) -> Result<Outcome, AccuracyError> {
    let make = |length: f64| {
        clear(1e-5, |seed| {
            let mut sketch = Sketch::new("extreme quaternion", 32, 32, seed);
            sketch.scatter(8, (0.3, 0.8));
            sketch.blobs[3].quat = sketch.blobs[3].quat.map(|x| x * length);
            sketch.scene()
        })
    };
    let mut outcome = Outcome::new();
    for length in [0.0, 1e-20, 1e20] {
        outcome = outcome.and(against_double(&make(length), device, &[])?);
    }
    let none = single(&make(0.0), device)?;
    let silent = none.gradients.quats.values[12..16]
        .iter()
        .all(|g| *g == 0.0)
        && none.gradients.means.values[9..12].iter().all(|g| *g == 0.0);
    Ok(outcome.demand(
        silent,
        "gradients of the Gaussian without rotation are zero",
    ))
}

fn quaternion_multiples(device: &Device) -> Result<Outcome, AccuracyError> {
    let make = |factor: f64| {
        clear(1e-5, |seed| {
            let mut sketch = Sketch::new("q, -q, 5q", 32, 32, seed).tilted();
            sketch.scatter(12, (0.3, 0.8));
            for blob in &mut sketch.blobs {
                // Rounded to single precision first, so that all are multiples of one quaternion.
                blob.quat = blob.quat.map(|x| super::super::sketch::rounded(x) * factor);
            }
            sketch.scene()
        })
    };
    let plain = single(&make(1.0), device)?;
    let negated = single(&make(-1.0), device)?;
    let long = make(5.0);
    let fivefold = single(&long, device)?;
    let image = |c: &crate::gradcheck::Computed| c.outputs.image.values.clone();
    let off = relative_l2(&image(&fivefold), &image(&plain));
    let radial = (0..12).map(|n| {
        let q = &long.inputs.quats.values[4 * n..4 * n + 4];
        let g = &fivefold.gradients.quats.values[4 * n..4 * n + 4];
        let dot: f64 = q.iter().zip(g).map(|(q, g)| q * g).sum();
        let length = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
        dot.abs() / (length(q) * length(g)).max(f64::MIN_POSITIVE)
    });
    let radial = radial.fold(0.0, f64::max);
    Ok(against_double(&long, device, &[])?
        .note(format!(
            "5q: image {off:.0e} off; radial share {radial:.0e}"
        ))
        .demand(image(&plain) == image(&negated), "q and -q: the same bits")
        .demand(off <= 1e-6, "q and 5q: the same image to 1e-6")
        .demand(radial <= 1e-5, "no gradient along the quaternion"))
}

fn spheres() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("spheres", 32, 32, seed).tilted();
        sketch.scatter(12, (0.3, 0.8));
        for blob in &mut sketch.blobs {
            blob.scale = [blob.scale[0]; 3];
        }
        sketch.scene()
    })]
}

fn needle_outside() -> Vec<Scene> {
    vec![clear(1e-4, |seed| {
        let mut sketch = Sketch::new("needles outside", 64, 48, seed);
        for (i, pixel) in [[-8.0, 20.0], [70.0, 10.0], [30.0, -9.0], [-30.0, 60.0]]
            .into_iter()
            .enumerate()
        {
            let quat = sketch.turn();
            sketch.splat(pixel, 2.0 + i as f64, [1_000.0, 0.1, 0.1], quat, 0.9);
        }
        sketch.scene()
    })]
}

fn relocation(_: &Device) -> Result<Outcome, AccuracyError> {
    // 51 copies of an opaque Gaussian; the reference is the paper's series in 90-digit decimal
    // arithmetic.
    let (opacity, factor) = splat_model::strategy::relocate(1.0, 51);
    let error = (factor / 0.420_778_371_403_541_15 - 1.0).abs();
    let finite = [0.0, 1e-300, 0.5, 1.0 - 1e-16, 1.0].iter().all(|o| {
        let (o, f) = splat_model::strategy::relocate(*o, 51);
        o.is_finite() && f.is_finite()
    });
    let outcome = Outcome {
        forward: error,
        ..Outcome::new()
    };
    Ok(outcome.note("on the host, in double precision").demand(
        opacity == 1.0 && error <= 1e-12 && finite,
        "1e-12, finite at both ends",
    ))
}
