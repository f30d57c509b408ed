//! What a backend must provide ([`SplatBackend`]), and the route from Burn's device-dispatched
//! tensors to it (`SplatOps`).

use core::fmt::Debug;

use burn::backend::{
    Backend, ExtensionType, backend_extension,
    tensor::{FloatTensor, IntTensor},
};
// The expansion of `#[backend_extension]` names these.
#[allow(unused_imports)]
use burn::backend::{Autodiff, Dispatch};

use crate::composed;
use crate::settings::Activation;
use crate::settings::AdamStep;
use crate::settings::SsimArgs;
use crate::settings::{ProjectArgs, RasterizeArgs, ShColorSettings};

pub use splat_core::{PROJECTED_EXTENT, PROJECTED_WIDTH};

/// The forward and backward computations of one backend. Callers have checked all shapes; tensors
/// need not be contiguous. `wanted` says which gradients are needed, in the order of the inputs;
/// the others are `None` and cost nothing.
pub trait SplatBackend: Backend {
    /// What `rasterize_forward` keeps for its backward: lists of splats per tile, final
    /// transmittances and the like.
    type RasterizeState: Clone + Debug + Send + 'static;

    /// Means `[N, 3]`, quats `[N, 4]`, scales `[N, 3]`, viewmats `[C, 4, 4]`, intrinsics `[C, 4]`
    /// to packed splats `[C, N, 9]`.
    fn project_forward(
        means: FloatTensor<Self>,
        quats: FloatTensor<Self>,
        scales: FloatTensor<Self>,
        viewmats: FloatTensor<Self>,
        intrinsics: FloatTensor<Self>,
        args: &ProjectArgs,
    ) -> FloatTensor<Self>;

    /// Gradients of the five inputs of [`project_forward`](Self::project_forward), given the
    /// gradient `[C, N, 9]` of its output.
    fn project_backward(
        means: FloatTensor<Self>,
        quats: FloatTensor<Self>,
        scales: FloatTensor<Self>,
        viewmats: FloatTensor<Self>,
        intrinsics: FloatTensor<Self>,
        grad_packed: FloatTensor<Self>,
        args: &ProjectArgs,
        wanted: [bool; 5],
    ) -> [Option<FloatTensor<Self>>; 5];

    /// Coefficients `[N, K, 3]`, K >= (degree + 1)^2, and directions `[C, N, 3]` to `[C, N, 3]`.
    fn spherical_harmonics_forward(
        coeffs: FloatTensor<Self>,
        dirs: FloatTensor<Self>,
        degree: usize,
    ) -> FloatTensor<Self>;

    /// Gradients of coefficients and directions, given the gradient `[C, N, 3]` of the output.
    fn spherical_harmonics_backward(
        coeffs: FloatTensor<Self>,
        dirs: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        degree: usize,
        wanted: [bool; 2],
    ) -> [Option<FloatTensor<Self>>; 2];

    /// [`sh_colors`](crate::sh_colors): `[N, 1, 3]`, `[N, R, 3]`, means `[N, 3]` and centres `[C, 3]` to `[C, N, 3]`. There
    /// are higher coefficients exactly when the degree is above 0.
    fn sh_colors_forward(inputs: ShInputs<Self>, settings: ShColorSettings) -> FloatTensor<Self>;

    /// Gradients of the four inputs, given the gradient `[C, N, 3]` of the colours.
    fn sh_colors_backward(
        inputs: ShInputs<Self>,
        grad: FloatTensor<Self>,
        settings: ShColorSettings,
        wanted: [bool; 4],
    ) -> [Option<FloatTensor<Self>>; 4];

    /// [`exp`](crate::exp) or [`sigmoid`](crate::sigmoid) of every element. Composed of tensor ops unless a backend knows
    /// better.
    fn activate(x: FloatTensor<Self>, function: Activation) -> FloatTensor<Self> {
        composed::activate::<Self>(x, function)
    }

    /// Gradient of the input, given the input, the output and the output's gradient.
    fn activate_backward(
        x: FloatTensor<Self>,
        y: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        function: Activation,
    ) -> FloatTensor<Self> {
        composed::activate_backward::<Self>(x, y, grad, function)
    }

