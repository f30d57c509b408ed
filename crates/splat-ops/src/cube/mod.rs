//! Launches `splat-kernels` on CubeCL devices: CUDA, Vulkan, Metal, WebGPU.
//!
//! The kernels know buffers of f32 and sizes; here tensors become buffers and buffers tensors.
//!
//! The `tracing` spans have the names of those on the CPU, and last as long as it takes to launch the kernels: these run on.

mod activation;
mod adam;
mod blur;
mod photometric;
mod project;
mod rasterize;
mod screen_statistics;
mod sh_colors;
mod spherical_harmonics;
mod ssim;
#[cfg(all(test, feature = "cpu", feature = "wgpu"))]
pub(crate) mod tests;

#[cfg(feature = "cpu")]
pub(crate) use rasterize::work as rasterize_work;

use burn::backend::TensorMetadata;
use burn::tensor::{DType, Shape};
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::{cast, into_contiguous};
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::Buffer;
use tracing::trace_span;

use crate::backend::{ShInputs, SplatBackend, Target};
use crate::composed;
use crate::settings::Activation;
use crate::settings::AdamStep;
use crate::settings::SsimArgs;
use crate::settings::{ProjectArgs, RasterizeArgs, ShColorSettings};

/// A tensor of f32, contiguous.
fn prepare(tensor: CubeTensor) -> CubeTensor {
    let tensor = if tensor.dtype == DType::F32 {
        tensor
    } else {
        cast(tensor, DType::F32)
    };
    into_contiguous(tensor)
}

/// The memory of a tensor that went through [`prepare`].
fn buffer(tensor: &CubeTensor) -> Buffer {
    let len = tensor.shape().num_elements();
    // A contiguous tensor of f32 holds its elements. One that did not would be read as empty: every kernel checks
    // bounds.
    Buffer::new(tensor.handle.clone(), len).unwrap_or_else(|_| Buffer::empty(&tensor.client, 0))
}

/// The same, of a tensor that nothing else needs: where nothing else holds the memory, a kernel may write into it. And
/// what makes a tensor of a buffer, like the one that was taken.
fn taken(tensor: CubeTensor) -> (Buffer, impl FnOnce(Buffer) -> CubeTensor) {
    let shape = tensor.shape();
    let CubeTensor {
        client,
        device,
        handle,
        ..
    } = tensor;
    let memory = Buffer::new(handle, shape.num_elements());
    let memory = memory.unwrap_or_else(|_| Buffer::empty(&client, 0));
    let tensor = move |buffer: Buffer| {
        let handle = buffer.into_handle();
        CubeTensor::new_contiguous(client, device, shape, handle, DType::F32)
    };
    (memory, tensor)
}

/// A tensor of `shape` on the device of `like`, in the memory of `buffer`.
fn tensor(like: &CubeTensor, buffer: Buffer, shape: Shape) -> CubeTensor {
    CubeTensor::new_contiguous(
        like.client.clone(),
        like.device.clone(),
        shape,
        buffer.into_handle(),
        DType::F32,
    )
}

impl SplatBackend for CubeBackend {
    /// `None`: nothing was rendered, see [`RasterizeArgs::errors`].
    type RasterizeState = Option<splat_kernels::rasterize::RasterizeState>;

    fn project_forward(
        means: CubeTensor,
        quats: CubeTensor,
        scales: CubeTensor,
        viewmats: CubeTensor,
        intrinsics: CubeTensor,
        args: &ProjectArgs,
    ) -> CubeTensor {
        let _span = trace_span!("project").entered();
        project::forward([means, quats, scales, viewmats, intrinsics], args)
    }

    fn project_backward(
        means: CubeTensor,
        quats: CubeTensor,
        scales: CubeTensor,
        viewmats: CubeTensor,
        intrinsics: CubeTensor,
        grad_packed: CubeTensor,
        args: &ProjectArgs,
        wanted: [bool; 5],
    ) -> [Option<CubeTensor>; 5] {
        let _span = trace_span!("project gradient").entered();
        project::backward(
            [means, quats, scales, viewmats, intrinsics],
            grad_packed,
            args,
            wanted,
        )
    }

    fn spherical_harmonics_forward(
        coeffs: CubeTensor,
        dirs: CubeTensor,
        degree: usize,
    ) -> CubeTensor {
        let _span = trace_span!("spherical harmonics").entered();
        spherical_harmonics::forward(coeffs, dirs, degree)
    }

