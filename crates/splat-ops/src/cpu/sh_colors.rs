//! View-dependent colours, `max(SH(mean - centre) + 0.5, 0)`, and their gradient.
//!
//! Directions and basis functions are the same arithmetic for every Gaussian, so they are computed
//! in columns, as SIMD code. Coefficients are stored in rows, and read and written there.
//!
//! Where Gaussians have different degrees, blocks are of Gaussians of one degree, so that those of
//! a low one cost no more than it takes.

use core::marker::PhantomData;
use core::ops::Range;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::buffer::{Buffer, tensor};
use super::real::Real;
use super::simd::{LANES, Lanes, for_each_block, vectorized};
use super::spherical_harmonics::{COUNT_MAX, basis, normalize};
use super::uninit::Uncleared;
use crate::backend::{
    OpInputs, PROJECTED_EXTENT, PROJECTED_WIDTH, ShColorInputs, ShColorTensors, ShColorsOps,
    ShLayout,
};
use crate::settings::{ClampGradient, ShColorSettings};
use crate::spherical_harmonics::{SH_DEGREE_MAX, sh_coefficient_count};

/// Gaussians per unit of parallel work. Fixed, so that sums over Gaussians have a fixed order.
const CHUNK: usize = 512;

/// The inputs as slices.
struct Inputs<'a, T> {
    sh0: &'a [T],
    rest: &'a [T],
    /// R, if that of all Gaussians.
    stored: usize,
    /// First row of `rest` of each Gaussian, and the end, if each has those of its own degree.
    starts: Option<&'a [i32]>,
    means: &'a [T],
    centers: &'a [T],
    /// Packed splats.
    seen: Option<&'a [T]>,
    degree: usize,
    /// See [`ClampGradient::Recovering`].
    recovers: bool,
}

/// The starts of a layout that has some.
fn starts_of(layout: ShLayout<Flex>) -> Option<Buffer> {
    match layout {
        ShLayout::Uniform => None,
        ShLayout::Ragged(starts) => Some(Buffer::new(starts)),
    }
}

impl<'a, T: Real> Inputs<'a, T> {
    fn new(
        buffers: &'a ShColorTensors<Buffer, Option<Buffer>>,
        starts: Option<&'a Buffer>,
        settings: ShColorSettings,
    ) -> Self {
        let rest = buffers.sh_rest.as_ref();
        Self {
            sh0: buffers.sh0.slice(),
            rest: rest.map_or(&[], Buffer::slice),
            stored: rest.map_or(0, |rest| rest.dims::<3>()[1]),
            starts: starts.map(Buffer::slice),
            means: buffers.means.slice(),
            centers: buffers.centers.slice(),
            seen: buffers.seen.as_ref().map(Buffer::slice),
            degree: settings.degree,
            recovers: settings.clamp_gradient == ClampGradient::Recovering,
        }
    }

    fn count(&self) -> usize {
        self.means.len() / 3
    }

    /// First row of the coefficients of a Gaussian after that of degree 0; for N the end.
    #[inline(always)]
    fn first_row(&self, n: usize) -> usize {
        match self.starts {
            None => self.stored * n,
            Some(starts) => starts[n] as usize,
        }
    }

    /// Passes on the Gaussians that are kept, in blocks of one degree, in order within each degree,
    /// and the degree at which they are evaluated: the lesser of theirs and the one asked for.
    fn for_each_block(
        &self,
        rows: Range<usize>,
        is_kept: impl Fn(usize) -> bool,
        mut visit: impl FnMut(usize, &[usize]),
    ) {
        let Some(starts) = self.starts else {
            return for_each_block(rows, is_kept, |block| visit(self.degree, block));
        };
        for degree in 0..=self.degree {
            let is_of_degree = |n: usize| {
                let own = match starts[n + 1] - starts[n] {
                    ..3 => 0,
                    3..8 => 1,
                    8..15 => 2,
                    15.. => SH_DEGREE_MAX,
                };
                own.min(self.degree) == degree && is_kept(n)
            };
            for_each_block(rows.clone(), is_of_degree, |block| visit(degree, block));
        }
    }

