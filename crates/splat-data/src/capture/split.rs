//! The split into training and held-out views.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use super::sparse_model::NamedSplit;
use super::{CaptureError, CaptureWarning};
use crate::text::{lines, utf8};

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

/// Which views are held out of training.
///
/// ```
/// use splat_data::{Capture, CaptureSettings, SplitRule};
///
/// # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
/// let options = CaptureSettings::new()
///     .with_downscale(16)
///     .with_split(SplitRule::Every(0));
/// let capture = Capture::load(folder, &options)?;
/// assert_eq!(capture.split.train.len(), capture.views.len());
/// # Ok::<(), splat_data::CaptureError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum SplitRule {
    /// What the capture says: its `split.json`, or else its format's own split (Blender's files, or
    /// `train_filenames`, `test_filenames` and `val_filenames`), or else every 8th view by name
    /// from the first.
    #[default]
    OfCapture,
    /// Every k-th view by name, from the first; none for 0.
    Every(usize),
    /// The views of these names. Names that the capture does not have are a warning, or an error if
    /// it has none of them.
    Names(Vec<String>),
    /// The views that a file names, relative to the working directory: a file like `split.json`
    /// with the lists `train` and `test`, or a text of one held-out name per line, in which empty
    /// lines and those after `#` are comments.
    File(PathBuf),
}

/// The lists of a split in messages: of training photos, and of held-out ones.
type ListNames = [&'static str; 2];

/// Those of `split.json`.
const OF_SPLIT_FILE: ListNames = ["`train`", "`test`"];

/// Those of a capture's own split, which only `transforms.json` has.
const OF_TRANSFORMS: ListNames = [
    "`train_filenames`",
    "`test_filenames` (or `val_filenames`, if they take its place)",
];

/// `split.json`: two lists of photo names. Other keys (such as `rule`) are comments.
#[derive(serde::Deserialize)]
struct SplitFile {
    train: Vec<String>,
    test: Vec<String>,
}

impl Split {
    /// The default split of `count` views sorted by name: every 8th from the first is held out.
    pub fn every_eighth(count: usize) -> Self {
        Self::every(count, HOLD_OUT_EVERY)
    }

    /// Every `interval`-th of `count` views sorted by name is held out, from the first; none if
    /// `interval` is 0.
    pub fn every(count: usize, interval: usize) -> Self {
        let held_out = |&index: &usize| interval > 0 && index.is_multiple_of(interval);
        let (test, train) = (0..count).partition(held_out);
        Self { train, test }
    }

    /// The split by this rule. `names` are the photos' names, sorted, and `own` is the split of the
    /// capture's format.
    pub(super) fn by_rule(
        rule: &SplitRule,
        root: &Path,
        names: &[&str],
        own: Option<&NamedSplit>,
        warnings: &mut Vec<CaptureWarning>,
    ) -> Result<Self, CaptureError> {
        let usual = root.join("split.json");
        match rule {
            SplitRule::Every(interval) => Ok(Self::every(names.len(), *interval)),
            SplitRule::Names(held_out) => {
                let lists = NamedSplit {
                    source: "the list of held-out photos".to_owned(),
                    train: None,
                    test: held_out.clone(),
                };
                Self::requested(root, names, &lists, warnings)
            }
            SplitRule::File(path) => Self::requested(path, names, &read(path)?, warnings),
            SplitRule::OfCapture if usual.exists() => {
                Self::named(&usual, names, &read(&usual)?, OF_SPLIT_FILE, warnings)
            }
            SplitRule::OfCapture => match own {
                Some(own) => {
                    let file = root.join(&own.source);
                    Self::named(&file, names, own, OF_TRANSFORMS, warnings)
                }
                None => Ok(Self::every_eighth(names.len())),
            },
        }
    }

    /// A split that was asked for, which therefore must fit at least one photo.
    fn requested(
        path: &Path,
        names: &[&str],
        lists: &NamedSplit,
        warnings: &mut Vec<CaptureWarning>,
    ) -> Result<Self, CaptureError> {
        let known: HashSet<&str> = names.iter().copied().collect();
        match lists.test.first() {
            Some(first) if !lists.test.iter().any(|name| known.contains(name.as_str())) => {
                Err(bad(
                    path,
                    format!(
                        "the capture has none of the {} held-out photo(s), from `{first}`; names are as in the capture, such as `{}`",
                        lists.test.len(),
                        names.first().unwrap_or(&"")
                    ),
                ))
            }
            _ => Self::named(path, names, lists, OF_SPLIT_FILE, warnings),
        }
    }

    /// The split of a list of names. `path` and `called` are used in messages.
    fn named(
        path: &Path,
        names: &[&str],
        lists: &NamedSplit,
        called: ListNames,
        warnings: &mut Vec<CaptureWarning>,
    ) -> Result<Self, CaptureError> {
        let index_of: HashMap<&str, usize> = names
            .iter()
            .enumerate()
            .map(|(i, &name)| (name, i))
            .collect();
        let [of_train, of_test] = called;
        // The list in which a photo is.
        let mut list_of: HashMap<usize, &str> = HashMap::new();
        let mut unknown: Vec<String> = Vec::new();
        let mut indices = |list: &[String], called: &'static str| {
            let mut indices = Vec::with_capacity(list.len());
            for name in list {
                let Some(&index) = index_of.get(name.as_str()) else {
                    unknown.push(name.clone());
                    continue;
                };
                if let Some(other) = list_of.insert(index, called) {
                    return Err(bad(path, twice(name, called, other)));
                }
                indices.push(index);
            }
            indices.sort_unstable();
            Ok(indices)
        };
        let test = indices(&lists.test, of_test)?;
        let train = lists.train.as_deref();
        let train = train.map(|list| indices(list, of_train)).transpose()?;
        if let Some(first) = unknown.first() {
            warnings.push(CaptureWarning::SplitNamesUnknown {
                source: lists.source.clone(),
                count: unknown.len(),
                first: first.clone(),
            });
        }
        let rest: Vec<usize> = (0..names.len())
            .filter(|i| !list_of.contains_key(i))
            .collect();
        let Some(train) = train else {
            return Ok(Self { train: rest, test });
        };
        if let Some(&first) = rest.first() {
            warnings.push(CaptureWarning::SplitLeavesOut {
                source: lists.source.clone(),
                count: rest.len(),
                first: names[first].to_owned(),
            });
        }
        Ok(Self { train, test })
    }
}

