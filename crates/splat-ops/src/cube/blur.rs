//! Separable blur on CubeCL devices.

use burn::backend::TensorMetadata;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::blur;

use super::{buffer, prepare, tensor};
use crate::backend::BlurOps;

impl BlurOps for CubeBackend {
    fn gaussian_blur(image: CubeTensor, window: Vec<f64>) -> CubeTensor {
        let image = prepare(image);
        let shape = image.shape();
        let window: Vec<f32> = window.iter().map(|weight| *weight as f32).collect();
        let (height, width, channels) = (shape[1], shape[2], shape[3]);
        let blurred = blur::blur(
            &image.client,
            &buffer(&image),
            height,
            width,
            channels,
            &window,
        );
        tensor(&image, blurred, shape)
    }
}
