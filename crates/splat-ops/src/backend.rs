//! Backend traits. Each op has a trait as Burn dispatches it ([`ProjectOps`]); an op with its own
//! gradient has a second one for that ([`ProjectBackend`]). [`SplatBackend`] combines them all.
//!
//! Callers have checked all shapes; tensors need not be contiguous. A gradient function is told
//! which gradients are needed and returns `None` for the others.

use core::fmt::Debug;

use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{
    Backend, BackendTensor, DispatchAutodiffContext, DispatchTensor, DispatchTensorKind,
    ExtensionType, backend_extension,
};
// The expansion of `#[backend_extension]` names these.
#[allow(unused_imports)]
use burn::backend::{Autodiff, Dispatch};

use crate::settings::{
    Activation, AdamGap, AdamStep, Perturbation, ProjectArgs, RasterizeArgs, RowGroups,
    ShColorSettings, SsimArgs,
};

pub use splat_core::{
    AdamTensors, PROJECTED_EXTENT, PROJECTED_WIDTH, PerturbTensors, ProjectTensors,
    RasterizeTensors, ScreenStatisticsTensors, ShColorTensors, SphericalHarmonicsTensors,
    SsimTensors,
};

/// Tensors of one op, in the form that Burn's dispatch carries.
#[derive(Debug, Clone)]
pub struct OpInputs<X>(pub X);

