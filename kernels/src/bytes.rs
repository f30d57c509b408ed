//! Bytes that a stage moves, and the sizes they follow from.

/// Bytes read and written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bytes {
    /// From device memory.
    pub read: u64,
    /// To device memory.
    pub written: u64,
}

impl Bytes {
    /// Sum of both directions.
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

/// Size of a training step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// Gaussians.
    pub gaussians: u64,
    /// Gaussians that reach into the view.
    pub visible: u64,
    /// Intersections, each of a splat and a tile.
    pub intersections: u64,
    /// Width of the view.
    pub width: u64,
    /// Height of the view.
    pub height: u64,
    /// Colour channels.
    pub channels: u64,
    /// Degree of spherical harmonics.
    pub degree: usize,
    /// Trained floats per Gaussian.
    pub parameters: u64,
    /// Bits per digit of the sort on this device: [`sort::digit_bits`](crate::sort::digit_bits).
    pub digit_bits: u32,
}