    fn spherical_harmonics_backward(
        coeffs: CubeTensor,
        dirs: CubeTensor,
        grad: CubeTensor,
        degree: usize,
        wanted: [bool; 2],
    ) -> [Option<CubeTensor>; 2] {
        let _span = trace_span!("spherical harmonics gradient").entered();
        spherical_harmonics::backward(coeffs, dirs, grad, degree, wanted)
    }

    fn sh_colors_forward(inputs: ShInputs<Self>, settings: ShColorSettings) -> CubeTensor {
        let _span = trace_span!("colours").entered();
        sh_colors::forward(inputs, settings)
    }

    fn sh_colors_backward(
        inputs: ShInputs<Self>,
        grad: CubeTensor,
        settings: ShColorSettings,
        wanted: [bool; 4],
    ) -> [Option<CubeTensor>; 4] {
        let _span = trace_span!("colours gradient").entered();
        sh_colors::backward(inputs, grad, settings, wanted)
    }

    fn activate(x: CubeTensor, function: Activation) -> CubeTensor {
        let _span = trace_span!("activations").entered();
        match x.dtype {
            DType::F32 => activation::forward(x, function),
            _ => composed::activate::<Self>(x, function),
        }
    }

    fn activate_backward(
        x: CubeTensor,
        y: CubeTensor,
        grad: CubeTensor,
        function: Activation,
    ) -> CubeTensor {
        let _span = trace_span!("activations gradient").entered();
        match x.dtype {
            DType::F32 => activation::backward([x, y], grad, function),
            _ => composed::activate_backward::<Self>(x, y, grad, function),
        }
    }

    fn rasterize_forward(
        packed: CubeTensor,
        colors: CubeTensor,
        opacities: CubeTensor,
        background: Option<CubeTensor>,
        args: &RasterizeArgs,
    ) -> (CubeTensor, Self::RasterizeState) {
        let _span = trace_span!("rasterize").entered();
        rasterize::forward(packed, colors, opacities, background, args)
    }

    fn rasterize_backward(
        packed: CubeTensor,
        colors: CubeTensor,
        opacities: CubeTensor,
        background: Option<CubeTensor>,
        _output: CubeTensor,
        state: Self::RasterizeState,
        grad_output: CubeTensor,
        args: &RasterizeArgs,
        wanted: [bool; 4],
    ) -> [Option<CubeTensor>; 4] {
        let _span = trace_span!("rasterize gradient").entered();
        rasterize::backward(
            packed,
            colors,
            opacities,
            background,
            state.as_ref(),
            grad_output,
            args,
            wanted,
        )
    }

    fn gaussian_blur(image: CubeTensor, window: &[f64]) -> CubeTensor {
        let _span = trace_span!("blur").entered();
        blur::blur(image, window)
    }

    fn ssim_forward(images: [CubeTensor; 2], args: &SsimArgs) -> (CubeTensor, Vec<CubeTensor>) {
        let _span = trace_span!("ssim").entered();
        ssim::forward(images, args)
    }

    fn ssim_backward(
        images: [CubeTensor; 2],
        moments: Vec<CubeTensor>,
        grad: CubeTensor,
        args: &SsimArgs,
        wanted: [bool; 2],
    ) -> [Option<CubeTensor>; 2] {
        let _span = trace_span!("ssim gradient").entered();
        ssim::backward(images, moments, grad, args, wanted)
    }

    fn photometric(rendered: CubeTensor, target: Target<Self>, args: &SsimArgs) -> CubeTensor {
        let _span = trace_span!("photometric").entered();
        photometric::measure(rendered, target, args)
    }

    fn photometric_tracked(
        rendered: CubeTensor,
        target: Target<Self>,
        args: &SsimArgs,
    ) -> (CubeTensor, CubeTensor) {
        let _span = trace_span!("photometric").entered();
        photometric::measure_tracked(rendered, target, args)
    }

    fn photometric_backward(
        rendered: CubeTensor,
        target: Target<Self>,
        kept: CubeTensor,
        grad: CubeTensor,
        args: &SsimArgs,
    ) -> CubeTensor {
        let _span = trace_span!("photometric gradient").entered();
        photometric::backward(rendered, target, kept, grad, args)
    }

    fn add_screen_statistics(tensors: [CubeTensor; 4], half: [f64; 2]) -> [CubeTensor; 2] {
        screen_statistics::add(tensors, half)
    }

    fn adam(tensors: [CubeTensor; 4], step: &AdamStep) -> [CubeTensor; 3] {
        let _span = trace_span!("adam").entered();
        adam::step(tensors, step)
    }
}
