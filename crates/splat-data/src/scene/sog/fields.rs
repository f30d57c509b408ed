//! Rotations, scales and colours: for each image, how it is written and read.

use std::f64::consts::SQRT_2;
use std::path::Path;

use super::super::{SceneFileError, SplatData, values};
use super::codebook;
use super::meta::Coded;

/// Log-scale that is written for a flat Gaussian's minus infinity, which JSON does not have; its
/// exponential is 0 too.
const FLAT: f32 = -1000.0;

/// Components that are written of a quaternion (w, x, y, z), by the index of the largest.
const OTHERS: [[usize; 3]; 4] = [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]];

/// Alpha of a quaternion whose largest component is w.
const FIRST_LARGEST: u8 = 252;

pub(super) fn quats(scene: &SplatData, order: &[u32]) -> Vec<[u8; 4]> {
    let pixel = |index: u32| {
        let quat = values::unit_quat(scene, index as usize);
        let largest = values::largest(quat);
        // The largest component, which is not written, is positive.
        let sign = 1f64.copysign(quat[largest]);
        let byte = |at: usize| (255.0 * (sign * quat[at] / SQRT_2 + 0.5)).round() as u8;
        let [a, b, c] = OTHERS[largest].map(byte);
        [a, b, c, FIRST_LARGEST + largest as u8]
    };
    order.iter().map(|&index| pixel(index)).collect()
}

pub(super) fn decode_quats(
    path: &Path,
    pixels: &[[u8; 4]],
) -> Result<Vec<[f32; 4]>, SceneFileError> {
    let decode = |(index, pixel): (usize, &[u8; 4])| {
        let largest = match pixel[3].checked_sub(FIRST_LARGEST) {
            Some(largest) => usize::from(largest),
            None => {
                return Err(SceneFileError::BadElement {
                    path: path.to_path_buf(),
                    index,
                    reason: format!(
                        "quats: alpha is {} instead of 252 to 255; the file is damaged",
                        pixel[3]
                    ),
                });
            }
        };
        let mut quat = [0.0; 4];
        let mut rest = 1.0;
        for (at, byte) in OTHERS[largest].into_iter().zip(pixel) {
            let value = (f64::from(*byte) / 255.0 - 0.5) * SQRT_2;
            quat[at] = value as f32;
            rest -= value * value;
        }
        quat[largest] = rest.max(0.0).sqrt() as f32;
        Ok(quat)
    };
    pixels.iter().enumerate().map(decode).collect()
}

/// Codebook and pixels of the scales.
pub(super) fn scales(scene: &SplatData, order: &[u32]) -> (Vec<f32>, Vec<[u8; 3]>) {
    let finite = |scale: f32| scale.max(FLAT);
    let all = scene.log_scales.as_flattened().iter();
    let codebook = codebook::fit(all.map(|&scale| finite(scale)).collect());
    let codes = codebook::Codes::new(&codebook);
    let pixel = |&index: &u32| scene.log_scales[index as usize].map(|s| codes.nearest(finite(s)));
    (
        codebook::full(codebook.clone()),
        order.iter().map(pixel).collect(),
    )
}

pub(super) fn decode_scales(
    path: &Path,
    coded: &Coded,
    pixels: &[[u8; 4]],
) -> Result<Vec<[f32; 3]>, SceneFileError> {
    let mut codebook = coded.codebook.clone();
    // Other programs write minus infinity, the least, as `null`.
    if let Some(first @ None) = codebook.first_mut() {
        *first = Some(FLAT);
    }
    let flat = |scale: f32| {
        if scale <= FLAT {
            f32::NEG_INFINITY
        } else {
            scale
        }
    };
    let scales = decode_coded(path, "scales", &codebook, pixels)?;
    Ok(scales.into_iter().map(|scales| scales.map(flat)).collect())
}

/// Codebook and pixels of the colours and opacities.
pub(super) fn colors(scene: &SplatData, order: &[u32]) -> (Vec<f32>, Vec<[u8; 4]>) {
    let codebook = codebook::fit(scene.sh0.as_flattened().to_vec());
    let codes = codebook::Codes::new(&codebook);
    let pixel = |&index: &u32| {
        let index = index as usize;
        let [r, g, b] = scene.sh0[index].map(|value| codes.nearest(value));
        let opacity = (255.0 * values::opacity(scene, index)).round() as u8;
        [r, g, b, opacity]
    };
    (
        codebook::full(codebook.clone()),
        order.iter().map(pixel).collect(),
    )
}

pub(super) fn decode_colors(
    path: &Path,
    coded: &Coded,
    pixels: &[[u8; 4]],
) -> Result<Vec<[f32; 3]>, SceneFileError> {
    decode_coded(path, "sh0", &coded.codebook, pixels)
}

fn decode_coded(
    path: &Path,
    field: &'static str,
    codebook: &[Option<f32>],
    pixels: &[[u8; 4]],
) -> Result<Vec<[f32; 3]>, SceneFileError> {
    let decode = |(index, [r, g, b, _]): (usize, &[u8; 4])| {
        let mut values = [0.0; 3];
        for (value, code) in values.iter_mut().zip([r, g, b]) {
            *value =
                codebook::value(codebook, *code).map_err(|reason| SceneFileError::BadElement {
                    path: path.to_path_buf(),
                    index,
                    reason: format!("{field}: {reason}"),
                })?;
        }
        Ok(values)
    };
    pixels.iter().enumerate().map(decode).collect()
}
