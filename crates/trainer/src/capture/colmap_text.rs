//! COLMAP's text files: one record a line (two for an image), fields separated by blanks, `#` starts a comment line.

use std::path::Path;
use std::str::{FromStr, SplitWhitespace};

use super::colmap::{Camera, Image, pinhole_intrinsics, pinhole_parameters};
use super::{CaptureError, Point};

/// Reads `cameras.txt`: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`.
pub(super) fn read_cameras(path: &Path) -> Result<Vec<Camera>, CaptureError> {
    parse_cameras(path, &read_file(path)?)
}

/// [`read_cameras`] on the content of the file; `path` is for messages.
pub(super) fn parse_cameras(path: &Path, bytes: &[u8]) -> Result<Vec<Camera>, CaptureError> {
    let text = text(path, bytes)?;
    records(text)
        .map(|(line, record)| {
            let mut fields = Fields::new(path, line, record);
            let id = fields.next("camera id")?;
            let model: String = fields.next("model")?;
            let Some(parameters) = pinhole_parameters(&model) else {
                return Err(CaptureError::UnsupportedCamera {
                    path: path.to_path_buf(),
                    camera_id: id,
                    model,
                });
            };
            let width = fields.next("width")?;
            let height = fields.next("height")?;
            let mut values = [0.0; 4];
            for value in &mut values[..parameters] {
                *value = fields.next("parameters")?;
            }
            Ok(Camera {
                id,
                width,
                height,
                intrinsics: pinhole_intrinsics(&values[..parameters]),
            })
        })
        .collect()
}

/// Reads `images.txt`: `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, then a line of keypoints, which may be empty
/// and is skipped. The name runs to the end of its line, blanks included.
pub(super) fn read_images(path: &Path) -> Result<Vec<Image>, CaptureError> {
    parse_images(path, &read_file(path)?)
}

/// [`read_images`] on the content of the file; `path` is for messages.
pub(super) fn parse_images(path: &Path, bytes: &[u8]) -> Result<Vec<Image>, CaptureError> {
    let text = text(path, bytes)?;
    let mut lines = text.lines().enumerate();
    let mut images = Vec::new();
    while let Some((line, record)) = lines.next() {
        if !is_record(record) {
            continue;
        }
        let mut fields = Fields::new(path, line, record);
        let id = fields.next("image id")?;
        let quaternion = fields.array("quaternion")?;
        let translation = fields.array("translation")?;
        let camera_id = fields.next("camera id")?;
        // Nine fields precede the name; splitting again keeps the blanks inside it.
        let name = nth_field_onwards(record, 9);
        if name.is_empty() {
            return Err(fields.error("its name is missing"));
        }
        images.push(Image {
            id,
            camera_id,
            name: name.to_owned(),
            quaternion,
            translation,
        });
        lines.next();
    }
    Ok(images)
}

/// Reads `points3D.txt`: `POINT3D_ID X Y Z R G B ERROR TRACK[]`; the track is skipped.
pub(super) fn read_points(path: &Path) -> Result<Vec<Point>, CaptureError> {
    parse_points(path, &read_file(path)?)
}

/// [`read_points`] on the content of the file; `path` is for messages.
pub(super) fn parse_points(path: &Path, bytes: &[u8]) -> Result<Vec<Point>, CaptureError> {
    let text = text(path, bytes)?;
    records(text)
        .map(|(line, record)| {
            let mut fields = Fields::new(path, line, record);
            let _id: u64 = fields.next("point id")?;
            let position = fields.array("position")?;
            let color = fields.array("colour")?;
            Ok(Point { position, color })
        })
        .collect()
}

fn read_file(path: &Path) -> Result<Vec<u8>, CaptureError> {
    std::fs::read(path).map_err(|source| CaptureError::Io {
        path: path.to_path_buf(),
        source,
    })
}

/// The file as text.
fn text<'a>(path: &Path, bytes: &'a [u8]) -> Result<&'a str, CaptureError> {
    std::str::from_utf8(bytes).map_err(|error| CaptureError::BadRecord {
        path: path.to_path_buf(),
        record: format!("byte {}", error.valid_up_to()),
        reason: "it is no UTF-8 text".to_owned(),
    })
}

fn is_record(line: &str) -> bool {
    let line = line.trim_start();
    !line.is_empty() && !line.starts_with('#')
}

/// Lines with a record, with their index from 0.
fn records(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().filter(|(_, line)| is_record(line))
}

/// What is left of `line` after its first `count` fields, trimmed.
fn nth_field_onwards(line: &str, count: usize) -> &str {
    (0..count)
        .fold(line.trim_start(), |rest, _| {
            let end = rest.find(char::is_whitespace).unwrap_or(rest.len());
            rest[end..].trim_start()
        })
        .trim_end()
}

/// The fields of one line.
struct Fields<'a> {
    path: &'a Path,
    line: usize,
    fields: SplitWhitespace<'a>,
}

impl<'a> Fields<'a> {
    fn new(path: &'a Path, line: usize, record: &'a str) -> Self {
        Self {
            path,
            line,
            fields: record.split_whitespace(),
        }
    }

    fn next<T: FromStr>(&mut self, field: &str) -> Result<T, CaptureError> {
        let Some(value) = self.fields.next() else {
            return Err(self.error(&format!("its {field} is missing")));
        };
        value
            .parse()
            .map_err(|_| self.error(&format!("its {field} `{value}` cannot be read")))
    }

    fn array<T: FromStr + Copy + Default, const N: usize>(
        &mut self,
        field: &str,
    ) -> Result<[T; N], CaptureError> {
        let mut values = [T::default(); N];
        for value in &mut values {
            *value = self.next(field)?;
        }
        Ok(values)
    }

    fn error(&self, reason: &str) -> CaptureError {
        CaptureError::BadRecord {
            path: self.path.to_path_buf(),
            record: format!("line {}", self.line + 1),
            reason: reason.to_owned(),
        }
    }
}