    /// Centre of a camera, and a function that tells whether the camera sees a Gaussian.
    fn camera(&self, camera: usize) -> (&'a [T], impl Fn(usize) -> bool + 'a) {
        let packed = self.seen.map(|seen| {
            let width = self.count() * PROJECTED_WIDTH;
            &seen[camera * width..][..width]
        });
        let is_seen = move |n: usize| {
            packed.is_none_or(|packed| packed[n * PROJECTED_WIDTH + PROJECTED_EXTENT] > T::ZERO)
        };
        (&self.centers[3 * camera..3 * camera + 3], is_seen)
    }

    /// Coefficients of one Gaussian, starting after the first. Each is read as four numbers: its
    /// three channels, and the next number in memory or zero.
    #[inline(always)]
    fn rest<const REST: usize>(&self, n: usize) -> [[T; 4]; REST] {
        let row = &self.rest[3 * self.first_row(n)..][..3 * REST];
        core::array::from_fn(|i| {
            let number = |j| {
                if 3 * i + j < 3 * REST {
                    row[3 * i + j]
                } else {
                    T::ZERO
                }
            };
            core::array::from_fn(number)
        })
    }

    fn sh0(&self, n: usize) -> &'a [T] {
        &self.sh0[3 * n..3 * n + 3]
    }

    /// Means of up to [`LANES`] Gaussians relative to a centre.
    fn directions(&self, rows: impl Iterator<Item = usize>, center: &[T]) -> [Lanes<T>; 3] {
        let mut columns = [[T::ZERO; LANES]; 3];
        for (lane, n) in rows.enumerate() {
            let mean = &self.means[3 * n..3 * n + 3];
            for (column, (mean, center)) in columns.iter_mut().zip(mean.iter().zip(center)) {
                column[lane] = *mean - *center;
            }
        }
        columns
    }

    /// Colours of some Gaussians before the clamp, from the basis in their directions.
    // Four numbers each, of which the last is meaningless: storing all four keeps the computation
    // in SIMD.
    #[inline(always)]
    fn colors<const REST: usize>(
        &self,
        rows: impl Iterator<Item = usize>,
        basis: &[Lanes<T>; COUNT_MAX],
    ) -> [[T; 4]; LANES] {
        let mut colors = [[T::of(0.5); 4]; LANES];
        for (lane, (n, color)) in rows.zip(&mut colors).enumerate() {
            let sh0 = self.sh0(n);
            let first = basis[0][lane];
            let mut sums = [first * sh0[0], first * sh0[1], first * sh0[2], T::ZERO];
            for (basis, coeff) in basis[1..].iter().zip(self.rest::<REST>(n)) {
                for j in 0..4 {
                    sums[j] += basis[lane] * coeff[j];
                }
            }
            for j in 0..4 {
                color[j] += sums[j];
            }
        }
        colors
    }
}

/// Calls `function::<.., COUNT>(...)` with the number of coefficients beyond the first that the
/// degree reads, as a compile-time constant.
macro_rules! by_degree {
    ($degree:expr, $function:ident::<$($generic:ident),+>($($argument:expr),* $(,)?)) => {
        match $degree {
            0 => $function::<$($generic,)+ 0>($($argument),*),
            1 => $function::<$($generic,)+ { sh_coefficient_count(1) - 1 }>($($argument),*),
            2 => $function::<$($generic,)+ { sh_coefficient_count(2) - 1 }>($($argument),*),
            _ => $function::<$($generic,)+ { sh_coefficient_count(SH_DEGREE_MAX) - 1 }>($($argument),*),
        }
    };
}

mod backward;

