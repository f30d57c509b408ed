//! COLMAP's sparse model in either encoding: location, contents, and consistency checks.
//!
//! Format: <https://colmap.github.io/format.html>. Files that are not needed here (`rigs.bin`,
//! `frames.bin`, `project.ini`) are ignored.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use super::format::CaptureFormat;
use super::sparse_model::{SparseCamera, SparseImage, SparseModel};
use super::{CaptureError, CaptureWarning, Point, colmap_binary, colmap_text};
use crate::text::Excerpt;

/// A folder with a COLMAP model in `sparse/0`, `sparse` or the folder itself.
pub(super) const FORMAT: CaptureFormat = CaptureFormat {
    is_in: |root| find_folder(root).is_ok(),
    read,
};

/// Length in bytes of the longest path that systems accept.
const MOST_NAME: usize = 4096;

/// Finds, reads and checks the model of the capture in `root`.
pub(super) fn read(root: &Path) -> Result<(SparseModel, Vec<CaptureWarning>), CaptureError> {
    let (folder, mut warnings) = find_folder(root)?;
    let files = ModelFiles::find(&folder)?;
    let [cameras, images, points] = [&files.cameras, &files.images, &files.points].map(|path| {
        std::fs::read(path).map_err(|source| CaptureError::Io {
            path: path.clone(),
            source,
        })
    });
    let model = parse(&files, [&cameras?, &images?, &points?], &mut warnings)?;
    Ok((model, warnings))
}

/// Reads and checks a model from the contents of its cameras, images and points.
fn parse(
    files: &ModelFiles,
    [cameras, images, points]: [&[u8]; 3],
    warnings: &mut Vec<CaptureWarning>,
) -> Result<SparseModel, CaptureError> {
    let (cameras, images, points) = if files.binary {
        (
            colmap_binary::parse_cameras(&files.cameras, cameras)?,
            colmap_binary::parse_images(&files.images, images)?,
            colmap_binary::parse_points(&files.points, points)?,
        )
    } else {
        (
            colmap_text::parse_cameras(&files.cameras, cameras)?.checked(
                &files.cameras,
                "cameras",
                warnings,
            ),
            colmap_text::parse_images(&files.images, images)?.checked(
                &files.images,
                "images",
                warnings,
            ),
            colmap_text::parse_points(&files.points, points)?.checked(
                &files.points,
                "points",
                warnings,
            ),
        )
    };
    assemble(files, cameras, images, points)
}

/// [`read`] for a model in memory: the contents of its cameras, images and points.
pub(super) fn parse_model(
    binary: bool,
    files: [&[u8]; 3],
) -> Result<(SparseModel, Vec<CaptureWarning>), CaptureError> {
    let mut warnings = Vec::new();
    let model = parse(&ModelFiles::of(Path::new(""), binary), files, &mut warnings)?;
    Ok((model, warnings))
}

/// The folder that holds the model.
fn find_folder(root: &Path) -> Result<(PathBuf, Vec<CaptureWarning>), CaptureError> {
    let metadata = root.metadata().map_err(|source| CaptureError::Io {
        path: root.to_path_buf(),
        source,
    })?;
    if !metadata.is_dir() {
        return Err(CaptureError::NotAFolder {
            path: root.to_path_buf(),
        });
    }
    let holds_model = |folder: &PathBuf| {
        ["cameras.bin", "cameras.txt"]
            .iter()
            .any(|file| folder.join(file).is_file())
    };
    let sparse = root.join("sparse");
    let candidates = [sparse.join("0"), sparse.clone(), root.to_path_buf()];
    let Some(found) = candidates.into_iter().find(holds_model) else {
        let json = ["transforms.json", "transforms_train.json"];
        let hint = if json.iter().any(|file| root.join(file).is_file()) {
            " (it looks like a nerfstudio or Blender capture, which cannot be read yet)"
        } else {
            ""
        };
        return Err(CaptureError::NoModel {
            root: root.to_path_buf(),
            hint,
        });
    };
    let mut warnings = Vec::new();
    if found == sparse.join("0") {
        let others = (1..)
            .take_while(|n: &u32| holds_model(&sparse.join(n.to_string())))
            .count();
        if others > 0 {
            warnings.push(CaptureWarning::OtherModels {
                used: found.clone(),
                others,
            });
        }
    }
    Ok((found, warnings))
}

/// The three files of a model, all in one encoding.
struct ModelFiles {
    binary: bool,
    cameras: PathBuf,
    images: PathBuf,
    points: PathBuf,
}

impl ModelFiles {
    /// The binary files if all are present, else the text files; otherwise names the missing one of
    /// the encoding that has the cameras.
    fn find(folder: &Path) -> Result<Self, CaptureError> {
        let [binary, text] = [true, false].map(|binary| Self::of(folder, binary));
        match (binary.missing(), text.missing()) {
            (None, _) => Ok(binary),
            (_, None) => Ok(text),
            (Some(in_binary), Some(in_text)) => {
                let path = if binary.cameras.is_file() {
                    in_binary
                } else {
                    in_text
                };
                Err(CaptureError::MissingModelFile { path: path.clone() })
            }
        }
    }

