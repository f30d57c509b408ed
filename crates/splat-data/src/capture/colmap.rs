//! COLMAP's sparse model in either encoding: location, contents, and consistency checks.
//!
//! Format: <https://colmap.github.io/format.html>. Files that are not needed here are ignored,
//! among them `rigs.bin` and `frames.bin`: the file of the images still has the whole pose of each
//! image, a rig's included.

use std::path::Path;

use super::colmap_checks::assemble;
use super::colmap_folder::{ModelFiles, candidates, find};
use super::format::{CaptureFormat, ReadModel};
use super::sparse_model::SparseModel;
use super::{CaptureError, CaptureSettings, CaptureWarning, colmap_binary, colmap_text};

/// A folder with a COLMAP model in a numbered folder of `sparse`, in `sparse`, or in the folder
/// itself.
pub(super) const FORMAT: CaptureFormat = CaptureFormat {
    name: "the COLMAP model",
    is_in: |root| !candidates(root).is_empty(),
    read,
};

/// Finds, reads and checks the model of the capture in `root`.
pub(super) fn read(root: &Path, settings: &CaptureSettings) -> ReadModel {
    let (folder, mut warnings) = find(root)?;
    let files = ModelFiles::find(&folder)?;
    let read = |path: &Path| {
        std::fs::read(path).map_err(|source| CaptureError::Io {
            path: path.to_path_buf(),
            source,
        })
    };
    let (cameras, images) = (read(&files.cameras)?, read(&files.images)?);
    // A model without points is trained from random ones.
    let points = match files.points.is_file() {
        true => Some(read(&files.points)?),
        false => None,
    };
    let contents = (&cameras[..], &images[..], points.as_deref());
    let model = parse(&files, contents, settings.observations, &mut warnings)?;
    Ok((model, warnings))
}

/// Reads and checks a model from the contents of its cameras, images and points.
fn parse(
    files: &ModelFiles,
    (cameras, images, points): (&[u8], &[u8], Option<&[u8]>),
    observations: bool,
    warnings: &mut Vec<CaptureWarning>,
) -> Result<SparseModel, CaptureError> {
    let paths = [&*files.cameras, &files.images, &files.points];
    if files.binary {
        return assemble(
            paths,
            colmap_binary::parse_cameras(&files.cameras, cameras)?,
            colmap_binary::parse_images(&files.images, images, observations)?,
            points.map_or(Ok(vec![]), |points| {
                colmap_binary::parse_points(&files.points, points)
            })?,
        );
    }
    let cameras = colmap_text::parse_cameras(&files.cameras, cameras)?;
    let cameras = cameras.checked(&files.cameras, "cameras", warnings);
    let images = colmap_text::parse_images(&files.images, images, observations)?;
    let images = images.checked(&files.images, "images", warnings);
    let points = match points {
        Some(points) => colmap_text::parse_points(&files.points, points)?.checked(
            &files.points,
            "points",
            warnings,
        ),
        None => vec![],
    };
    assemble(paths, cameras, images, points)
}

/// [`read`] for a model in memory, with its observations: the contents of its cameras, images and
/// points.
pub(super) fn parse_model(binary: bool, [cameras, images, points]: [&[u8]; 3]) -> ReadModel {
    let mut warnings = Vec::new();
    let files = ModelFiles::of(Path::new(""), binary);
    let contents = (cameras, images, Some(points));
    let model = parse(&files, contents, true, &mut warnings)?;
    Ok((model, warnings))
}