vectorized! {
    /// Writes the colours of some Gaussians, relative to the `first`, from the basis in their
    /// directions.
    fn colors_of_rows<T: Real, const FMA: bool>(
        inputs: &Inputs<T>,
        degree: usize,
        rows: &[usize],
        first: usize,
        basis: &[Lanes<T>; COUNT_MAX],
        colors: &mut [T],
    ) {
        by_degree!(degree, colors_of_degree::<T>(inputs, rows, first, basis, colors));
    }
}

#[inline(always)]
fn colors_of_degree<T: Real, const REST: usize>(
    inputs: &Inputs<T>,
    rows: &[usize],
    first: usize,
    basis: &[Lanes<T>; COUNT_MAX],
    colors: &mut [T],
) {
    let values = inputs.colors::<REST>(rows.iter().copied(), basis);
    for (row, values) in rows.iter().zip(values) {
        let out = &mut colors[3 * (row - first)..][..3];
        for (out, value) in out.iter_mut().zip(values) {
            // Keeps NaN.
            *out = if value < T::ZERO { T::ZERO } else { value };
        }
    }
}

vectorized! {
    /// Unit directions, the inverse of their lengths, and the basis functions in them.
    fn evaluate<T: Real, const FMA: bool>(
        degree: usize,
        directions: &[Lanes<T>; 3],
        units: &mut [Lanes<T>; 4],
        values: &mut [Lanes<T>; COUNT_MAX],
    ) {
        // One branch-free loop per degree.
        match degree {
            0 => evaluate_degree::<T, 0>(directions, units, values),
            1 => evaluate_degree::<T, 1>(directions, units, values),
            2 => evaluate_degree::<T, 2>(directions, units, values),
            _ => evaluate_degree::<T, SH_DEGREE_MAX>(directions, units, values),
        }
    }
}

#[inline(always)]
fn evaluate_degree<T: Real, const DEGREE: usize>(
    directions: &[Lanes<T>; 3],
    units: &mut [Lanes<T>; 4],
    values: &mut [Lanes<T>; COUNT_MAX],
) {
    for lane in 0..LANES {
        let at = |axis: usize| directions[axis][lane];
        let (unit, inverse) = normalize([at(0), at(1), at(2)]);
        units[0][lane] = unit[0];
        units[1][lane] = unit[1];
        units[2][lane] = unit[2];
        units[3][lane] = inverse;
        let basis = basis(DEGREE, unit);
        for i in 0..sh_coefficient_count(DEGREE) {
            values[i][lane] = basis[i];
        }
    }
}

impl ShColorsOps for Flex {
    fn sh_colors(
        OpInputs(inputs): ShColorInputs<Self>,
        layout: ShLayout<Self>,
        settings: ShColorSettings,
    ) -> FlexTensor {
        in_precision!(inputs.means, forward, inputs, layout, settings)
    }
}

fn forward<T: Real>(
    _: PhantomData<T>,
    inputs: ShColorTensors<FlexTensor, Option<FlexTensor>>,
    layout: ShLayout<Flex>,
    settings: ShColorSettings,
) -> FlexTensor {
    let (buffers, starts) = (inputs.map_inputs(Buffer::new), starts_of(layout));
    let inputs = Inputs::<T>::new(&buffers, starts.as_ref(), settings);
    let (c, n) = (inputs.centers.len() / 3, inputs.count());
    let mut colors = Uncleared::<T>::new(c * n * 3);
    let parts = colors.chunks_of_each(c, 3 * CHUNK);
    parts.into_par_iter().for_each(|(camera, first, part)| {
        let (center, is_seen) = inputs.camera(camera);
        let (first, colors) = (first / 3, part.cleared());
        inputs.for_each_block(first..first + colors.len() / 3, is_seen, |degree, rows| {
            let directions = inputs.directions(rows.iter().copied(), center);
            let mut units = [[T::ZERO; LANES]; 4];
            let mut basis = [[T::ZERO; LANES]; COUNT_MAX];
            evaluate(degree, &directions, &mut units, &mut basis);
            colors_of_rows(&inputs, degree, rows, first, &basis, colors);
        });
    });
    tensor(colors.written(), [c, n, 3])
}
