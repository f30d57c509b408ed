//! COLMAP's text files: one record per line (two for an image), fields separated by blanks,
//! comments after `#`.
//!
//! Comments may be in any encoding; records must be UTF-8, since a name in another encoding matches
//! no file. Reading takes less than 32 times the memory of the file.

use std::path::Path;
use std::str::{FromStr, SplitAsciiWhitespace};

use super::colmap_models::{MOST_PARAMETERS, by_name};
use super::colmap_records::{ColmapCamera, ColmapImage, ColmapKeypoint, ColmapPoint};
use super::{CaptureError, CaptureWarning, Point};
use crate::text::{Excerpt, lines, without_mark};

/// The records of a file, and the count announced by the comments at its head.
#[derive(Debug)]
pub(super) struct Listed<T> {
    pub records: Vec<T>,
    pub announced: Option<u64>,
}

impl<T> Listed<T> {
    /// The records, with a warning if their number differs from the announced one. `what` names
    /// them in the plural.
    pub fn checked(
        self,
        path: &Path,
        what: &'static str,
        warnings: &mut Vec<CaptureWarning>,
    ) -> Vec<T> {
        let read = self.records.len();
        if let Some(announced) = self.announced.filter(|&count| count != read as u64) {
            warnings.push(CaptureWarning::Miscounted {
                path: path.to_path_buf(),
                what,
                announced,
                read,
            });
        }
        self.records
    }
}

/// Parses `cameras.txt`: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]`. `path` is used in messages.
pub(super) fn parse_cameras(
    path: &Path,
    text: &[u8],
) -> Result<Listed<ColmapCamera>, CaptureError> {
    let file = File::new(path, text)?;
    let camera = |mut fields: Fields<'_>| {
        let id = fields.next("camera id")?;
        let model: String = fields.next("model")?;
        let layout =
            by_name(&model).map_err(|model| CaptureError::unsupported_camera(path, id, model))?;
        let size = [fields.next("width")?, fields.next("height")?];
        let count = layout.parameters();
        let given = fields.fields.clone().count();
        if given != count {
            return Err(fields.error(&format!(
                "the camera model {model} of camera {id} has {count} parameters, but the line gives {given}"
            )));
        }
        let mut values = [0.0; MOST_PARAMETERS];
        let values = &mut values[..count];
        for value in &mut *values {
            *value = fields.next("parameters")?;
        }
        Ok(ColmapCamera::new(id, size, layout, values))
    };
    Ok(Listed {
        records: file
            .records()
            .map(|fields| camera(fields?))
            .collect::<Result<_, _>>()?,
        announced: file.announced("cameras"),
    })
}

/// Parses `images.txt`: `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, followed by a line of
/// keypoints, `X Y POINT3D_ID` any number of times, which is skipped unless `keypoints` are asked
/// for. The name extends to the end of its line, blanks included. `path` is used in messages.
///
/// The line of keypoints may be empty, and some programs omit it then. Each line is therefore
/// classified by its contents: keypoints are numbers only, in triples, which an image with a name
/// is not. An ambiguous line (a name that is a number, or keypoints that look like ids) counts as
/// keypoints if it follows an image.
pub(super) fn parse_images(
    path: &Path,
    text: &[u8],
    keypoints: bool,
) -> Result<Listed<ColmapImage>, CaptureError> {
    /// State after the last non-blank line, and an empty one after it.
    #[derive(PartialEq)]
    enum Next {
        Keypoints,
        Either,
        Image,
    }
    let file = File::new(path, text)?;
    let mut records: Vec<ColmapImage> = Vec::new();
    let mut next = Next::Image;
    for fields in file.lines() {
        let fields = fields?;
        if fields.record.is_empty() {
            if next == Next::Keypoints {
                next = Next::Either;
            }
            continue;
        }
        let image = image(fields.clone());
        let of_image = match (&image, are_keypoints(fields.record, image.is_ok())) {
            (Err(_), true) => next != Next::Image,
            (Ok(_), true) => next == Next::Keypoints,
            (_, false) => false,
        };
        match (image, of_image) {
            (_, true) => {
                next = Next::Image;
                if let (true, Some(last)) = (keypoints, records.last_mut()) {
                    last.keypoints = matched_keypoints(fields)?;
                }
            }
            (Ok(image), false) => {
                records.push(image);
                next = Next::Keypoints;
            }
            (Err(reason), false) => {
                let taken_for = if are_keypoints(fields.record, false) {
                    "keypoints that follow no image, or a damaged image"
                } else {
                    "neither an image nor the keypoints of one"
                };
                return Err(fields.error(&format!("{taken_for}: {reason}")));
            }
        }
    }
    Ok(Listed {
        records,
        announced: file.announced("images"),
    })
}

