//! Sizes and settings of the ops. Every constant of the method is a field with a default.

/// Size of the rendered image in pixels. The centre of pixel (i, j) lies at (i + 0.5, j + 0.5).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageSize {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Smallest opacity that changes an 8-bit image (3DGS appendix C).
pub const ALPHA_MIN: f64 = 1.0 / 255.0;

/// Settings of `project`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProjectSettings {
    /// Splats with camera z below this are culled. World units. Default 0.01 (gsplat).
    pub near: f64,
    /// Splats with camera z above this are culled. World units. Default 1e10 (gsplat).
    pub far: f64,
    /// Low-pass filter: variance added to the diagonal of the 2D covariance, in pixels squared.
    /// Default 0.3 (3DGS reference implementation).
    pub eps2d: f64,
    /// Margin outside the image, as a share of its width (height), within which the Jacobian of the
    /// projection is evaluated. Default 0.15.
    pub clamp_margin: f64,
    /// Opacity at which a splat's extent ends. Default 1/255 (3DGS appendix C).
    pub alpha_min: f64,
}

impl Default for ProjectSettings {
    fn default() -> Self {
        Self {
            near: 0.01,
            far: 1e10,
            eps2d: 0.3,
            clamp_margin: 0.15,
            alpha_min: ALPHA_MIN,
        }
    }
}

impl ProjectSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets `near`.
    #[must_use]
    pub fn with_near(mut self, near: f64) -> Self {
        self.near = near;
        self
    }

    /// Sets `far`.
    #[must_use]
    pub fn with_far(mut self, far: f64) -> Self {
        self.far = far;
        self
    }

    /// Sets `eps2d`.
    #[must_use]
    pub fn with_eps2d(mut self, eps2d: f64) -> Self {
        self.eps2d = eps2d;
        self
    }

    /// Sets `clamp_margin`.
    #[must_use]
    pub fn with_clamp_margin(mut self, clamp_margin: f64) -> Self {
        self.clamp_margin = clamp_margin;
        self
    }

    /// Sets `alpha_min`.
    #[must_use]
    pub fn with_alpha_min(mut self, alpha_min: f64) -> Self {
        self.alpha_min = alpha_min;
        self
    }
}

/// Settings of `rasterize`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RasterizeSettings {
    /// Alpha below which a splat is skipped at a pixel; positive. Default 1/255 (3DGS appendix C).
    pub alpha_min: f64,
    /// Cap of alpha, below 1; the gradient through a capped alpha is zero. Default 0.99 (3DGS
    /// appendix C).
    pub alpha_max: f64,
    /// A pixel stops before its transmittance would fall below this; if 0, never. Default 9.999e-5:
    /// the 1e-4 of 3DGS appendix C less one part in 10,000, because two splats at the cap leave
    /// exactly 1e-4, which rounds either way.
    pub transmittance_min: f64,
    /// Makes gradients reproducible bit for bit. Default true.
    ///
    /// When false, a CubeCL device sums the tiles' shares of a splat's gradient by atomic
    /// addition, which differs between runs in the last digits. That saves memory: per
    /// intersection 24 bytes and 4 per channel in the backward pass and 4 bytes from the forward
    /// pass on, and 12 bytes per Gaussian and camera. `docs/notes/rasteriser-gradient.md` compares
    /// the times. The CPU always sums in order.
    pub deterministic: bool,
}

impl Default for RasterizeSettings {
    fn default() -> Self {
        Self {
            alpha_min: ALPHA_MIN,
            alpha_max: 0.99,
            transmittance_min: 9.999e-5,
            deterministic: true,
        }
    }
}

impl RasterizeSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets `alpha_min`.
    #[must_use]
    pub fn with_alpha_min(mut self, alpha_min: f64) -> Self {
        self.alpha_min = alpha_min;
        self
    }

    /// Sets `alpha_max`.
    #[must_use]
    pub fn with_alpha_max(mut self, alpha_max: f64) -> Self {
        self.alpha_max = alpha_max;
        self
    }

    /// Sets `transmittance_min`.
    #[must_use]
    pub fn with_transmittance_min(mut self, transmittance_min: f64) -> Self {
        self.transmittance_min = transmittance_min;
        self
    }

    /// Sets `deterministic`.
    #[must_use]
    pub fn with_deterministic(mut self, deterministic: bool) -> Self {
        self.deterministic = deterministic;
        self
    }
}