/// Why a photo in these two lists, which may be one, is refused.
fn twice(name: &str, list: &str, other: &str) -> String {
    if list == other {
        return format!("names the photo `{name}` twice");
    }
    format!(
        "names the photo `{name}` both in {list} and in {other}; remove it from one of them, since it is either for training or held out"
    )
}

fn bad(path: &Path, reason: String) -> CaptureError {
    CaptureError::BadSplit {
        path: path.to_path_buf(),
        reason,
    }
}

/// The lists of a file: of JSON by its name or its first character, or else of names in lines.
fn read(path: &Path) -> Result<NamedSplit, CaptureError> {
    let bytes = std::fs::read(path).map_err(|error| bad(path, error.to_string()))?;
    let text = utf8(&bytes).map_err(|reason| bad(path, reason))?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let is_json = path
        .extension()
        .is_some_and(|ending| ending.eq_ignore_ascii_case("json"));
    let (train, test) = if is_json || text.trim_start().starts_with('{') {
        let file: SplitFile = serde_json::from_str(text).map_err(|error| {
            bad(
                path,
                format!(
                    "not a split (an object with the lists `train` and `test` of photo names): {error}"
                ),
            )
        })?;
        (Some(file.train), file.test)
    } else {
        let lines = lines(text.as_bytes()).filter(|(_, line)| !line.is_empty());
        let named = lines.filter(|(_, line)| !line.starts_with(b"#"));
        let name = |(_, line): (usize, &[u8])| String::from_utf8_lossy(line).into_owned();
        (None, named.map(name).collect())
    };
    Ok(NamedSplit {
        source: name.into_owned(),
        train,
        test,
    })
}
