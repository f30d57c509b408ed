//! Structural similarity on CubeCL devices.

use burn::backend::TensorMetadata;
use burn::tensor::Shape;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::ssim::{SsimShape, ssim, ssim_vjp};

use super::{buffer, prepare, tensor};
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

/// The map `[B, H, W, D]`, and one tensor for the gradient: the windowed means `[4, B, H, W, D]`.
pub(super) fn forward(images: [CubeTensor; 2], args: &SsimArgs) -> (CubeTensor, Vec<CubeTensor>) {
    let [x, y] = images.map(prepare);
    let sizes = shape(&x, args);
    let (map, moments) = ssim(&x.client, [&buffer(&x), &buffer(&y)], &sizes, &window(args));
    let kept = Shape::from([4, sizes.images, sizes.height, sizes.width, sizes.channels]);
    let map = tensor(&x, map, x.shape());
    (map, vec![tensor(&x, moments, kept)])
}

/// The wanted gradients of both images.
pub(super) fn backward(
    images: [CubeTensor; 2],
    moments: Vec<CubeTensor>,
    grad: CubeTensor,
    args: &SsimArgs,
    wanted: [bool; 2],
) -> [Option<CubeTensor>; 2] {
    let [x, y] = images.map(prepare);
    let grad = prepare(grad);
    // The forward keeps one tensor.
    let grads = ssim_vjp(
        &x.client,
        [&buffer(&x), &buffer(&y)],
        &buffer(&moments[0]),
        &buffer(&grad),
        &shape(&x, args),
        &window(args),
        wanted,
    );
    grads.map(|grad| grad.map(|grad| tensor(&x, grad, x.shape())))
}
