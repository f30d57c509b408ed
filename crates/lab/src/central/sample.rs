//! Results of one step of central differences, and the sequence of steps.

/// Most steps tried. The last is 2^-20 of the first.
pub(super) const LEVELS: usize = 11;
pub(super) const RATIO: f64 = 4.0;

/// Outputs that change along a line.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Extent {
    /// Weighted root of the sum of their squares.
    pub size: f64,
    /// The same for their weights alone.
    pub weight: f64,
}

impl Extent {
    /// Union of both. An output that changes at a large step is rounded at a small step too, even
    /// if it does not seem to change there.
    pub(super) fn or(self, other: Self) -> Self {
        Self {
            size: self.size.max(other.size),
            weight: self.weight.max(other.weight),
        }
    }
}

/// Result of one step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    /// `(f(h) - f(-h)) / 2h`.
    pub central: f64,
    /// `(f(h) - 2 f(0) + f(-h)) / h`: slope on the right minus slope on the left.
    pub jump: f64,
    /// Outputs that changed.
    pub extent: Extent,
}
