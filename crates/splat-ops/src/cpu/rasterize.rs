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
//! Splats are prepared once per view, in depth order. A tile is worked on in blocks of eight pixels of
//! a row, those only that a splat's ellipse reaches, in loops of fixed width without branches that the
//! compiler turns into SIMD code for the processor it finds at run time.

mod blend;
mod gradient;
mod splat;

use core::marker::PhantomData;
use std::sync::Arc;

use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::buffer::{Buffer, overwritten, tensor};
use super::intersect::{CHUNK, Grid, TILE, TileLists};
use super::real::Real;
use super::simd::vectorized;
use crate::backend::PROJECTED_WIDTH;
use crate::settings::RasterizeArgs;
use blend::BlendTile;
use gradient::{GradientTile, Upstream};
use splat::Splat;

/// Partial gradients of a splat before its D colours: screen mean, w11, w21, w22, opacity.
const GEOMETRY: usize = 6;

/// What the forward keeps for the backward.
#[derive(Debug, Clone)]
pub struct State {
    /// Per camera.
    lists: Arc<Vec<TileLists>>,
    /// `[C, H, W]`: what is left of the light at each pixel. One minus alpha would lose its digits.
    transmittance: FlexTensor,
    /// `[C, H, W]`: the place, in the list of the pixel's tile, of the splat before which it stopped.
    stop: Arc<Vec<u32>>,
}

impl State {
    /// Of an image that was not rendered: no camera has a list, and no gradient anything in it.
    fn none<T: Real>() -> Self {
        Self {
            lists: Arc::default(),
            transmittance: tensor(Vec::<T>::new(), [0, 0, 0]),
            stop: Arc::default(),
        }
    }
}

/// One camera's splats, front to back, as the tiles read them.
struct View<'a, T> {
    /// By rank.
    splats: Vec<Splat<T>>,
    /// By rank, D each.
    colors: Vec<T>,
    background: Option<&'a [T]>,
    channels: usize,
    width: usize,
    height: usize,
    grid: Grid,
    args: &'a RasterizeArgs,
}

impl<'a, T: Real> View<'a, T> {
    fn new(camera: &Camera<'a, T>, order: &[u32], args: &'a RasterizeArgs) -> Self {
        let d = camera.channels;
        let splats = order
            .par_iter()
            .with_min_len(CHUNK)
            .map(|n| {
                let n = *n as usize;
                let row = &camera.packed[n * PROJECTED_WIDTH..(n + 1) * PROJECTED_WIDTH];
                Splat::new(row, camera.opacities[n], args)
            })
            // The lists hold what has a footprint, and so has a splat.
            .flatten_iter()
            .collect();
        let mut colors = overwritten::<T>(order.len() * d);
        colors
            .par_chunks_exact_mut(d)
            .with_min_len(CHUNK)
            .zip(order)
            .for_each(|(color, n)| {
                let n = *n as usize;
                color.copy_from_slice(&camera.colors[n * d..(n + 1) * d]);
            });
        Self {
            splats,
            colors,
            background: camera.background,
            channels: d,
            width: args.size.width as usize,
            height: args.size.height as usize,
            grid: Grid::new(args),
            args,
        }
    }

    /// Pixels in one row of tiles (the last row of tiles may have fewer).
    fn slab(&self) -> usize {
        TILE * self.width
    }

    /// (columns of a tile in the image, rows of a row of tiles in the image).
    fn inside(&self, tx: usize, ty: usize) -> (usize, usize) {
        (
            TILE.min(self.width - tx * TILE),
            TILE.min(self.height - ty * TILE),
        )
    }
}

/// The pixels of one row of tiles.
struct Slab<'a, T> {
    image: &'a mut [T],
    transmittance: &'a mut [T],
    stop: &'a mut [u32],
}

/// The inputs of one camera.
struct Camera<'a, T> {
    packed: &'a [T],
    colors: &'a [T],
    opacities: &'a [T],
    background: Option<&'a [T]>,
    channels: usize,
}

/// The tensors of one call, split by camera.
struct Inputs {
    packed: Buffer,
    colors: Buffer,
    opacities: Buffer,
    background: Option<Buffer>,
}

impl Inputs {
    fn new([packed, colors, opacities]: [FlexTensor; 3], background: Option<FlexTensor>) -> Self {
        Self {
            packed: Buffer::new(packed),
            colors: Buffer::new(colors),
            opacities: Buffer::new(opacities),
            background: background.map(Buffer::new),
        }
    }