    /// Packed splats `[C, N, 9]`, colours `[C, N, D]`, opacities `[C, N]` and background `[C, D]`
    /// to `[C, H, W, D + 1]`, the last channel being alpha.
    ///
    /// What goes wrong is reported to `args.errors`; the image is then zero, and the gradients that the state leads to
    /// are.
    fn rasterize_forward(
        packed: FloatTensor<Self>,
        colors: FloatTensor<Self>,
        opacities: FloatTensor<Self>,
        background: Option<FloatTensor<Self>>,
        args: &RasterizeArgs,
    ) -> (FloatTensor<Self>, Self::RasterizeState);

    /// Gradients of packed splats, colours, opacities and background, given the forward's output
    /// and state and the gradient `[C, H, W, D + 1]` of that output.
    fn rasterize_backward(
        packed: FloatTensor<Self>,
        colors: FloatTensor<Self>,
        opacities: FloatTensor<Self>,
        background: Option<FloatTensor<Self>>,
        output: FloatTensor<Self>,
        state: Self::RasterizeState,
        grad_output: FloatTensor<Self>,
        args: &RasterizeArgs,
        wanted: [bool; 4],
    ) -> [Option<FloatTensor<Self>>; 4];

    /// Convolves rows and columns of `[B, H, W, D]` with a symmetric window of odd length, zeros
    /// outside. Linear and self-adjoint: its own vector-Jacobian product.
    fn gaussian_blur(image: FloatTensor<Self>, window: &[f64]) -> FloatTensor<Self>;

    /// [`ssim_map`](crate::ssim_map) of two images, and what the backend keeps for the gradient.
    fn ssim_forward(
        images: [FloatTensor<Self>; 2],
        args: &SsimArgs,
    ) -> (FloatTensor<Self>, Vec<FloatTensor<Self>>) {
        composed::ssim_forward::<Self>(images, args)
    }

    /// Gradients of both images, given that of the map.
    fn ssim_backward(
        images: [FloatTensor<Self>; 2],
        moments: Vec<FloatTensor<Self>>,
        grad: FloatTensor<Self>,
        args: &SsimArgs,
        wanted: [bool; 2],
    ) -> [Option<FloatTensor<Self>>; 2] {
        composed::ssim_backward::<Self>(images, moments, grad, args, wanted)
    }

    /// [`Photometric::losses`](crate::Photometric::losses), `[2]`.
    fn photometric(
        rendered: FloatTensor<Self>,
        target: Target<Self>,
        args: &SsimArgs,
    ) -> FloatTensor<Self> {
        composed::photometric::<Self>(rendered, target, args)
    }

    /// The same, and what the backend keeps for the gradient.
    fn photometric_tracked(
        rendered: FloatTensor<Self>,
        target: Target<Self>,
        args: &SsimArgs,
    ) -> (FloatTensor<Self>, FloatTensor<Self>) {
        composed::photometric_tracked::<Self>(rendered, target, args)
    }

    /// Gradient `[B, H, W, E]` of what was rendered, given what was kept and the gradient `[2]` of the means.
    fn photometric_backward(
        rendered: FloatTensor<Self>,
        target: Target<Self>,
        kept: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        _args: &SsimArgs,
    ) -> FloatTensor<Self> {
        composed::photometric_backward::<Self>(rendered, target, kept, grad)
    }

    /// [`ScreenStatistics::add`](crate::ScreenStatistics::add): gradient and splats `[C, N, 9]` and both sums `[N]` to the
    /// sums with the lengths of `half * gradient` and the views added.
    fn add_screen_statistics(
        tensors: [FloatTensor<Self>; 4],
        half: [f64; 2],
    ) -> [FloatTensor<Self>; 2];

    /// Parameter, gradient and both moments to parameter and moments after [`adam_step`](crate::adam_step).
    fn adam(tensors: [FloatTensor<Self>; 4], step: &AdamStep) -> [FloatTensor<Self>; 3];
}

