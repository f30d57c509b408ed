//! The split into training and held-out views.

use std::collections::{HashMap, HashSet};
use std::path::Path;

use super::{CaptureError, CaptureWarning};
use crate::text::without_mark;

/// Default interval of held-out views.
const HOLD_OUT_EVERY: usize = 8;

/// Ascending indices into the views of a capture.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Split {
    /// Training views.
    pub train: Vec<usize>,
    /// Held-out views.
    pub test: Vec<usize>,
}

/// `split.json`: two lists of photo names. Other keys (such as `rule`) are comments.
#[derive(serde::Deserialize)]
struct SplitFile {
    train: Vec<String>,
    test: Vec<String>,
}

impl Split {
    /// The default split of `count` views sorted by name: every 8th from the first is held out.
    pub fn every_eighth(count: usize) -> Self {
        let (test, train) = (0..count).partition(|index| index % HOLD_OUT_EVERY == 0);
        Self { train, test }
    }

    /// The split named by `split.json` in `root`, or the default one if there is no such file.
    /// `names` are the photos' names, sorted.
    pub(super) fn of_capture(
        root: &Path,
        names: &[&str],
        warnings: &mut Vec<CaptureWarning>,
    ) -> Result<Self, CaptureError> {
        let path = root.join("split.json");
        if !path.exists() {
            return Ok(Self::every_eighth(names.len()));
        }
        let bad = |reason: String| CaptureError::BadSplit {
            path: path.clone(),
            reason,
        };
        let bytes = std::fs::read(&path).map_err(|error| bad(error.to_string()))?;
        let text = without_mark(&bytes).map_err(|reason| bad(reason.to_owned()))?;
        let file: SplitFile = serde_json::from_slice(text).map_err(|error| {
            bad(format!(
                "not a split (an object with the lists `train` and `test` of photo names): {error}"
            ))
        })?;

        let index_of: HashMap<&str, usize> = names
            .iter()
            .enumerate()
            .map(|(i, &name)| (name, i))
            .collect();
        let mut seen = HashSet::new();
        let mut unknown: Vec<String> = Vec::new();
        let mut indices = |list: &[String]| -> Result<Vec<usize>, CaptureError> {
            let mut indices = Vec::with_capacity(list.len());
            for name in list {
                match index_of.get(name.as_str()) {
                    Some(&index) if seen.insert(index) => indices.push(index),
                    Some(_) => return Err(bad(format!("names the photo `{name}` twice"))),
                    None => unknown.push(name.clone()),
                }
            }
            indices.sort_unstable();
            Ok(indices)
        };
        let split = Self {
            train: indices(&file.train)?,
            test: indices(&file.test)?,
        };

        if let Some(first) = unknown.first() {
            warnings.push(CaptureWarning::SplitNamesUnknown {
                count: unknown.len(),
                first: first.clone(),
            });
        }
        let left_out = |index: &usize| !seen.contains(index);
        if let Some(first) = (0..names.len()).find(left_out) {
            warnings.push(CaptureWarning::SplitLeavesOut {
                count: (0..names.len()).filter(left_out).count(),
                first: names[first].to_owned(),
            });
        }
        Ok(split)
    }
}
