//! Rasterisation on CubeCL devices.

use burn::backend::TensorMetadata;
use burn::backend::ops::FloatTensorOps;
use burn::tensor::{FloatDType, Shape};
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use cubecl::client::Client;
use splat_kernels::intersect::{Frames, IntersectError};
use splat_kernels::rasterize::{
    RasterizeInputs, RasterizeSettings, RasterizeState, rasterize, rasterize_vjp,
};
use splat_kernels::{MOST_BUFFERS, bindable_buffers};

use super::{buffer, gradients, prepare, tensor};
use crate::OpError;
use crate::backend::{
    self, OpInputs, RasterizeBackend, RasterizeGradients, RasterizeOps, RasterizeTensors,
};
use crate::settings::RasterizeArgs;

/// Sizes of a call, from colours `[C, N, D]`.
fn frames(colors: &CubeTensor, args: &RasterizeArgs) -> Frames {
    let shape = colors.shape();
    Frames {
        cameras: shape[0],
        gaussians: shape[1],
        width: args.size.width,
        height: args.size.height,
        alpha_min: args.settings.alpha_min as f32,
    }
}

/// The tensors of one call, ready for the kernels.
type Prepared = RasterizeTensors<CubeTensor, Option<CubeTensor>>;

fn inputs(tensors: &Prepared) -> RasterizeInputs {
    RasterizeInputs {
        packed: buffer(&tensors.packed),
        colors: buffer(&tensors.colors),
        opacities: buffer(&tensors.opacities),
        background: tensors.background.as_ref().map(buffer),
        channels: tensors.colors.shape()[2],
    }
}

fn op_error(error: IntersectError) -> OpError {
    let op = "rasterize";
    match error {
        IntersectError::TooManyIntersections { count, limit } => OpError::TooManyIntersections {
            op,
            intersections: count,
            limit,
        },
        IntersectError::Device(what) => OpError::Device { op, what },
    }
}

/// Checks that the device can bind the buffers of the rasteriser's gradient, which needs the most.
/// Without the check wgpu would refuse those kernels at launch, and the error would only appear
/// when a gradient is read.
fn enough_bindings(client: &Client) -> Result<(), OpError> {
    let (bound, needed) = (bindable_buffers(client), MOST_BUFFERS);
    if bound >= needed {
        return Ok(());
    }
    Err(OpError::TooFewBindings {
        op: "rasterize",
        bound,
        needed,
    })
}

fn zeros(like: &CubeTensor, shape: Shape) -> CubeTensor {
    CubeBackend::float_zeros(shape, &like.device, FloatDType::F32)
}

impl RasterizeOps for CubeBackend {
    fn rasterize(inputs: backend::RasterizeInputs<Self>, args: RasterizeArgs) -> CubeTensor {
        Self::rasterize_tracked(inputs, &args).0
    }
}

impl RasterizeBackend for CubeBackend {
    /// `None` if nothing was rendered; see [`RasterizeArgs::errors`].
    type RasterizeState = Option<RasterizeState>;

    fn rasterize_tracked(
        OpInputs(tensors): backend::RasterizeInputs<Self>,
        args: &RasterizeArgs,
    ) -> (CubeTensor, Self::RasterizeState) {
        let tensors = tensors.map_inputs(prepare);
        let inputs = inputs(&tensors);
        let frames = frames(&tensors.colors, args);
        let shape = Shape::from([
            frames.cameras,
            frames.height as usize,
            frames.width as usize,
            inputs.channels + 1,
        ]);
        let client = &tensors.packed.client;
        let rendered = enough_bindings(client).and_then(|()| {
            let settings = RasterizeSettings::from(&args.settings);
            rasterize(client, &inputs, &frames, &settings).map_err(op_error)
        });
        match rendered {
            Ok((output, state)) => (tensor(&tensors.packed, output, shape), Some(state)),
            Err(error) => {
                args.errors.report(error);
                (zeros(&tensors.packed, shape), None)
            }
        }
    }

    fn rasterize_backward(
        OpInputs(tensors): backend::RasterizeInputs<Self>,
        state: Self::RasterizeState,
        grad_output: CubeTensor,
        args: &RasterizeArgs,
        needs_grad: RasterizeTensors<bool>,
    ) -> RasterizeGradients<Self> {
        let tensors = tensors.map_inputs(prepare);
        let Some(state) = state else {
            let inputs = needs_grad.zip(tensors.inputs());
            return inputs.map(|(needed, input)| {
                let input = input.filter(|_| needed)?;
                Some(zeros(input, input.shape()))
            });
        };
        let grad_output = prepare(grad_output);
        let grads = rasterize_vjp(
            &grad_output.client,
            &inputs(&tensors),
            &state,
            &buffer(&grad_output),
            &frames(&tensors.colors, args),
            &RasterizeSettings::from(&args.settings),
            needs_grad,
        );
        gradients(grads.into(), tensors.inputs().into()).into()
    }
}

/// Counts the evaluations of a forward pass on the device of `client`. Packed splats, colours `[C,
/// N, D]` and opacities `[C, N]` go through the host, as this is called once per measurement.
#[cfg(feature = "cpu")]
pub(crate) fn work(
    client: &Client,
    projected: &crate::Projected,
    colors: burn::tensor::Tensor<3>,
    opacities: burn::tensor::Tensor<2>,
    settings: &crate::RasterizeSettings,
) -> Result<crate::RasterizeWork, OpError> {
    let [cameras, gaussians, channels] = colors.dims();
    let upload = |data: burn::tensor::TensorData| {
        let values = data.convert::<f32>().try_into_vec::<f32>();
        splat_kernels::Buffer::from_f32(client, &values.unwrap_or_default())
    };
    let inputs = RasterizeInputs {
        packed: upload(projected.packed().into_data()),
        colors: upload(colors.into_data()),
        opacities: upload(opacities.into_data()),
        background: None,
        channels,
    };
    let size = projected.image_size();
    let frames = Frames {
        cameras,
        gaussians,
        width: size.width,
        height: size.height,
        alpha_min: settings.alpha_min as f32,
    };
    let settings = RasterizeSettings::from(settings);
    let (_, state) = rasterize(client, &inputs, &frames, &settings).map_err(op_error)?;
    let count =
        splat_kernels::rasterize::count_evaluations(client, &inputs, &state, &frames, &settings);
    let count = count.map_err(|what| op_error(IntersectError::Device(what)))?;
    Ok(crate::RasterizeWork {
        intersections: state.lists.intersections as u64,
        tested: count.tested,
        seen: count.seen,
        blended: count.blended,
    })
}
