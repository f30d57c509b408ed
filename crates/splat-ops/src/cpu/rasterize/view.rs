//! The splats of one camera, as its tiles read them and as they are kept for the backward pass.

use core::any::Any;
use std::sync::Arc;

use rayon::prelude::*;
use tracing::trace_span;

use super::super::intersect::TileLists;
use super::super::real::Real;
use super::super::simd::prefetch;
use super::super::tiles::{CHUNK, Grid, TILE};
use super::super::uninit::Uncleared;
use super::inputs::Camera;
use super::splat::{GROUP, Splat, shape_sums};
use super::trace::{Trace, kept_per_intersection};
use crate::OpError;
use crate::settings::RasterizeArgs;

/// Prefetch distance, in partial gradients.
const AHEAD: usize = 16;

/// State that the forward pass keeps for the backward pass: a [`Frame`] per camera, none of an
/// image that was not rendered.
#[derive(Debug, Clone)]
pub struct State(Arc<dyn Any + Send + Sync>);

impl State {
    pub(super) fn new<T: Real>(frames: Vec<Frame<T>>) -> Self {
        Self(Arc::new(frames))
    }

    pub(super) fn frames<T: Real>(&self) -> &[Frame<T>] {
        self.0
            .downcast_ref::<Vec<Frame<T>>>()
            .map_or(&[], Vec::as_slice)
    }
}

/// The splats that one camera sees.
pub(super) struct Listed<T> {
    pub(super) lists: TileLists,
    pub(super) splats: Vec<Splat<T>>,
    /// Channels of each splat's colour that it does not have with it.
    pub(super) further_colors: Vec<T>,
    pub(super) channels: usize,
    /// Whether absolute gradients may be asked for.
    pub(super) absolute: bool,
}

impl<T: Real> Listed<T> {
    /// Bytes kept of each intersection by the forward pass, and, where a backward pass follows, by
    /// its partial gradients.
    fn kept_per_intersection(camera: &Camera<T>, args: &RasterizeArgs) -> usize {
        let number = size_of::<T>();
        let partials = if args.backward {
            (shape_sums(camera.absolute) + camera.channels) * number
        } else {
            0
        };
        kept_per_intersection(number) + partials
    }

    pub(super) fn new(camera: &Camera<T>, args: &RasterizeArgs) -> Result<Self, OpError> {
        let _span = trace_span!("rasterize lists").entered();
        let inputs = [camera.packed, camera.colors, camera.opacities];
        let d = camera.channels;
        let kept = Self::kept_per_intersection(camera, args);
        let (lists, splats) = TileLists::new(inputs, args, kept)?;
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
            absolute: camera.absolute,
        })
    }

    /// Partial gradients of each intersection: those of the shape, then those of the colours.
    pub(super) fn partials(&self) -> usize {
        shape_sums(self.absolute) + self.channels
    }

    /// Sums some of a splat's partial gradients over its tiles, in the order in which these were
    /// emitted.
    #[inline(always)]
    pub(super) fn sum<const COUNT: usize>(
        &self,
        splat: usize,
        partials: &[T],
        first: usize,
    ) -> [T; COUNT] {
        let width = self.partials();
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

    /// The same for a few channels of the colour.
    #[inline(always)]
    pub(super) fn sum_colors<const COUNT: usize>(
        &self,
        first: usize,
        splat: usize,
        partials: &[T],
        sums: &mut [T],
    ) {
        let of_channels = self.sum::<COUNT>(splat, partials, shape_sums(self.absolute) + first);
        sums[first..first + COUNT].copy_from_slice(&of_channels);
    }
}

/// One camera's splats, and what became of its pixels.
pub(super) struct Frame<T> {
    pub(super) listed: Listed<T>,
    /// By row of tiles.
    pub(super) traces: Vec<Trace<T>>,
}

/// One camera's splats as the tiles read them.
pub(super) struct View<'a, T> {
    pub(super) lists: &'a TileLists,
    pub(super) splats: &'a [Splat<T>],
    pub(super) further_colors: &'a [T],
    pub(super) background: Option<&'a [T]>,
    pub(super) channels: usize,
    /// Whether absolute gradients are asked for.
    pub(super) absolute: bool,
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) grid: Grid,
    pub(super) args: &'a RasterizeArgs,
}

impl<'a, T: Real> View<'a, T> {
    pub(super) fn new(
        listed: &'a Listed<T>,
        background: Option<&'a [T]>,
        args: &'a RasterizeArgs,
    ) -> Self {
        Self {
            lists: &listed.lists,
            splats: &listed.splats,
            further_colors: &listed.further_colors,
            background,
            channels: listed.channels,
            absolute: listed.absolute,
            width: args.size.width as usize,
            height: args.size.height as usize,
            grid: Grid::new(args),
            args,
        }
    }

    /// The splats of a tile, front to back; none beyond the end of its row.
    pub(super) fn list(&self, [tx, ty]: [usize; 2]) -> &[u32] {
        match tx < self.grid.columns {
            true => self.lists.tile(ty * self.grid.columns + tx),
            false => &[],
        }
    }

    /// How many splats the tiles of a row have together: its length in what is kept per
    /// intersection, and its work.
    pub(super) fn intersections_of_row(&self, ty: usize) -> usize {
        self.lists.row_of_tiles(ty, self.grid).len()
    }

    /// Columns and rows of a tile that lie in the image.
    pub(super) fn inside(&self, [tx, ty]: [usize; 2]) -> [usize; 2] {
        [
            TILE.min(self.width - tx * TILE),
            TILE.min(self.height - ty * TILE),
        ]
    }
}
