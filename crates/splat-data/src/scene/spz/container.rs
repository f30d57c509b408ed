//! The file around the arrays: gzip up to version 3, Zstandard streams since version 4.

use std::io::{Error, Read};
use std::path::Path;

use flate2::read::GzDecoder;
use rayon::prelude::*;

use super::super::SceneFileError;
use super::super::limits::{most_gaussians, read_at_most, too_many};
use super::header::{COMMON, EXTENDED, Header};
use crate::text::one_line;

/// First bytes of a gzip file.
pub(super) const GZIP: &[u8] = &[0x1f, 0x8b];
/// Bytes of the header of version 4.
const HEADER: usize = 32;
/// Bytes of an entry of the table.
const ENTRY: usize = 16;
/// Level of compression of the reference implementation.
const LEVEL: i32 = 12;
/// Most bytes of extensions after the arrays; those known take a few dozen.
const MOST_EXTENSIONS: u64 = 1 << 16;

/// The decompressed contents of a file.
pub(super) struct Packed {
    pub header: Header,
    /// In the order of [`Header::arrays`], of the lengths there.
    pub arrays: [Vec<u8>; 6],
    /// Records of extensions.
    pub extensions: Vec<u8>,
}

/// Decompresses a file.
pub(super) fn unpack(path: &Path, bytes: &[u8]) -> Result<Packed, SceneFileError> {
    let file_bytes = bytes.len() as u64;
    if bytes.starts_with(GZIP) {
        return single_stream(path, &mut GzDecoder::new(bytes), file_bytes);
    }
    let (header, streams) = Header::read(path, bytes)?;
    match header.version {
        // Version 4 was the first without a stream around the header, but unpacked files exist.
        1..=3 => single_stream(path, &mut &bytes[..], file_bytes),
        _ => table(path, bytes, header, usize::from(streams)),
    }
}

/// Versions 1 to 3: everything in one stream.
fn single_stream(
    path: &Path,
    reader: &mut impl Read,
    file_bytes: u64,
) -> Result<Packed, SceneFileError> {
    let bad = |field: &'static str, error: Error| SceneFileError::Field {
        path: path.to_path_buf(),
        field,
        reason: format!("gzip: {}", one_line(&error.to_string())),
    };
    let head = read_at_most(reader, COMMON as u64).map_err(|error| bad("header", error))?;
    let (header, _) = Header::read(path, &head)?;
    if header.version > 3 {
        return Err(SceneFileError::Header {
            path: path.to_path_buf(),
            reason: format!(
                "gzip around SPZ version {}, which has none; unpack it with gunzip",
                header.version
            ),
        });
    }
    check_count(path, &header, file_bytes)?;
    let mut arrays: [Vec<u8>; 6] = Default::default();
    for (array, (name, each)) in arrays.iter_mut().zip(header.arrays()) {
        let len = each as u64 * u64::from(header.count);
        *array = read_at_most(reader, len).map_err(|error| bad(name, error))?;
        if (array.len() as u64) < len {
            return Err(SceneFileError::Field {
                path: path.to_path_buf(),
                field: name,
                reason: format!(
                    "truncated: the file ends in Gaussian {} of {}",
                    array.len() / each,
                    header.count
                ),
            });
        }
    }
    // To the end, which also checks the checksum.
    let rest = read_at_most(reader, MOST_EXTENSIONS).map_err(|error| bad("end", error))?;
    let extended = header.flags & EXTENDED != 0;
    Ok(Packed {
        header,
        arrays,
        extensions: if extended { rest } else { vec![] },
    })
}

