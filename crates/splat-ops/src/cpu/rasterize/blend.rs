//! Blends the splats of a tile, front to back.

use super::super::intersect::TILE;
use super::super::real::Real;
use super::super::simd::prefetch;
use super::blocks::Blocks;
use super::splat::{AHEAD, Centres, LANES, PLANE, Splat, Thresholds, Window, block, block_mut};
use super::work::Tally;
use super::{Slab, View};

/// After so many splats it is looked which pixels still take light.
const LOOK: usize = 8;

/// The pixels of a tile while it is being blended.
pub(super) struct BlendTile<T> {
    transmittance: [T; PLANE],
    /// The least raw alpha that still counts: `alpha_min`, infinity once the pixel has stopped or where
    /// there is none.
    gate: [T; PLANE],
    /// The place of the splat before which the pixel stopped; `i32::MAX` while it has not.
    stop: [i32; PLANE],
    /// D planes of colour.
    colors: Vec<[T; PLANE]>,
}

impl<T: Real> BlendTile<T> {
    pub(super) fn new(channels: usize) -> Self {
        Self {
            transmittance: [T::ONE; PLANE],
            gate: [T::of(f64::INFINITY); PLANE],
            stop: [i32::MAX; PLANE],
            colors: vec![[T::ZERO; PLANE]; channels],
        }
    }

    /// Starts a tile anew and blends the splats of its list.
    #[inline(always)]
    pub(super) fn blend<const FMA: bool>(
        &mut self,
        view: &View<T>,
        list: &[u32],
        tile: [usize; 2],
        channels: usize,
        blocks: &mut Blocks,
        tally: &mut impl Tally,
    ) {
        let thresholds = Thresholds::<T>::new(view.args);
        let centres = Centres::<T>::new(tile);
        self.begin(view.inside(tile), &thresholds);
        let mut open = self.open();
        let mut any_stopped = 0;

        for (place, index) in list.iter().enumerate() {
            let index = *index as usize;
            let splat = &view.splats[index];
            let color = &view.colors[index * channels..][..channels];
            let next = list.get(place + AHEAD);
            prefetch(view.splats, next.map(|index| *index as usize));
            for at in blocks.cover(splat, &centres, &open) {
                any_stopped |= self.add::<FMA>(
                    splat,
                    color,
                    &centres,
                    *at,
                    place as i32,
                    &thresholds,
                    tally,
                );
            }
            if place % LOOK == LOOK - 1 && any_stopped != 0 {
                open = self.open();
                if open.to.iter().all(|to| *to == 0) {
                    blocks.skip(list.len() - 1 - place);
                    break;
                }
                any_stopped = 0;
            }
        }
    }

    #[inline(always)]
    fn begin(&mut self, [columns, rows]: [usize; 2], thresholds: &Thresholds<T>) {
        let closed = T::of(f64::INFINITY);
        self.transmittance = [T::ONE; PLANE];
        self.stop = [i32::MAX; PLANE];
        self.colors.fill([T::ZERO; PLANE]);
        for (row, gates) in self.gate.chunks_exact_mut(TILE).enumerate() {
            for (column, gate) in gates.iter_mut().enumerate() {
                let exists = row < rows && column < columns;
                *gate = if exists { thresholds.alpha_min } else { closed };
            }
        }
    }

    /// In each row, the span of the pixels that still take light.
    #[inline(always)]
    fn open(&self) -> Window {
        let closed = T::of(f64::INFINITY);
        let mut window = Window::CLOSED;
        window.from = [TILE as i32; TILE];
        for (row, gates) in self.gate.chunks_exact(TILE).enumerate() {
            for (column, gate) in (0..).zip(gates) {
                let is_open = *gate < closed;
                let (from, to) = (
                    if is_open { column } else { TILE as i32 },
                    if is_open { column + 1 } else { 0 },
                );
                window.from[row] = window.from[row].min(from);
                window.to[row] = window.to[row].max(to);
            }
        }
        window
    }

    /// Blends one splat into the block that begins `at` a pixel; not zero when one of its pixels stopped.
    #[inline(always)]
    fn add<const FMA: bool>(
        &mut self,
        splat: &Splat<T>,
        color: &[T],
        centres: &Centres<T>,
        at: u8,
        place: i32,
        thresholds: &Thresholds<T>,
        tally: &mut impl Tally,
    ) -> u32 {
        let (dx, dy) = centres.from(splat.mean, at);
        let w22_dy = splat.along_y(dy);
        // Copies: behind references they might alias what is written, which bars SIMD.
        let (before, gate) = (*block(&self.transmittance, at), *block(&self.gate, at));
        let (mut left, mut shares) = (before, [T::ZERO; LANES]);
        let mut any_stops = 0;
        for i in 0..LANES {
            let (_, _, falloff) = splat.falloff::<FMA>(dx[i], w22_dy);
            let raw = splat.opacity * falloff;
            let alpha = thresholds.alpha(raw);
            // Every store is unconditional: masked ones are slow. Without a share nothing changes, exactly.
            shares[i] = if raw >= gate[i] { alpha } else { T::ZERO };
            left[i] = T::multiply_add::<FMA>(-shares[i], before[i], before[i]);
            any_stops |= u32::from(thresholds.stops(left[i]));
            tally.pair(
                thresholds.seen(raw),
                raw >= gate[i] && !thresholds.stops(left[i]),
            );
        }
        // Once in a pixel's life; for all lanes without a branch.
        if any_stops != 0 {
            let (mut gate, mut stop) = (gate, *block(&self.stop, at));
            for i in 0..LANES {
                let stops = thresholds.stops(left[i]);
                left[i] = if stops { before[i] } else { left[i] };
                shares[i] = if stops { T::ZERO } else { shares[i] };
                gate[i] = if stops { T::of(f64::INFINITY) } else { gate[i] };
                stop[i] = if stops { place } else { stop[i] };
            }
            *block_mut(&mut self.gate, at) = gate;
            *block_mut(&mut self.stop, at) = stop;
        }
        *block_mut(&mut self.transmittance, at) = left;
        let mut weights = [T::ZERO; LANES];
        for i in 0..LANES {
            weights[i] = shares[i] * before[i];
        }
        let planes = &mut self.colors[..color.len()];
        for (plane, color) in planes.iter_mut().zip(color) {
            let (lanes, color) = (block_mut(plane, at), *color);
            for i in 0..LANES {
                lanes[i] = T::multiply_add::<FMA>(color, weights[i], lanes[i]);
            }
        }
        any_stops
    }

    /// Writes the tile into its row of tiles, with the background behind it.
    #[inline(always)]
    pub(super) fn store(
        &self,
        view: &View<T>,
        [tx, ty]: [usize; 2],
        slab: &mut Slab<T>,
        channels: usize,
    ) {
        let [columns, rows] = view.inside([tx, ty]);
        for row in 0..rows {
            for column in 0..columns {
                let (at, pixel) = (row * TILE + column, row * view.width + tx * TILE + column);
                let left = self.transmittance[at];
                let out = &mut slab.image[pixel * (channels + 1)..(pixel + 1) * (channels + 1)];
                for channel in 0..channels {
                    let behind = view.background.map_or(T::ZERO, |b| b[channel]);
                    out[channel] = self.colors[channel][at] + left * behind;
                }
                out[channels] = T::ONE - left;
                slab.transmittance[pixel] = left;
                slab.stop[pixel] = self.stop[at];
            }
        }
    }
}
