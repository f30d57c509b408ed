//! The capture formats, and detection of a folder's format.

use std::path::Path;

use super::format::{CaptureFormat, ReadModel};
use super::{CaptureError, CaptureSettings, CaptureWarning, colmap, transforms};

/// All formats; the first that matches is read.
const FORMATS: &[CaptureFormat] = &[colmap::FORMAT, transforms::FORMAT];

/// Reads the folder, or the `.json` file, in the first format that matches.
pub(super) fn read(root: &Path, settings: &CaptureSettings) -> ReadModel {
    let metadata = root.metadata().map_err(|source| CaptureError::Io {
        path: root.to_path_buf(),
        source,
    })?;
    let mut formats = FORMATS.iter().filter(|format| (format.is_in)(root));
    let Some(format) = formats.next() else {
        let root = root.to_path_buf();
        return Err(match metadata.is_dir() {
            true => CaptureError::NoModel { root },
            false => CaptureError::NotAFolder { path: root },
        });
    };
    let (model, mut warnings) = (format.read)(root, settings)?;
    warnings.extend(formats.map(|other| CaptureWarning::OtherCapture {
        used: format.name.to_owned(),
        other: root.join(other.name),
    }));
    Ok((model, warnings))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_example_is_in_one_format() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/data/saharov");
        let formats = FORMATS.iter().filter(|format| (format.is_in)(&folder));
        assert_eq!(formats.count(), 1);
        assert!(
            FORMATS
                .iter()
                .all(|format| !(format.is_in)("nowhere".as_ref()))
        );
    }
}
