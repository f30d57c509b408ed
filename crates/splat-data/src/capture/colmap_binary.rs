//! COLMAP's binary files: little endian, packed, every list preceded by its length.
//!
//! Every length is checked against the rest of the file before anything is allocated for it. A
//! truncated or damaged file is an error, never a panic or a huge allocation.

use std::fmt::Display;
use std::path::Path;

use super::colmap_models::{MOST_PARAMETERS, by_number};
use super::colmap_records::{ColmapCamera, ColmapImage, ColmapKeypoint, ColmapPoint};
use super::{CaptureError, Point};

/// Bytes of a camera record up to its parameters, of the shortest image record, and of the shortest
/// point record.
const MIN_CAMERA: usize = 4 + 4 + 8 + 8;
const MIN_IMAGE: usize = 4 + 7 * 8 + 4 + 1 + 8;
const MIN_POINT: usize = 8 + 3 * 8 + 3 + 8 + 8;
/// Bytes of one keypoint (x, y, point id) and of one track entry (image id, keypoint index).
const KEYPOINT: usize = 8 + 8 + 8;
const TRACK_ENTRY: usize = 4 + 4;

/// The point of a keypoint that has none.
const NO_POINT: u64 = u64::MAX;

/// Reads `cameras.bin`.
pub(super) fn parse_cameras(path: &Path, bytes: &[u8]) -> Result<Vec<ColmapCamera>, CaptureError> {
    let mut reader = Reader::new(path, bytes);
    reader.records("camera", "cameras", MIN_CAMERA, |reader, record| {
        let id = reader.u32(record, "id")?;
        let layout = by_number(reader.i32(record, "model")?)
            .map_err(|model| CaptureError::unsupported_camera(path, id, model))?;
        let width = reader.size(record, "width")?;
        let height = reader.size(record, "height")?;
        let mut values = [0.0; MOST_PARAMETERS];
        let values = &mut values[..layout.parameters()];
        for value in &mut *values {
            *value = reader.f64(record, "parameters")?;
        }
        Ok(ColmapCamera::new(id, [width, height], layout, values))
    })
}

/// The number of images that the `head` of an `images.bin` of this length announces.
pub(super) fn count_images(path: &Path, head: &[u8], length: u64) -> Result<u64, CaptureError> {
    let count = Reader::new(path, head).u64(FILE, "count")?;
    let remaining = length.saturating_sub(head.len() as u64);
    if count > remaining / MIN_IMAGE as u64 {
        return Err(CaptureError::ImpossibleCount {
            path: path.to_path_buf(),
            record: FILE.to_string(),
            what: "images",
            count,
            remaining: usize::try_from(remaining).unwrap_or(usize::MAX),
        });
    }
    Ok(count)
}

/// Reads `images.bin`; the keypoints are skipped unless they are asked for.
pub(super) fn parse_images(
    path: &Path,
    bytes: &[u8],
    keypoints: bool,
) -> Result<Vec<ColmapImage>, CaptureError> {
    let mut reader = Reader::new(path, bytes);
    reader.records("image", "images", MIN_IMAGE, |reader, record| {
        let id = reader.u32(record, "id")?;
        let quaternion = reader.f64s(record, "quaternion")?;
        let translation = reader.f64s(record, "translation")?;
        let camera_id = reader.u32(record, "camera id")?;
        let name = reader.name(record)?;
        let keypoints = match keypoints {
            true => reader.keypoints(record)?,
            false => {
                reader.skip_list(record, "keypoints", KEYPOINT)?;
                vec![]
            }
        };
        Ok(ColmapImage {
            id,
            camera_id,
            name,
            quaternion,
            translation,
            keypoints,
        })
    })
}

/// Reads `points3D.bin`; the tracks are skipped, since the images' keypoints say the same.
pub(super) fn parse_points(path: &Path, bytes: &[u8]) -> Result<Vec<ColmapPoint>, CaptureError> {
    let mut reader = Reader::new(path, bytes);
    reader.records("point", "points", MIN_POINT, |reader, record| {
        let id = reader.u64(record, "id")?;
        let position = reader.f64s(record, "position")?;
        let color = reader.take::<3>(record, "colour")?;
        reader.take::<8>(record, "error")?;
        reader.skip_list(record, "track entries", TRACK_ENTRY)?;
        let point = Point { position, color };
        Ok(ColmapPoint { id, point })
    })
}

/// The record being read, for messages; formatted only on error.
#[derive(Clone, Copy)]
struct Record {
    kind: &'static str,
    index: usize,
    count: usize,
}

impl Display for Record {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.kind.is_empty() {
            write!(f, "the file")
        } else {
            write!(f, "{} {} of {}", self.kind, self.index + 1, self.count)
        }
    }
}

/// The file itself as a record: the count at its start.
const FILE: Record = Record {
    kind: "",
    index: 0,
    count: 0,
};

