//! The fields of an object in a JSON file, with their place in messages.

use std::path::Path;

use serde_json::{Map, Value};

use super::super::CaptureError;
use crate::text::Excerpt;

/// An object of a file. A field that is `null` counts as missing.
#[derive(Clone, Copy)]
pub(super) struct Fields<'a> {
    pub path: &'a Path,
    /// Index of the frame; `None` for the object of the whole file.
    pub frame: Option<usize>,
    pub map: &'a Map<String, Value>,
}

impl<'a> Fields<'a> {
    pub fn get(&self, field: &str) -> Option<&'a Value> {
        self.map.get(field).filter(|value| !value.is_null())
    }

    /// A finite number.
    pub fn number(&self, field: &str) -> Result<Option<f64>, CaptureError> {
        let Some(value) = self.get(field) else {
            return Ok(None);
        };
        match value.as_f64().filter(|number| number.is_finite()) {
            Some(number) => Ok(Some(number)),
            None => Err(self.error(&format!("its {field} is {}, no number", shown(value)))),
        }
    }

    /// A truth value, for which some programs write 1 or 0.
    pub fn flag(&self, field: &str) -> Result<Option<bool>, CaptureError> {
        let Some(value) = self.get(field) else {
            return Ok(None);
        };
        let flag = match value.as_f64() {
            Some(0.0) => Some(false),
            Some(1.0) => Some(true),
            _ => value.as_bool(),
        };
        match flag {
            Some(flag) => Ok(Some(flag)),
            None => Err(self.error(&format!(
                "its {field} is {}, neither true nor false",
                shown(value)
            ))),
        }
    }

    pub fn text(&self, field: &str) -> Result<Option<&'a str>, CaptureError> {
        let Some(value) = self.get(field) else {
            return Ok(None);
        };
        match value.as_str() {
            Some(text) => Ok(Some(text)),
            None => Err(self.error(&format!("its {field} is {}, no text", shown(value)))),
        }
    }

    pub fn list(&self, field: &str) -> Result<Option<&'a [Value]>, CaptureError> {
        let Some(value) = self.get(field) else {
            return Ok(None);
        };
        match value.as_array() {
            Some(list) => Ok(Some(list)),
            None => Err(self.error(&format!("its {field} is {}, no list", shown(value)))),
        }
    }

    pub fn error(&self, reason: &str) -> CaptureError {
        CaptureError::BadRecord {
            path: self.path.to_path_buf(),
            record: record(self.frame, self.map),
            reason: reason.to_owned(),
        }
    }
}

/// Description of a frame by its index, counted from 0 as in the file, and its photo.
pub(super) fn record(frame: Option<usize>, map: &Map<String, Value>) -> String {
    match (frame, map.get("file_path").and_then(Value::as_str)) {
        (None, _) => "the top level".to_owned(),
        (Some(index), None) => format!("frames[{index}]"),
        (Some(index), Some(file)) => format!("frames[{index}] (`{}`)", Excerpt(file)),
    }
}

/// A value in a message, shortened.
pub(super) fn shown(value: &Value) -> String {
    match value {
        Value::Object(_) => "an object".to_owned(),
        Value::Array(_) => "a list".to_owned(),
        Value::String(text) => format!("the text `{}`", Excerpt(text)),
        other => other.to_string(),
    }
}
