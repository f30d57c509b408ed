//! One JSON file: its frames, each with its camera and pose, and what it says about all of them.

use std::path::{Path, PathBuf};

use serde_json::Value;
use splat_core::Lens;

use super::super::CaptureError;
use super::super::sparse_model::{Intrinsics, NamedSplit};
use super::fields::{Fields, record, shown};
use super::{camera, paths, pose};
use crate::text::utf8;

/// The contents of a file.
pub(super) struct Document {
    pub path: PathBuf,
    /// Never empty.
    pub frames: Vec<Frame>,
    /// `ply_file_path`.
    pub points: Option<String>,
    pub lists: Option<Lists>,
    /// True for a synthetic capture, rendered by Blender.
    pub blender: bool,
    /// True if it has `fisheye_crop_radius`.
    pub crop_radius: bool,
}

/// One photo.
pub(super) struct Frame {
    pub index: usize,
    /// `file_path`, not empty.
    pub file: String,
    pub intrinsics: Intrinsics,
    pub lens: Lens,
    /// World to camera, row-major 4x4.
    pub viewmat: [[f64; 4]; 4],
    pub mask: Option<String>,
    pub depth: Option<String>,
}

impl Frame {
    /// Description for messages.
    pub fn record(&self) -> String {
        let mut map = serde_json::Map::new();
        map.insert("file_path".to_owned(), Value::from(self.file.as_str()));
        record(Some(self.index), &map)
    }
}

/// `train_filenames`, `val_filenames` and `test_filenames`, of which at least one is there.
#[derive(Clone, Default)]
pub(super) struct Lists {
    train: Option<Vec<String>>,
    val: Option<Vec<String>>,
    test: Option<Vec<String>>,
}

impl Lists {
    /// The split by view names. `root` is the folder of the file, `photos` that of the views'
    /// names.
    pub fn split(&self, source: &str, root: &Path, photos: &Path) -> NamedSplit {
        let named = |list: &Vec<String>| {
            let name = |file: &String| paths::name_in(root, photos, file);
            list.iter().map(name).collect()
        };
        let test = self.test.as_ref().filter(|list| !list.is_empty());
        NamedSplit {
            source: source.to_owned(),
            train: self.train.as_ref().map(named),
            test: test.or(self.val.as_ref()).map(named).unwrap_or_default(),
        }
    }
}

impl Document {
    /// Reads and checks a file; `path` is used in messages.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, CaptureError> {
        let bad = |reason: String| CaptureError::BadTransforms {
            path: path.to_path_buf(),
            reason,
        };
        let text = utf8(bytes).map_err(bad)?;
        let value: Value = serde_json::from_str(text).map_err(|error| {
            // Python writes these, and JSON has none of them.
            let odd = ["NaN", "Infinity"]
                .into_iter()
                .find(|word| text.contains(word));
            let hint = odd.map_or_else(String::new, |word| format!("; JSON has no {word}"));
            bad(format!("no JSON ({error}){hint}"))
        })?;
        let Value::Object(map) = &value else {
            return Err(bad(format!(
                "{} instead of an object with `frames`",
                shown(&value)
            )));
        };
        let top = Fields {
            path,
            frame: None,
            map,
        };
        let listed = top.list("frames")?.unwrap_or_default();
        if listed.is_empty() {
            return Err(top.error("its list `frames` is missing or empty: it names no photo"));
        }
        let mut frames = Vec::with_capacity(listed.len());
        for (index, value) in listed.iter().enumerate() {
            let Value::Object(map) = value else {
                let reason = format!("frames[{index}] is {}, no object", shown(value));
                return Err(top.error(&reason));
            };
            let fields = Fields {
                path,
                frame: Some(index),
                map,
            };
            frames.push(frame(&top, &fields, index)?);
        }
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        let measured = |key: &str| top.get(key).is_some();
        let blender = stem.starts_with("transforms_")
            && measured("camera_angle_x")
            && !["fl_x", "fl_y", "w", "h"].into_iter().any(measured);
        Ok(Self {
            frames,
            points: owned(top.text("ply_file_path")?),
            lists: lists(&top)?,
            blender,
            crop_radius: measured("fisheye_crop_radius"),
            path: path.to_path_buf(),
        })
    }
}

fn frame(top: &Fields<'_>, fields: &Fields<'_>, index: usize) -> Result<Frame, CaptureError> {
    let file = fields.text("file_path")?.unwrap_or_default();
    if file.is_empty() {
        return Err(fields.error("its file_path is missing"));
    }
    let model = camera::Model::read(top, fields)?;
    Ok(Frame {
        index,
        file: file.to_owned(),
        intrinsics: camera::intrinsics(top, fields)?,
        lens: camera::lens(top, fields, model)?,
        viewmat: pose::viewmat(fields)?,
        mask: owned(fields.text("mask_path")?),
        depth: owned(fields.text("depth_file_path")?),
    })
}

fn owned(text: Option<&str>) -> Option<String> {
    text.filter(|text| !text.is_empty()).map(str::to_owned)
}

fn lists(top: &Fields<'_>) -> Result<Option<Lists>, CaptureError> {
    let list = |field: &str| -> Result<Option<Vec<String>>, CaptureError> {
        let Some(values) = top.list(field)? else {
            return Ok(None);
        };
        let name = |value: &Value| match value.as_str() {
            Some(name) => Ok(name.to_owned()),
            None => Err(top.error(&format!("its {field} has {}, no text", shown(value)))),
        };
        values.iter().map(name).collect::<Result<_, _>>().map(Some)
    };
    let lists = Lists {
        train: list("train_filenames")?,
        val: list("val_filenames")?,
        test: list("test_filenames")?,
    };
    let any = [&lists.train, &lists.val, &lists.test];
    let any = any.into_iter().flatten().any(|list| !list.is_empty());
    Ok(any.then_some(lists))
}
