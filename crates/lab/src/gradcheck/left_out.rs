//! Checks in single precision, with the pixels excluded that it may decide differently.
//!
//! If alpha or transmittance lies within rounding of a threshold, a splat may be blended in one
//! precision and not in the other, and neither is wrong. The upstream gradient of these pixels is
//! zeroed on both sides: our double-precision result, which must itself match the file with every
//! pixel counted, then serves as the reference without them. The file's images are compared without
//! them too. At most one pixel in a hundred may be excluded.

use burn::tensor::Device;

use super::thresholds::near_in_single;
use super::{Bug, FileReport, Fixture, GradcheckError, Outputs, Precision, compare, run};

/// At most one pixel in this many may be excluded.
const RARE: usize = 100;

/// Checks a fixture in single precision on a device.
pub(super) fn check(
    fixture: &Fixture,
    device: &Device,
    bug: Option<Bug>,
) -> Result<FileReport, GradcheckError> {
    let scene = &fixture.scene;
    let double = |scene| run(scene, &Device::flex(), Precision::F64, None);
    let reference = double(scene)?;
    let near = near_in_single(scene, &reference);
    if near.is_empty() {
        let computed = run(scene, device, Precision::F32, bug)?;
        return Ok(compare(fixture, &computed, Precision::F32, 0));
    }

    let mut rest = fixture.clone();
    clear(&mut rest.scene.upstream, &near);
    clear(&mut rest.expected, &near);
    let reference_of_rest = double(&rest.scene)?;
    rest.gradients = reference_of_rest.gradients;
    // In the shape of the file, which may have no camera in front.
    if let (Some(expected), Some(ours)) = (&mut rest.absgrad, reference_of_rest.absgrad) {
        expected.values = ours.values;
    }
    let mut computed = run(&rest.scene, device, Precision::F32, bug)?;
    clear(&mut computed.outputs, &near);
    let mut report = compare(&rest, &computed, Precision::F32, near.len());

    let whole = compare(fixture, &reference, Precision::F64, near.len());
    if !whole.pass {
        report.reasons.push(format!(
            "ours in f64, which stands for the reference where pixels are left out, does not match the file: {} beyond {:.0e}",
            whole.failed().join(", "),
            whole.gate
        ));
    }
    if near.len() * RARE > report.pixels {
        report.reasons.push(format!(
            "more than 1 % of the pixels ({} of {}) lie on a threshold in f32; move the scene off it, or check it in f64",
            near.len(),
            report.pixels
        ));
    }
    report.pass &= report.reasons.is_empty();
    Ok(report)
}

/// Sets these pixels to zero.
fn clear(pictures: &mut Outputs, pixels: &[usize]) {
    let depth = pictures.depth.as_mut();
    for (array, channels) in [(&mut pictures.image, 3), (&mut pictures.alpha, 1)]
        .into_iter()
        .chain(depth.map(|depth| (depth, 1)))
    {
        for pixel in pixels {
            array.values[channels * pixel..channels * (pixel + 1)].fill(0.0);
        }
    }
}

#[cfg(test)]
mod tests;
