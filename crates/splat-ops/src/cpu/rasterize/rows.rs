//! Rows of tiles: the unit of work of both passes, and of the sums over them.

use macerator::{Arch, Simd, Vector, WithSimd};

#[cfg(target_arch = "x86_64")]
use super::super::instructions::InstructionSet;
use super::super::instructions::registers;
use super::super::real::Real;
use super::super::schedule::heaviest_first;
use super::super::uninit::Part;
use super::batch::by_groups;
use super::blend::BlendTile;
use super::gradient::GradientTile;
use super::splat::{ABSOLUTE, GROUP, MOMENTS, shape_sums};
use super::trace::Trace;
use super::view::{Frame, Listed, View};
use crate::backend::PROJECTED_WIDTH;
use crate::settings::RasterizeArgs;

/// Renders one camera's image.
pub(super) fn blend<T: Real>(
    listed: Listed<T>,
    background: Option<&[T]>,
    args: &RasterizeArgs,
    image: Vec<Part<T>>,
) -> Frame<T> {
    let view = View::new(&listed, background, args);
    let traces = heaviest_first(
        image,
        |ty| view.intersections_of_row(ty),
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
        let splats = view.intersections_of_row(ty);
        let mut trace = Trace::with_capacity(view.grid.columns, splats);
        for tx in 0..view.grid.columns {
            tile.blend::<S>(view, [tx, ty], &mut trace, &mut ());
            tile.store::<S>(view, [tx, ty], image);
        }
        trace
    }
}

/// Writes the sums of one row of tiles; gives its share of the background's gradient.
pub(super) struct RowOfTilesBackward<'a, T> {
    pub(super) view: &'a View<'a, T>,
    pub(super) trace: &'a Trace<T>,
    pub(super) grad: &'a [T],
    pub(super) ty: usize,
    pub(super) partials: &'a mut [T],
}

impl<T: Real> RowOfTilesBackward<'_, T> {
    /// In registers of 256 bits at most: it writes a splat's sums, which lie in memory, once for
    /// every block. Wider registers take twice as long for that as for anything else where they are
    /// halves to the processor (Zen 4), and gain nothing where they are not (Zen 5).
    pub(super) fn run(self) -> Vec<T> {
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
        match self.view.absolute {
            true => self.walk_tiles::<S, true>(),
            false => self.walk_tiles::<S, false>(),
        }
    }

    /// `ABS`: with absolute gradients.
    #[inline(always)]
    fn walk_tiles<S: Simd, const ABS: bool>(self) -> Vec<T> {
        let Self { view, ty, .. } = self;
        let channels = view.channels;
        let mut background = vec![T::ZERO; channels];
        let mut tile = GradientTile::<S, T, ABS>::new(channels);
        let (mut partials, mut first) = (self.partials, 0);
        for tx in 0..view.grid.columns {
            let count = view.list([tx, ty]).len();
            let (sums, later) = partials.split_at_mut(count * (shape_sums(ABS) + channels));
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
pub(super) struct GradientRows<'a, T> {
    /// The first Gaussian.
    pub(super) first: usize,
    pub(super) packed: Part<'a, T>,
    pub(super) colors: Part<'a, T>,
    pub(super) opacities: Part<'a, T>,
    /// Absolute gradients of the screen means, where they are asked for.
    pub(super) absgrad: Option<Part<'a, T>>,
}

impl<T: Real> GradientRows<'_, T> {
    /// From what each splat has in its tiles.
    pub(super) fn write(self, frame: &Listed<T>, partials: &[T]) {
        let d = frame.channels;
        let [packed, colors, opacities] =
            [self.packed, self.colors, self.opacities].map(Part::cleared);
        let mut absgrad = self.absgrad.map(Part::cleared);
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
            if let Some(absgrad) = &mut absgrad {
                let sums: [_; ABSOLUTE] = frame.sum(splat, partials, MOMENTS);
                let of_mean = frame.splats[splat].absolute_gradients(sums);
                absgrad[row * ABSOLUTE..][..ABSOLUTE].copy_from_slice(&of_mean);
            }
            let colors = &mut colors[row * d..][..d];
            by_groups!(frame.sum_colors(0..d, splat, partials, colors));
        }
    }

    pub(super) fn clear(self) {
        let parts = [self.packed, self.colors, self.opacities].into_iter();
        parts.chain(self.absgrad).for_each(|part| {
            part.cleared();
        });
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};

    use super::super::super::tiles::TILE;
    use super::super::inputs::Camera;
    use super::super::splat::BATCH;
    use super::*;
    use crate::{ErrorSlot, ImageSize};

    const CHANNELS: usize = 5;
    const ABSOLUTE_TOO: bool = true;
    const PARTIALS: usize = shape_sums(ABSOLUTE_TOO) + CHANNELS;

    /// Image, what partial gradients each listed splat has in its tiles, and the background's
    /// gradient.
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
            let mut partials = vec![T::ZERO; view.lists.intersections() * PARTIALS];
            let mut background = vec![];
            let slab = TILE * view.width * (CHANNELS + 1);
            let mut later = &mut *partials;
            for (ty, image) in image.chunks_mut(slab).enumerate() {
                let trace = RowOfTiles { view, ty, image }.with_simd::<S>();
                let length = view.intersections_of_row(ty);
                let (own, rest) = later.split_at_mut(length * PARTIALS);
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

    /// Compares all registers that this processor has, from one number wide on, with each other and
    /// a reference; returns what the widest give.
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
            absolute: ABSOLUTE_TOO,
        };
        let listed = Listed::new(&camera, &args).unwrap();
        let view = View::new(&listed, camera.background, &args);
        assert!(view.lists.tile(0).len() > BATCH);

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
