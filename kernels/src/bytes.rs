//! Bytes that a stage moves, and what they follow from.

/// Bytes read and written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bytes {
    /// From device memory.
    pub read: u64,
    /// To device memory.
    pub written: u64,
}

impl Bytes {
    /// Both ways together.
    pub fn total(self) -> u64 {
        self.read + self.written
    }
}

impl core::ops::Add for Bytes {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            read: self.read + other.read,
            written: self.written + other.written,
        }
    }
}

/// How large a training step is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// Gaussians.
    pub gaussians: u64,
    /// Those that reach into the view.
    pub visible: u64,
    /// Intersections of splats and tiles.
    pub intersections: u64,
    /// Width of the view.
    pub width: u64,
    /// Height of the view.
    pub height: u64,
    /// Colour channels.
    pub channels: u64,
    /// Degree of spherical harmonics.
    pub degree: usize,
    /// Floats of one Gaussian that are trained.
    pub parameters: u64,
    /// Bits of a digit of the sort on this device: [`sort::digit_bits`](crate::sort::digit_bits).
    pub digit_bits: u32,
}
