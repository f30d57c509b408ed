//! Captures in `transforms.json`: those of nerfstudio and instant-ngp, and Blender's synthetic ones
//! (`transforms_train.json`, `transforms_test.json`).
//!
//! Formats: <https://docs.nerf.studio/quickstart/data_conventions.html>, and that of the NeRF
//! paper's synthetic scenes.
//!
//! The world is that of the poses as they are in the file, in which `ply_file_path` has its points
//! too. `applied_transform` and `applied_scale` say how that world came from another one, and are
//! not undone; nothing is centred, turned upright or scaled.

mod camera;
mod document;
mod fields;
mod files;
mod paths;
mod pose;

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use super::colmap_checks::stays_inside;
use super::format::{CaptureFormat, ReadModel};
use super::random_points::Room;
use super::sparse_model::{NamedSplit, SparseCamera, SparseImage, SparseModel};
use super::{CaptureError, CaptureSettings, CaptureWarning, images, points_file};
use document::{Document, Frame};
use files::Chosen;

/// A folder with `transforms.json`, or with `transforms_train.json`; or such a file itself.
pub(super) const FORMAT: CaptureFormat = CaptureFormat {
    name: "transforms.json",
    is_in: |root| files::choose(root).is_some(),
    read,
};

/// Colour behind a Blender capture.
const WHITE: [f32; 3] = [1.0; 3];

/// Reads and checks the frames and points of the capture in `root`.
fn read(root: &Path, settings: &CaptureSettings) -> ReadModel {
    let chosen = files::choose(root).ok_or_else(|| CaptureError::NoModel {
        root: root.to_path_buf(),
    })?;
    let mut warnings = chosen.warnings();
    let mut documents = Vec::new();
    for path in chosen.files() {
        documents.push(Document::parse(path, &contents(path)?)?);
    }
    let (mut model, frames) = assemble(&chosen, documents, &mut warnings)?;
    model.photos = Some(images::folder(&chosen.folder, &model, settings)?);
    files::resolve(&chosen, &mut model, &frames, &mut warnings)?;
    if let Some(path) = chosen.points(frames.points.as_ref())? {
        model.points = points_file::parse(&path, &contents(&path)?)?;
    }
    Ok((model, warnings))
}

fn contents(path: &Path) -> Result<Vec<u8>, CaptureError> {
    std::fs::read(path).map_err(|source| CaptureError::Io {
        path: path.to_path_buf(),
        source,
    })
}

/// [`read`] for one file in memory, without its photos and points.
pub(super) fn parse_model(path: &Path, bytes: &[u8]) -> ReadModel {
    let chosen = Chosen::single(path);
    let document = Document::parse(path, bytes)?;
    let mut warnings = Vec::new();
    let (model, _) = assemble(&chosen, vec![document], &mut warnings)?;
    Ok((model, warnings))
}

/// What the frames name besides their photos.
struct Named {
    /// The file of each frame, in the order of the model's images.
    frames: Vec<FrameFiles>,
    /// The file with `ply_file_path`, and that path.
    points: Option<(PathBuf, String)>,
}

/// Files of a frame, relative to the folder of the capture.
struct FrameFiles {
    /// Description of the frame, and the file that lists it.
    record: String,
    file: PathBuf,
    mask: Option<String>,
    depth: Option<String>,
}

/// A frame with the index and the path of its file.
type Listed = (usize, PathBuf, Frame);

