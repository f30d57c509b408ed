//! The scene file formats, and detection of a file's format.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::format::SceneFormat;
use super::{SceneFileError, SplatData, ply, sog, spz};

/// All formats.
pub const FORMATS: &[SceneFormat] = &[ply::FORMAT, spz::FORMAT, sog::FORMAT];

/// Number of bytes used to recognise a format.
const HEAD: u64 = 64;

/// Reads a scene in any format, recognised by the file's first bytes, else by its extension, else
/// the first format.
///
/// # Errors
/// [`SceneFileError`] if the file cannot be read or is malformed.
pub fn read(path: impl AsRef<Path>) -> Result<SplatData, SceneFileError> {
    let path = path.as_ref();
    let mut head = Vec::new();
    // A pipe yields its bytes only once; other unreadable files are reported by the reader.
    if path.is_file()
        && let Ok(file) = File::open(path)
    {
        let _ = file.take(HEAD).read_to_end(&mut head);
    }
    let format = FORMATS.iter().find(|format| (format.is)(&head));
    let format = format.or_else(|| of_name(path)).unwrap_or(&FORMATS[0]);
    (format.read)(path)
}

/// Writes a scene in the format of the file's extension; PLY without an extension.
///
/// # Errors
/// [`SceneFileError`] if the extension is unknown or the scene cannot be written.
pub fn write(path: impl AsRef<Path>, scene: &SplatData) -> Result<(), SceneFileError> {
    let path = path.as_ref();
    (format_to_write(path)?.write)(path, scene)
}

/// The format in which [`write()`] writes a file of this name.
///
/// # Errors
/// [`SceneFileError::Header`] if the extension is unknown.
pub fn format_to_write(path: impl AsRef<Path>) -> Result<&'static SceneFormat, SceneFileError> {
    let path = path.as_ref();
    match (of_name(path), path.extension()) {
        (Some(format), _) => Ok(format),
        (None, None) => Ok(&FORMATS[0]),
        (None, Some(_)) => {
            let endings = FORMATS.iter().flat_map(|format| format.endings);
            let endings: Vec<String> = endings.map(|ending| format!(".{ending}")).collect();
            Err(SceneFileError::Header {
                path: path.to_path_buf(),
                reason: format!(
                    "no format of that name is known; name it {}",
                    endings.join(", ")
                ),
            })
        }
    }
}

fn of_name(path: &Path) -> Option<&'static SceneFormat> {
    let ending = path.extension()?.to_str()?.to_lowercase();
    FORMATS
        .iter()
        .find(|format| format.endings.contains(&ending.as_str()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_known_by_its_bytes_then_by_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let scene = SplatData {
            means: vec![[1.0, 2.0, 3.0]],
            log_scales: vec![[0.0; 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![0.5],
            sh0: vec![[0.1; 3]],
            ..SplatData::default()
        };
        for name in ["scene.ply", "scene.PLY", "scene"] {
            let path = folder.path().join(name);
            write(&path, &scene).unwrap();
            assert_eq!(read(&path).unwrap(), scene, "{name}");
        }
        // Compressed files are known by their bytes, whatever their name.
        for name in ["scene.spz", "scene.sog"] {
            let path = folder.path().join(name);
            write(&path, &scene).unwrap();
            let renamed = folder.path().join("renamed.ply");
            std::fs::rename(path, &renamed).unwrap();
            assert_eq!(read(&renamed).unwrap().means, scene.means, "{name}");
        }
        let other = write(folder.path().join("scene.splat"), &scene);
        let other = other.unwrap_err().to_string();
        assert!(
            other.contains("scene.splat") && other.contains(".ply"),
            "{other}"
        );
        let missing = read(folder.path().join("none.ply"))
            .unwrap_err()
            .to_string();
        assert!(missing.contains("none.ply"), "{missing}");
        assert!(of_name("a.b/scene".as_ref()).is_none());
    }
}
