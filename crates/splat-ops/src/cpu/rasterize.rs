//! Blending of the splats of each tile, and its gradient.
//!
//! Per pixel, front to back over the tile's list (3DGS eq. 3, appendix C), T being the transmittance:
//!
//! ```text
//! z1 = w11 dx,  z2 = w21 dx + w22 dy,  raw = o exp(-(z1^2 + z2^2) / 2)
//! skip if raw < alpha_min;  alpha = min(alpha_max, raw);  stop if T (1 - alpha) < transmittance_min
//! image += c alpha T;  T *= 1 - alpha
//! ```
//!
//! Splats are prepared once per view. A tile is worked on in blocks of four by four pixels, each with the splats whose
//! ellipse reaches it; both directions go over these in several short passes without branches. The pixels of a block lie in
//! registers (`pixels.rs`), as wide as those of the processor found at run time.

mod batch;
mod blend;
mod gradient;
mod pixels;
mod splat;
mod trace;
mod work;

use core::any::Any;
use core::marker::PhantomData;
use std::sync::Arc;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use macerator::{Arch, Simd, Vector, WithSimd};
use rayon::prelude::*;
use tracing::trace_span;

use super::buffer::{Buffer, tensor, zeros};
#[cfg(target_arch = "x86_64")]
use super::instructions::InstructionSet;
use super::instructions::registers;
use super::intersect::{CHUNK, Grid, TILE, TileLists};
use super::parts::{Part, Uncleared};
use super::real::Real;
use super::schedule::heaviest_first;
use super::simd::prefetch;
use crate::OpError;
use crate::backend::{
    OpInputs, PROJECTED_WIDTH, RasterizeBackend, RasterizeGradients, RasterizeInputs, RasterizeOps,
    RasterizeTensors,
};
use crate::settings::RasterizeArgs;
use batch::by_groups;
use blend::BlendTile;
use gradient::GradientTile;
pub(super) use gradient::MOMENTS;
pub(super) use splat::{GROUP, NUMBERS, Splat};
use trace::Trace;
pub(super) use trace::kept_per_pair;
pub use work::{RasterizeWork, rasterize_work};

/// So many partial gradients before its turn one is fetched.
const AHEAD: usize = 16;

/// What the forward keeps for the backward: a [`Frame`] per camera, none of an image that was not rendered.
#[derive(Debug, Clone)]
pub struct State(Arc<dyn Any + Send + Sync>);

impl State {
    fn new<T: Real>(frames: Vec<Frame<T>>) -> Self {
        Self(Arc::new(frames))
    }

    fn frames<T: Real>(&self) -> &[Frame<T>] {
        self.0
            .downcast_ref::<Vec<Frame<T>>>()
            .map_or(&[], Vec::as_slice)
    }
}

/// The splats that one camera sees.
struct Listed<T> {
    lists: TileLists,
    splats: Vec<Splat<T>>,
    /// Of each splat the channels of its colour that it does not have with it.
    further_colors: Vec<T>,
    channels: usize,
}

impl<T: Real> Listed<T> {
    fn new(camera: &Camera<T>, args: &RasterizeArgs) -> Result<Self, OpError> {
        let _span = trace_span!("rasterize lists").entered();
        let inputs = [camera.packed, camera.colors, camera.opacities];
        let (lists, splats) = TileLists::new(inputs, args)?;
        let d = camera.channels;
        let further = d.saturating_sub(GROUP);
        let mut further_colors = Uncleared::<T>::new(lists.listed.len() * further);
        further_colors
            .chunks(CHUNK * further)
            .into_par_iter()
            .zip(lists.listed.par_chunks(CHUNK))
            .for_each(|(colors, listed)| {
                for (color, n) in colors.overwritten().chunks_exact_mut(further).zip(listed) {
                    let end = (*n as usize + 1) * d;
                    color.copy_from_slice(&camera.colors[end - further..end]);
                }
            });
        Ok(Self {
            lists,
            splats,
            further_colors: further_colors.written(),
            channels: d,
        })
    }

    /// Sums some of a splat's partial gradients over its tiles, in the order in which these were emitted.
    #[inline(always)]
    fn sum<const COUNT: usize>(&self, splat: usize, partials: &[T], first: usize) -> [T; COUNT] {
        let width = MOMENTS + self.channels;
        let mut sums = [T::ZERO; COUNT];
        for i in self.lists.emitted(splat) {
            if first == 0 {
                // They lie anywhere; those of the next splats follow.
                if let Some(next) = self.lists.place(i + AHEAD) {
                    prefetch(partials, next * width..(next + 1) * width);
                }
            }
            let place = self.lists.place(i).unwrap_or_default();
            let row = &partials[place * width + first..][..COUNT];
            for i in 0..COUNT {
                sums[i] += row[i];
            }
        }
        sums
    }

