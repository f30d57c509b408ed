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
    let mut counted = Vec::new();
    let mut damaged = Vec::new();
    for folder in &folders {
        match images(folder) {
            Ok(images) => counted.push((images, folder)),
            Err(error) => damaged.push(error.to_string()),
        }
    }
    let others = counted.len().saturating_sub(1);
    let largest = counted
        .into_iter()
        .reduce(|best, next| if next.0 > best.0 { next } else { best });
    let Some((images, used)) = largest else {
        // Reading it says why it cannot be read.
        return Ok((folders[0].clone(), vec![]));
    };
    let mut warnings = Vec::new();
    if others > 0 {
        warnings.push(CaptureWarning::OtherModels {
            used: used.clone(),
            images,
            others,
        });
    }
    let count = damaged.len();
    let first = damaged.into_iter().next();
    warnings.extend(first.map(|first| CaptureWarning::DamagedModels {
        used: used.clone(),
        count,
        first,
    }));
    Ok((used.clone(), warnings))
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

/// Number of images of the model in a folder. Of a binary model, only the head of the file is read.
fn images(folder: &Path) -> Result<u64, CaptureError> {
    let files = ModelFiles::find(folder)?;
    let path = &files.images;
    let io_error = |source| CaptureError::Io {
        path: path.clone(),
        source,
    };
    if !files.binary {
        let text = std::fs::read(path).map_err(io_error)?;
        let images = colmap_text::parse_images(path, &text, false)?;
        return Ok(images.records.len() as u64);
    }
    let file = File::open(path).map_err(io_error)?;
    let length = file.metadata().map_err(io_error)?.len();
    let mut head = Vec::new();
    file.take(8).read_to_end(&mut head).map_err(io_error)?;
    colmap_binary::count_images(path, &head, length)
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

#[cfg(test)]
mod tests {
    use super::super::test_capture::{TestCapture, good, load};
    use super::*;

    /// The damaged one may be the larger part of the reconstruction.
    #[test]
    fn a_model_that_cannot_be_read_is_named_beside_the_one_that_is() {
        type Spoil = fn(&Path);
        let cases: [(&str, Spoil); 6] = [
            ("images.txt: line 1", |folder| {
                TestCapture::new().write_text(folder);
                std::fs::write(folder.join("images.txt"), "junk\n").unwrap();
            }),
            ("images.txt: UTF-16", |folder| {
                TestCapture::new().write_text(folder);
                std::fs::write(folder.join("images.txt"), b"\xff\xfe1\0").unwrap();
            }),
            ("images.txt: missing", |folder| {
                TestCapture::new().write_text(folder);
                std::fs::remove_file(folder.join("images.txt")).unwrap();
            }),
            ("images.bin: missing", |folder| {
                TestCapture::new().write_binary(folder);
                std::fs::remove_file(folder.join("images.bin")).unwrap();
            }),
            ("images.bin: truncated", |folder| {
                TestCapture::new().write_binary(folder);
                std::fs::write(folder.join("images.bin"), [9, 0, 0]).unwrap();
            }),
            ("images.bin: the file announces", |folder| {
                TestCapture::new().write_binary(folder);
                std::fs::write(folder.join("images.bin"), [0xff; 80]).unwrap();
            }),
        ];
        for (words, spoil) in cases {
            let (root, mut model) = good();
            let sparse = root.path().join("sparse");
            model.images.truncate(2);
            model.write_binary(&sparse.join("0"));
            spoil(&sparse.join("1"));
            let warnings = load(root.path()).unwrap().warnings;
            let [damaged, CaptureWarning::UnregisteredPhotos { .. }] = &warnings[..] else {
                panic!("a warning of a damaged model, not {warnings:?}");
            };
            let damaged = damaged.to_string();
            for words in ["1 model(s)", "sparse/0", &format!("sparse/1/{words}")] {
                assert!(damaged.contains(words), "`{damaged}` without `{words}`");
            }
            assert!(!damaged.contains('\n'), "{damaged}");

            // A third one is still counted.
            model.images.truncate(1);
            model.write_binary(&sparse.join("2"));
            let (used, warnings) = find(root.path()).unwrap();
            let others = CaptureWarning::OtherModels {
                used: sparse.join("0"),
                images: 2,
                others: 1,
            };
            assert_eq!((used, &warnings[0]), (sparse.join("0"), &others));
            assert_eq!(warnings[1].to_string(), damaged);
        }
    }

    #[test]
    fn folders_without_a_model_are_not_damaged_and_models_that_all_are_end_the_reading() {
        let (root, _) = good();
        let sparse = root.path().join("sparse");
        std::fs::create_dir(sparse.join("1")).unwrap();
        assert_eq!(load(root.path()).unwrap().warnings, []);

        std::fs::remove_file(sparse.join("0/images.bin")).unwrap();
        std::fs::write(sparse.join("1/cameras.bin"), b"").unwrap();
        let message = load(root.path()).unwrap_err().to_string();
        assert!(message.contains("sparse/0/images.bin"), "{message}");
    }
}
