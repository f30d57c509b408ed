//! The capture formats, and detection of a folder's format.

use std::path::Path;

use super::format::{CaptureFormat, ReadModel};
use super::{CaptureSettings, colmap};

/// All formats; the first that matches is read.
const FORMATS: &[CaptureFormat] = &[colmap::FORMAT];

/// Reads the folder in the format that matches. If none does, returns the error of the first.
pub(super) fn read(root: &Path, settings: &CaptureSettings) -> ReadModel {
    let format = FORMATS.iter().find(|format| (format.is_in)(root));
    (format.unwrap_or(&FORMATS[0]).read)(root, settings)
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
