//! The ops on Burn's autodiff backend: one file per op says what is saved and how the gradient
//! flows. A tracked op has N parents and one output; only gradients of tracked parents are asked
//! of the backend.

mod activation;
mod blur;
mod photometric;
mod project;
mod rasterize;
mod screen_probe;
mod sh_colors;
mod spherical_harmonics;
mod ssim;

use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::{Autodiff, AutodiffBackend, tensor::FloatTensor};

use crate::backend::{AdamTensors, Optional, SplatBackend, SplatOps, StatisticsTensors, Target};
use crate::settings::Activation;
use crate::settings::AdamStep;
use crate::settings::SsimArgs;
use crate::settings::{ProjectArgs, RasterizeArgs, ShColorSettings};

impl<B: SplatBackend, C: CheckpointStrategy> SplatOps for Autodiff<B, C> {
    fn project(
        means: FloatTensor<Self>,
        quats: FloatTensor<Self>,
        scales: FloatTensor<Self>,
        viewmats: FloatTensor<Self>,
        intrinsics: FloatTensor<Self>,
        args: ProjectArgs,
    ) -> FloatTensor<Self> {
        project::project::<B, C>([means, quats, scales, viewmats, intrinsics], args)
    }

    fn spherical_harmonics(
        coeffs: FloatTensor<Self>,
        dirs: FloatTensor<Self>,
        degree: usize,
    ) -> FloatTensor<Self> {
        spherical_harmonics::spherical_harmonics::<B, C>([coeffs, dirs], degree)
    }

    fn sh_colors(
        sh0: FloatTensor<Self>,
        sh_rest: Optional<Self>,
        means: FloatTensor<Self>,
        centers: FloatTensor<Self>,
        seen: Optional<Self>,
        settings: ShColorSettings,
    ) -> FloatTensor<Self> {
        let (sh_rest, seen) = (sh_rest.into_option(), seen.into_option());
        sh_colors::sh_colors::<B, C>(sh0, sh_rest, means, centers, seen, settings)
    }

    fn activation(x: FloatTensor<Self>, function: Activation) -> FloatTensor<Self> {
        activation::activation::<B, C>(x, function)
    }

    fn screen_probe(packed: FloatTensor<Self>, probe: FloatTensor<Self>) -> FloatTensor<Self> {
        screen_probe::screen_probe::<B, C>(packed, probe)
    }

    fn rasterize(
        packed: FloatTensor<Self>,
        colors: FloatTensor<Self>,
        opacities: FloatTensor<Self>,
        background: Optional<Self>,
        args: RasterizeArgs,
    ) -> FloatTensor<Self> {
        rasterize::rasterize::<B, C>([packed, colors, opacities], background, args)
    }

    fn gaussian_blur(image: FloatTensor<Self>, window: Vec<f64>) -> FloatTensor<Self> {
        blur::gaussian_blur::<B, C>(image, window)
    }

    fn ssim(x: FloatTensor<Self>, y: FloatTensor<Self>, args: SsimArgs) -> FloatTensor<Self> {
        ssim::ssim::<B, C>([x, y], args)
    }

    fn photometric(
        rendered: FloatTensor<Self>,
        target: Target<Self>,
        args: SsimArgs,
    ) -> FloatTensor<Self> {
        photometric::photometric::<B, C>(rendered, target, args)
    }

    /// An optimiser's step is no part of any graph: what comes out is new leaves.
    fn adam(
        param: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        moment_1: FloatTensor<Self>,
        moment_2: FloatTensor<Self>,
        step: AdamStep,
    ) -> AdamTensors<Self> {
        let tensors = [param, grad, moment_1, moment_2].map(|tensor| tensor.into_primitive());
        let [param, moment_1, moment_2] = B::adam(tensors, &step).map(Self::from_inner);
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
        let tensors = [gradient, packed, gradients, views].map(|tensor| tensor.into_primitive());
        let [gradients, views] = B::add_screen_statistics(tensors, half).map(Self::from_inner);
        StatisticsTensors { gradients, views }
    }
}

/// Hands each tracked parent its gradient.
fn register<B: SplatBackend, const N: usize>(
    grads: &mut Gradients,
    parents: [Option<NodeId>; N],
    values: [Option<FloatTensor<B>>; N],
) {
    for (parent, value) in parents.into_iter().zip(values) {
        if let (Some(parent), Some(value)) = (parent, value) {
            grads.register::<B>(parent, value);
        }
    }
}
