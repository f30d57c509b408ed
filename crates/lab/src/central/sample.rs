//! What one step of central differences gives, and how steps shrink.

/// Steps tried at most. The last is 2^-20 of the first.
pub(super) const LEVELS: usize = 11;
pub(super) const RATIO: f64 = 4.0;

/// The outputs that change along a line.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Extent {
    /// Root of the sum of their squares, weighted.
    pub size: f64,
    /// The same of their weights alone.
    pub weight: f64,
}

impl Extent {
    /// Both. An output that changes at a large step is rounded at a small one too, where it may not
    /// seem to change.
    pub(super) fn or(self, other: Self) -> Self {
        Self {
            size: self.size.max(other.size),
            weight: self.weight.max(other.weight),
        }
    }
}

/// What one step gives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    /// `(f(h) - f(-h)) / 2h`.
    pub central: f64,
    /// `(f(h) - 2 f(0) + f(-h)) / h`: the slope on the right minus that on the left.
    pub jump: f64,
    /// What changed.
    pub extent: Extent,
}
