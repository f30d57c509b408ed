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
//! A row of a tile is 16 lanes of fixed width, in loops without branches that the compiler turns
//! into SIMD code for the processor it finds at run time.

use core::marker::PhantomData;
use std::sync::Arc;

use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::buffer::{Buffer, overwritten, tensor};
use super::intersect::{Footprint, Grid, TILE, TileLists};
use super::real::Real;
use super::simd::vectorized;
use crate::backend::PROJECTED_WIDTH;
use crate::settings::RasterizeArgs;

/// One value per pixel of a row of a tile.
type Lanes<T> = [T; TILE];

/// Partial gradients of a splat before its D colours: screen mean, w11, w21, w22, opacity.
const GEOMETRY: usize = 6;

/// What the forward keeps for the backward.
#[derive(Debug, Clone)]
pub struct State {
    /// Per camera.
    lists: Arc<Vec<TileLists>>,
    /// `[C, H, W]`: what is left of the light at each pixel. One minus alpha would lose its digits.
    transmittance: FlexTensor,
    /// `[C, H, W]`: one past the place of the last blended splat in the list of the pixel's tile.
    last: Arc<Vec<u32>>,
}

impl State {
    /// Of an image that was not rendered: no camera has a list, and no gradient anything in it.
    fn none<T: Real>() -> Self {
        Self {
            lists: Arc::default(),
            transmittance: tensor(Vec::<T>::new(), [0, 0, 0]),
            last: Arc::default(),
        }
    }
}

/// A splat as the pixels of a tile see it.
struct Splat<'a, T> {
    footprint: Footprint<T>,
    opacity: T,
    color: &'a [T],
    /// Of the quadratic in dx that bounds a row of the ellipse.
    inverse_a: T,
    slope: T,
    reach: T,
    shrink: T,
}

impl<'a, T: Real> Splat<'a, T> {
    #[inline(always)]
    fn new(packed: &[T], opacity: T, color: &'a [T], args: &RasterizeArgs) -> Option<Self> {
        let footprint = Footprint::new(packed, opacity, args)?;
        let Footprint {
            w11, w21, w22, cut, ..
        } = footprint;
        let a = w11 * w11 + w21 * w21;
        let inverse_a = T::ONE / a;
        Some(Self {
            footprint,
            opacity,
            color,
            inverse_a,
            slope: -w21 * w22 * inverse_a,
            reach: (cut + cut) * a,
            shrink: w11 * w22 * w11 * w22,
        })
    }

    /// Whether the ellipse can reach a pixel centre in [x0, x1] on the row at dy.
    #[inline(always)]
    fn reaches(&self, x0: T, x1: T, dy: T) -> bool {
        // sigma <= cut along a row is a quadratic in dx; a thousandth of a pixel stands for rounding.
        let discriminant = self.reach - self.shrink * dy * dy;
        if !(discriminant >= T::ZERO) {
            return false;
        }
        let centre = self.footprint.mean[0] + self.slope * dy;
        let half = discriminant.sqrt() * self.inverse_a + T::of(1e-3);
        centre + half >= x0 && centre - half <= x1
    }

    /// Rows of the tile beginning at pixel row `y0` that the ellipse reaches.
    #[inline(always)]
    fn rows(&self, y0: usize) -> core::ops::Range<usize> {
        let (mean, half) = (self.footprint.mean[1].wide(), self.footprint.half[1].wide());
        let low = mean - half - 1.0 - y0 as f64;
        let high = mean + half + 1.0 - y0 as f64;
        (low.max(0.0) as usize).min(TILE)..(high.max(0.0) as usize).min(TILE)
    }

    /// (z1, z2, exp(-sigma)) at an offset from the mean.
    #[inline(always)]
    fn falloff<const FMA: bool>(&self, dx: T, dy: T) -> (T, T, T) {
        let z1 = self.footprint.w11 * dx;
        let z2 = self.footprint.w21 * dx + self.footprint.w22 * dy;
        let sigma = T::of(0.5) * (z1 * z1 + z2 * z2);
        (z1, z2, T::exp_neg::<FMA>(sigma))
    }
}

/// The one place that decides what becomes of a (pixel, splat) pair; both passes call it.
#[derive(Clone, Copy)]
struct Thresholds<T> {
    alpha_min: T,
    alpha_max: T,
    transmittance_min: T,
}