/// The model of all documents, without points and with names as the files give them. Held out are
/// the frames of the second document, or else those of the lists of the first.
fn assemble(
    chosen: &Chosen,
    documents: Vec<Document>,
    warnings: &mut Vec<CaptureWarning>,
) -> Result<(SparseModel, Named), CaptureError> {
    let lists = documents[0].lists.clone();
    let points = documents
        .iter()
        .find_map(|document| Some((document.path.clone(), document.points.clone()?)));
    let blender = documents[0].blender;
    let has_test = documents.len() > 1;
    let mut frames: Vec<Listed> = Vec::new();
    for (index, document) in documents.into_iter().enumerate() {
        if document.crop_radius {
            warnings.push(CaptureWarning::CropRadiusIgnored {
                path: document.path.clone(),
            });
        }
        let listed = document.frames.into_iter();
        frames.extend(listed.map(|frame| (index, document.path.clone(), frame)));
    }
    let placed = paths::relative(
        &chosen.folder,
        frames.iter().map(|(_, path, frame)| (&**path, frame)),
    )?;
    for ((_, path, frame), name) in frames.iter().zip(&placed.names) {
        if !stays_inside(name) {
            return Err(CaptureError::BadRecord {
                path: path.clone(),
                record: frame.record(),
                reason: "its file_path gives no name inside of one folder; move all photos to one"
                    .to_owned(),
            });
        }
    }
    let mut frames = unique(frames.into_iter().zip(placed.names), warnings)?;
    let split = if has_test {
        let of = |wanted: usize| {
            let found = frames
                .iter()
                .filter(|((document, ..), _)| *document == wanted);
            found.map(|(_, name)| name.clone()).collect()
        };
        Some(NamedSplit {
            source: chosen.names(),
            train: Some(of(0)),
            test: of(1),
        })
    } else {
        lists.map(|lists| lists.split(&chosen.names(), &chosen.folder, &placed.folder))
    };
    let mut cameras = HashMap::new();
    frames.sort_by(|(_, a), (_, b)| a.cmp(b));
    let (images, frames) = (0..)
        .zip(frames)
        .map(|(id, ((_, file, frame), name))| {
            let image = SparseImage {
                id,
                camera_id: camera_id(&mut cameras, &frame),
                name,
                viewmat: frame.viewmat,
                mask: None,
                depth: None,
            };
            let record = frame.record();
            let (mask, depth) = (frame.mask, frame.depth);
            let files = FrameFiles {
                record,
                file,
                mask,
                depth,
            };
            (image, files)
        })
        .unzip();
    let model = SparseModel {
        cameras,
        images,
        points: Vec::new(),
        observations: Vec::new(),
        photos: Some(placed.folder),
        split,
        background: blender.then_some(WHITE),
        room: blender.then_some(Room::BLENDER),
    };
    Ok((model, Named { frames, points }))
}

/// The frames without those of a later file whose photo an earlier one has too. Within a file a
/// photo has one frame.
fn unique(
    frames: impl Iterator<Item = (Listed, String)>,
    warnings: &mut Vec<CaptureWarning>,
) -> Result<Vec<(Listed, String)>, CaptureError> {
    let mut kept: Vec<(Listed, String)> = Vec::new();
    let mut first_of: HashMap<String, usize> = HashMap::new();
    let mut repeated: Vec<String> = Vec::new();
    for ((document, path, frame), name) in frames {
        let first = *first_of.entry(name.clone()).or_insert(kept.len());
        match kept.get(first) {
            None => kept.push(((document, path, frame), name)),
            Some(((in_document, ..), _)) if *in_document != document => repeated.push(name),
            Some(((_, _, other), _)) => {
                let record = other.record();
                return Err(CaptureError::BadRecord {
                    path,
                    record: frame.record(),
                    reason: format!("its photo is that of {record} too; remove one of them"),
                });
            }
        }
    }
    if let Some(first) = repeated.first() {
        warnings.push(CaptureWarning::RepeatedPhotos {
            count: repeated.len(),
            first: first.clone(),
        });
    }
    Ok(kept)
}

/// Id of the frame's camera, which is that of the frame before if they are equal.
fn camera_id(cameras: &mut HashMap<u32, SparseCamera>, frame: &Frame) -> u32 {
    let last = cameras.len() as u32;
    let camera = SparseCamera {
        id: last + 1,
        intrinsics: frame.intrinsics,
        lens: frame.lens,
    };
    match cameras.get(&last) {
        Some(before) if (before.intrinsics, before.lens) == (camera.intrinsics, camera.lens) => {
            last
        }
        _ => {
            cameras.insert(camera.id, camera);
            camera.id
        }
    }
}

#[cfg(test)]
mod tests;
