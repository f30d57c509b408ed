//! Colours in the directions of the cameras, on CubeCL devices.

use burn::backend::TensorMetadata;
use burn::tensor::{DType, Shape};
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::HalfBuffer;
use splat_kernels::sh_colors as kernels;

use super::{buffer, prepare, tensor};
use crate::backend::ShInputs;
use crate::settings::ShColorSettings;

/// The inputs, ready for the kernels.
struct Prepared {
    sh0: CubeTensor,
    sh_rest: Option<CubeTensor>,
    means: CubeTensor,
    centers: CubeTensor,
    seen: Option<CubeTensor>,
}

impl Prepared {
    fn new(inputs: ShInputs<CubeBackend>) -> Self {
        Self {
            sh0: prepare(inputs.sh0),
            // The kernels read both of the types that the op takes.
            sh_rest: inputs.sh_rest.map(into_contiguous),
            means: prepare(inputs.means),
            centers: prepare(inputs.centers),
            seen: inputs.seen.map(prepare),
        }
    }

    fn buffers(&self) -> kernels::ShInputs {
        kernels::ShInputs {
            sh0: buffer(&self.sh0),
            sh_rest: self.sh_rest.as_ref().map(|rest| match rest.dtype {
                DType::F16 => {
                    let len = rest.shape().num_elements();
                    HalfBuffer::new(rest.handle.clone(), len).map_or_else(
                        |_| kernels::ShRest::Exact(buffer(rest)),
                        kernels::ShRest::Half,
                    )
                }
                _ => kernels::ShRest::Exact(buffer(rest)),
            }),
            stored: self.sh_rest.as_ref().map_or(0, |rest| rest.shape()[1]),
            means: buffer(&self.means),
            centers: buffer(&self.centers),
            seen: self.seen.as_ref().map(buffer),
        }
    }
}

/// Colours `[C, N, 3]`.
pub(super) fn forward(inputs: ShInputs<CubeBackend>, settings: ShColorSettings) -> CubeTensor {
    let inputs = Prepared::new(inputs);
    let (means, centers) = (&inputs.means, &inputs.centers);
    let colors = kernels::sh_colors(&means.client, &inputs.buffers(), settings);
    let shape = [centers.shape()[0], means.shape()[0], 3];
    tensor(means, colors, Shape::from(shape))
}

/// The wanted gradients of the four inputs.
pub(super) fn backward(
    inputs: ShInputs<CubeBackend>,
    grad: CubeTensor,
    settings: ShColorSettings,
    wanted: [bool; 4],
) -> [Option<CubeTensor>; 4] {
    let inputs = Prepared::new(inputs);
    let grad = prepare(grad);
    let [sh0, sh_rest, means, centers] = kernels::sh_colors_backward(
        &grad.client,
        &inputs.buffers(),
        &buffer(&grad),
        settings,
        wanted,
    );
    let like = |grad: Option<_>, input: &CubeTensor| Some(tensor(input, grad?, input.shape()));
    [
        like(sh0, &inputs.sh0),
        inputs.sh_rest.as_ref().and_then(|rest| like(sh_rest, rest)),
        like(means, &inputs.means),
        like(centers, &inputs.centers),
    ]
}