/// The image of a line, or the reason that it is none.
fn image(mut fields: Fields<'_>) -> Result<ColmapImage, String> {
    let id = fields.parsed("image id")?;
    let quaternion = fields.parsed_array("quaternion")?;
    let translation = fields.parsed_array("translation")?;
    let camera_id = fields.parsed("camera id")?;
    // Nine fields precede the name; splitting again preserves the blanks inside it.
    let name = nth_field_onwards(fields.record, 9);
    if name.is_empty() {
        return Err("its name is missing".to_owned());
    }
    Ok(ColmapImage {
        id,
        camera_id,
        name: name.to_owned(),
        quaternion,
        translation,
        keypoints: vec![],
    })
}

/// The keypoints of a line that were matched with a point. Those without one have the id -1.
fn matched_keypoints(mut fields: Fields<'_>) -> Result<Vec<ColmapKeypoint>, CaptureError> {
    let mut keypoints = Vec::new();
    while fields.fields.clone().next().is_some() {
        let position = fields.array("keypoints")?;
        let id: &str = fields.fields.clone().next().unwrap_or_default();
        // Some programs write ids as they write positions.
        let whole: f64 = fields.next("keypoints")?;
        let point_id = id.parse().ok();
        if point_id.is_none() && whole.fract() != 0.0 {
            return Err(fields.error(&format!(
                "the point id `{}` of a keypoint is not whole",
                Excerpt(id)
            )));
        }
        // The largest number below which no two ids are the same as numbers with a fraction.
        let exact = 0.0..9e15;
        let point_id = point_id.or_else(|| exact.contains(&whole).then_some(whole as u64));
        keypoints.extend(point_id.map(|point_id| ColmapKeypoint { position, point_id }));
    }
    Ok(keypoints)
}

/// True if a line is numbers only, in triples. If it might be an `image` too, every third number
/// must be whole, as ids are.
fn are_keypoints(line: &str, image: bool) -> bool {
    let is_number = |field: &str| {
        // Cheaper than parsing, and sufficient if nothing else fits the line.
        let plain = |byte: u8| byte.is_ascii_digit() || b"+-.eE".contains(&byte);
        !image && field.bytes().all(plain) || field.parse::<f64>().is_ok()
    };
    let is_whole = |field: &str| field.parse::<f64>().is_ok_and(|value| value.fract() == 0.0);
    let mut count = 0;
    for field in line.split_ascii_whitespace() {
        count += 1;
        if !is_number(field) || image && count % 3 == 0 && !is_whole(field) {
            return false;
        }
    }
    count % 3 == 0
}

/// Parses `points3D.txt`: `POINT3D_ID X Y Z R G B ERROR TRACK[]`. The track, pairs of an image id
/// and a keypoint's index, is skipped; track and error are optional. `path` is used in messages.
pub(super) fn parse_points(path: &Path, text: &[u8]) -> Result<Listed<ColmapPoint>, CaptureError> {
    let file = File::new(path, text)?;
    let point = |mut fields: Fields<'_>| {
        let id = fields.next("point id")?;
        let position = fields.array("position")?;
        let color = fields.array("colour")?;
        if fields.fields.clone().next().is_some() {
            let _: f64 = fields.next("error")?;
        }
        if !fields.fields.clone().count().is_multiple_of(2) {
            return Err(fields.error("its track is no list of pairs; is the line cut off?"));
        }
        let point = Point { position, color };
        Ok(ColmapPoint { id, point })
    };
    Ok(Listed {
        records: file
            .records()
            .map(|fields| point(fields?))
            .collect::<Result<_, _>>()?,
        announced: file.announced("points"),
    })
}

