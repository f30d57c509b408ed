//! The pose of a frame: from camera to world in OpenGL's axes, to world to camera in OpenCV's.

use glam::{DMat3, DQuat, DVec3};
use serde_json::Value;

use super::super::CaptureError;
use super::fields::Fields;

/// Most that columns of a rotation may differ from unit length and right angles, relatively.
/// Files have six digits, and some programs compute in single precision.
const TOLERANCE: f64 = 1e-2;

/// The last row of a pose.
const LAST_ROW: [f64; 4] = [0.0, 0.0, 0.0, 1.0];

/// Most that its numbers may differ from it, as those of a rotation in camera files may.
const LAST_ROW_TOLERANCE: f64 = 1e-4;

/// The view matrix of `transform_matrix`, 4x4 or 3x4.
pub(super) fn viewmat(frame: &Fields<'_>) -> Result<[[f64; 4]; 4], CaptureError> {
    let Some(value) = frame.get("transform_matrix") else {
        return Err(frame.error("its transform_matrix is missing"));
    };
    let Some(rows) = matrix(value) else {
        return Err(frame.error("its transform_matrix is no matrix of 4x4 numbers"));
    };
    let column = |at: usize| DVec3::new(rows[0][at], rows[1][at], rows[2][at]);
    let position = column(3);
    let rotation = DMat3::from_cols(column(0), column(1), column(2));
    let Some(rotation) = rotation_of(rotation) else {
        return Err(frame.error(
            "its transform_matrix is no pose: the columns of a rotation are at right angles, equally long, and not mirrored",
        ));
    };
    check_last_row(frame, rows[3], position)?;
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
    Ok([row(0), row(1), row(2), LAST_ROW])
}

/// The rows of a matrix; one of three rows has the last one of a pose.
fn matrix(value: &Value) -> Option<[[f64; 4]; 4]> {
    let rows = value
        .as_array()
        .filter(|rows| matches!(rows.len(), 3 | 4))?;
    let mut matrix = [[0.0; 4], [0.0; 4], [0.0; 4], LAST_ROW];
    for (entries, row) in matrix.iter_mut().zip(rows) {
        let row = row.as_array().filter(|row| row.len() == 4)?;
        for (entry, value) in entries.iter_mut().zip(row) {
            *entry = value.as_f64().filter(|value| value.is_finite())?;
        }
    }
    Some(matrix)
}

/// Checks the last row. In a file that has its matrices column by column it is the position, and
/// every camera would be at the origin.
fn check_last_row(frame: &Fields<'_>, row: [f64; 4], position: DVec3) -> Result<(), CaptureError> {
    let is_zero = |value: &f64| value.abs() <= LAST_ROW_TOLERANCE;
    let [x, y, z, w] = row;
    let first = [x, y, z];
    if first.iter().all(is_zero) && is_zero(&(w - 1.0)) {
        return Ok(());
    }
    let looks_transposed = position.to_array().iter().all(is_zero) && !first.iter().all(is_zero);
    let remedy = if looks_transposed {
        "the matrix looks transposed (column by column): write it row by row, with the position in its last column"
    } else {
        "write the pose as a rotation and a position, without a scale or a projection"
    };
    Err(frame.error(&format!(
        "the last row of its transform_matrix is {row:?} instead of [0, 0, 0, 1]; {remedy}"
    )))
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
