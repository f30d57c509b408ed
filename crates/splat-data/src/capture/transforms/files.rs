//! The files of a capture: which are read, and which exist.

use std::path::{Path, PathBuf};

use super::super::sparse_model::SparseModel;
use super::super::{CaptureError, CaptureWarning};
use super::Named;

/// Endings of photos that a path may leave out; Blender's scenes do.
const ENDINGS: [&str; 10] = [
    "png", "jpg", "jpeg", "JPG", "JPEG", "PNG", "webp", "tif", "tiff", "TIF",
];
/// Names of files of points that need not be mentioned.
const POINTS: [&str; 3] = ["points3d.ply", "points3D.ply", "sparse_pc.ply"];
const ALL: &str = "transforms.json";
const TRAIN: &str = "transforms_train.json";
const TEST: [&str; 2] = ["transforms_test.json", "transforms_val.json"];

/// The files to read, in one folder.
pub(super) struct Chosen {
    pub folder: PathBuf,
    first: PathBuf,
    /// The file of the held-out frames.
    test: Option<PathBuf>,
    /// True if there is a `transforms.json` that is not read.
    unread: bool,
}

/// The files of a folder: `transforms_train.json` with `transforms_test.json`, or with
/// `transforms_val.json`, or else `transforms.json`. Or a file of this kind itself.
pub(super) fn choose(root: &Path) -> Option<Chosen> {
    if root.is_file() {
        let is_json = root
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("json"));
        return is_json.then(|| Chosen::single(root));
    }
    let there = |name: &&str| root.join(name).is_file();
    let all = there(&ALL);
    if !there(&TRAIN) {
        return all.then(|| Chosen::single(&root.join(ALL)));
    }
    Some(Chosen {
        folder: root.to_path_buf(),
        first: root.join(TRAIN),
        test: TEST
            .iter()
            .find(|name| there(name))
            .map(|name| root.join(name)),
        unread: all,
    })
}

impl Chosen {
    /// One file alone.
    pub fn single(path: &Path) -> Self {
        let parent = path.parent().filter(|folder| *folder != Path::new(""));
        Self {
            folder: parent.unwrap_or(Path::new(".")).to_path_buf(),
            first: path.to_path_buf(),
            test: None,
            unread: false,
        }
    }

    pub fn files(&self) -> impl Iterator<Item = &PathBuf> {
        [&self.first].into_iter().chain(&self.test)
    }

    /// Names of the files for messages.
    pub fn names(&self) -> String {
        let name = |path: &PathBuf| {
            path.file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned()
        };
        self.files().map(name).collect::<Vec<_>>().join(" and ")
    }

    pub fn warnings(&self) -> Vec<CaptureWarning> {
        let unread = self.unread.then(|| CaptureWarning::OtherCapture {
            used: self.names(),
            other: self.folder.join(ALL),
        });
        unread.into_iter().collect()
    }

    /// The file of points, if one is named or has a usual name. `named` is a `ply_file_path` and
    /// the file that has it.
    pub fn points(
        &self,
        named: Option<&(PathBuf, String)>,
    ) -> Result<Option<PathBuf>, CaptureError> {
        let Some((file, name)) = named else {
            let mut paths = POINTS.iter().map(|name| self.folder.join(name));
            return Ok(paths.find(|path| path.is_file()));
        };
        let path = self.folder.join(name);
        if path.is_file() {
            return Ok(Some(path));
        }
        Err(CaptureError::BadRecord {
            path: file.clone(),
            record: "the top level".to_owned(),
            reason: format!(
                "its ply_file_path names {}, where there is no file; correct the path, or remove the field",
                path.display()
            ),
        })
    }
}

/// Completes the names of photos by their endings and drops images without a photo, if those are
/// few; then finds masks and depth maps.
pub(super) fn resolve(
    chosen: &Chosen,
    model: &mut SparseModel,
    named: &Named,
    warnings: &mut Vec<CaptureWarning>,
) -> Result<(), CaptureError> {
    let folder = model
        .photos
        .clone()
        .unwrap_or_else(|| chosen.folder.clone());
    let mut renamed = std::collections::HashMap::new();
    let mut missing = Vec::new();
    let mut kept = Vec::with_capacity(model.images.len());
    let listed = model.images.len();
    for (mut image, files) in std::mem::take(&mut model.images)
        .into_iter()
        .zip(&named.frames)
    {
        let Some(name) = with_ending(&folder, &image.name) else {
            missing.push((image.name, files));
            continue;
        };
        let exists = |path: &Option<String>, field: &str| {
            let Some(path) = path else { return Ok(None) };
            let path = chosen.folder.join(path);
            if path.is_file() {
                return Ok(Some(path));
            }
            Err(CaptureError::BadRecord {
                path: files.file.clone(),
                record: files.record.clone(),
                reason: format!("its {field} names {}, which does not exist", path.display()),
            })
        };
        image.mask = exists(&files.mask, "mask_path")?;
        image.depth = exists(&files.depth, "depth_file_path")?;
        if name != image.name {
            renamed.insert(std::mem::replace(&mut image.name, name.clone()), name);
        }
        kept.push(image);
    }
    kept.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = kept.windows(2).find(|pair| pair[0].name == pair[1].name) {
        return Err(CaptureError::BadTransforms {
            path: named.frames[0].file.clone(),
            reason: format!(
                "two frames have the photo `{}`; remove one of them",
                pair[0].name
            ),
        });
    }
    model.images = kept;
    if let Some((first, files)) = missing.first() {
        if 2 * missing.len() > listed {
            return Err(CaptureError::MissingPhotos {
                path: files.file.clone(),
                missing: missing.len(),
                frames: listed,
                first: folder.join(first),
            });
        }
        warnings.push(CaptureWarning::MissingPhotos {
            count: missing.len(),
            frames: listed,
            first: folder.join(first),
        });
    }
    if let Some(split) = &mut model.split {
        let absent: std::collections::HashSet<&String> =
            missing.iter().map(|(name, _)| name).collect();
        for list in split.train.iter_mut().chain([&mut split.test]) {
            list.retain(|name| !absent.contains(name));
            for name in list {
                if let Some(new) = renamed.get(name) {
                    name.clone_from(new);
                }
            }
        }
    }
    Ok(())
}

/// The name of an existing photo: the name itself, or with an ending.
fn with_ending(folder: &Path, name: &str) -> Option<String> {
    let endings = ENDINGS.iter().map(|ending| format!("{name}.{ending}"));
    let mut names = [name.to_owned()].into_iter().chain(endings);
    names.find(|name| folder.join(name).is_file())
}