/// Rest of `line` after its first `count` fields, trimmed.
fn nth_field_onwards(line: &str, count: usize) -> &str {
    (0..count)
        .fold(line.trim_ascii_start(), |rest, _| {
            let end = rest.find(|c: char| c.is_ascii_whitespace());
            rest[end.unwrap_or(rest.len())..].trim_ascii_start()
        })
        .trim_ascii_end()
}

/// A text file in memory.
struct File<'a> {
    path: &'a Path,
    text: &'a [u8],
}

impl<'a> File<'a> {
    fn new(path: &'a Path, bytes: &'a [u8]) -> Result<Self, CaptureError> {
        let text = without_mark(bytes).map_err(|reason| CaptureError::NotText {
            path: path.to_path_buf(),
            reason,
        })?;
        Ok(Self { path, text })
    }

    /// Lines that are not comments, including empty ones.
    fn lines(&self) -> impl Iterator<Item = Result<Fields<'a>, CaptureError>> {
        let path = self.path;
        let lines = lines(self.text).filter(|(_, line)| !line.starts_with(b"#"));
        lines.map(move |(line, bytes)| match std::str::from_utf8(bytes) {
            Ok(record) => Ok(Fields::new(path, line, record)),
            Err(error) => {
                let from = bytes[..error.valid_up_to()]
                    .iter()
                    .rposition(u8::is_ascii_whitespace);
                let odd = bytes[from.map_or(0, |at| at + 1)..].escape_ascii();
                let odd: String = odd.take(80).map(char::from).collect();
                let reason = format!("`{odd}` is not UTF-8 text; save the file as UTF-8");
                Err(Fields::new(path, line, "").error(&reason))
            }
        })
    }

    /// Lines that contain a record.
    fn records(&self) -> impl Iterator<Item = Result<Fields<'a>, CaptureError>> {
        let is_record = |fields: &Result<Fields<'_>, _>| match fields {
            Ok(fields) => !fields.record.is_empty(),
            Err(_) => true,
        };
        self.lines().filter(is_record)
    }

    /// The number in the first comment like `# Number of images: 15, mean observations per image:
    /// 812`.
    fn announced(&self, what: &str) -> Option<u64> {
        let mut comments = lines(self.text).filter(|(_, line)| line.starts_with(b"#"));
        comments.find_map(|(_, line)| {
            let line = String::from_utf8_lossy(line).to_ascii_lowercase();
            let (_, rest) = line.split_once(&format!("number of {what}:"))?;
            let rest = rest.trim_ascii_start();
            let end = rest
                .find(|c: char| !c.is_ascii_digit())
                .unwrap_or(rest.len());
            rest[..end].parse().ok()
        })
    }
}

/// The fields of one line.
#[derive(Clone)]
struct Fields<'a> {
    path: &'a Path,
    line: usize,
    record: &'a str,
    fields: SplitAsciiWhitespace<'a>,
}

impl<'a> Fields<'a> {
    fn new(path: &'a Path, line: usize, record: &'a str) -> Self {
        Self {
            path,
            line,
            record,
            fields: record.split_ascii_whitespace(),
        }
    }

    fn next<T: FromStr>(&mut self, field: &str) -> Result<T, CaptureError> {
        self.parsed(field).map_err(|reason| self.error(&reason))
    }

    fn array<T: FromStr + Copy + Default, const N: usize>(
        &mut self,
        field: &str,
    ) -> Result<[T; N], CaptureError> {
        self.parsed_array(field)
            .map_err(|reason| self.error(&reason))
    }

    /// The next field, or the reason that it cannot be read.
    fn parsed<T: FromStr>(&mut self, field: &str) -> Result<T, String> {
        let Some(value) = self.fields.next() else {
            return Err(format!("its {field} is missing"));
        };
        let unreadable = |_| format!("its {field} `{}` cannot be read", Excerpt(value));
        value.parse().map_err(unreadable)
    }

    fn parsed_array<T: FromStr + Copy + Default, const N: usize>(
        &mut self,
        field: &str,
    ) -> Result<[T; N], String> {
        let mut values = [T::default(); N];
        for value in &mut values {
            *value = self.parsed(field)?;
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

#[cfg(test)]
mod tests;
