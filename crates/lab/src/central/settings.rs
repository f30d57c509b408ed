//! Settings of gradient checks.

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

    /// Sets the allowed relative difference between analytic and numeric derivative. Default 1e-7.
    ///
    /// For an element it is relative to its own derivative, and a thousandth of it to the root mean
    /// square of its input's. For a direction over many elements it is relative to the root of the
    /// sum of their squared derivatives.
    pub fn with_tolerance(mut self, tolerance: f64) -> Self {
        self.tolerance = tolerance;
        self
    }

    /// Sets the multiple of the numeric derivative's estimated error that also passes. Default 10.
    pub fn with_safety(mut self, safety: f64) -> Self {
        self.safety = safety;
        self
    }

    /// Sets the largest step, relative to the size of an element. Default 1/64. Smaller steps
    /// follow, each a quarter of the previous one, until the error is small. Choose a smaller value
    /// for functions that cannot be evaluated so far from their inputs.
    pub fn with_step(mut self, step: f64) -> Self {
        self.step = step;
        self
    }

    /// Sets the number of elements up to which inputs are checked element by element; larger ones
    /// are checked along directions. Default 1000.
    pub fn with_each_up_to(mut self, elements: usize) -> Self {
        self.each_up_to = elements;
        self
    }

    /// Sets the number of random directions over all elements of a large input. Default 4. One
    /// finds nearly every wrong element; more make it less likely that errors of two elements
    /// cancel.
    pub fn with_directions(mut self, directions: usize) -> Self {
        self.directions = directions;
        self
    }

    /// Sets the seed of the directions and of the outputs' weights. Default 0.
    pub fn with_seed(mut self, seed: u64) -> Self {
        self.seed = seed;
        self
    }

    /// Makes every kink fail, even if the gradient lies between the slopes on both sides.
    pub fn with_kinks_refused(mut self) -> Self {
        self.refuse_kinks = true;
        self
    }

    /// Sets the weights of the outputs' elements in the sum that is differentiated: outputs in
    /// order, each row-major. Random by default, of both signs and none near zero.
    pub fn with_upstream(mut self, upstream: impl Into<Vec<f64>>) -> Self {
        self.upstream = Some(upstream.into());
        self
    }

    /// Passes the input of this name to the function without differentiating it.
    pub fn with_constant(mut self, input: impl Into<String>) -> Self {
        self.constants.push(input.into());
        self
    }
}
