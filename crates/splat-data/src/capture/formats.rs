//! The formats of captures, and which of them a folder holds.

use std::path::Path;

use super::colmap;
use super::format::{CaptureFormat, ReadModel};

/// Every format; the first that fits is read.
const FORMATS: &[CaptureFormat] = &[colmap::FORMAT];

/// Reads the folder in the format that it holds. Where it holds none, the error is that of the
/// first.
pub(super) fn read(root: &Path) -> ReadModel {
    let format = FORMATS.iter().find(|format| (format.is_in)(root));
    (format.unwrap_or(&FORMATS[0]).read)(root)
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
