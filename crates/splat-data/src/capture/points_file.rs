//! Points of a capture in a PLY file.

use std::path::Path;

use super::{CaptureError, Point};
use crate::scene::SceneFileError;
use crate::scene::ply::parse_points;

/// Points with colours from the contents of a PLY file; `path` is used in messages.
pub(super) fn parse(path: &Path, bytes: &[u8]) -> Result<Vec<Point>, CaptureError> {
    let points = parse_points(path, bytes).map_err(of_points)?;
    let point = |(position, color)| Point { position, color };
    Ok(points.into_iter().map(point).collect())
}

/// The error in terms of points instead of Gaussians.
fn of_points(error: SceneFileError) -> CaptureError {
    let bad = |path, index: Option<usize>, reason| CaptureError::BadRecord {
        path,
        record: index.map_or_else(
            || "no file of points".to_owned(),
            |index| format!("point {index} (counted from 0)"),
        ),
        reason,
    };
    match error {
        SceneFileError::Io { path, source } => CaptureError::Io { path, source },
        SceneFileError::Header { path, reason } => bad(path, None, reason),
        SceneFileError::MissingProperty { path, property } => bad(
            path,
            None,
            format!("its vertices lack the number `{property}`"),
        ),
        SceneFileError::Truncated { path, index, count } => {
            let reason = format!("the file ends in it, but announces {count}; it is truncated");
            bad(path, Some(index), reason)
        }
        SceneFileError::BadElement {
            path,
            index,
            reason,
        } => bad(path, Some(index), reason),
        SceneFileError::NotFinite {
            path,
            index,
            property,
            value,
        } => bad(path, Some(index), format!("its {property} is {value}")),
        other => CaptureError::BadTransforms {
            path: Path::new("points").to_path_buf(),
            reason: other.to_string(),
        },
    }
}
