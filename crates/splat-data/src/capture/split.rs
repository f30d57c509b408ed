//! The split into training and held-out views.

use std::collections::{HashMap, HashSet};
use std::path::Path;

use super::sparse_model::NamedSplit;
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

    /// The split named by `split.json` in `root`, or else the format's own, or else the default
    /// one. `names` are the photos' names, sorted.
    pub(super) fn of_capture(
        root: &Path,
        names: &[&str],
        own: Option<&NamedSplit>,
        warnings: &mut Vec<CaptureWarning>,
    ) -> Result<Self, CaptureError> {
        let path = root.join("split.json");
        if path.exists() {
            return Self::named(&path, names, &from_json(&path)?, warnings);
        }
        match own {
            Some(own) => Self::named(root, names, own, warnings),
            None => Ok(Self::every_eighth(names.len())),
        }
    }

    /// The split of a list of names. `path` is used in messages.
    fn named(
        path: &Path,
        names: &[&str],
        lists: &NamedSplit,
        warnings: &mut Vec<CaptureWarning>,
    ) -> Result<Self, CaptureError> {
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
                    Some(_) => return Err(bad(path, format!("names the photo `{name}` twice"))),
                    None => unknown.push(name.clone()),
                }
            }
            indices.sort_unstable();
            Ok(indices)
        };
        let test = indices(&lists.test)?;
        let train = match &lists.train {
            Some(list) => indices(list)?,
            None => (0..names.len()).filter(|i| !test.contains(i)).collect(),
        };
        if let Some(first) = unknown.first() {
            warnings.push(CaptureWarning::SplitNamesUnknown {
                source: lists.source.clone(),
                count: unknown.len(),
                first: first.clone(),
            });
        }
        let left_out = |index: &usize| lists.train.is_some() && !seen.contains(index);
        if let Some(first) = (0..names.len()).find(left_out) {
            warnings.push(CaptureWarning::SplitLeavesOut {
                source: lists.source.clone(),
                count: (0..names.len()).filter(left_out).count(),
                first: names[first].to_owned(),
            });
        }
        Ok(Self { train, test })
    }
}

fn bad(path: &Path, reason: String) -> CaptureError {
    CaptureError::BadSplit {
        path: path.to_path_buf(),
        reason,
    }
}

/// The lists of a `split.json`.
fn from_json(path: &Path) -> Result<NamedSplit, CaptureError> {
    let bytes = std::fs::read(path).map_err(|error| bad(path, error.to_string()))?;
    let text = without_mark(&bytes).map_err(|reason| bad(path, reason.to_owned()))?;
    let file: SplitFile = serde_json::from_slice(text).map_err(|error| {
        bad(
            path,
            format!(
                "not a split (an object with the lists `train` and `test` of photo names): {error}"
            ),
        )
    })?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    Ok(NamedSplit {
        source: name.into_owned(),
        train: Some(file.train),
        test: file.test,
    })
}
