//! The header of a PLY file, read line by line up to its end.

use std::io::{BufRead, Read};
use std::path::Path;

use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::Header;

use super::repetition::repetition;
use super::{Row, SceneFileError, one_line};

/// Most bytes of a header: hundreds of times what a scene of degree 3 needs. What has more is another kind of file.
const LONGEST: u64 = 1 << 20;

/// Reads the header and leaves `reader` behind it.
pub(super) fn read(path: &Path, reader: &mut impl BufRead) -> Result<Header, SceneFileError> {
    let error = |reason: String| SceneFileError::Header {
        path: path.to_path_buf(),
        reason,
    };
    let mut text = String::new();
    let mut lines = reader.take(LONGEST);
    loop {
        let start = text.len();
        let count = lines
            .read_line(&mut text)
            .map_err(|failure| error(format!("no PLY header: {failure}")))?;
        let line = text[start..].trim_end();
        if count == 0 || line == "end_header" || (start == 0 && line != "ply") {
            break;
        }
    }
    if text.len() as u64 == LONGEST {
        return Err(error(format!(
            "no PLY header: its end is not in the first {LONGEST} bytes"
        )));
    }
    if let Some(line) = repetition(&text) {
        return Err(error(format!("`{line}` repeats a name of the header")));
    }
    Parser::<Row>::new()
        .read_header(&mut Reader::new(text.as_bytes()))
        .map_err(|failure| error(format!("no PLY header: {}", one_line(&failure.to_string()))))
}
