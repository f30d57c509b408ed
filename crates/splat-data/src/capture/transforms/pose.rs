//! The pose of a frame: from camera to world in OpenGL's axes, to world to camera in OpenCV's.

use glam::{DMat3, DQuat, DVec3};
use serde_json::Value;

use super::super::CaptureError;
use super::fields::Fields;

/// Most that columns of a rotation may differ from unit length and right angles, relatively.
/// Files have six digits, and some programs compute in single precision.
const TOLERANCE: f64 = 1e-2;

/// The view matrix of `transform_matrix`, 4x4 or 3x4.
pub(super) fn viewmat(frame: &Fields<'_>) -> Result<[[f64; 4]; 4], CaptureError> {
    let Some(rows) = frame.get("transform_matrix") else {
        return Err(frame.error("its transform_matrix is missing"));
    };
    let Some([right, up, back, position]) = columns(rows) else {
        return Err(frame.error("its transform_matrix is no matrix of 4x4 numbers"));
    };
    let rotation = DMat3::from_cols(right, up, back);
    let Some(rotation) = rotation_of(rotation) else {
        return Err(frame.error(
            "its transform_matrix is no pose: the columns of a rotation are at right angles, equally long, and not mirrored",
        ));
    };
    // OpenGL's camera looks along -z, with +y up.
    let flip = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let to_camera = flip * rotation.transpose();
    let translation = -(to_camera * position);
    if !translation.is_finite() {
        return Err(frame.error("its transform_matrix is too far from zero"));
    }
    let row = |index: usize| {
        let row = to_camera.row(index);
        [row.x, row.y, row.z, translation[index]]
    };
    Ok([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])
}

/// The first three entries of each column.
fn columns(rows: &Value) -> Option<[DVec3; 4]> {
    let rows = rows.as_array().filter(|rows| matches!(rows.len(), 3 | 4))?;
    let mut columns = [DVec3::ZERO; 4];
    for (at, row) in rows.iter().enumerate() {
        let row = row.as_array().filter(|row| row.len() == 4)?;
        for (column, value) in columns.iter_mut().zip(row) {
            let value = value.as_f64().filter(|value| value.is_finite())?;
            if at < 3 {
                column[at] = value;
            }
        }
    }
    Some(columns)
}

/// The rotation nearest to a matrix of rounded numbers, without its scale; `None` if it is none.
fn rotation_of(matrix: DMat3) -> Option<DMat3> {
    let largest = matrix
        .to_cols_array()
        .iter()
        .fold(0.0, |m: f64, x| m.max(x.abs()));
    let matrix = matrix * (1.0 / largest);
    let length = matrix.determinant().cbrt();
    let unit = matrix * (1.0 / length);
    let product = unit.transpose() * unit;
    let close = product.abs_diff_eq(DMat3::IDENTITY, TOLERANCE);
    (length > 0.0 && length.is_finite() && close)
        .then(|| DMat3::from_quat(DQuat::from_mat3(&unit).normalize()))
}
