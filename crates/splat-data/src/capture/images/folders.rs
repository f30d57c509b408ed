//! Location of a capture's photos.

use std::collections::{BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use super::super::sparse_model::SparseModel;
use super::super::{CaptureError, CaptureWarning};

/// Extensions of photos: those that structure from motion reads, not only the supported ones.
const PHOTO_ENDINGS: [&str; 9] = [
    "jpg", "jpeg", "jpe", "png", "tif", "tiff", "bmp", "webp", "heic",
];

/// The folder `given`, relative to the capture `root` or absolute; by default `images/`, or the
/// capture itself if that does not exist.
pub(super) fn of_photos(
    root: &Path,
    given: Option<&Path>,
    model: &SparseModel,
) -> Result<PathBuf, CaptureError> {
    let Some(given) = given else {
        let images = root.join("images");
        let there = images.is_dir();
        return Ok(if there { images } else { root.to_path_buf() });
    };
    let folder = root.join(given);
    if folder.is_dir() {
        return Ok(folder);
    }
    Err(CaptureError::NoPhotoFolder {
        elsewhere: elsewhere(root, &folder, model).map(|(folder, _)| folder),
        path: folder,
    })
}

/// The folder of the capture, relative to it, that holds the most photos of the model, with their
/// number; `None` if that is `used`, which does not hold all.
pub(super) fn elsewhere(root: &Path, used: &Path, model: &SparseModel) -> Option<(PathBuf, usize)> {
    let held = |folder: &Path| {
        let there = |name: &str| folder.join(name).is_file();
        model
            .images
            .iter()
            .filter(|image| there(&image.name))
            .count()
    };
    let in_used = held(used);
    let folders = sub_folders(root, Path::is_dir)
        .into_iter()
        .chain([root.to_path_buf()]);
    let mut most = None;
    for folder in folders.filter(|folder| folder != used) {
        let count = held(&folder);
        let least = most.as_ref().map_or(in_used, |&(_, count)| count);
        if count > least {
            let relative = folder.strip_prefix(root).ok()?.to_path_buf();
            let is_root = relative.as_os_str().is_empty();
            most = Some((if is_root { ".".into() } else { relative }, count));
        }
    }
    most
}

/// Photos that the model does not name, in the folders of its photos. If those are subfolders
/// (`cam1/0001.png`), all subfolders are searched, as a whole camera may be missing. Otherwise
/// subfolders are ignored, as they contain masks or smaller copies.
pub(super) fn unregistered(
    root: &Path,
    folder: &Path,
    model: &SparseModel,
) -> Option<CaptureWarning> {
    let photos = || model.images.iter().map(|image| folder.join(&image.name));
    let registered: HashSet<PathBuf> = photos().collect();
    let mut folders: BTreeSet<PathBuf> = photos()
        .filter_map(|path| path.parent().map(Path::to_path_buf))
        .collect();
    if folder != root && folders.iter().any(|of_photo| of_photo != folder) {
        add_below(folder, &mut folders);
    }
    let is_photo = |path: &Path| {
        let ending = path.extension().unwrap_or_default();
        PHOTO_ENDINGS
            .iter()
            .any(|known| ending.eq_ignore_ascii_case(known))
            && !is_hidden(path)
    };
    let mut left_out: Vec<PathBuf> = folders
        .iter()
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .flat_map(|entries| entries.filter_map(|entry| Some(entry.ok()?.path())))
        .filter(|path| is_photo(path) && !registered.contains(path) && path.is_file())
        .collect();
    left_out.sort();
    let first = left_out.first()?;
    let first = first.strip_prefix(folder).unwrap_or(first);
    Some(CaptureWarning::UnregisteredPhotos {
        first: first.to_string_lossy().into_owned(),
        count: left_out.len(),
    })
}

/// Adds `folder` and all folders below it, without following links.
fn add_below(folder: &Path, folders: &mut BTreeSet<PathBuf>) {
    folders.insert(folder.to_path_buf());
    for below in sub_folders(folder, |path| path.is_dir() && !path.is_symlink()) {
        add_below(&below, folders);
    }
}

/// Subfolders by name, without hidden ones.
fn sub_folders(folder: &Path, is_folder: fn(&Path) -> bool) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return Vec::new();
    };
    let mut folders: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| is_folder(path) && !is_hidden(path))
        .collect();
    folders.sort();
    folders
}

/// System thumbnails and notes: `.thumbnails`, `._0001.jpg`, `@eaDir`.
fn is_hidden(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().as_encoded_bytes();
    matches!(name.first(), None | Some(b'.' | b'@'))
}