    /// C, N, D.
    fn dims(&self) -> [usize; 3] {
        self.colors.dims()
    }

    fn camera<T: Real>(&self, index: usize) -> Camera<'_, T> {
        let [_, n, d] = self.dims();
        fn part<T: Real>(buffer: &Buffer, index: usize, length: usize) -> &[T] {
            &buffer.slice()[index * length..(index + 1) * length]
        }
        Camera {
            packed: part(&self.packed, index, n * PROJECTED_WIDTH),
            colors: part(&self.colors, index, n * d),
            opacities: part(&self.opacities, index, n),
            background: self.background.as_ref().map(|b| part(b, index, d)),
            channels: d,
        }
    }
}

pub(super) fn forward<T: Real>(
    _: PhantomData<T>,
    inputs: [FlexTensor; 3],
    background: Option<FlexTensor>,
    args: &RasterizeArgs,
) -> (FlexTensor, State) {
    let inputs = Inputs::new(inputs, background);
    let [c, _, d] = inputs.dims();
    let (w, h) = (args.size.width as usize, args.size.height as usize);
    let mut image = overwritten::<T>(c * h * w * (d + 1));
    let mut transmittance = overwritten::<T>(c * h * w);
    let mut stop = overwritten::<u32>(c * h * w);
    let mut lists = Vec::with_capacity(c);

    for index in 0..c {
        let camera = inputs.camera::<T>(index);
        let camera_lists =
            match TileLists::new(camera.packed, camera.colors, camera.opacities, args) {
                Ok(lists) => lists,
                Err(error) => {
                    args.errors.report(error);
                    let black = vec![T::ZERO; image.len()];
                    return (tensor(black, [c, h, w, d + 1]), State::none::<T>());
                }
            };
        let pixels = index * h * w..(index + 1) * h * w;
        let image = &mut image[pixels.start * (d + 1)..pixels.end * (d + 1)];
        let view = View::new(&camera, &camera_lists.order, args);
        image
            .par_chunks_mut(view.slab() * (d + 1))
            .zip(transmittance[pixels.clone()].par_chunks_mut(view.slab()))
            .zip(stop[pixels].par_chunks_mut(view.slab()))
            .enumerate()
            .for_each(|(ty, ((image, transmittance), stop))| {
                let slab = Slab {
                    image,
                    transmittance,
                    stop,
                };
                blend_row_of_tiles(&view, &camera_lists, ty, slab);
            });
        lists.push(camera_lists);
    }
    let state = State {
        lists: Arc::new(lists),
        transmittance: tensor(transmittance, [c, h, w]),
        stop: Arc::new(stop),
    };
    (tensor(image, [c, h, w, d + 1]), state)
}

vectorized! {
    /// Renders one row of tiles into its part of the image.
    fn blend_row_of_tiles<T: Real, const FMA: bool>(
        view: &View<T>,
        lists: &TileLists,
        ty: usize,
        slab: Slab<T>,
    ) {
        let mut slab = slab;
        for tx in 0..view.grid.columns {
            let (_, ranks) = lists.tile(ty * view.grid.columns + tx);
            BlendTile::blend::<FMA>(view, ranks, tx, ty).store(view, tx, ty, &mut slab);
        }
    }
}