    /// Of a few channels.
    #[inline(always)]
    fn sum_colors<const COUNT: usize>(
        &self,
        first: usize,
        splat: usize,
        partials: &[T],
        sums: &mut [T],
    ) {
        let of_channels = self.sum::<COUNT>(splat, partials, MOMENTS + first);
        sums[first..first + COUNT].copy_from_slice(&of_channels);
    }
}

/// One camera's splats, and what became of its pixels.
struct Frame<T> {
    listed: Listed<T>,
    /// By row of tiles.
    traces: Vec<Trace<T>>,
}

/// One camera's splats as the tiles read them.
struct View<'a, T> {
    lists: &'a TileLists,
    splats: &'a [Splat<T>],
    further_colors: &'a [T],
    background: Option<&'a [T]>,
    channels: usize,
    width: usize,
    height: usize,
    grid: Grid,
    args: &'a RasterizeArgs,
}

impl<'a, T: Real> View<'a, T> {
    fn new(listed: &'a Listed<T>, background: Option<&'a [T]>, args: &'a RasterizeArgs) -> Self {
        Self {
            lists: &listed.lists,
            splats: &listed.splats,
            further_colors: &listed.further_colors,
            background,
            channels: listed.channels,
            width: args.size.width as usize,
            height: args.size.height as usize,
            grid: Grid::new(args),
            args,
        }
    }

    /// The splats of a tile, front to back; none beyond the end of its row.
    fn list(&self, [tx, ty]: [usize; 2]) -> &[u32] {
        match tx < self.grid.columns {
            true => self.lists.tile(ty * self.grid.columns + tx),
            false => &[],
        }
    }

    /// How many splats the tiles of a row have together: its length in what is kept per instance, and its work.
    fn instances_of_row(&self, ty: usize) -> usize {
        self.lists.row_of_tiles(ty, self.grid).len()
    }

    /// Columns and rows of a tile that lie in the image.
    fn inside(&self, [tx, ty]: [usize; 2]) -> [usize; 2] {
        [
            TILE.min(self.width - tx * TILE),
            TILE.min(self.height - ty * TILE),
        ]
    }
}

/// The inputs of one camera.
struct Camera<'a, T> {
    packed: &'a [T],
    colors: &'a [T],
    opacities: &'a [T],
    background: Option<&'a [T]>,
    channels: usize,
}

/// The tensors of one call.
type Buffers = RasterizeTensors<Buffer, Option<Buffer>>;

impl<'a, T: Real> Camera<'a, T> {
    fn new(buffers: &'a Buffers, index: usize) -> Self {
        let [_, n, d] = buffers.colors.dims();
        fn part<T: Real>(buffer: &Buffer, index: usize, length: usize) -> &[T] {
            &buffer.slice()[index * length..(index + 1) * length]
        }
        Self {
            packed: part(&buffers.packed, index, n * PROJECTED_WIDTH),
            colors: part(&buffers.colors, index, n * d),
            opacities: part(&buffers.opacities, index, n),
            background: buffers.background.as_ref().map(|b| part(b, index, d)),
            channels: d,
        }
    }
}

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

/// Renders one camera's image.
fn blend<T: Real>(
    listed: Listed<T>,
    background: Option<&[T]>,
    args: &RasterizeArgs,
    image: Vec<Part<T>>,
) -> Frame<T> {
    let view = View::new(&listed, background, args);
    let traces = heaviest_first(
        image,
        |ty| view.instances_of_row(ty),
        |ty, image| {
            let row = RowOfTiles {
                view: &view,
                ty,
                image: image.overwritten(),
            };
            row.run()
        },
    );
    Frame { listed, traces }
}

/// Renders one row of tiles into its part of the image.
struct RowOfTiles<'a, T> {
    view: &'a View<'a, T>,
    ty: usize,
    image: &'a mut [T],
}

impl<T: Real> RowOfTiles<'_, T> {
    fn run(self) -> Trace<T> {
        // SAFETY: the processor has them.
        unsafe { registers().dispatch(self) }
    }
}

impl<T: Real> WithSimd for RowOfTiles<'_, T> {
    type Output = Trace<T>;

    #[inline(always)]
    fn with_simd<S: Simd>(self) -> Trace<T> {
        let Self { view, ty, image } = self;
        let mut tile = BlendTile::new(view.channels);
        let splats = view.instances_of_row(ty);
        let mut trace = Trace::with_capacity(view.grid.columns, splats);
        for tx in 0..view.grid.columns {
            tile.blend::<S>(view, [tx, ty], &mut trace, &mut ());
            tile.store::<S>(view, [tx, ty], image);
        }
        trace
    }
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
            },
        );
    for (index, frame) in state.frames::<T>().iter().enumerate() {
        let background = Camera::<T>::new(&buffers, index).background;
        let view = View::new(&frame.listed, background, args);
        let grad = &grad[index * pixels..(index + 1) * pixels];
        // Every (tile, splat) pair writes its own row; each splat then sums its rows in order.
        let width = MOMENTS + d;
        let mut partials = Uncleared::<T>::new(view.lists.instances() * width);
        let of_row = |ty: usize| view.instances_of_row(ty) * width;
        let backgrounds = heaviest_first(
            partials.parts((0..view.grid.rows).map(of_row)),
            |ty| view.instances_of_row(ty),
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
    }
}

