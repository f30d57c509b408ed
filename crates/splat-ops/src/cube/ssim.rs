//! Structural similarity on CubeCL devices.

use burn::backend::TensorMetadata;
use burn::tensor::Shape;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::ssim::{SsimShape, ssim, ssim_vjp};

use super::{buffer, gradients, prepare, tensor};
use crate::backend::{OpInputs, SsimBackend, SsimGradients, SsimInputs, SsimOps, SsimTensors};
use crate::settings::SsimArgs;

fn shape(image: &CubeTensor, args: &SsimArgs) -> SsimShape {
    let shape = image.shape();
    SsimShape {
        images: shape[0],
        height: shape[1],
        width: shape[2],
        channels: shape[3],
        c1: args.c1 as f32,
        c2: args.c2 as f32,
    }
}

fn window(args: &SsimArgs) -> Vec<f32> {
    args.window.iter().map(|weight| *weight as f32).collect()
}

impl SsimOps for CubeBackend {
    fn ssim(inputs: SsimInputs<Self>, args: SsimArgs) -> CubeTensor {
        Self::ssim_tracked(inputs, &args).0
    }
}

impl SsimBackend for CubeBackend {
    /// Keeps the windowed means as one tensor `[4, B, H, W, D]`.
    fn ssim_tracked(
        OpInputs(inputs): SsimInputs<Self>,
        args: &SsimArgs,
    ) -> (CubeTensor, Vec<CubeTensor>) {
        let SsimTensors { x, y } = inputs.map(prepare);
        let sizes = shape(&x, args);
        let (map, moments) = ssim(&x.client, [&buffer(&x), &buffer(&y)], &sizes, &window(args));
        let kept = Shape::from([4, sizes.images, sizes.height, sizes.width, sizes.channels]);
        let map = tensor(&x, map, x.shape());
        (map, vec![tensor(&x, moments, kept)])
    }

    fn ssim_backward(
        OpInputs(inputs): SsimInputs<Self>,
        moments: Vec<CubeTensor>,
        grad_map: CubeTensor,
        args: &SsimArgs,
        needs_grad: SsimTensors<bool>,
    ) -> SsimGradients<Self> {
        let inputs = inputs.map(prepare);
        let SsimTensors { x, y } = &inputs;
        let grads = ssim_vjp(
            &x.client,
            [&buffer(x), &buffer(y)],
            &buffer(&moments[0]),
            &buffer(&prepare(grad_map)),
            &shape(x, args),
            &window(args),
            needs_grad.into(),
        );
        gradients(grads, inputs.inputs().into()).into()
    }
}
