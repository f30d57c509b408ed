//! Bounds on what a compressed scene file may hold, so that a damaged or malicious one cannot fill
//! the memory.

use std::io::Read;

/// Gaussians that a file of any size may hold.
const ALWAYS: u64 = 1 << 16;

/// Most Gaussians that a compressed file of this many bytes is believed to hold: 65,536, and two
/// for each byte. Trained scenes take 10 bytes or more for each.
pub(super) fn most_gaussians(file_bytes: u64) -> u64 {
    file_bytes.saturating_mul(2).saturating_add(ALWAYS)
}

/// Why so many Gaussians are refused.
pub(super) fn too_many(count: u64, file_bytes: u64) -> String {
    format!(
        "{count} Gaussians in {file_bytes} bytes cannot be; the file is damaged or cut off, fetch it again"
    )
}

/// Reads up to `len` bytes into memory that grows with what is there.
pub(super) fn read_at_most(reader: &mut impl Read, len: u64) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    reader.take(len).read_to_end(&mut bytes)?;
    Ok(bytes)
}
