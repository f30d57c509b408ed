//! Normalises the header of a PLY file before it is parsed.
//!
//! Headers come from many programs and text editors. These variations are accepted: a byte-order
//! mark before `ply`, blank lines, indentation, carriage returns before line feeds, comments before
//! `format`, and comments that are not UTF-8.

use std::io::{BufRead, Read};
use std::path::Path;

use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::Header;

use super::super::SceneFileError;
use super::Row;
use super::repetition::repetition;
use crate::text::one_line;

/// Longest accepted header in bytes; anything longer is not a PLY header.
const LONGEST: u64 = 1 << 20;
/// UTF-8's byte-order mark.
const BYTE_ORDER_MARK: &[u8] = b"\xEF\xBB\xBF";

/// Reads the header, leaving `reader` after it.
pub(super) fn read(reader: &mut impl BufRead, path: &Path) -> Result<Header, SceneFileError> {
    let bad = |reason: String| SceneFileError::Header {
        path: path.to_path_buf(),
        reason: format!("no PLY header: {reason}"),
    };
    let mut text = String::new();
    let mut left = LONGEST;
    loop {
        let mut line = Vec::new();
        let read = reader.by_ref().take(left).read_until(b'\n', &mut line);
        let read = read.map_err(|source| SceneFileError::Io {
            path: path.to_path_buf(),
            source,
        })?;
        left -= read as u64;
        if left == 0 {
            return Err(bad(format!("no line `end_header` in {LONGEST} bytes")));
        }
        let first = text.is_empty();
        let bytes = match line.strip_prefix(BYTE_ORDER_MARK) {
            Some(rest) if first => rest,
            _ => &line[..],
        };
        let line = String::from_utf8_lossy(bytes);
        let line = line.trim();
        if first && line != "ply" {
            return Err(bad(match line.strip_prefix("ply\r") {
                Some(_) => "its lines end in carriage returns alone; end them in line feeds".into(),
                None => "it does not begin with the line `ply`".into(),
            }));
        }
        if read == 0 {
            return Err(bad("it ends without the line `end_header`".into()));
        }
        // Blank lines count towards the line numbers in messages.
        text += &match line {
            "" => "comment".to_owned(),
            line => line.replace('\r', " "),
        };
        text.push('\n');
        if line == "end_header" {
            break;
        }
    }
    if let Some(line) = repetition(&text) {
        return Err(SceneFileError::Header {
            path: path.to_path_buf(),
            reason: format!("`{line}` repeats a name of the header"),
        });
    }
    let header = Parser::<Row>::new().read_header(&mut Reader::new(text.as_bytes()));
    header.map_err(|error| {
        let message = error.to_string();
        // The rest is about the grammar, not about the file.
        let (message, _) = message.split_once("\n\tError:").unwrap_or((&message, ""));
        bad(one_line(message))
    })
}