/// Writes the sums of one row of tiles; gives its share of the background's gradient.
struct RowOfTilesBackward<'a, T> {
    view: &'a View<'a, T>,
    trace: &'a Trace<T>,
    grad: &'a [T],
    ty: usize,
    partials: &'a mut [T],
}

impl<T: Real> RowOfTilesBackward<'_, T> {
    /// In registers of 256 bits at most: it writes a splat's sums, which lie in memory, once for every block. Wider
    /// registers take twice as long for that as for anything else where they are halves to the processor (Zen 4), and
    /// gain nothing where they are not (Zen 5).
    fn run(self) -> Vec<T> {
        let registers = match registers() {
            #[cfg(target_arch = "x86_64")]
            Arch::V4 => Arch::V3,
            others => others,
        };
        // SAFETY: the processor has them; what runs AVX-512 runs AVX2 too.
        unsafe { registers.dispatch(self) }
    }

    /// With AVX-512 there are twice as many registers, of any width.
    ///
    /// # Safety
    /// The processor has [`InstructionSet::Avx512`].
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")]
    fn walk_with_avx512<S: Simd>(self) -> Vec<T> {
        self.walk::<S>()
    }

    #[inline(always)]
    fn walk<S: Simd>(self) -> Vec<T> {
        let Self { view, ty, .. } = self;
        let channels = view.channels;
        let mut background = vec![T::ZERO; channels];
        let mut tile = GradientTile::<S, T>::new(channels);
        let (mut partials, mut first) = (self.partials, 0);
        for tx in 0..view.grid.columns {
            let count = view.list([tx, ty]).len();
            let (sums, later) = partials.split_at_mut(count * (MOMENTS + channels));
            let of_tile = self.trace.tile(tx, first..first + count);
            (partials, first) = (later, first + count);
            tile.load(view, self.grad, [tx, ty], &of_tile, &mut background);
            tile.walk(view, [tx, ty], &of_tile, sums);
        }
        background
    }
}

impl<T: Real> WithSimd for RowOfTilesBackward<'_, T> {
    type Output = Vec<T>;

    #[inline(always)]
    fn with_simd<S: Simd>(self) -> Vec<T> {
        #[cfg(target_arch = "x86_64")]
        if size_of::<Vector<S, T>>() == 32 && InstructionSet::chosen() == InstructionSet::Avx512 {
            // SAFETY: as `chosen` says.
            return unsafe { self.walk_with_avx512::<S>() };
        }
        self.walk::<S>()
    }
}

/// Gradients of up to [`CHUNK`] Gaussians in one camera.
struct GradientRows<'a, T> {
    /// The first Gaussian.
    first: usize,
    packed: Part<'a, T>,
    colors: Part<'a, T>,
    opacities: Part<'a, T>,
}

