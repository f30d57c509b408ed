//! Location of a COLMAP model: the folder of a capture, and the files in it.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::{CaptureError, CaptureWarning, colmap_binary, colmap_text};

/// The folder that holds the model. COLMAP writes every connected part of a reconstruction to a
/// numbered folder of `sparse`; the one with the most images is read.
pub(super) fn find(root: &Path) -> Result<(PathBuf, Vec<CaptureWarning>), CaptureError> {
    let mut folders = candidates(root);
    if folders.len() < 2 {
        let no_model = || CaptureError::NoModel {
            root: root.to_path_buf(),
        };
        return Ok((folders.pop().ok_or_else(no_model)?, vec![]));
    }
    let others = folders.len() - 1;
    let counted = folders.into_iter().map(|folder| (images(&folder), folder));
    let (images, used) = counted
        .reduce(|best, next| if next.0 > best.0 { next } else { best })
        .unwrap_or_default();
    let warning = CaptureWarning::OtherModels {
        used: used.clone(),
        images,
        others,
    };
    Ok((used, vec![warning]))
}

/// Folders of the capture that hold a model: the numbered ones in `sparse`, or else the first of
/// `sparse` and the capture itself.
pub(super) fn candidates(root: &Path) -> Vec<PathBuf> {
    let holds_model = |folder: &Path| {
        let files = ["cameras.bin", "cameras.txt"];
        files.iter().any(|file| folder.join(file).is_file())
    };
    let sparse = root.join("sparse");
    let mut numbered: Vec<(u64, PathBuf)> = std::fs::read_dir(&sparse)
        .into_iter()
        .flatten()
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter_map(|folder| Some((folder.file_name()?.to_str()?.parse().ok()?, folder)))
        .filter(|(_, folder)| holds_model(folder))
        .collect();
    numbered.sort();
    if !numbered.is_empty() {
        return numbered.into_iter().map(|(_, folder)| folder).collect();
    }
    let whole = [sparse, root.to_path_buf()];
    whole
        .into_iter()
        .find(|f| holds_model(f))
        .into_iter()
        .collect()
}

/// Number of images of the model in a folder; 0 if it cannot be told.
fn images(folder: &Path) -> u64 {
    let count = || -> Option<u64> {
        let files = ModelFiles::find(folder).ok()?;
        if !files.binary {
            let text = std::fs::read(&files.images).ok()?;
            let images = colmap_text::parse_images(&files.images, &text, false).ok()?;
            return Some(images.records.len() as u64);
        }
        let mut file = File::open(&files.images).ok()?;
        let mut count = [0; 8];
        file.read_exact(&mut count).ok()?;
        let count = u64::from_le_bytes(count);
        let room = file.metadata().ok()?.len() / colmap_binary::MIN_IMAGE as u64;
        (count <= room).then_some(count)
    };
    count().unwrap_or(0)
}

/// The three files of a model, all in one encoding.
pub(super) struct ModelFiles {
    pub binary: bool,
    pub cameras: PathBuf,
    pub images: PathBuf,
    /// Need not exist.
    pub points: PathBuf,
}

impl ModelFiles {
    /// The binary files if cameras and images are present, else the text files; otherwise names the
    /// missing one of the encoding that has the cameras.
    pub fn find(folder: &Path) -> Result<Self, CaptureError> {
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

    pub fn of(folder: &Path, binary: bool) -> Self {
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
        [&self.cameras, &self.images]
            .into_iter()
            .find(|path| !path.is_file())
    }
}
