//! Cases of the camera: centre, near plane, clamp, openings, map-sized coordinates, units.

use burn::tensor::Device;
use glam::DVec3;

use super::super::case::Case;
use super::super::measure::{AccuracyError, Outcome, clear, double, judge, single};
use super::super::sketch::{Sketch, about_z, neighbours};
use crate::gradcheck::{Array, Scene};

pub(super) const CASES: [Case; 7] = [
    Case::scenes(15, "mean at the camera centre", "0/0 direction", at_centre),
    Case::scenes(
        16,
        "z = near +- 1 ulp, z -> 0+, z < 0",
        "explosion; negative depth bits sort the wrong way",
        near_plane,
    ),
    Case::scenes(
        17,
        "the off-screen clamp +- 1 ulp",
        "wrong gradient",
        at_the_clamp,
    ),
    Case::scenes(
        18,
        "off-centre principal point, beyond the clamp",
        "asymmetric clamp wrong",
        off_centre,
    ),
    Case::scenes(20, "120 degree field of view, near splat", "popping", wide),
    Case::own(
        26,
        "world offset 1e5 to 1e7 (map coordinates)",
        "cancellation in world-to-camera",
        "means from an origin in double precision",
        map_coordinates,
    ),
    Case::scenes(
        27,
        "whole scene scaled by 1e-3 and 1e4",
        "absolute epsilons misfire",
        other_units,
    ),
];

fn at_centre() -> Vec<Scene> {
    [0.01, 0.0]
        .into_iter()
        .map(|near| {
            clear(1e-5, |seed| {
                let mut sketch = Sketch::new("at the camera centre", 32, 32, seed);
                sketch.project.near = near;
                sketch.scatter(10, (0.3, 0.8));
                sketch.blobs[4].mean = DVec3::ZERO;
                sketch.scene()
            })
        })
        .collect()
}

fn near_plane() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("about the near plane", 32, 32, seed);
        sketch.project.near = 0.5;
        let [below, above] = neighbours(0.5);
        for (i, z) in [below, 0.5, above, 1e-30, -1.0, -0.5, 3.0]
            .into_iter()
            .enumerate()
        {
            let pixel = [6.0 + 3.0 * i as f64, 16.0];
            sketch
                .splat(pixel, 0.5, [3.0, 2.0, 2.5], about_z(i as f64), 0.6)
                .mean
                .z = z;
        }
        sketch.scene()
    })]
}

fn at_the_clamp() -> Vec<Scene> {
    // Margin and focal length are powers of two, so that x/z = (16 + 4)/32 and its neighbours are
    // exact.
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("at the clamp", 32, 32, seed);
        sketch.project.clamp_margin = 0.125;
        let limit = 1.25;
        let [below, above] = neighbours(limit);
        for (i, x) in [limit, below, above, -limit, -below, -above]
            .into_iter()
            .enumerate()
        {
            let pixel = [16.0, 6.0 + 4.0 * i as f64];
            let quat = sketch.turn();
            sketch.splat(pixel, 2.0, [8.0, 6.0, 9.0], quat, 0.8).mean.x = x;
        }
        sketch.scene()
    })]
}

fn off_centre() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("off-centre", 32, 24, seed).tilted();
        sketch.intrinsics[2] = 22.5;
        sketch.intrinsics[3] = 5.75;
        for (i, pixel) in [
            [-12.0, 4.0],
            [44.0, 20.0],
            [12.0, -9.0],
            [20.0, 33.0],
            [40.0, -8.0],
        ]
        .into_iter()
        .enumerate()
        {
            let quat = sketch.turn();
            sketch.splat(pixel, 2.0 + i as f64, [14.0, 10.0, 12.0], quat, 0.8);
        }
        sketch.scene()
    })]
}

fn wide() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("120 degrees", 48, 48, seed).tilted();
        let focal = 24.0 / 60f64.to_radians().tan();
        sketch.intrinsics[0] = focal;
        sketch.intrinsics[1] = focal;
        for (i, depth) in [0.05, 0.11, 0.3, 0.9, 2.0, 3.1, 5.0]
            .into_iter()
            .enumerate()
        {
            let pixel = [sketch.uniform(2.0, 46.0), sketch.uniform(2.0, 46.0)];
            let quat = sketch.turn();
            let size = sketch.uniform(1.0, 5.0);
            sketch.splat(
                pixel,
                depth,
                [size, size * 0.5, size * 1.5],
                quat,
                0.7 + 0.02 * i as f64,
            );
        }
        sketch.scene()
    })]
}