/// Names the inputs of ops and passes them through Burn's dispatch.
macro_rules! inputs {
    ($($(#[$doc:meta])* $name:ident = $tensors:ty;)+) => {$(
        $(#[$doc])*
        pub type $name<B> = OpInputs<$tensors>;

        impl<B: Backend> ExtensionType<B> for $name<B> {
            type Target = $name<Dispatch>;

            fn map_to_dispatch<F>(self, map_kind: F, autodiff: DispatchAutodiffContext) -> Self::Target
            where
                F: Fn(BackendTensor<B>) -> DispatchTensorKind,
            {
                OpInputs(self.0.map_inputs(|tensor| DispatchTensor {
                    kind: map_kind(BackendTensor::Float(tensor)),
                    autodiff,
                }))
            }

            fn map_from_dispatch<F>(target: Self::Target, unwrap_kind: F) -> Self
            where
                F: Fn(DispatchTensor) -> BackendTensor<B>,
            {
                OpInputs(target.0.map_inputs(|tensor| unwrap_kind(tensor).float()))
            }

            fn routing_tensor(target: &Self::Target) -> Option<&DispatchTensor> {
                <[_; _]>::from(target.0.inputs()).into_iter().flatten().next()
            }

            fn routing_float_tensor(target: &Self::Target) -> Option<&DispatchTensor> {
                <Self as ExtensionType<B>>::routing_tensor(target)
            }

            fn autodiff_context(target: &Self::Target) -> DispatchAutodiffContext {
                let tensors = <[_; _]>::from(target.0.inputs()).into_iter().flatten();
                tensors.fold(DispatchAutodiffContext::Disabled, |context, tensor| {
                    context.merge(tensor.autodiff)
                })
            }
        }
    )+};
}

inputs! {
    /// Inputs of [`ProjectOps`].
    ProjectInputs = ProjectTensors<FloatTensor<B>, Option<FloatTensor<B>>>;
    /// Inputs of [`SphericalHarmonicsOps`].
    SphericalHarmonicsInputs = SphericalHarmonicsTensors<FloatTensor<B>>;
    /// Inputs of [`ShColorsOps`].
    ShColorInputs = ShColorTensors<FloatTensor<B>, Option<FloatTensor<B>>>;
    /// Inputs of [`RasterizeOps`].
    RasterizeInputs = RasterizeTensors<FloatTensor<B>, Option<FloatTensor<B>>>;
    /// Inputs of [`SsimOps`].
    SsimInputs = SsimTensors<FloatTensor<B>>;
    /// Inputs of [`AdamOps`].
    AdamInputs = AdamTensors<FloatTensor<B>>;
    /// Inputs of [`PerturbOps`].
    PerturbInputs = PerturbTensors<FloatTensor<B>>;
    /// Inputs of [`ScreenStatisticsOps`].
    ScreenStatisticsInputs = ScreenStatisticsTensors<FloatTensor<B>>;
}

/// Gradients of [`ProjectInputs`].
pub type ProjectGradients<B> = ProjectTensors<Option<FloatTensor<B>>>;
/// Gradients of [`SphericalHarmonicsInputs`].
pub type SphericalHarmonicsGradients<B> = SphericalHarmonicsTensors<Option<FloatTensor<B>>>;
/// Gradients of [`ShColorInputs`].
pub type ShColorGradients<B> = ShColorTensors<Option<FloatTensor<B>>>;
/// Gradients of [`RasterizeInputs`].
pub type RasterizeGradients<B> = RasterizeTensors<Option<FloatTensor<B>>>;
/// Gradients of [`SsimInputs`].
pub type SsimGradients<B> = SsimTensors<Option<FloatTensor<B>>>;

/// Photo that [`photometric`](crate::photometric) compares with, `[B, H, W, D]`, in the form that
/// Burn's dispatch carries.
#[derive(Debug, Clone, ExtensionType)]
pub enum Target<B: Backend> {
    /// Levels 0 to 255 of any integer type, meaning `level / 255`.
    Levels(IntTensor<B>),
    /// The values themselves.
    Values(FloatTensor<B>),
}

/// How the coefficients of [`ShColorInputs`] belong to the Gaussians, in the form that Burn's
/// dispatch carries.
#[derive(Debug, Clone, ExtensionType)]
pub enum ShLayout<B: Backend> {
    /// As many of each, `[N, R, 3]`.
    Uniform,
    /// Those of each Gaussian's own degree, `[K, 1, 3]`, at the rows that start here: `[N + 1]`, of
    /// type I32, as [`ShStarts`](crate::ShStarts) has checked them.
    Ragged(IntTensor<B>),
}

/// A parameter and its moments after a step, in the form that Burn's dispatch carries.
#[derive(Debug, Clone, ExtensionType)]
pub struct AdamOutputs<B: Backend> {
    /// Parameter.
    pub param: FloatTensor<B>,
    /// First moment.
    pub moment_1: FloatTensor<B>,
    /// Second moment.
    pub moment_2: FloatTensor<B>,
}

/// Sums of screen gradients and of views, in the form that Burn's dispatch carries.
#[derive(Debug, Clone, ExtensionType)]
pub struct ScreenStatisticsOutputs<B: Backend> {
    /// Sums of the lengths of screen gradients `[N]`.
    pub gradients: FloatTensor<B>,
    /// Sums of views `[N]`.
    pub views: FloatTensor<B>,
}

/// [`project`](crate::project).
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait ProjectOps: Backend {
    /// Packed splats `[C, N, 9]`.
    fn project(
        #[extension_type] inputs: ProjectInputs<Self>,
        args: ProjectArgs,
    ) -> FloatTensor<Self>;
}

/// The gradient of [`ProjectOps`].
pub trait ProjectBackend: ProjectOps {
    /// Gradients of the inputs, from the gradient `[C, N, 9]` of the packed splats.
    fn project_backward(
        inputs: ProjectInputs<Self>,
        grad_packed: FloatTensor<Self>,
        args: &ProjectArgs,
        needs_grad: ProjectTensors<bool>,
    ) -> ProjectGradients<Self>;
}

/// [`Projected::with_screen_probe`](crate::Projected::with_screen_probe).
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait ScreenProbeOps: Backend {
    /// Returns the packed splats unchanged; their gradient goes to the probe too.
    fn screen_probe(packed: FloatTensor<Self>, _probe: FloatTensor<Self>) -> FloatTensor<Self> {
        packed
    }
}

/// [`spherical_harmonics`](crate::spherical_harmonics()).
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait SphericalHarmonicsOps: Backend {
    /// Colours `[C, N, 3]`.
    fn spherical_harmonics(
        #[extension_type] inputs: SphericalHarmonicsInputs<Self>,
        degree: usize,
    ) -> FloatTensor<Self>;
}

/// The gradient of [`SphericalHarmonicsOps`].
pub trait SphericalHarmonicsBackend: SphericalHarmonicsOps {
    /// Gradients of the inputs, from the gradient `[C, N, 3]` of the colours.
    fn spherical_harmonics_backward(
        inputs: SphericalHarmonicsInputs<Self>,
        grad_colors: FloatTensor<Self>,
        degree: usize,
        needs_grad: SphericalHarmonicsTensors<bool>,
    ) -> SphericalHarmonicsGradients<Self>;
}

/// [`sh_colors`](crate::sh_colors()).
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait ShColorsOps: Backend {
    /// Colours `[C, N, 3]`. Higher coefficients are present exactly when the degree is above 0.
    fn sh_colors(
        #[extension_type] inputs: ShColorInputs<Self>,
        #[extension_type] layout: ShLayout<Self>,
        settings: ShColorSettings,
    ) -> FloatTensor<Self>;
}

/// The gradient of [`ShColorsOps`].
pub trait ShColorsBackend: ShColorsOps {
    /// Gradients of the inputs, from the gradient `[C, N, 3]` of the colours.
    fn sh_colors_backward(
        inputs: ShColorInputs<Self>,
        layout: ShLayout<Self>,
        grad_colors: FloatTensor<Self>,
        settings: ShColorSettings,
        needs_grad: ShColorTensors<bool>,
    ) -> ShColorGradients<Self>;
}

/// [`exp`](crate::exp) and [`sigmoid`](crate::sigmoid).
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait ActivationOps: Backend {
    /// Applies the function to every element.
    fn activation(x: FloatTensor<Self>, function: Activation) -> FloatTensor<Self>;
}

/// The gradient of [`ActivationOps`].
pub trait ActivationBackend: ActivationOps {
    /// Gradient of the input x, from x, the output y, and the gradient of y.
    fn activation_backward(
        x: FloatTensor<Self>,
        y: FloatTensor<Self>,
        grad_y: FloatTensor<Self>,
        function: Activation,
    ) -> FloatTensor<Self>;
}

/// [`rasterize`](crate::rasterize()).
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait RasterizeOps: Backend {
    /// Image `[C, H, W, D + 1]`; the last channel is alpha.
    ///
    /// Reports errors to `args.errors`. The image is then zero, and so are gradients computed from
    /// the state.
    fn rasterize(
        #[extension_type] inputs: RasterizeInputs<Self>,
        args: RasterizeArgs,
    ) -> FloatTensor<Self>;
}

/// The gradient of [`RasterizeOps`].
pub trait RasterizeBackend: RasterizeOps {
    /// State kept for the backward pass: lists of splats per tile, final transmittances and so on.
    type RasterizeState: Clone + Debug + Send + 'static;

    /// [`RasterizeOps::rasterize`], with the state that its gradient needs.
    fn rasterize_tracked(
        inputs: RasterizeInputs<Self>,
        args: &RasterizeArgs,
    ) -> (FloatTensor<Self>, Self::RasterizeState);

    /// Gradients of the inputs, from the state and the gradient `[C, H, W, D + 1]` of the output.
    fn rasterize_backward(
        inputs: RasterizeInputs<Self>,
        state: Self::RasterizeState,
        grad_output: FloatTensor<Self>,
        args: &RasterizeArgs,
        needs_grad: RasterizeTensors<bool>,
    ) -> RasterizeGradients<Self>;
}

/// [`gaussian_blur`](crate::gaussian_blur). Linear and self-adjoint, so it is its own gradient.
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait BlurOps: Backend {
    /// Convolves the rows and columns of `[B, H, W, D]` with a symmetric window of odd length; zero
    /// outside.
    fn gaussian_blur(image: FloatTensor<Self>, window: Vec<f64>) -> FloatTensor<Self>;
}

/// [`ssim_map`](crate::ssim_map).
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait SsimOps: Backend {
    /// The map `[B, H, W, D]`.
    fn ssim(#[extension_type] inputs: SsimInputs<Self>, args: SsimArgs) -> FloatTensor<Self>;
}

/// The gradient of [`SsimOps`].
pub trait SsimBackend: SsimOps {
    /// [`SsimOps::ssim`], with the windowed moments that its gradient needs.
    fn ssim_tracked(
        inputs: SsimInputs<Self>,
        args: &SsimArgs,
    ) -> (FloatTensor<Self>, Vec<FloatTensor<Self>>);

    /// Gradients of both images, from the moments and the gradient of the map.
    fn ssim_backward(
        inputs: SsimInputs<Self>,
        moments: Vec<FloatTensor<Self>>,
        grad_map: FloatTensor<Self>,
        args: &SsimArgs,
        needs_grad: SsimTensors<bool>,
    ) -> SsimGradients<Self>;
}

/// [`photometric`](crate::photometric()).
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait PhotometricOps: Backend {
    /// [`Photometric::losses`](crate::Photometric::losses), `[2]`.
    fn photometric(
        rendered: FloatTensor<Self>,
        #[extension_type] target: Target<Self>,
        args: SsimArgs,
    ) -> FloatTensor<Self>;
}

/// The gradient of [`PhotometricOps`].
pub trait PhotometricBackend: PhotometricOps {
    /// [`PhotometricOps::photometric`], with the state that its gradient needs.
    fn photometric_tracked(
        rendered: FloatTensor<Self>,
        target: Target<Self>,
        args: &SsimArgs,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);

    /// Gradient of the rendered images `[B, H, W, E]`, from the state and the gradient `[2]` of the
    /// losses.
    fn photometric_backward(
        rendered: FloatTensor<Self>,
        target: Target<Self>,
        kept: FloatTensor<Self>,
        grad_losses: FloatTensor<Self>,
        args: &SsimArgs,
    ) -> FloatTensor<Self>;
}

/// [`ScreenStatistics::add`](crate::ScreenStatistics::add). Not differentiable.
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait ScreenStatisticsOps: Backend {
    /// Adds the lengths of `half * gradient` and the views to the sums, of the given rows if the
    /// splats are those of some alone.
    fn add_screen_statistics(
        #[extension_type] inputs: ScreenStatisticsInputs<Self>,
        half: [f64; 2],
        rows: Option<RowGroups>,
    ) -> ScreenStatisticsOutputs<Self>;
}

/// [`adam_step`](crate::adam_step), [`adam_step_groups`](crate::adam_step_groups) and
/// [`adam_catch_up`](crate::adam_catch_up). Not differentiable.
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait AdamOps: Backend {
    /// Parameter and moments after the step.
    fn adam(#[extension_type] inputs: AdamInputs<Self>, step: AdamStep) -> AdamOutputs<Self>;

    /// The same for the given rows, of which the gradient has one each; others stay as they are.
    fn adam_groups(
        #[extension_type] inputs: AdamInputs<Self>,
        step: AdamStep,
        rows: RowGroups,
    ) -> AdamOutputs<Self>;

    /// Parameter and moments after steps without a gradient, of the given rows; a gap for each
    /// group.
    fn adam_catch_up(
        #[extension_type] tensors: AdamOutputs<Self>,
        rows: RowGroups,
        gaps: Vec<AdamGap>,
    ) -> AdamOutputs<Self>;
}

/// [`perturb_means`](crate::perturb_means). Not differentiable.
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub trait PerturbOps: Backend {
    /// The means after the noise.
    fn perturb(
        #[extension_type] inputs: PerturbInputs<Self>,
        noise: Perturbation,
    ) -> FloatTensor<Self>;
}

/// Everything that the ops need from a backend.
pub trait SplatBackend:
    ProjectBackend
    + ScreenProbeOps
    + SphericalHarmonicsBackend
    + ShColorsBackend
    + ActivationBackend
    + RasterizeBackend
    + BlurOps
    + SsimBackend
    + PhotometricBackend
    + ScreenStatisticsOps
    + AdamOps
    + PerturbOps
{
}

impl<B> SplatBackend for B where
    B: ProjectBackend
        + ScreenProbeOps
        + SphericalHarmonicsBackend
        + ShColorsBackend
        + ActivationBackend
        + RasterizeBackend
        + BlurOps
        + SsimBackend
        + PhotometricBackend
        + ScreenStatisticsOps
        + AdamOps
        + PerturbOps
{
}