impl<T: Real> GradientRows<'_, T> {
    /// From what each splat has in its tiles.
    fn write(self, frame: &Listed<T>, partials: &[T]) {
        let d = frame.channels;
        let [packed, colors, opacities] =
            [self.packed, self.colors, self.opacities].map(Part::cleared);
        let listed = &frame.lists.listed;
        let at = |n: usize| listed.partition_point(|listed| (*listed as usize) < n);
        for splat in at(self.first)..at(self.first + opacities.len()) {
            let moments = frame.sum(splat, partials, 0);
            let (geometry, of_opacity) = frame.splats[splat].gradients(moments);
            let row = listed[splat] as usize - self.first;
            let packed = &mut packed[row * PROJECTED_WIDTH..][..PROJECTED_WIDTH];
            packed[..2].copy_from_slice(&geometry[..2]);
            packed[3..6].copy_from_slice(&geometry[2..]);
            opacities[row] = of_opacity;
            let colors = &mut colors[row * d..][..d];
            by_groups!(frame.sum_colors(0..d, splat, partials, colors));
        }
    }

    fn clear(self) {
        for part in [self.packed, self.colors, self.opacities] {
            part.cleared();
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};

    use super::*;
    use crate::{ErrorSlot, ImageSize};

    const CHANNELS: usize = 5;

    /// Image, what partial gradients each listed splat has in its tiles, and the background's gradient.
    struct Both<'a, T> {
        view: &'a View<'a, T>,
        grad: &'a [T],
        /// Whether the backward pass runs with the registers that it chooses.
        chosen: bool,
    }

    impl<T: Real> WithSimd for Both<'_, T> {
        type Output = [Vec<f64>; 3];

        #[inline(always)]
        fn with_simd<S: Simd>(self) -> Self::Output {
            let Self { view, grad, .. } = self;
            let mut image = vec![T::ZERO; grad.len()];
            let mut partials = vec![T::ZERO; view.lists.instances() * (MOMENTS + CHANNELS)];
            let mut background = vec![];
            let slab = TILE * view.width * (CHANNELS + 1);
            let mut later = &mut *partials;
            for (ty, image) in image.chunks_mut(slab).enumerate() {
                let trace = RowOfTiles { view, ty, image }.with_simd::<S>();
                let length = view.instances_of_row(ty);
                let (own, rest) = later.split_at_mut(length * (MOMENTS + CHANNELS));
                later = rest;
                let row = RowOfTilesBackward {
                    view,
                    trace: &trace,
                    grad,
                    ty,
                    partials: own,
                };
                background.extend(match self.chosen {
                    true => row.run(),
                    false => row.walk::<S>(),
                });
            }
            let wide = |values: Vec<T>| values.into_iter().map(T::wide).collect();
            [wide(image), wide(partials), wide(background)]
        }
    }

    /// Compares all registers that this processor has, from one number wide on, with each other and a reference; returns what
    /// the widest give.
    fn agrees<T: Real>(reference: Option<&[Vec<f64>; 3]>, tolerance: f64) -> [Vec<f64>; 3] {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(21);
        let size = ImageSize {
            width: 37,
            height: 21,
        };
        // Some of the pixels stop in the second batch of their lists, some at none.
        let count = 400;
        let (mut packed, mut opacities) = (vec![], vec![]);
        for depth in 0..count {
            let mut w = |low: f64, high: f64| rng.random_range(low..high);
            let (x, y) = (w(-4.0, 41.0), w(-4.0, 25.0));
            let (w11, w21, w22) = (w(0.05, 0.3), w(-0.1, 0.1), w(0.05, 0.3));
            packed.extend([x, y, 1.0 + depth as f64, w11, w21, w22, 1.0, 80.0, 80.0]);
            opacities.push(if depth % 7 == 0 { 1.0 } else { w(0.01, 0.2) });
        }
        let mut some = |length: usize| -> Vec<T> {
            let numbers = (0..length).map(|_| T::of(rng.random_range(0.0..1.0)));
            numbers.collect()
        };
        let (colors, background) = (some(count * CHANNELS), some(CHANNELS));
        let grad = some(37 * 21 * (CHANNELS + 1));
        let of = |values: Vec<f64>| -> Vec<T> { values.into_iter().map(T::of).collect() };
        let (packed, opacities) = (of(packed), of(opacities));
        let args = RasterizeArgs {
            size,
            settings: Default::default(),
            backward: true,
            errors: ErrorSlot::default(),
        };
        let camera = Camera {
            packed: &packed,
            colors: &colors,
            opacities: &opacities,
            background: Some(&background),
            channels: CHANNELS,
        };
        let listed = Listed::new(&camera, &args).unwrap();
        let view = View::new(&listed, camera.background, &args);
        assert!(view.lists.tile(0).len() > batch::BATCH);

        let both = |chosen| Both {
            view: &view,
            grad: &grad,
            chosen,
        };
        let best = Arch::detect();
        let mut sets = vec![(best, true), (best, false), (Arch::Scalar, false)];
        #[cfg(target_arch = "x86_64")]
        if matches!(best, Arch::V3 | Arch::V4) {
            // Whatever runs these runs what came before them.
            sets.extend([(Arch::V2, false), (Arch::V3, false)]);
        }
        let mut results = sets.into_iter().map(|(set, chosen)| {
            // SAFETY: the processor has them.
            (set, unsafe { set.dispatch(both(chosen)) })
        });
        let (_, first) = results.next().unwrap();
        let reference = reference.unwrap_or(&first);
        for (set, result) in results.chain([(best, first.clone())]) {
            for (ours, theirs) in result.iter().zip(reference) {
                assert_eq!(ours.len(), theirs.len());
                let norm = |values: &mut dyn Iterator<Item = f64>| {
                    values.map(|value| value * value).sum::<f64>().sqrt()
                };
                let error = norm(&mut ours.iter().zip(theirs).map(|(a, b)| a - b));
                let error = error / norm(&mut theirs.iter().copied());
                assert!(error < tolerance, "{set:?}: {error:e}");
            }
        }
        first
    }

    #[test]
    fn registers_of_any_width_give_the_same_image_and_gradients() {
        let reference = agrees::<f64>(None, 1e-13);
        agrees::<f32>(Some(&reference), 2e-5);
    }
}
