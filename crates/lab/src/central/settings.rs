//! How closely gradients are checked.

/// Settings of [`gradcheck_with`](super::gradcheck_with).
///
/// ```
/// use splat_lab::central::Settings;
///
/// let settings = Settings::new().with_tolerance(1e-6).with_directions(8);
/// # let _ = settings;
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    pub(super) tolerance: f64,
    pub(super) safety: f64,
    pub(super) step: f64,
    pub(super) each_up_to: usize,
    pub(super) directions: usize,
    pub(super) seed: u64,
    pub(super) refuse_kinks: bool,
    pub(super) upstream: Option<Vec<f64>>,
    pub(super) constants: Vec<String>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            tolerance: 1e-7,
            safety: 10.0,
            step: 1.0 / 64.0,
            each_up_to: 1000,
            directions: 4,
            seed: 0,
            refuse_kinks: false,
            upstream: None,
            constants: Vec::new(),
        }
    }
}

impl Settings {
    /// The default settings.
    pub fn new() -> Self {
        Self::default()
    }

    /// Relative difference between analytic and numeric derivative that passes; 1e-7 by default.
    ///
    /// Of an element it is relative to its own derivative, and a thousandth of that to the root
    /// mean square of its input's. Along a direction over many elements it is relative to the root
    /// of the sum of the squares of their derivatives.
    pub fn with_tolerance(mut self, tolerance: f64) -> Self {
        self.tolerance = tolerance;
        self
    }

    /// Multiples of the numeric derivative's estimated error that pass as well; 10 by default.
    pub fn with_safety(mut self, safety: f64) -> Self {
        self.safety = safety;
        self
    }

    /// The largest step, relative to the size of an element; 1/64 by default. Smaller ones follow,
    /// each a quarter of the one before, until the error is small. Choose it smaller for a function
    /// that cannot be evaluated so far from its inputs.
    pub fn with_step(mut self, step: f64) -> Self {
        self.step = step;
        self
    }

    /// Inputs of at most this many elements are checked element by element, larger ones along
    /// directions; 1000 by default.
    pub fn with_each_up_to(mut self, elements: usize) -> Self {
        self.each_up_to = elements;
        self
    }

    /// Random directions over all elements of a large input; 4 by default. One finds nearly every
    /// wrong element; more of them make it less likely that errors of two elements cancel.
    pub fn with_directions(mut self, directions: usize) -> Self {
        self.directions = directions;
        self
    }

    /// Seed of the directions and of the weights of the outputs; 0 by default.
    pub fn with_seed(mut self, seed: u64) -> Self {
        self.seed = seed;
        self
    }

    /// Every kink fails, even where the gradient lies between the slopes on both sides.
    pub fn with_kinks_refused(mut self) -> Self {
        self.refuse_kinks = true;
        self
    }

    /// Weights of the outputs' elements in the sum that is differentiated: outputs in order, each
    /// row-major. Random ones, of both signs and none near zero, by default.
    pub fn with_upstream(mut self, upstream: impl Into<Vec<f64>>) -> Self {
        self.upstream = Some(upstream.into());
        self
    }

    /// The input of this name is handed to the function and not differentiated.
    pub fn with_constant(mut self, input: impl Into<String>) -> Self {
        self.constants.push(input.into());
        self
    }
}