impl<T: Real> Thresholds<T> {
    fn new(args: &RasterizeArgs) -> Self {
        Self {
            alpha_min: T::of(args.settings.alpha_min),
            alpha_max: T::of(args.settings.alpha_max),
            transmittance_min: T::of(args.settings.transmittance_min),
        }
    }

    #[inline(always)]
    fn seen(&self, raw: T) -> bool {
        raw >= self.alpha_min
    }

    #[inline(always)]
    fn alpha(&self, raw: T) -> T {
        raw.least(self.alpha_max)
    }

    /// At the cap alpha no longer depends on anything.
    #[inline(always)]
    fn capped(&self, raw: T) -> bool {
        raw >= self.alpha_max
    }

    #[inline(always)]
    fn stops(&self, transmittance_after: T) -> bool {
        transmittance_after < self.transmittance_min
    }
}

/// The inputs of one camera.
struct Camera<'a, T> {
    packed: &'a [T],
    colors: &'a [T],
    opacities: &'a [T],
    background: Option<&'a [T]>,
    channels: usize,
    width: usize,
    height: usize,
    grid: Grid,
    args: &'a RasterizeArgs,
}

impl<'a, T: Real> Camera<'a, T> {
    #[inline(always)]
    fn splat(&self, n: u32) -> Option<Splat<'a, T>> {
        let (n, d) = (n as usize, self.channels);
        Splat::new(
            &self.packed[n * PROJECTED_WIDTH..(n + 1) * PROJECTED_WIDTH],
            self.opacities[n],
            &self.colors[n * d..(n + 1) * d],
            self.args,
        )
    }

    /// Pixels in one row of tiles (the last row of tiles may have fewer).
    fn slab(&self) -> usize {
        TILE * self.width
    }

    /// (lanes of a tile in the image, rows of a row of tiles in the image).
    fn inside(&self, tx: usize, ty: usize) -> (usize, usize) {
        (
            TILE.min(self.width - tx * TILE),
            TILE.min(self.height - ty * TILE),
        )
    }
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

    fn camera<'a, T: Real>(&'a self, index: usize, args: &'a RasterizeArgs) -> Camera<'a, T> {
        let [_, n, d] = self.dims();
        let part = |buffer: &'a Buffer, length: usize| {
            &buffer.slice::<T>()[index * length..(index + 1) * length]
        };
        Camera {
            packed: part(&self.packed, n * PROJECTED_WIDTH),
            colors: part(&self.colors, n * d),
            opacities: part(&self.opacities, n),
            background: self.background.as_ref().map(|buffer| part(buffer, d)),
            channels: d,
            width: args.size.width as usize,
            height: args.size.height as usize,
            grid: Grid::new(args),
            args,
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
    let mut last = overwritten::<u32>(c * h * w);
    let mut lists = Vec::with_capacity(c);

    for index in 0..c {
        let camera = inputs.camera::<T>(index, args);
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
        image
            .par_chunks_mut(camera.slab() * (d + 1))
            .zip(transmittance[pixels.clone()].par_chunks_mut(camera.slab()))
            .zip(last[pixels].par_chunks_mut(camera.slab()))
            .enumerate()
            .for_each(|(ty, ((image, transmittance), last))| {
                blend_row_of_tiles(&camera, &camera_lists, ty, image, transmittance, last);
            });
        lists.push(camera_lists);
    }
    let state = State {
        lists: Arc::new(lists),
        transmittance: tensor(transmittance, [c, h, w]),
        last: Arc::new(last),
    };
    (tensor(image, [c, h, w, d + 1]), state)
}

vectorized! {
    /// Renders one row of tiles into its part of the image.
    fn blend_row_of_tiles<T: Real, const FMA: bool>(
        camera: &Camera<T>,
        lists: &TileLists,
        ty: usize,
        image: &mut [T],
        transmittance: &mut [T],
        last: &mut [u32],
    ) {
        for tx in 0..camera.grid.columns {
            let (_, splats) = lists.tile(ty * camera.grid.columns + tx);
            let tile = ForwardTile::blend::<FMA>(camera, splats, tx, ty);
            tile.store(camera, tx, ty, image, transmittance, last);
        }
    }
}

