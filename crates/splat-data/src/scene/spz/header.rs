//! The header that all versions begin with.

use std::path::Path;

use super::super::SceneFileError;

/// First bytes of a file of version 4, and of the contents of earlier ones.
pub(super) const MAGIC: &[u8] = b"NGSP";
/// Flag: the scene was trained with anti-aliasing.
pub(super) const ANTIALIASED: u8 = 1;
/// Flag: there are extensions.
pub(super) const EXTENDED: u8 = 2;
/// Bytes of the common part.
pub(super) const COMMON: usize = 16;
/// Most bits after the binary point; readers compute their power of two in 32-bit integers.
pub(super) const MOST_FRACTIONAL_BITS: u8 = 30;

/// The fields that all versions have.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Header {
    pub version: u32,
    /// Number of Gaussians.
    pub count: u32,
    /// Degree of the harmonics, 0 to 4.
    pub sh_degree: u8,
    /// Bits of positions after the binary point.
    pub fractional_bits: u8,
    pub flags: u8,
}

impl Header {
    /// The header from its first 16 bytes, and their last one.
    pub fn read(path: &Path, bytes: &[u8]) -> Result<(Self, u8), SceneFileError> {
        let bad = |reason: String| SceneFileError::Header {
            path: path.to_path_buf(),
            reason,
        };
        let Some(bytes) = bytes.first_chunk::<COMMON>() else {
            return Err(bad(format!(
                "no SPZ header: {} bytes instead of {COMMON}",
                bytes.len()
            )));
        };
        if !bytes.starts_with(MAGIC) {
            return Err(bad("no SPZ header: it does not begin with `NGSP`".into()));
        }
        let number = |at: usize| {
            u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
        };
        let header = Self {
            version: number(4),
            count: number(8),
            sh_degree: bytes[12],
            fractional_bits: bytes[13],
            flags: bytes[14],
        };
        if !(1..=4).contains(&header.version) {
            return Err(bad(format!(
                "SPZ version {}; versions 1 to 4 can be read, so write it again as one of those",
                header.version
            )));
        }
        if header.sh_degree > 4 {
            return Err(bad(format!(
                "SH degree {}; SPZ has 0 to 4, so the file is damaged",
                header.sh_degree
            )));
        }
        if header.fractional_bits > MOST_FRACTIONAL_BITS {
            return Err(bad(format!(
                "{} fractional bits; up to {MOST_FRACTIONAL_BITS} are possible, so the file is damaged",
                header.fractional_bits
            )));
        }
        if header.count == 0 {
            return Err(SceneFileError::Empty {
                path: path.to_path_buf(),
            });
        }
        Ok((header, bytes[15]))
    }

    /// The 16 bytes of the header; `last` is their last one.
    pub fn bytes(&self, last: u8) -> Vec<u8> {
        let mut bytes = MAGIC.to_vec();
        bytes.extend(self.version.to_le_bytes());
        bytes.extend(self.count.to_le_bytes());
        bytes.extend([self.sh_degree, self.fractional_bits, self.flags, last]);
        bytes
    }

    /// Values of the harmonics of a Gaussian, without those of degree 0.
    pub fn sh_values(&self) -> usize {
        3 * ((usize::from(self.sh_degree) + 1).pow(2) - 1)
    }

    /// Name and bytes per Gaussian of each array, in the order of the file.
    pub fn arrays(&self) -> [(&'static str, usize); 6] {
        [
            ("positions", if self.version == 1 { 6 } else { 9 }),
            ("alphas", 1),
            ("colors", 3),
            ("scales", 3),
            ("rotations", if self.version < 3 { 3 } else { 4 }),
            ("sh", self.sh_values()),
        ]
    }
}