/// What [`sh_colors`](crate::sh_colors) takes.
#[derive(Debug, Clone)]
pub struct ShInputs<B: Backend> {
    /// `[N, 1, 3]`.
    pub sh0: FloatTensor<B>,
    /// `[N, R, 3]`; absent at degree 0.
    pub sh_rest: Option<FloatTensor<B>>,
    /// `[N, 3]`.
    pub means: FloatTensor<B>,
    /// `[C, 3]`.
    pub centers: FloatTensor<B>,
    /// Packed splats `[C, N, 9]`, of which those without an extent have no colour.
    pub seen: Option<FloatTensor<B>>,
}

/// A parameter and its moments, in the form in which Burn's dispatch can carry them.
#[derive(ExtensionType)]
pub(crate) struct AdamTensors<B: Backend> {
    pub(crate) param: FloatTensor<B>,
    pub(crate) moment_1: FloatTensor<B>,
    pub(crate) moment_2: FloatTensor<B>,
}

/// Sums of screen gradients and of views, in the form in which Burn's dispatch can carry them.
#[derive(ExtensionType)]
pub(crate) struct StatisticsTensors<B: Backend> {
    pub(crate) gradients: FloatTensor<B>,
    pub(crate) views: FloatTensor<B>,
}

/// An optional tensor, in the form in which Burn's dispatch can carry one.
#[derive(ExtensionType)]
pub(crate) enum Optional<B: Backend> {
    Some(FloatTensor<B>),
    None,
}

impl<B: Backend> Optional<B> {
    pub(crate) fn into_option(self) -> Option<FloatTensor<B>> {
        match self {
            Self::Some(tensor) => Some(tensor),
            Self::None => None,
        }
    }
}

/// What [`photometric`](crate::photometric) compares with, `[B, H, W, D]`, in the form in which Burn's dispatch can
/// carry it.
#[derive(Debug, Clone, ExtensionType)]
pub enum Target<B: Backend> {
    /// Of any integer type, 0 to 255, for `level / 255`.
    Levels(IntTensor<B>),
    /// As they are.
    Values(FloatTensor<B>),
}

/// The forward ops as Burn dispatches them: to Flex, to CubeCL, or through autodiff to either.
#[backend_extension(Cube: cfg(feature = "cube"), Flex: cfg(feature = "cpu"), Autodiff)]
pub(crate) trait SplatOps: Backend {
    fn project(
        means: FloatTensor<Self>,
        quats: FloatTensor<Self>,
        scales: FloatTensor<Self>,
        viewmats: FloatTensor<Self>,
        intrinsics: FloatTensor<Self>,
        args: ProjectArgs,
    ) -> FloatTensor<Self>;

    fn spherical_harmonics(
        coeffs: FloatTensor<Self>,
        dirs: FloatTensor<Self>,
        degree: usize,
    ) -> FloatTensor<Self>;

    fn sh_colors(
        sh0: FloatTensor<Self>,
        #[extension_type] sh_rest: Optional<Self>,
        means: FloatTensor<Self>,
        centers: FloatTensor<Self>,
        #[extension_type] seen: Optional<Self>,
        settings: ShColorSettings,
    ) -> FloatTensor<Self>;

    fn activation(x: FloatTensor<Self>, function: Activation) -> FloatTensor<Self>;

    fn screen_probe(packed: FloatTensor<Self>, probe: FloatTensor<Self>) -> FloatTensor<Self>;

    fn rasterize(
        packed: FloatTensor<Self>,
        colors: FloatTensor<Self>,
        opacities: FloatTensor<Self>,
        #[extension_type] background: Optional<Self>,
        args: RasterizeArgs,
    ) -> FloatTensor<Self>;

    fn gaussian_blur(image: FloatTensor<Self>, window: Vec<f64>) -> FloatTensor<Self>;

    fn ssim(x: FloatTensor<Self>, y: FloatTensor<Self>, args: SsimArgs) -> FloatTensor<Self>;

    fn photometric(
        rendered: FloatTensor<Self>,
        #[extension_type] target: Target<Self>,
        args: SsimArgs,
    ) -> FloatTensor<Self>;

    fn adam(
        param: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        moment_1: FloatTensor<Self>,
        moment_2: FloatTensor<Self>,
        step: AdamStep,
    ) -> AdamTensors<Self>;