pub(super) fn backward<T: Real>(
    _: PhantomData<T>,
    inputs: [FlexTensor; 3],
    background: Option<FlexTensor>,
    state: State,
    grad_output: FlexTensor,
    args: &RasterizeArgs,
    wanted: [bool; 4],
) -> [Option<FlexTensor>; 4] {
    let inputs = Inputs::new(inputs, background);
    let [c, n, d] = inputs.dims();
    let (w, h) = (args.size.width as usize, args.size.height as usize);
    let (grad, transmittance) = (Buffer::new(grad_output), Buffer::new(state.transmittance));
    let width = GEOMETRY + d;
    let mut sums = vec![T::ZERO; c * n * width];
    let mut grad_background = vec![T::ZERO; c * d];

    for (index, lists) in state.lists.iter().enumerate() {
        let view = View::new(&inputs.camera::<T>(index), &lists.order, args);
        let pixels = index * h * w..(index + 1) * h * w;
        let upstream = Upstream {
            grad: &grad.slice::<T>()[pixels.start * (d + 1)..pixels.end * (d + 1)],
            transmittance: &transmittance.slice::<T>()[pixels.clone()],
            stop: &state.stop[pixels],
        };
        // Every (tile, splat) pair writes its own row; each splat then sums its rows in order.
        let mut partials = vec![T::ZERO; lists.instances() * width];
        let slabs = split_by_tile_row(&mut partials, lists, view.grid, width);
        let backgrounds: Vec<Vec<T>> = slabs
            .into_par_iter()
            .enumerate()
            .map(|(ty, partials)| row_of_tiles_backward(&view, lists, &upstream, ty, partials))
            .collect();
        for row in backgrounds {
            for (sum, value) in grad_background[index * d..].iter_mut().zip(row) {
                *sum += value;
            }
        }
        reduce(
            &partials,
            lists,
            &mut sums[index * n * width..(index + 1) * n * width],
            width,
        );
    }

    let column = |from: usize, length: usize| -> Vec<T> {
        sums.chunks_exact(width)
            .flat_map(|row| &row[from..from + length])
            .copied()
            .collect()
    };
    [
        wanted[0].then(|| {
            let mut packed = vec![T::ZERO; c * n * PROJECTED_WIDTH];
            for (row, sum) in packed
                .chunks_exact_mut(PROJECTED_WIDTH)
                .zip(sums.chunks_exact(width))
            {
                row[..2].copy_from_slice(&sum[..2]);
                row[3..6].copy_from_slice(&sum[2..5]);
            }
            tensor(packed, [c, n, PROJECTED_WIDTH])
        }),
        wanted[1].then(|| tensor(column(GEOMETRY, d), [c, n, d])),
        wanted[2].then(|| tensor(column(GEOMETRY - 1, 1), [c, n])),
        wanted[3].then(|| tensor(grad_background, [c, d])),
    ]
}

vectorized! {
    /// Writes the partial gradients of one row of tiles; returns its share of the background's.
    fn row_of_tiles_backward<T: Real, const FMA: bool>(
        view: &View<T>,
        lists: &TileLists,
        upstream: &Upstream<T>,
        ty: usize,
        partials: &mut [T],
    ) -> Vec<T> {
        let width = GEOMETRY + view.channels;
        let mut partials = partials;
        let mut background = vec![T::ZERO; view.channels];
        for tx in 0..view.grid.columns {
            let (_, ranks) = lists.tile(ty * view.grid.columns + tx);
            let (tile, rest) = core::mem::take(&mut partials).split_at_mut(ranks.len() * width);
            partials = rest;
            GradientTile::load(view, upstream, tx, ty, &mut background)
                .walk::<FMA>(view, ranks, tx, ty, tile);
        }
        background
    }
}

/// The part of `partials` that belongs to each row of tiles.
fn split_by_tile_row<'a, T>(
    mut partials: &'a mut [T],
    lists: &TileLists,
    grid: Grid,
    width: usize,
) -> Vec<&'a mut [T]> {
    (0..grid.rows)
        .map(|ty| {
            let (start, _) = lists.tile(ty * grid.columns);
            let (last, splats) = lists.tile(ty * grid.columns + grid.columns - 1);
            let length = (last + splats.len() - start) * width;
            let (slab, rest) = core::mem::take(&mut partials).split_at_mut(length);
            partials = rest;
            slab
        })
        .collect()
}

/// Sums the partial gradients of each splat over its tiles, in the order they were emitted.
fn reduce<T: Real>(partials: &[T], lists: &TileLists, sums: &mut [T], width: usize) {
    const HIDDEN: u32 = u32::MAX;
    let mut rank = vec![HIDDEN; sums.len() / width];
    for (i, n) in lists.order.iter().enumerate() {
        rank[*n as usize] = i as u32;
    }
    sums.par_chunks_mut(width)
        .with_min_len(256)
        .zip(&rank)
        .filter(|(_, rank)| **rank != HIDDEN)
        .for_each(|(sum, rank)| {
            let i = *rank as usize;
            for position in &lists.position[lists.spans[i] as usize..lists.spans[i + 1] as usize] {
                let row = &partials[*position as usize * width..][..width];
                for (sum, value) in sum.iter_mut().zip(row) {
                    *sum += *value;
                }
            }
        });
}
