//! Rasterisation on CubeCL devices.

use burn::backend::TensorMetadata;
use burn::backend::ops::FloatTensorOps;
use burn::tensor::{FloatDType, Shape};
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use cubecl::client::Client;
use splat_kernels::intersect::{Frames, IntersectError};
use splat_kernels::rasterize::{
    RasterizeInputs, RasterizeSettings, RasterizeState, count_evaluations, rasterize, rasterize_vjp,
};
use splat_kernels::{Buffer, MOST_BUFFERS, bindable_buffers};

use super::{buffer, prepare, tensor};
use crate::OpError;
use crate::settings::RasterizeArgs;

/// Sizes, from colours `[C, N, D]`.
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

/// Packed splats, colours, opacities and the background, ready for the kernels.
struct Prepared {
    packed: CubeTensor,
    colors: CubeTensor,
    opacities: CubeTensor,
    background: Option<CubeTensor>,
}

impl Prepared {
    fn new(
        packed: CubeTensor,
        colors: CubeTensor,
        opacities: CubeTensor,
        background: Option<CubeTensor>,
    ) -> Self {
        Self {
            packed: prepare(packed),
            colors: prepare(colors),
            opacities: prepare(opacities),
            background: background.map(prepare),
        }
    }

    fn inputs(&self) -> RasterizeInputs {
        RasterizeInputs {
            packed: buffer(&self.packed),
            colors: buffer(&self.colors),
            opacities: buffer(&self.opacities),
            background: self.background.as_ref().map(buffer),
            channels: self.colors.shape()[2],
        }
    }
}

fn op_error(error: IntersectError) -> OpError {
    let op = "rasterize";
    match error {
        IntersectError::TooManyInstances { count, limit } => OpError::TooManyPairs {
            op,
            pairs: count,
            limit,
        },
        IntersectError::Device(what) => OpError::Device { op, what },
    }
}

/// Of all kernels, those of the rasteriser's gradient bind the most. wgpu would refuse them when they are launched, which
/// shows when a gradient is read, if it is.
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

/// The image with alpha `[C, H, W, D + 1]`, and what the backward pass needs. Where rendering fails, zeros and nothing,
/// and the reason is in `args.errors`.
pub(super) fn forward(
    packed: CubeTensor,
    colors: CubeTensor,
    opacities: CubeTensor,
    background: Option<CubeTensor>,
    args: &RasterizeArgs,
) -> (CubeTensor, Option<RasterizeState>) {
    let prepared = Prepared::new(packed, colors, opacities, background);
    let inputs = prepared.inputs();
    let frames = frames(&prepared.colors, args);
    let shape = Shape::from([
        frames.cameras,
        frames.height as usize,
        frames.width as usize,
        inputs.channels + 1,
    ]);
    let client = &prepared.packed.client;
    let rendered = enough_bindings(client).and_then(|()| {
        rasterize(
            client,
            &inputs,
            &frames,
            &RasterizeSettings::from(&args.settings),
        )
        .map_err(op_error)
    });
    match rendered {
        Ok((output, state)) => (tensor(&prepared.packed, output, shape), Some(state)),
        Err(error) => {
            args.errors.report(error);
            (zeros(&prepared.packed, shape), None)
        }
    }
}

/// The wanted gradients of packed splats, colours, opacities and background.
pub(super) fn backward(
    packed: CubeTensor,
    colors: CubeTensor,
    opacities: CubeTensor,
    background: Option<CubeTensor>,
    state: Option<&RasterizeState>,
    grad_output: CubeTensor,
    args: &RasterizeArgs,
    wanted: [bool; 4],
) -> [Option<CubeTensor>; 4] {
    let prepared = Prepared::new(packed, colors, opacities, background);
    let Some(state) = state else {
        let [packed, colors, opacities] =
            [&prepared.packed, &prepared.colors, &prepared.opacities].map(Some);
        let inputs = [packed, colors, opacities, prepared.background.as_ref()];
        return core::array::from_fn(|i| {
            let input = inputs[i].filter(|_| wanted[i])?;
            Some(zeros(input, input.shape()))
        });
    };
    let grad_output = prepare(grad_output);
    let [packed, colors, opacities, background] = rasterize_vjp(
        &grad_output.client,
        &prepared.inputs(),
        state,
        &buffer(&grad_output),
        &frames(&prepared.colors, args),
        &RasterizeSettings::from(&args.settings),
        wanted,
    );
    let like = |grad: Option<Buffer>, input: &CubeTensor| {
        grad.map(|grad| tensor(input, grad, input.shape()))
    };
    [
        like(packed, &prepared.packed),
        like(colors, &prepared.colors),
        like(opacities, &prepared.opacities),
        prepared
            .background
            .as_ref()
            .and_then(|input| like(background, input)),
    ]
}

/// The evaluations of a forward pass, counted on the device of `client`. Through the host: packed splats, colours
/// `[C, N, D]` and opacities `[C, N]` are measured once, not often.
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
        Buffer::from_f32(client, &values.unwrap_or_default())
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
    let count = count_evaluations(client, &inputs, &state, &frames, &settings);
    let count = count.map_err(|what| op_error(IntersectError::Device(what)))?;
    Ok(crate::RasterizeWork {
        instances: state.lists.instances as u64,
        tested: count.tested,
        seen: count.seen,
        blended: count.blended,
    })
}