/// Version 4: a table of streams.
fn table(
    path: &Path,
    bytes: &[u8],
    header: Header,
    streams: usize,
) -> Result<Packed, SceneFileError> {
    let bad = |field: &'static str, reason: String| SceneFileError::Field {
        path: path.to_path_buf(),
        field,
        reason,
    };
    check_count(path, &header, bytes.len() as u64)?;
    let names = header.arrays();
    let expected = names.iter().filter(|(_, each)| *each > 0).count();
    if streams != expected {
        return Err(bad(
            "table",
            format!(
                "{streams} streams instead of {expected}; a file of a later version, or damaged"
            ),
        ));
    }
    let truncated = || bad("table", "truncated: the file ends before it".to_owned());
    let offset = bytes.get(COMMON..COMMON + 4).ok_or_else(truncated)?;
    let offset = u32::from_le_bytes([offset[0], offset[1], offset[2], offset[3]]) as usize;
    if offset < HEADER {
        return Err(bad(
            "table",
            format!("it begins at byte {offset}, inside of the header; the file is damaged"),
        ));
    }
    let extensions = bytes.get(HEADER..offset).ok_or_else(truncated)?;
    let mut entries = bytes[offset..]
        .get(..streams * ENTRY)
        .ok_or_else(truncated)?;
    let mut rest = &bytes[offset + streams * ENTRY..];
    let mut number = || {
        let (number, after) = entries.split_first_chunk::<8>()?;
        entries = after;
        Some(u64::from_le_bytes(*number))
    };
    let mut arrays: [Vec<u8>; 6] = Default::default();
    for (array, (name, each)) in arrays.iter_mut().zip(names) {
        if each == 0 {
            continue;
        }
        let (Some(compressed), Some(claimed)) = (number(), number()) else {
            return Err(truncated());
        };
        // At most 72 bytes for each of at most 2^32 Gaussians.
        let len = each as u64 * u64::from(header.count);
        if claimed != len {
            return Err(bad(
                name,
                format!(
                    "{claimed} bytes, but {} Gaussians have {len}; the file is damaged",
                    header.count
                ),
            ));
        }
        let stream = usize::try_from(compressed)
            .ok()
            .and_then(|compressed| rest.split_at_checked(compressed));
        let Some((stream, after)) = stream else {
            return Err(bad(
                name,
                format!(
                    "truncated: {} of {compressed} bytes are in the file",
                    rest.len()
                ),
            ));
        };
        rest = after;
        *array = decompress(stream, len).map_err(|reason| bad(name, reason))?;
    }
    let extended = header.flags & EXTENDED != 0;
    Ok(Packed {
        header,
        arrays,
        extensions: if extended {
            extensions.to_vec()
        } else {
            vec![]
        },
    })
}

fn decompress(stream: &[u8], len: u64) -> Result<Vec<u8>, String> {
    let len = usize::try_from(len).map_err(|_| format!("{len} bytes exceed this machine"))?;
    // Frames say how long they are.
    if let Ok(Some(said)) = zstd::zstd_safe::get_frame_content_size(stream)
        && said != len as u64
    {
        return Err(format!(
            "Zstandard: {said} bytes instead of {len}; the file is damaged"
        ));
    }
    let mut array = vec![0; len];
    let read = zstd::bulk::decompress_to_buffer(stream, &mut array[..])
        .map_err(|error| format!("Zstandard: {}", one_line(&error.to_string())))?;
    match read == len {
        true => Ok(array),
        false => Err(format!(
            "Zstandard: {read} bytes instead of {len}; the file is damaged"
        )),
    }
}

fn check_count(path: &Path, header: &Header, file_bytes: u64) -> Result<(), SceneFileError> {
    let count = u64::from(header.count);
    if count > most_gaussians(file_bytes) {
        return Err(SceneFileError::Field {
            path: path.to_path_buf(),
            field: "header",
            reason: too_many(count, file_bytes),
        });
    }
    Ok(())
}

/// A file of version 4.
pub(super) fn pack(header: &Header, arrays: &[Vec<u8>; 6]) -> std::io::Result<Vec<u8>> {
    let arrays: Vec<&Vec<u8>> = arrays.iter().filter(|array| !array.is_empty()).collect();
    let streams = arrays
        .par_iter()
        .map(|array| zstd::bulk::compress(array, LEVEL))
        .collect::<std::io::Result<Vec<_>>>()?;
    let mut bytes = header.bytes(streams.len() as u8);
    bytes.extend((HEADER as u32).to_le_bytes());
    bytes.resize(HEADER, 0);
    for (stream, array) in streams.iter().zip(&arrays) {
        bytes.extend((stream.len() as u64).to_le_bytes());
        bytes.extend((array.len() as u64).to_le_bytes());
    }
    for stream in &streams {
        bytes.extend(stream);
    }
    Ok(bytes)
}
