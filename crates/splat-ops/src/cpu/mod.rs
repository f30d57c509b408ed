//! Native Rust for Burn's Flex backend: f32, and f64 as the reference.
//!
//! Parallel over Gaussians or rows of tiles with rayon, and deterministic: whatever is summed across
//! threads is summed in a fixed order, so the same input gives the same bits on any number of threads.
//!
//! Every op runs in a `tracing` span of its name, level trace, on the caller's thread: one load and a branch where nobody
//! listens.

mod activation;
mod adam;
mod awake;
mod blur;
pub(crate) mod buffer;
mod instructions;
mod intersect;
mod math;
mod parts;
mod photometric;
#[cfg(test)]
pub(crate) mod poison;
mod project;
mod rasterize;
pub(crate) mod real;
mod schedule;
mod screen_statistics;
mod sh_colors;
mod simd;
mod spherical_harmonics;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use burn::tensor::DType;
use tracing::trace_span;

pub(crate) use awake::keep_awake;
pub use instructions::InstructionSet;

pub use rasterize::{RasterizeWork, rasterize_work};

use crate::backend::{ShInputs, SplatBackend, Target};
use crate::composed;
use crate::settings::Activation;
use crate::settings::AdamStep;
use crate::settings::SsimArgs;
use crate::settings::{ProjectArgs, RasterizeArgs, ShColorSettings};

/// Runs a generic function in the precision of a tensor. The public ops let only F32 and F64 pass.
macro_rules! in_precision {
    ($tensor:expr, $function:path, $($argument:expr),* $(,)?) => {
        match $tensor.dtype() {
            DType::F64 => $function(core::marker::PhantomData::<f64>, $($argument),*),
            _ => $function(core::marker::PhantomData::<f32>, $($argument),*),
        }
    };
}

impl SplatBackend for Flex {
    type RasterizeState = rasterize::State;

    fn project_forward(
        means: FlexTensor,
        quats: FlexTensor,
        scales: FlexTensor,
        viewmats: FlexTensor,
        intrinsics: FlexTensor,
        args: &ProjectArgs,
    ) -> FlexTensor {
        let _span = trace_span!("project").entered();
        in_precision!(
            means,
            project::forward,
            [means, quats, scales, viewmats, intrinsics],
            args
        )
    }

    fn project_backward(
        means: FlexTensor,
        quats: FlexTensor,
        scales: FlexTensor,
        viewmats: FlexTensor,
        intrinsics: FlexTensor,
        grad_packed: FlexTensor,
        args: &ProjectArgs,
        wanted: [bool; 5],
    ) -> [Option<FlexTensor>; 5] {
        let _span = trace_span!("project gradient").entered();
        in_precision!(
            means,
            project::backward,
            [means, quats, scales, viewmats, intrinsics],
            grad_packed,
            args,
            wanted
        )
    }

    fn spherical_harmonics_forward(
        coeffs: FlexTensor,
        dirs: FlexTensor,
        degree: usize,
    ) -> FlexTensor {
        let _span = trace_span!("spherical harmonics").entered();
        in_precision!(coeffs, spherical_harmonics::forward, coeffs, dirs, degree)
    }

    fn spherical_harmonics_backward(
        coeffs: FlexTensor,
        dirs: FlexTensor,
        grad: FlexTensor,
        degree: usize,
        wanted: [bool; 2],
    ) -> [Option<FlexTensor>; 2] {
        let _span = trace_span!("spherical harmonics gradient").entered();
        in_precision!(
            coeffs,
            spherical_harmonics::backward,
            coeffs,
            dirs,
            grad,
            degree,
            wanted
        )
    }

    fn sh_colors_forward(inputs: ShInputs<Self>, settings: ShColorSettings) -> FlexTensor {
        let _span = trace_span!("colours").entered();
        in_precision!(inputs.means, sh_colors::forward, inputs, settings)
    }

    fn sh_colors_backward(
        inputs: ShInputs<Self>,
        grad: FlexTensor,
        settings: ShColorSettings,
        wanted: [bool; 4],
    ) -> [Option<FlexTensor>; 4] {
        let _span = trace_span!("colours gradient").entered();
        in_precision!(grad, sh_colors::backward, inputs, grad, settings, wanted)
    }

    fn activate(x: FlexTensor, function: Activation) -> FlexTensor {
        let _span = trace_span!("activations").entered();
        match x.dtype() {
            DType::F32 | DType::F64 => in_precision!(x, activation::forward, x, function),
            _ => composed::activate::<Self>(x, function),
        }
    }

    fn activate_backward(
        x: FlexTensor,
        y: FlexTensor,
        grad: FlexTensor,
        function: Activation,
    ) -> FlexTensor {
        let _span = trace_span!("activations gradient").entered();
        match x.dtype() {
            DType::F32 | DType::F64 => in_precision!(x, activation::backward, x, y, grad, function),
            _ => composed::activate_backward::<Self>(x, y, grad, function),
        }
    }

    fn rasterize_forward(
        packed: FlexTensor,
        colors: FlexTensor,
        opacities: FlexTensor,
        background: Option<FlexTensor>,
        args: &RasterizeArgs,
    ) -> (FlexTensor, Self::RasterizeState) {
        let _span = trace_span!("rasterize").entered();
        in_precision!(
            packed,
            rasterize::forward,
            [packed, colors, opacities],
            background,
            args
        )
    }

    fn rasterize_backward(
        packed: FlexTensor,
        colors: FlexTensor,
        opacities: FlexTensor,
        background: Option<FlexTensor>,
        _output: FlexTensor,
        state: Self::RasterizeState,
        grad_output: FlexTensor,
        args: &RasterizeArgs,
        wanted: [bool; 4],
    ) -> [Option<FlexTensor>; 4] {
        let _span = trace_span!("rasterize gradient").entered();
        in_precision!(
            packed,
            rasterize::backward,
            [packed, colors, opacities],
            background,
            state,
            grad_output,
            args,
            wanted
        )
    }

    fn gaussian_blur(image: FlexTensor, window: &[f64]) -> FlexTensor {
        let _span = trace_span!("blur").entered();
        in_precision!(image, blur::blur, image, window)
    }

    fn photometric(rendered: FlexTensor, target: Target<Self>, args: &SsimArgs) -> FlexTensor {
        let _span = trace_span!("photometric").entered();
        in_precision!(rendered, photometric::measure, rendered, target, args)
    }

    fn photometric_tracked(
        rendered: FlexTensor,
        target: Target<Self>,
        args: &SsimArgs,
    ) -> (FlexTensor, FlexTensor) {
        let _span = trace_span!("photometric").entered();
        in_precision!(
            rendered,
            photometric::measure_tracked,
            rendered,
            target,
            args
        )
    }

    fn photometric_backward(
        rendered: FlexTensor,
        target: Target<Self>,
        slope: FlexTensor,
        grad: FlexTensor,
        _args: &SsimArgs,
    ) -> FlexTensor {
        let _span = trace_span!("photometric gradient").entered();
        in_precision!(
            rendered,
            photometric::backward,
            rendered,
            target,
            slope,
            grad
        )
    }

    fn add_screen_statistics(tensors: [FlexTensor; 4], half: [f64; 2]) -> [FlexTensor; 2] {
        in_precision!(tensors[0], screen_statistics::add, tensors, half)
    }

    fn adam(tensors: [FlexTensor; 4], step: &AdamStep) -> [FlexTensor; 3] {
        let _span = trace_span!("adam").entered();
        in_precision!(tensors[0], adam::step, tensors, step)
    }
}