/// Gradient of the clamp of colours at zero, `max(x, 0)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ClampGradient {
    /// The derivative: zero below zero.
    #[default]
    Exact,
    /// The derivative, and below zero also a gradient whose descent raises the channel. A channel
    /// below zero in every view would otherwise stay black forever, since no gradient reaches it.
    /// For training.
    Recovering,
}

/// Settings of `sh_colors`. A degree converts into settings with the exact gradient.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct ShColorSettings {
    /// Degree of the spherical harmonics, 0 to 3. Default 0.
    pub degree: usize,
    /// Gradient of the clamp at zero. Default exact.
    pub clamp_gradient: ClampGradient,
}

impl ShColorSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets `degree`.
    #[must_use]
    pub fn with_degree(mut self, degree: usize) -> Self {
        self.degree = degree;
        self
    }

    /// Sets `clamp_gradient`.
    #[must_use]
    pub fn with_clamp_gradient(mut self, clamp_gradient: ClampGradient) -> Self {
        self.clamp_gradient = clamp_gradient;
        self
    }
}

impl From<usize> for ShColorSettings {
    fn from(degree: usize) -> Self {
        Self {
            degree,
            ..Self::default()
        }
    }
}

/// An elementwise function.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Activation {
    /// `exp(x)`.
    Exp,
    /// `1 / (1 + exp(-x))`.
    Sigmoid,
}

/// Constants of one step of Adam, with the bias corrections folded into `rate` and `epsilon`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamStep {
    /// Decay of the first moment.
    pub beta_1: f64,
    /// Decay of the second moment.
    pub beta_2: f64,
    /// Learning rate times `sqrt(1 - beta_2^t) / (1 - beta_1^t)`.
    pub rate: f64,
    /// Added to the root of the second moment; epsilon times `sqrt(1 - beta_2^t)`.
    pub epsilon: f64,
    /// Rows that take the step.
    pub rows: AdamRows,
}

/// What several steps of Adam without a gradient do to a row: `p = p - step m / (sqrt(v) +
/// epsilon)`, then `m = keep_1 m`, `v = keep_2 v`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamGap {
    /// Product of the decays of the first moment.
    pub keep_1: f64,
    /// Product of the decays of the second moment.
    pub keep_2: f64,
    /// Sum of the steps' rates, each times what is left of `m / sqrt(v)` then.
    pub step: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
}

impl AdamGap {
    /// No steps.
    pub const NONE: Self = Self {
        keep_1: 1.0,
        keep_2: 1.0,
        step: 0.0,
        epsilon: 1.0,
    };
}

/// Rows of a parameter, along its first dimension, that a step changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AdamRows {
    /// All rows, as Adam is defined: where the gradient is zero, moments decay and parameters keep
    /// drifting.
    #[default]
    All,
    /// Rows whose gradient is not all zero (NaN counts as zero); others keep parameter and moments,
    /// as if the step had not happened. This is the sparse Adam of Mallick et al. 2024, *Taming
    /// 3DGS*, and `SelectiveAdam` of gsplat: another optimiser with other results, and faster if
    /// most Gaussians are out of view.
    Seen,
}

/// The noise of one step of Langevin dynamics (Kheradmand et al. 2024, *3D Gaussian Splatting as
/// Markov Chain Monte Carlo*, section 3).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Perturbation {
    /// Factor of the noise where nothing fades it, in 1 / world units; positive.
    pub amount: f64,
    /// Opacity at which half of that is left.
    pub opacity: f64,
    /// How steeply it falls with the opacity.
    pub steepness: f64,
    /// Seed of the run.
    pub seed: u64,
    /// The step. Draws are a function of seed, step and row.
    pub step: u32,
}

impl Perturbation {
    /// Factor of the noise of a Gaussian of this opacity.
    pub fn gate(&self, opacity: f64) -> f64 {
        self.amount / (1.0 + (self.steepness * (opacity - self.opacity)).exp())
    }

    /// The words that the draws of a row are a hash of.
    pub fn words(&self, row: u32) -> [u32; 4] {
        [row, self.step, self.seed as u32, (self.seed >> 32) as u32]
    }
}

/// Window and constants of structural similarity.
#[derive(Debug, Clone, PartialEq)]
pub struct SsimArgs {
    /// Weights along one axis, symmetric, of odd length.
    pub window: Vec<f64>,
    /// Constant of the luminance term.
    pub c1: f64,
    /// Constant of the contrast term.
    pub c2: f64,
}
