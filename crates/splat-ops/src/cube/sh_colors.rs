//! View-dependent colours on CubeCL devices.

use burn::backend::TensorMetadata;
use burn::tensor::{DType, Shape};
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::HalfBuffer;
use splat_kernels::sh_colors as kernels;

use super::{buffer, gradients, prepare, tensor};
use crate::backend::{
    OpInputs, ShColorGradients, ShColorInputs, ShColorTensors, ShColorsBackend, ShColorsOps,
    ShLayout,
};
use crate::settings::ShColorSettings;

/// The inputs, ready for the kernels. Higher coefficients are read as f32 or f16.
fn prepared(
    inputs: ShColorTensors<CubeTensor, Option<CubeTensor>>,
) -> ShColorTensors<CubeTensor, Option<CubeTensor>> {
    ShColorTensors {
        sh0: prepare(inputs.sh0),
        sh_rest: inputs.sh_rest.map(into_contiguous),
        means: prepare(inputs.means),
        centers: prepare(inputs.centers),
        seen: inputs.seen.map(prepare),
    }
}

fn buffers(
    inputs: &ShColorTensors<CubeTensor, Option<CubeTensor>>,
    layout: ShLayout<CubeBackend>,
) -> kernels::ShColorInputs {
    kernels::ShColorInputs {
        sh0: buffer(&inputs.sh0),
        sh_rest: inputs.sh_rest.as_ref().map(|rest| match rest.dtype {
            DType::F16 => {
                let len = rest.shape().num_elements();
                HalfBuffer::new(rest.handle.clone(), len).map_or_else(
                    |_| kernels::ShRest::Exact(buffer(rest)),
                    kernels::ShRest::Half,
                )
            }
            _ => kernels::ShRest::Exact(buffer(rest)),
        }),
        stored: inputs.sh_rest.as_ref().map_or(0, |rest| rest.shape()[1]),
        starts: match layout {
            ShLayout::Uniform => None,
            // In 32 bits, and not negative: read as they are.
            ShLayout::Ragged(starts) => Some(buffer(&into_contiguous(starts))),
        },
        means: buffer(&inputs.means),
        centers: buffer(&inputs.centers),
        seen: inputs.seen.as_ref().map(buffer),
    }
}

impl ShColorsOps for CubeBackend {
    fn sh_colors(
        OpInputs(inputs): ShColorInputs<Self>,
        layout: ShLayout<Self>,
        settings: ShColorSettings,
    ) -> CubeTensor {
        let inputs = prepared(inputs);
        let (means, centers) = (&inputs.means, &inputs.centers);
        let colors = kernels::sh_colors(&means.client, &buffers(&inputs, layout), settings);
        let shape = [centers.shape()[0], means.shape()[0], 3];
        tensor(means, colors, Shape::from(shape))
    }
}

impl ShColorsBackend for CubeBackend {
    fn sh_colors_backward(
        OpInputs(inputs): ShColorInputs<Self>,
        layout: ShLayout<Self>,
        grad_colors: CubeTensor,
        settings: ShColorSettings,
        needs_grad: ShColorTensors<bool>,
    ) -> ShColorGradients<Self> {
        let inputs = prepared(inputs);
        let grad_colors = prepare(grad_colors);
        let grads = kernels::sh_colors_backward(
            &grad_colors.client,
            &buffers(&inputs, layout),
            &buffer(&grad_colors),
            settings,
            needs_grad,
        );
        gradients(grads.into(), inputs.inputs().into()).into()
    }
}