    fn screen_statistics(
        gradient: FloatTensor<Self>,
        packed: FloatTensor<Self>,
        gradients: FloatTensor<Self>,
        views: FloatTensor<Self>,
        half: [f64; 2],
    ) -> StatisticsTensors<Self>;
}

/// Without autodiff an op is its forward, and nothing is kept.
macro_rules! forward_only {
    ($backend:ty) => {
        impl SplatOps for $backend {
            fn project(
                means: FloatTensor<Self>,
                quats: FloatTensor<Self>,
                scales: FloatTensor<Self>,
                viewmats: FloatTensor<Self>,
                intrinsics: FloatTensor<Self>,
                args: ProjectArgs,
            ) -> FloatTensor<Self> {
                Self::project_forward(means, quats, scales, viewmats, intrinsics, &args)
            }

            fn spherical_harmonics(
                coeffs: FloatTensor<Self>,
                dirs: FloatTensor<Self>,
                degree: usize,
            ) -> FloatTensor<Self> {
                Self::spherical_harmonics_forward(coeffs, dirs, degree)
            }

            fn sh_colors(
                sh0: FloatTensor<Self>,
                sh_rest: Optional<Self>,
                means: FloatTensor<Self>,
                centers: FloatTensor<Self>,
                seen: Optional<Self>,
                settings: ShColorSettings,
            ) -> FloatTensor<Self> {
                let inputs = ShInputs {
                    sh0,
                    sh_rest: sh_rest.into_option(),
                    means,
                    centers,
                    seen: seen.into_option(),
                };
                Self::sh_colors_forward(inputs, settings)
            }

            fn activation(x: FloatTensor<Self>, function: Activation) -> FloatTensor<Self> {
                Self::activate(x, function)
            }

            fn screen_probe(
                packed: FloatTensor<Self>,
                _probe: FloatTensor<Self>,
            ) -> FloatTensor<Self> {
                packed
            }

            fn rasterize(
                packed: FloatTensor<Self>,
                colors: FloatTensor<Self>,
                opacities: FloatTensor<Self>,
                background: Optional<Self>,
                args: RasterizeArgs,
            ) -> FloatTensor<Self> {
                Self::rasterize_forward(packed, colors, opacities, background.into_option(), &args)
                    .0
            }

            fn gaussian_blur(image: FloatTensor<Self>, window: Vec<f64>) -> FloatTensor<Self> {
                <Self as SplatBackend>::gaussian_blur(image, &window)
            }

            fn ssim(
                x: FloatTensor<Self>,
                y: FloatTensor<Self>,
                args: SsimArgs,
            ) -> FloatTensor<Self> {
                Self::ssim_forward([x, y], &args).0
            }

            fn photometric(
                rendered: FloatTensor<Self>,
                target: Target<Self>,
                args: SsimArgs,
            ) -> FloatTensor<Self> {
                <Self as SplatBackend>::photometric(rendered, target, &args)
            }

            fn adam(
                param: FloatTensor<Self>,
                grad: FloatTensor<Self>,
                moment_1: FloatTensor<Self>,
                moment_2: FloatTensor<Self>,
                step: AdamStep,
            ) -> AdamTensors<Self> {
                let [param, moment_1, moment_2] =
                    <Self as SplatBackend>::adam([param, grad, moment_1, moment_2], &step);
                AdamTensors {
                    param,
                    moment_1,
                    moment_2,
                }
            }

            fn screen_statistics(
                gradient: FloatTensor<Self>,
                packed: FloatTensor<Self>,
                gradients: FloatTensor<Self>,
                views: FloatTensor<Self>,
                half: [f64; 2],
            ) -> StatisticsTensors<Self> {
                let tensors = [gradient, packed, gradients, views];
                let [gradients, views] = Self::add_screen_statistics(tensors, half);
                StatisticsTensors { gradients, views }
            }
        }
    };
}

#[cfg(feature = "cpu")]
forward_only!(burn::backend::Flex);
#[cfg(feature = "cube")]
forward_only!(burn_cubecl::CubeBackend);