/// A distant scene, in double precision at its place in the world, and in single precision relative
/// to an origin. The pose gradient of the first is transferred to the origin: that of W loses the
/// gradient of t times the origin.
fn map_coordinates(device: &Device) -> Result<Outcome, AccuracyError> {
    let mut outcome = Outcome::new();
    for offset in [1e5, 1e6, 1e7] {
        let origin = DVec3::new(offset, -0.7 * offset, 0.3 * offset).round();
        let local = clear(1e-5, |seed| {
            let mut sketch = Sketch::new("map coordinates", 32, 32, seed).tilted();
            sketch.scatter(16, (0.3, 0.8));
            sketch.scene()
        });
        // A rotation that is orthonormal only to single precision would turn the distance of the
        // origin into an error of the scene.
        let mut local = local;
        local.inputs.viewmat.values = orthonormal(&local.inputs.viewmat.values);
        let mut world = local.clone();
        for mean in world.inputs.means.values.chunks_mut(3) {
            for (x, o) in mean.iter_mut().zip(origin.to_array()) {
                *x += o;
            }
        }
        for row in world.inputs.viewmat.values.chunks_mut(4).take(3) {
            row[3] -= row[0] * origin.x + row[1] * origin.y + row[2] * origin.z;
        }
        let mut reference = double(&world)?;
        for row in reference.gradients.viewmat.values.chunks_mut(4) {
            let shift = row[3];
            for (value, o) in row.iter_mut().zip(origin.to_array()) {
                *value -= o * shift;
            }
        }
        let mut ours = single(&local, device)?;
        for computed in [&mut reference, &mut ours] {
            pose_gradient(
                &local.inputs.viewmat.values,
                &mut computed.gradients.viewmat,
            );
        }
        outcome = outcome.and(judge(&local, &ours, reference, &[]));
    }
    Ok(outcome.note("1e5, 1e6, 1e7"))
}

/// Restricts the gradient [dW | dt] to rigid motions: the skew part of W^T dW, and dt. The rest
/// would make W something other than a rotation, for which the two placements of the scene differ
/// by definition.
fn pose_gradient(viewmat: &[f64], gradient: &mut Array) {
    let rows = |values: &[f64]| [0, 1, 2].map(|i| DVec3::from_slice(&values[4 * i..4 * i + 3]));
    let (w, dw) = (rows(viewmat), rows(&gradient.values));
    let product = |i: usize, k: usize| (0..3).map(|r| w[r][i] * dw[r][k]).sum::<f64>();
    for i in 0..3 {
        for k in 0..3 {
            gradient.values[4 * i + k] = product(i, k) - product(k, i);
        }
    }
}

/// The same pose, with its rotation orthonormal in double precision.
fn orthonormal(viewmat: &[f64]) -> Vec<f64> {
    let axis = |i: usize| DVec3::from_slice(&viewmat[4 * i..4 * i + 3]);
    let x = axis(0).normalize();
    let z = x.cross(axis(1)).normalize();
    let rows = [x, z.cross(x), z];
    let mut exact = viewmat.to_vec();
    for (row, axis) in exact.chunks_mut(4).zip(rows) {
        row[..3].copy_from_slice(&axis.to_array());
    }
    exact
}

fn other_units() -> Vec<Scene> {
    [1e-3, 1e4]
        .into_iter()
        .map(|unit| {
            clear(1e-5, |seed| {
                let mut sketch = Sketch::new("other units", 32, 32, seed).tilted();
                sketch.scatter(16, (0.3, 0.8));
                sketch.project.near *= unit;
                sketch.viewmat.w_axis *= glam::DVec4::new(unit, unit, unit, 1.0);
                for blob in &mut sketch.blobs {
                    blob.mean *= unit;
                    blob.scale = blob.scale.map(|s| s * unit);
                }
                sketch.scene()
            })
        })
        .collect()
}