    fn of(folder: &Path, binary: bool) -> Self {
        let extension = if binary { "bin" } else { "txt" };
        let file = |stem: &str| folder.join(format!("{stem}.{extension}"));
        Self {
            binary,
            cameras: file("cameras"),
            images: file("images"),
            points: file("points3D"),
        }
    }

    fn missing(&self) -> Option<&PathBuf> {
        [&self.cameras, &self.images, &self.points]
            .into_iter()
            .find(|path| !path.is_file())
    }
}

/// Checks the three lists individually and against each other.
fn assemble(
    files: &ModelFiles,
    cameras: Vec<SparseCamera>,
    mut images: Vec<SparseImage>,
    points: Vec<Point>,
) -> Result<SparseModel, CaptureError> {
    let mut by_id = HashMap::with_capacity(cameras.len());
    for camera in cameras {
        let bad = |reason| CaptureError::BadRecord {
            path: files.cameras.clone(),
            record: format!("camera {}", camera.id),
            reason,
        };
        check_camera(&camera).map_err(bad)?;
        if by_id.insert(camera.id, camera).is_some() {
            return Err(bad("its id occurs twice".to_owned()));
        }
    }

    if images.is_empty() {
        return Err(CaptureError::NoImages {
            path: files.images.clone(),
        });
    }
    let mut names = HashSet::with_capacity(images.len());
    for image in &images {
        let unique = names.insert(image.name.as_str());
        check_image(image, &by_id, unique).map_err(|reason| CaptureError::BadRecord {
            path: files.images.clone(),
            record: format!("image {} (`{}`)", image.id, Excerpt(&image.name)),
            reason,
        })?;
    }
    drop(names);
    images.sort_by(|a, b| a.name.cmp(&b.name));

    if points.is_empty() {
        return Err(CaptureError::NoPoints {
            path: files.points.clone(),
        });
    }
    let is_finite = |point: &Point| point.position.iter().all(|x| x.is_finite());
    if let Some(index) = points.iter().position(|point| !is_finite(point)) {
        return Err(CaptureError::BadRecord {
            path: files.points.clone(),
            record: format!("point {index} (counted from 0)"),
            reason: format!("its position {:?} is not finite", points[index].position),
        });
    }
    Ok(SparseModel {
        cameras: by_id,
        images,
        points,
    })
}

fn check_camera(camera: &SparseCamera) -> Result<(), String> {
    let [fx, fy, cx, cy] = camera.intrinsics;
    if camera.width == 0 || camera.height == 0 {
        return Err(format!("its size is {}x{}", camera.width, camera.height));
    }
    // Guards are written so that NaN fails them.
    let focal_ok = fx > 0.0 && fy > 0.0 && fx.is_finite() && fy.is_finite();
    if !focal_ok || !cx.is_finite() || !cy.is_finite() {
        return Err(format!(
            "its parameters fx {fx}, fy {fy}, cx {cx}, cy {cy} are not a pinhole camera"
        ));
    }
    Ok(())
}

fn check_image(
    image: &SparseImage,
    cameras: &HashMap<u32, SparseCamera>,
    unique: bool,
) -> Result<(), String> {
    if !unique {
        return Err("its name occurs twice".to_owned());
    }
    let is_odd = |c: char| c.is_control() && c != '\t';
    if image.name.chars().any(is_odd) || image.name.len() > MOST_NAME {
        return Err("its name is no file's name".to_owned());
    }
    if !stays_inside(&image.name) {
        return Err("its name leads out of the folder of photos".to_owned());
    }
    if !cameras.contains_key(&image.camera_id) {
        return Err(format!(
            "its camera {} is not among the cameras",
            image.camera_id
        ));
    }
    if !image.translation.iter().all(|x| x.is_finite()) {
        return Err(format!(
            "its translation {:?} is not finite",
            image.translation
        ));
    }
    let rotates = image.quaternion.iter().any(|q| *q != 0.0);
    if !(rotates && image.quaternion.iter().all(|q| q.is_finite())) {
        return Err(format!(
            "its quaternion {:?} is not a rotation",
            image.quaternion
        ));
    }
    Ok(())
}

/// True if a name, in the notation of any system, stays inside the folder that it is resolved in.
fn stays_inside(name: &str) -> bool {
    let has_drive = matches!(name.as_bytes(), [drive, b':', ..] if drive.is_ascii_alphabetic());
    let from_root = has_drive || name.starts_with(['/', '\\']);
    let mut steps = name.split(['/', '\\']);
    !from_root && !name.contains('\0') && !steps.any(|step| step == "..")
}
