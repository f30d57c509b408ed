//! Cases of colour: spherical harmonics, their direction, and 8-bit photos.

use std::sync::Arc;

use burn::tensor::Device;

use super::super::case::Case;
use super::super::measure::{AccuracyError, Outcome, against_double, clear, double, single};
use super::super::sketch::Sketch;
use crate::gradcheck::{Bug, Precision, Scene, relative_l2, run};

pub(super) const CASES: [Case; 3] = [
    Case::scenes(
        28,
        "SH degree 3 with the colour crossing 0",
        "clamp gradient wrong at 0",
        crossing_zero,
    ),
    Case::own(
        29,
        "SH direction gradient into the mean and the camera",
        "silently missing",
        "present and right",
        direction,
    ),
    Case::own(
        37,
        "SH of 1e3; 8-bit target",
        "overflow, bias",
        "every level of a photo to half an ulp",
        large_and_eight_bit,
    ),
];

fn directional(name: &'static str, base: (f64, f64), band: f64) -> Scene {
    clear(1e-5, |seed| {
        let mut sketch = Sketch::new(name, 32, 32, seed).tilted();
        sketch.sh_degree = 3;
        sketch.scatter(20, (0.3, 0.8));
        for n in 0..sketch.blobs.len() {
            for k in 0..16 {
                for channel in 0..3 {
                    let (low, high) = if k == 0 { base } else { (-band, band) };
                    sketch.blobs[n].sh[k][channel] = sketch.uniform(low, high);
                }
            }
        }
        sketch.scene()
    })
}

fn crossing_zero() -> Vec<Scene> {
    // The colour is 0.5 + 0.28 sh0 + ...: around zero, half of the values below it.
    vec![directional("colour crosses zero", (-2.8, -0.8), 0.5)]
}

fn direction(device: &Device) -> Result<Outcome, AccuracyError> {
    let scene = directional("direction", (0.0, 1.5), 0.4);
    let outcome = against_double(&scene, device, &[])?;
    // The loss without this gradient exceeds the gate, so a missing gradient would fail.
    let without = run(
        &scene,
        &Device::flex(),
        Precision::F64,
        Some(Bug::DirectionDetached),
    )?;
    let with = double(&scene)?;
    let lost = |array: fn(&crate::gradcheck::Inputs) -> &crate::gradcheck::Array| {
        relative_l2(
            &array(&without.gradients).values,
            &array(&with.gradients).values,
        )
    };
    let (means, viewmat) = (lost(|g| &g.means), lost(|g| &g.viewmat));
    Ok(outcome
        .note(format!(
            "its share: {:.0} % of means, {:.1} % of viewmat",
            100.0 * means,
            100.0 * viewmat
        ))
        .demand(
            means > 1e-2 && viewmat > 1e-3,
            "the direction's share is above the gate",
        ))
}

fn large_and_eight_bit(device: &Device) -> Result<Outcome, AccuracyError> {
    let scene = directional("SH of 1e3", (-1e3, 1e3), 1e3);
    let outcome = against_double(&scene, device, &[])?;
    let finite = single(&scene, device)?
        .outputs
        .image
        .values
        .iter()
        .all(|v| v.is_finite());

    let view = splat_data::View {
        name: "ramp".into(),
        width: 16,
        height: 16,
        intrinsics: [16.0, 16.0, 8.0, 8.0],
        viewmat: [[0.0; 4]; 4],
        lens: splat_data::Lens::Pinhole,
        image: Arc::new((0..=255).flat_map(|level| [level; 3]).collect()),
        mask: None,
        depth: None,
        on_disk: None,
    };
    let photo = splat_trainer::photo(&view, device)?
        .try_into_vec_as::<f64>()
        .map_err(|error| AccuracyError::Read(error.to_string()))?;
    let worst = photo.iter().enumerate().map(|(i, value)| {
        let exact = (i / 3) as f64 / 255.0;
        (value - exact).abs() / exact.max(f64::MIN_POSITIVE)
    });
    let worst = worst.fold(0.0, f64::max);
    Ok(outcome
        .note(format!("8-bit levels {worst:.0e} off"))
        .demand(finite, "finite")
        .demand(worst <= 6e-8, "levels to half an ulp"))
}