/// A cursor over the bytes of a file.
struct Reader<'a> {
    path: &'a Path,
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    fn new(path: &'a Path, bytes: &'a [u8]) -> Self {
        Self { path, rest: bytes }
    }

    /// Reads a count and that many records, after which the file must end.
    fn records<T>(
        &mut self,
        kind: &'static str,
        kinds: &'static str,
        min_size: usize,
        mut read: impl FnMut(&mut Self, Record) -> Result<T, CaptureError>,
    ) -> Result<Vec<T>, CaptureError> {
        let count = self.list_len(FILE, kinds, min_size)?;
        let records = (0..count)
            .map(|index| read(self, Record { kind, index, count }))
            .collect::<Result<_, _>>()?;
        if !self.rest.is_empty() {
            return Err(CaptureError::LeftOver {
                path: self.path.to_path_buf(),
                count,
                what: kinds,
                remaining: self.rest.len(),
            });
        }
        Ok(records)
    }

    fn take<const N: usize>(
        &mut self,
        record: Record,
        field: &'static str,
    ) -> Result<[u8; N], CaptureError> {
        let Some((head, rest)) = self.rest.split_first_chunk() else {
            return Err(self.truncated(record, field));
        };
        self.rest = rest;
        Ok(*head)
    }

    fn u32(&mut self, record: Record, field: &'static str) -> Result<u32, CaptureError> {
        self.take(record, field).map(u32::from_le_bytes)
    }

    fn i32(&mut self, record: Record, field: &'static str) -> Result<i32, CaptureError> {
        self.take(record, field).map(i32::from_le_bytes)
    }

    fn u64(&mut self, record: Record, field: &'static str) -> Result<u64, CaptureError> {
        self.take(record, field).map(u64::from_le_bytes)
    }

    fn f64(&mut self, record: Record, field: &'static str) -> Result<f64, CaptureError> {
        self.take(record, field).map(f64::from_le_bytes)
    }

    fn f64s<const N: usize>(
        &mut self,
        record: Record,
        field: &'static str,
    ) -> Result<[f64; N], CaptureError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64(record, field)?;
        }
        Ok(values)
    }

    /// A width or height: stored in 64 bits, of which 32 make sense.
    fn size(&mut self, record: Record, field: &'static str) -> Result<u32, CaptureError> {
        let value = self.u64(record, field)?;
        u32::try_from(value).map_err(|_| CaptureError::BadRecord {
            path: self.path.to_path_buf(),
            record: record.to_string(),
            reason: format!("its {field} is {value} pixels"),
        })
    }

    /// A length that fits into the rest of the file, at `min_size` bytes per entry.
    fn list_len(
        &mut self,
        record: Record,
        what: &'static str,
        min_size: usize,
    ) -> Result<usize, CaptureError> {
        let count = self.u64(record, "count")?;
        let room = self.rest.len() / min_size;
        match usize::try_from(count) {
            Ok(len) if len <= room => Ok(len),
            _ => Err(CaptureError::ImpossibleCount {
                path: self.path.to_path_buf(),
                record: record.to_string(),
                what,
                count,
                remaining: self.rest.len(),
            }),
        }
    }

    fn skip_list(
        &mut self,
        record: Record,
        what: &'static str,
        entry: usize,
    ) -> Result<(), CaptureError> {
        let len = self.list_len(record, what, entry)?;
        self.rest = &self.rest[len * entry..];
        Ok(())
    }

    /// The keypoints of an image that were matched with a point.
    fn keypoints(&mut self, record: Record) -> Result<Vec<ColmapKeypoint>, CaptureError> {
        let len = self.list_len(record, "keypoints", KEYPOINT)?;
        let mut keypoints = Vec::new();
        for _ in 0..len {
            let position = self.f64s(record, "keypoints")?;
            let point_id = self.u64(record, "keypoints")?;
            if point_id != NO_POINT {
                keypoints.push(ColmapKeypoint { position, point_id });
            }
        }
        Ok(keypoints)
    }

    /// A name terminated by a zero byte.
    fn name(&mut self, record: Record) -> Result<String, CaptureError> {
        let Some(end) = self.rest.iter().position(|&byte| byte == 0) else {
            return Err(self.truncated(record, "name"));
        };
        let name = &self.rest[..end];
        self.rest = &self.rest[end + 1..];
        match std::str::from_utf8(name) {
            Ok(name) if !name.is_empty() => Ok(name.to_owned()),
            _ => Err(CaptureError::BadRecord {
                path: self.path.to_path_buf(),
                record: record.to_string(),
                reason: format!("its name `{}` is no text", name.escape_ascii()),
            }),
        }
    }

    fn truncated(&self, record: Record, field: &'static str) -> CaptureError {
        CaptureError::Truncated {
            path: self.path.to_path_buf(),
            record: record.to_string(),
            field,
        }
    }
}
