//! Names of views from the paths of a file.
//!
//! A view's name is the path of its photo from the folder that holds all photos of the capture, so
//! that no name leads out of that folder, wherever the photos are: in `images/`, in `../images`, or
//! anywhere else on the disk.

use std::path::{Component, Path, PathBuf};

use super::super::CaptureError;
use super::document::Frame;

/// Length in bytes of the longest path that systems accept.
const MOST_PATH: usize = 4096;

/// The views' names, and the folder from which they are.
pub(super) struct Placed {
    pub folder: PathBuf,
    pub names: Vec<String>,
}

/// The names of the frames, and the deepest folder that holds all their photos. `root` is the
/// folder of the file.
pub(super) fn relative<'a>(
    root: &Path,
    frames: impl Iterator<Item = (&'a Path, &'a Frame)>,
) -> Result<Placed, CaptureError> {
    let mut steps = Vec::new();
    for (file, frame) in frames {
        let bad = |reason: &str| CaptureError::BadRecord {
            path: file.to_path_buf(),
            record: frame.record(),
            reason: reason.to_owned(),
        };
        let is_odd = |c: char| c.is_control() && c != '\t';
        if frame.file.chars().any(is_odd) || frame.file.len() > MOST_PATH {
            return Err(bad("its file_path is no file's name"));
        }
        let path = from_file(&frame.file);
        if !matches!(path.components().next_back(), Some(Component::Normal(_))) {
            return Err(bad("its file_path is no file's name"));
        }
        steps.push(path);
    }
    let leads_out = |path: &PathBuf| path.is_absolute() || path.starts_with("..");
    let mut base = root.to_path_buf();
    if steps.iter().any(leads_out) {
        // Paths can be compared only from the same place.
        let absolute = normal(&std::path::absolute(root).unwrap_or(base));
        for path in &mut steps {
            *path = normal(&absolute.join(&*path));
        }
        base = PathBuf::new();
    }
    let mut common: Option<PathBuf> = None;
    for path in &steps {
        let parent = path.parent().unwrap_or(Path::new(""));
        common = Some(match common {
            None => parent.to_path_buf(),
            Some(so_far) => so_far
                .components()
                .zip(parent.components())
                .take_while(|(a, b)| a == b)
                .map(|(a, _)| a)
                .collect(),
        });
    }
    let common = common.unwrap_or_default();
    let names = steps.iter().map(|path| name(path, &common)).collect();
    let inside = common != Path::new("");
    Ok(Placed {
        folder: if inside { base.join(common) } else { base },
        names,
    })
}

/// The name of the view whose photo is at `file`, a path from `root`, if names are from `photos`.
pub(super) fn name_in(root: &Path, photos: &Path, file: &str) -> String {
    let inside = from_file(file);
    if let Ok(common) = photos.strip_prefix(root)
        && !inside.starts_with("..")
    {
        return name(&inside, common);
    }
    let root = std::path::absolute(root).unwrap_or_else(|_| root.to_path_buf());
    name(&normal(&root.join(inside)), photos)
}

fn name(path: &Path, folder: &Path) -> String {
    let path = path.strip_prefix(folder).unwrap_or(path);
    path.to_string_lossy().replace('\\', "/")
}

/// A path as files have it. Backslashes separate too, as in files that were written on Windows.
fn from_file(path: &str) -> PathBuf {
    normal(Path::new(&path.replace('\\', "/")))
}

/// A path without `.`, and without `..` where there is a folder to leave.
fn normal(path: &Path) -> PathBuf {
    let mut out = PathBuf::new();
    for component in path.components() {
        let inside = matches!(out.components().next_back(), Some(Component::Normal(_)));
        match component {
            Component::CurDir => {}
            Component::ParentDir if inside => {
                out.pop();
            }
            Component::ParentDir if out.has_root() => {}
            other => out.push(other),
        }
    }
    out
}