/// The pixels of a tile while it is being blended.
struct ForwardTile<T> {
    /// D lanes per row.
    colors: Vec<Lanes<T>>,
    transmittance: [Lanes<T>; TILE],
    last: [Lanes<u32>; TILE],
}

impl<T: Real> ForwardTile<T> {
    #[inline(always)]
    fn blend<const FMA: bool>(camera: &Camera<T>, splats: &[u32], tx: usize, ty: usize) -> Self {
        let d = camera.channels;
        let thresholds = Thresholds::<T>::new(camera.args);
        let (columns, rows) = camera.inside(tx, ty);
        let centres = pixel_centres::<T>(tx);
        let mut tile = Self {
            colors: vec![[T::ZERO; TILE]; TILE * d],
            transmittance: [[T::ONE; TILE]; TILE],
            last: [[0; TILE]; TILE],
        };
        // One while a pixel still takes light, zero once it has stopped or where there is none.
        let mut open = [[T::ZERO; TILE]; TILE];
        let mut row_open = [false; TILE];
        for row in 0..rows {
            open[row][..columns].fill(T::ONE);
            row_open[row] = true;
        }

        for (place, n) in splats.iter().enumerate() {
            let Some(splat) = camera.splat(*n) else {
                continue;
            };
            for row in splat.rows(ty * TILE) {
                let y = T::of((ty * TILE + row) as f64 + 0.5);
                let dy = y - splat.footprint.mean[1];
                if !row_open[row] || !splat.reaches(centres[0], centres[TILE - 1], dy) {
                    continue;
                }
                let mut weights = [T::ZERO; TILE];
                let transmittance = &mut tile.transmittance[row];
                let (last, open) = (&mut tile.last[row], &mut open[row]);
                for i in 0..TILE {
                    let (_, _, falloff) =
                        splat.falloff::<FMA>(centres[i] - splat.footprint.mean[0], dy);
                    let raw = splat.opacity * falloff;
                    let alpha = thresholds.alpha(raw);
                    let before = transmittance[i];
                    let after = before * (T::ONE - alpha);
                    let seen = thresholds.seen(raw) & (open[i] > T::ZERO);
                    let stops = thresholds.stops(after);
                    let blends = seen & !stops;
                    weights[i] = if blends { alpha * before } else { T::ZERO };
                    transmittance[i] = if blends { after } else { before };
                    last[i] = if blends { place as u32 + 1 } else { last[i] };
                    open[i] = if seen & stops { T::ZERO } else { open[i] };
                }
                row_open[row] = any_positive(open);
                for (lanes, color) in tile.colors[row * d..(row + 1) * d]
                    .iter_mut()
                    .zip(splat.color)
                {
                    // A copy: through the reference it might alias the lanes, which bars SIMD.
                    let color = *color;
                    for i in 0..TILE {
                        lanes[i] += color * weights[i];
                    }
                }
            }
            if !row_open.contains(&true) {
                break;
            }
        }
        tile
    }

    /// Writes the tile into its row of tiles, with the background behind it.
    #[inline(always)]
    fn store(
        &self,
        camera: &Camera<T>,
        tx: usize,
        ty: usize,
        image: &mut [T],
        transmittance: &mut [T],
        last: &mut [u32],
    ) {
        let d = camera.channels;
        let (columns, rows) = camera.inside(tx, ty);
        for row in 0..rows {
            for i in 0..columns {
                let pixel = row * camera.width + tx * TILE + i;
                let left = self.transmittance[row][i];
                let out = &mut image[pixel * (d + 1)..(pixel + 1) * (d + 1)];
                for channel in 0..d {
                    let behind = camera.background.map_or(T::ZERO, |b| b[channel]);
                    out[channel] = self.colors[row * d + channel][i] + left * behind;
                }
                out[d] = T::ONE - left;
                transmittance[pixel] = left;
                last[pixel] = self.last[row][i];
            }
        }
    }
}

/// Integers, because a sum of floats has a fixed order and would not vectorise.
#[inline(always)]
fn any_positive<T: Real>(lanes: &Lanes<T>) -> bool {
    let mut any = 0;
    for lane in lanes {
        any |= u32::from(*lane > T::ZERO);
    }
    any != 0
}

