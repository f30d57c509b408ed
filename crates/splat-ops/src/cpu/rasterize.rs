//! Blending of the splats of each tile, and its gradient.
//!
//! Per pixel, front to back over the tile's list (3DGS eq. 3, appendix C), T being the
//! transmittance:
//!
//! ```text
//! z1 = w11 dx,  z2 = w21 dx + w22 dy,  raw = o exp(-(z1^2 + z2^2) / 2)
//! skip if raw < alpha_min;  alpha = min(alpha_max, raw);  stop if T (1 - alpha) < transmittance_min
//! image += c alpha T;  T *= 1 - alpha
//! ```
//!
//! Splats are prepared once per view. A tile is worked on in blocks of four by four pixels, each
//! with the splats whose ellipse reaches it; both directions go over these in several short passes
//! without branches. The pixels of a block lie in registers (`pixels.rs`), as wide as those of the
//! processor found at run time.

mod batch;
mod blend;
mod gradient;
mod inputs;
mod lanes;
mod pixels;
mod rows;
mod splat;
mod tally;
mod trace;
mod view;
mod work;

use core::marker::PhantomData;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::buffer::{Buffer, tensor, zeros};
use super::real::Real;
use super::schedule::heaviest_first;
use super::tiles::{CHUNK, TILE};
use super::uninit::Uncleared;
use crate::backend::{
    OpInputs, PROJECTED_WIDTH, RasterizeBackend, RasterizeGradients, RasterizeInputs, RasterizeOps,
    RasterizeTensors,
};
use crate::settings::RasterizeArgs;
use inputs::Camera;
use rows::{GradientRows, RowOfTilesBackward, blend};
use splat::ABSOLUTE;
pub use view::State;
use view::{Listed, View};
pub use work::{RasterizeWork, rasterize_work};

impl RasterizeOps for Flex {
    fn rasterize(inputs: RasterizeInputs<Self>, args: RasterizeArgs) -> FlexTensor {
        Self::rasterize_tracked(inputs, &args).0
    }
}

impl RasterizeBackend for Flex {
    type RasterizeState = State;

    fn rasterize_tracked(
        OpInputs(inputs): RasterizeInputs<Self>,
        args: &RasterizeArgs,
    ) -> (FlexTensor, State) {
        in_precision!(inputs.packed, forward, inputs, args)
    }

    fn rasterize_backward(
        OpInputs(inputs): RasterizeInputs<Self>,
        state: State,
        grad_output: FlexTensor,
        args: &RasterizeArgs,
        needs_grad: RasterizeTensors<bool>,
    ) -> RasterizeGradients<Self> {
        in_precision!(
            inputs.packed,
            backward,
            inputs,
            state,
            grad_output,
            args,
            needs_grad
        )
    }
}

fn forward<T: Real>(
    _: PhantomData<T>,
    inputs: RasterizeTensors<FlexTensor, Option<FlexTensor>>,
    args: &RasterizeArgs,
) -> (FlexTensor, State) {
    let buffers = inputs.map_inputs(Buffer::new);
    let [c, _, d] = buffers.colors.dims();
    let (w, h) = (args.size.width as usize, args.size.height as usize);
    let shape = [c, h, w, d + 1];
    let mut image = Uncleared::<T>::new(shape.iter().product());
    let mut frames = Vec::with_capacity(c);

    let slab = |first: usize| TILE.min(h - first) * w * (d + 1);
    let slabs = (0..c).flat_map(|_| (0..h).step_by(TILE).map(slab));
    let mut slabs = image.parts(slabs).into_iter();
    for index in 0..c {
        let camera = Camera::<T>::new(&buffers, index);
        match Listed::new(&camera, args) {
            Ok(listed) => {
                let slabs = slabs.by_ref().take(h.div_ceil(TILE)).collect();
                frames.push(blend(listed, camera.background, args, slabs));
            }
            Err(error) => {
                args.errors.report(error);
                let nothing = tensor(zeros::<T>(shape.iter().product()), shape);
                return (nothing, State::new::<T>(Vec::new()));
            }
        }
    }
    (tensor(image.written(), shape), State::new(frames))
}

fn backward<T: Real>(
    _: PhantomData<T>,
    inputs: RasterizeTensors<FlexTensor, Option<FlexTensor>>,
    state: State,
    grad_output: FlexTensor,
    args: &RasterizeArgs,
    needs_grad: RasterizeTensors<bool>,
) -> RasterizeGradients<Flex> {
    let buffers = inputs.map_inputs(Buffer::new);
    let [c, n, d] = buffers.colors.dims();
    let pixels = args.size.width as usize * args.size.height as usize * (d + 1);
    let grad = Buffer::new(grad_output);
    let grad = grad.slice::<T>();
    let mut of_background = vec![T::ZERO; c * d];
    let mut packed = Uncleared::new(c * n * PROJECTED_WIDTH);
    let mut colors = Uncleared::new(c * n * d);
    let mut opacities = Uncleared::new(c * n);
    let absolute = buffers.absgrad.is_some();
    let mut absgrad = Uncleared::new(if absolute { c * n * ABSOLUTE } else { 0 });
    let absgrads = absgrad.chunks_of_each(c, CHUNK * ABSOLUTE);
    let mut absgrads = absgrads.into_iter().map(|(.., part)| part);
    let mut rows = packed
        .chunks_of_each(c, CHUNK * PROJECTED_WIDTH)
        .into_iter()
        .zip(colors.chunks_of_each(c, CHUNK * d))
        .zip(opacities.chunks_of_each(c, CHUNK))
        .map(
            |(((.., packed), (.., colors)), (_, first, opacities))| GradientRows {
                first,
                packed,
                colors,
                opacities,
                absgrad: absgrads.next(),
            },
        );
    for (index, frame) in state.frames::<T>().iter().enumerate() {
        let background = Camera::<T>::new(&buffers, index).background;
        let view = View::new(&frame.listed, background, args);
        let grad = &grad[index * pixels..(index + 1) * pixels];
        // Every intersection writes its own row; each splat then sums its rows in order.
        let width = frame.listed.partials();
        let mut partials = Uncleared::<T>::new(view.lists.intersections() * width);
        let of_row = |ty: usize| view.intersections_of_row(ty) * width;
        let backgrounds = heaviest_first(
            partials.parts((0..view.grid.rows).map(of_row)),
            |ty| view.intersections_of_row(ty),
            |ty, partials| {
                let row = RowOfTilesBackward {
                    view: &view,
                    trace: &frame.traces[ty],
                    grad,
                    ty,
                    partials: partials.overwritten(),
                };
                row.run()
            },
        );
        for row in backgrounds {
            for (sum, value) in of_background[index * d..].iter_mut().zip(row) {
                *sum += value;
            }
        }
        let partials = partials.written();
        let rows: Vec<_> = rows.by_ref().take(n.div_ceil(CHUNK)).collect();
        rows.into_par_iter()
            .for_each(|rows| rows.write(&frame.listed, &partials));
    }
    // Nothing was rendered by a camera without a frame.
    rows.for_each(GradientRows::clear);
    RasterizeTensors {
        packed: needs_grad
            .packed
            .then(|| tensor(packed.written(), [c, n, PROJECTED_WIDTH])),
        colors: needs_grad
            .colors
            .then(|| tensor(colors.written(), [c, n, d])),
        opacities: needs_grad
            .opacities
            .then(|| tensor(opacities.written(), [c, n])),
        background: needs_grad.background.then(|| tensor(of_background, [c, d])),
        absgrad: (needs_grad.absgrad && absolute)
            .then(|| tensor(absgrad.written(), [c, n, ABSOLUTE])),
    }
}