/// x of the pixel centres of a tile's row.
#[inline(always)]
fn pixel_centres<T: Real>(tx: usize) -> Lanes<T> {
    core::array::from_fn(|i| T::of((tx * TILE + i) as f64 + 0.5))
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
        let camera = inputs.camera::<T>(index, args);
        let pixels = index * h * w..(index + 1) * h * w;
        let upstream = Upstream {
            grad: &grad.slice::<T>()[pixels.start * (d + 1)..pixels.end * (d + 1)],
            transmittance: &transmittance.slice::<T>()[pixels.clone()],
            last: &state.last[pixels],
        };
        // Every (tile, splat) pair writes its own row; each splat then sums its rows in order.
        let mut partials = vec![T::ZERO; lists.instances() * width];
        let slabs = split_by_tile_row(&mut partials, lists, camera.grid, width);
        let backgrounds: Vec<Vec<T>> = slabs
            .into_par_iter()
            .enumerate()
            .map(|(ty, partials)| row_of_tiles_backward(&camera, lists, &upstream, ty, partials))
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
        camera: &Camera<T>,
        lists: &TileLists,
        upstream: &Upstream<T>,
        ty: usize,
        partials: &mut [T],
    ) -> Vec<T> {
        let width = GEOMETRY + camera.channels;
        let mut partials = partials;
        let mut background = vec![T::ZERO; camera.channels];
        for tx in 0..camera.grid.columns {
            let (_, splats) = lists.tile(ty * camera.grid.columns + tx);
            let (tile, rest) =
                core::mem::take(&mut partials).split_at_mut(splats.len() * width);
            partials = rest;
            BackwardTile::load(camera, upstream, tx, ty, &mut background)
                .blend::<FMA>(camera, splats, tx, ty, tile);
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

/// Per-pixel data of one camera that the backward starts from.
struct Upstream<'a, T> {
    grad: &'a [T],
    transmittance: &'a [T],
    last: &'a [u32],
}

/// The pixels of a tile while they are walked back to front.
struct BackwardTile<T> {
    /// Gradient of the D colours, D lanes per row.
    grad: Vec<Lanes<T>>,
    /// Transmittance behind the splats walked so far; in front of them after the next one.
    transmittance: [Lanes<T>; TILE],
    /// What lies behind, as the loss sees it: sum of (c . grad) alpha T over the splats behind, plus
    /// the final transmittance times (background . grad - grad of alpha).
    behind: [Lanes<T>; TILE],
    last: [Lanes<u32>; TILE],
}

impl<T: Real> BackwardTile<T> {
    /// Reads the tile's pixels, and adds its share of the background's gradient,
    /// `sum of T_final grad`.
    #[inline(always)]
    fn load(
        camera: &Camera<T>,
        upstream: &Upstream<T>,
        tx: usize,
        ty: usize,
        background: &mut [T],
    ) -> Self {
        let d = camera.channels;
        let (columns, rows) = camera.inside(tx, ty);
        let mut tile = Self {
            grad: vec![[T::ZERO; TILE]; TILE * d],
            transmittance: [[T::ONE; TILE]; TILE],
            behind: [[T::ZERO; TILE]; TILE],
            last: [[0; TILE]; TILE],
        };
        for row in 0..rows {
            for i in 0..columns {
                let pixel = (ty * TILE + row) * camera.width + tx * TILE + i;
                let grad = &upstream.grad[pixel * (d + 1)..(pixel + 1) * (d + 1)];
                let left = upstream.transmittance[pixel];
                let mut behind = -grad[d];
                for channel in 0..d {
                    tile.grad[row * d + channel][i] = grad[channel];
                    background[channel] += left * grad[channel];
                    if let Some(color) = camera.background {
                        behind += color[channel] * grad[channel];
                    }
                }
                tile.transmittance[row][i] = left;
                tile.behind[row][i] = left * behind;
                tile.last[row][i] = upstream.last[pixel];
            }
        }
        tile
    }

    /// Walks the list back to front and writes the partial gradients of each splat, `6 + D` values.
    ///
    /// ```text
    /// d alpha = T (c . grad) - behind / (1 - alpha)
    /// d o = exp(-sigma) d alpha,  d sigma = -raw d alpha     (both 0 at the cap)
    /// d z = z d sigma;  d w11 = dz1 dx;  d w21 = dz2 dx;  d w22 = dz2 dy
    /// d mean = -(w11 dz1 + w21 dz2, w22 dz2)
    /// ```
    #[inline(always)]
    fn blend<const FMA: bool>(
        mut self,
        camera: &Camera<T>,
        splats: &[u32],
        tx: usize,
        ty: usize,
        partials: &mut [T],
    ) {
        let d = camera.channels;
        let thresholds = Thresholds::<T>::new(camera.args);
        let centres = pixel_centres::<T>(tx);
        let row_last = self.last.map(|row| row.into_iter().fold(0, u32::max));
        let depth = row_last.into_iter().fold(0, u32::max) as usize;
        let mut color_sums = vec![[T::ZERO; TILE]; d];

        for place in (0..depth).rev() {
            let Some(splat) = camera.splat(splats[place]) else {
                continue;
            };
            let [
                mut z1_sum,
                mut z2_sum,
                mut w11_sum,
                mut w21_sum,
                mut w22_sum,
                mut o_sum,
            ] = [[T::ZERO; TILE]; GEOMETRY];
            color_sums.fill([T::ZERO; TILE]);
            for row in splat.rows(ty * TILE) {
                let y = T::of((ty * TILE + row) as f64 + 0.5);
                let dy = y - splat.footprint.mean[1];
                if row_last[row] as usize <= place
                    || !splat.reaches(centres[0], centres[TILE - 1], dy)
                {
                    continue;
                }
                let grad = &self.grad[row * d..(row + 1) * d];
                let mut color_grad = [T::ZERO; TILE];
                for (lanes, color) in grad.iter().zip(splat.color) {
                    for i in 0..TILE {
                        color_grad[i] += *color * lanes[i];
                    }
                }
                let mut weights = [T::ZERO; TILE];
                let (transmittance, behind) = (&mut self.transmittance[row], &mut self.behind[row]);
                let last = &self.last[row];
                for i in 0..TILE {
                    let dx = centres[i] - splat.footprint.mean[0];
                    let (z1, z2, falloff) = splat.falloff::<FMA>(dx, dy);
                    let raw = splat.opacity * falloff;
                    let alpha = thresholds.alpha(raw);
                    let blended = thresholds.seen(raw) & (last[i] > place as u32);
                    let passes = T::ONE - alpha;
                    let after = transmittance[i];
                    let before = after / passes;
                    let weight = if blended { alpha * before } else { T::ZERO };
                    let dalpha = before * color_grad[i] - behind[i] / passes;
                    let draw = if blended & !thresholds.capped(raw) {
                        dalpha
                    } else {
                        T::ZERO
                    };
                    weights[i] = weight;
                    behind[i] += weight * color_grad[i];
                    transmittance[i] = if blended { before } else { after };

                    let dsigma = -raw * draw;
                    let (dz1, dz2) = (z1 * dsigma, z2 * dsigma);
                    o_sum[i] += falloff * draw;
                    z1_sum[i] += dz1;
                    z2_sum[i] += dz2;
                    w11_sum[i] += dz1 * dx;
                    w21_sum[i] += dz2 * dx;
                    w22_sum[i] += dz2 * dy;
                }
                for (sums, lanes) in color_sums.iter_mut().zip(grad) {
                    for i in 0..TILE {
                        sums[i] += weights[i] * lanes[i];
                    }
                }
            }
            let total = |lanes: &Lanes<T>| lanes.iter().copied().sum::<T>();
            let (dz1, dz2) = (total(&z1_sum), total(&z2_sum));
            let Footprint { w11, w21, w22, .. } = splat.footprint;
            let out = &mut partials[place * (GEOMETRY + d)..(place + 1) * (GEOMETRY + d)];
            out[0] = -(w11 * dz1 + w21 * dz2);
            out[1] = -(w22 * dz2);
            out[2] = total(&w11_sum);
            out[3] = total(&w21_sum);
            out[4] = total(&w22_sum);
            out[5] = total(&o_sum);
            for (out, sums) in out[GEOMETRY..].iter_mut().zip(&color_sums) {
                *out = total(sums);
            }
        }
    }
}
