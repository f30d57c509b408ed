//! Colours in the directions of the cameras, `max(SH(mean - centre) + 0.5, 0)`, and their gradient.
//!
//! Directions and basis functions are the same arithmetic for every Gaussian: in columns, as SIMD code. Coefficients lie
//! in rows, and are read and written there.

use core::marker::PhantomData;
use core::ops::Range;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::buffer::{Buffer, tensor};
use super::math::{Vec3, dot};
use super::parts::{Part, Uncleared};
use super::real::Real;
use super::simd::{LANES, Lanes, for_each_block, vectorized};
use super::spherical_harmonics::{
    COUNT_MAX, basis, basis_gradient, guarded_dot, is_zero, normalize,
};
use crate::backend::{
    OpInputs, PROJECTED_EXTENT, PROJECTED_WIDTH, ShColorGradients, ShColorInputs, ShColorTensors,
    ShColorsBackend, ShColorsOps,
};
use crate::settings::{ClampGradient, ShColorSettings};
use crate::spherical_harmonics::{SH_DEGREE_MAX, sh_coefficient_count};

/// Gaussians per unit of parallel work. Fixed, so that sums over Gaussians have a fixed order.
const CHUNK: usize = 512;

/// The inputs as slices.
struct Inputs<'a, T> {
    sh0: &'a [T],
    rest: &'a [T],
    /// R.
    stored: usize,
    means: &'a [T],
    centers: &'a [T],
    /// Packed splats.
    seen: Option<&'a [T]>,
    degree: usize,
    /// See [`ClampGradient::Recovering`].
    recovers: bool,
}

impl<'a, T: Real> Inputs<'a, T> {
    fn new(buffers: &'a ShColorTensors<Buffer, Option<Buffer>>, settings: ShColorSettings) -> Self {
        let rest = buffers.sh_rest.as_ref();
        Self {
            sh0: buffers.sh0.slice(),
            rest: rest.map_or(&[], Buffer::slice),
            stored: rest.map_or(0, |rest| rest.dims::<3>()[1]),
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

    /// The centre of a camera, and whether it sees a Gaussian, by its index.
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

    /// Some coefficients of one Gaussian, from the one after the first; each with the number that follows it in memory, or
    /// zero, as four numbers are read at once.
    #[inline(always)]
    fn rest<const REST: usize>(&self, n: usize) -> [[T; 4]; REST] {
        let row = &self.rest[3 * self.stored * n..][..3 * REST];
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

    /// Means of up to [`LANES`] Gaussians, seen from a centre.
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

    /// The colours of some Gaussians before the clamp, given the basis in their directions.
    // Four numbers each, of which one means nothing: written to memory, all of them have to be computed, side by side.
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

/// Calls a function for the number of coefficients beyond the first that the degree reads, which the compiler then knows:
/// `function::<.., COUNT>(...)`.
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

vectorized! {
    /// Writes the colours of some Gaussians to where they lie behind that of the `first`, given the basis in their
    /// directions.
    fn colors_of_rows<T: Real, const FMA: bool>(
        inputs: &Inputs<T>,
        rows: &[usize],
        first: usize,
        basis: &[Lanes<T>; COUNT_MAX],
        colors: &mut [T],
    ) {
        by_degree!(inputs.degree, colors_of_degree::<T>(inputs, rows, first, basis, colors));
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
            // NaN stays.
            *out = if value < T::ZERO { T::ZERO } else { value };
        }
    }
}

vectorized! {
    /// Unit directions and one over their lengths, and the basis functions in them.
    fn evaluate<T: Real, const FMA: bool>(
        degree: usize,
        directions: &[Lanes<T>; 3],
        units: &mut [Lanes<T>; 4],
        values: &mut [Lanes<T>; COUNT_MAX],
    ) {
        // One loop per degree, without a branch in it.
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

vectorized! {
    /// Gradients of the directions, given `weights`, those of the basis functions. d = v / |v|: the gradient of v is what
    /// is tangential, divided by |v|.
    fn evaluate_backward<T: Real, const FMA: bool>(
        degree: usize,
        units: &[Lanes<T>; 4],
        weights: &[Lanes<T>; COUNT_MAX],
        gradients: &mut [Lanes<T>; 3],
    ) {
        match degree {
            0 => (),
            1 => evaluate_degree_backward::<T, 1>(units, weights, gradients),
            2 => evaluate_degree_backward::<T, 2>(units, weights, gradients),
            _ => evaluate_degree_backward::<T, SH_DEGREE_MAX>(units, weights, gradients),
        }
    }
}

#[inline(always)]
fn evaluate_degree_backward<T: Real, const DEGREE: usize>(
    units: &[Lanes<T>; 4],
    weights: &[Lanes<T>; COUNT_MAX],
    gradients: &mut [Lanes<T>; 3],
) {
    for lane in 0..LANES {
        let unit = [units[0][lane], units[1][lane], units[2][lane]];
        let slopes = basis_gradient(DEGREE, unit);
        let mut sum = [T::ZERO; 3];
        for i in 1..sh_coefficient_count(DEGREE) {
            let weight = weights[i][lane];
            sum[0] += weight * slopes[i][0];
            sum[1] += weight * slopes[i][1];
            sum[2] += weight * slopes[i][2];
        }
        let radial = dot(sum, unit);
        let inverse = units[3][lane];
        gradients[0][lane] = (sum[0] - unit[0] * radial) * inverse;
        gradients[1][lane] = (sum[1] - unit[1] * radial) * inverse;
        gradients[2][lane] = (sum[2] - unit[2] * radial) * inverse;
    }
}

impl ShColorsOps for Flex {
    fn sh_colors(OpInputs(inputs): ShColorInputs<Self>, settings: ShColorSettings) -> FlexTensor {
        in_precision!(inputs.means, forward, inputs, settings)
    }
}

impl ShColorsBackend for Flex {
    fn sh_colors_backward(
        OpInputs(inputs): ShColorInputs<Self>,
        grad_colors: FlexTensor,
        settings: ShColorSettings,
        needs_grad: ShColorTensors<bool>,
    ) -> ShColorGradients<Self> {
        in_precision!(
            grad_colors,
            backward,
            inputs,
            grad_colors,
            settings,
            needs_grad
        )
    }
}

fn forward<T: Real>(
    _: PhantomData<T>,
    inputs: ShColorTensors<FlexTensor, Option<FlexTensor>>,
    settings: ShColorSettings,
) -> FlexTensor {
    let buffers = inputs.map_inputs(Buffer::new);
    let inputs = Inputs::<T>::new(&buffers, settings);
    let (c, n) = (inputs.centers.len() / 3, inputs.count());
    let mut colors = Uncleared::<T>::new(c * n * 3);
    let parts = colors.chunks_of_each(c, 3 * CHUNK);
    parts.into_par_iter().for_each(|(camera, first, part)| {
        let (center, is_seen) = inputs.camera(camera);
        let (first, colors) = (first / 3, part.cleared());
        for_each_block(first..first + colors.len() / 3, is_seen, |rows| {
            let directions = inputs.directions(rows.iter().copied(), center);
            let mut units = [[T::ZERO; LANES]; 4];
            let mut basis = [[T::ZERO; LANES]; COUNT_MAX];
            evaluate(inputs.degree, &directions, &mut units, &mut basis);
            colors_of_rows(&inputs, rows, first, &basis, colors);
        });
    });
    tensor(colors.written(), [c, n, 3])
}

/// The gradients of one chunk of Gaussians, where they belong; those that are not wanted are empty.
struct Chunk<'a, T> {
    rows: Range<usize>,
    sh0: &'a mut [T],
    rest: &'a mut [T],
    means: &'a mut [T],
    /// Whether the means' or the centres' are wanted.
    directions: bool,
    /// Whether all are zero still.
    is_clear: bool,
}

impl<T: Real> Chunk<'_, T> {
    /// Adds the gradients through one camera, given those of its colours; returns that of its centre.
    fn add(&mut self, inputs: &Inputs<T>, camera: usize, grad: &[T]) -> Vec3<T> {
        let mut of_center = [T::ZERO; 3];
        let (center, is_seen) = inputs.camera(camera);
        let is_graded = |row: usize| !is_zero(&grad[3 * row..3 * row + 3]) && is_seen(row);
        for_each_block(self.rows.clone(), is_graded, |rows| {
            self.add_block(rows, inputs, center, grad, &mut of_center);
        });
        self.is_clear = false;
        of_center
    }

    fn add_block(
        &mut self,
        rows: &[usize],
        inputs: &Inputs<T>,
        center: &[T],
        grad: &[T],
        of_center: &mut Vec3<T>,
    ) {
        let mut units = [[T::ZERO; LANES]; 4];
        let mut basis = [[T::ZERO; LANES]; COUNT_MAX];
        let directions = inputs.directions(rows.iter().copied(), center);
        evaluate(inputs.degree, &directions, &mut units, &mut basis);

        let mut weights = [[T::ZERO; LANES]; COUNT_MAX];
        add_to_rows(self, rows, inputs, &basis, grad, &mut weights);
        if !self.directions {
            return;
        }
        let mut gradients = [[T::ZERO; LANES]; 3];
        evaluate_backward(inputs.degree, &units, &weights, &mut gradients);
        for (lane, n) in rows.iter().enumerate() {
            for axis in 0..3 {
                of_center[axis] -= gradients[axis][lane];
            }
            if !self.means.is_empty() {
                let i = 3 * (n - self.rows.start);
                for (mean, gradient) in self.means[i..i + 3].iter_mut().zip(&gradients) {
                    *mean += gradient[lane];
                }
            }
        }
    }
}

vectorized! {
    /// Adds the gradients of the coefficients of up to [`LANES`] Gaussians, given the basis in their directions and the
    /// gradients of all colours; and writes those of the basis functions.
    fn add_to_rows<T: Real, const FMA: bool>(
        chunk: &mut Chunk<T>,
        rows: &[usize],
        inputs: &Inputs<T>,
        basis: &[Lanes<T>; COUNT_MAX],
        grad: &[T],
        weights: &mut [Lanes<T>; COUNT_MAX],
    ) {
        by_degree!(inputs.degree, add_to_degree::<T>(chunk, rows, inputs, basis, grad, weights));
    }
}

#[inline(always)]
fn add_to_degree<T: Real, const REST: usize>(
    chunk: &mut Chunk<T>,
    rows: &[usize],
    inputs: &Inputs<T>,
    basis: &[Lanes<T>; COUNT_MAX],
    grad: &[T],
    weights: &mut [Lanes<T>; COUNT_MAX],
) {
    let colors = inputs.colors::<REST>(rows.iter().copied(), basis);
    for (lane, (n, color)) in rows.iter().zip(colors).enumerate() {
        let mut grad = [grad[3 * n], grad[3 * n + 1], grad[3 * n + 2]];
        for (grad, color) in grad.iter_mut().zip(color) {
            if color < T::ZERO && !(inputs.recovers && *grad < T::ZERO) {
                *grad = T::ZERO;
            }
        }
        // A coefficient's gradient is its basis function times the colour's.
        let i = n - chunk.rows.start;
        if !chunk.sh0.is_empty() {
            add_scaled(&mut chunk.sh0[3 * i..3 * i + 3], basis[0][lane], grad);
        }
        if !chunk.rest.is_empty() {
            let rest = &mut chunk.rest[3 * inputs.stored * i..][..3 * REST];
            let values = core::array::from_fn(|i| basis[1 + i][lane]);
            if chunk.is_clear {
                write_scaled::<T, REST>(rest, values, grad);
            } else {
                for (sums, value) in rest.chunks_exact_mut(3).zip(values) {
                    add_scaled(sums, value, grad);
                }
            }
        }
        if chunk.directions {
            let rest = inputs.rest::<REST>(*n);
            let rest = rest.map(|[red, green, blue, _]| [red, green, blue]);
            let weights = weights[1..].iter_mut().zip(rest);
            // Most channels have a gradient.
            if grad.contains(&T::ZERO) {
                weights.for_each(|(weight, coeff)| weight[lane] = guarded_dot(grad, coeff));
            } else {
                weights.for_each(|(weight, coeff)| weight[lane] = dot(grad, coeff));
            }
        }
    }
}

/// `out = scale values` for one scale after the other. Four numbers are written at once: the last one is overwritten by the
/// next three.
#[inline(always)]
fn write_scaled<T: Real, const COUNT: usize>(
    out: &mut [T],
    scales: [T; COUNT],
    [x, y, z]: Vec3<T>,
) {
    let Some((last, scales)) = scales.split_last() else {
        return;
    };
    for (i, scale) in scales.iter().enumerate() {
        out[3 * i..][..4].copy_from_slice(&[x, y, z, T::ZERO].map(|value| *scale * value));
    }
    out[3 * scales.len()..][..3].copy_from_slice(&[x, y, z].map(|value| *last * value));
}

/// `sums += scale values`.
#[inline(always)]
fn add_scaled<T: Real>(sums: &mut [T], scale: T, values: Vec3<T>) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += scale * value;
    }
}

fn backward<T: Real>(
    _: PhantomData<T>,
    inputs: ShColorTensors<FlexTensor, Option<FlexTensor>>,
    grad: FlexTensor,
    settings: ShColorSettings,
    needs_grad: ShColorTensors<bool>,
) -> ShColorGradients<Flex> {
    let buffers = inputs.map_inputs(Buffer::new);
    let inputs = Inputs::<T>::new(&buffers, settings);
    let grad = Buffer::new(grad);
    let grad = grad.slice::<T>();
    let (c, n) = (inputs.centers.len() / 3, inputs.count());

    let widths = [3, 3 * inputs.stored, 3];
    let needed = [needs_grad.sh0, needs_grad.sh_rest, needs_grad.means];
    let mut out = [0, 1, 2].map(|i| Uncleared::<T>::new(if needed[i] { n * widths[i] } else { 0 }));
    let [sh0, rest, means] = &mut out;
    let mut parts = [(sh0, widths[0]), (rest, widths[1]), (means, widths[2])]
        .map(|(out, width)| out.chunks(CHUNK * width).into_iter());
    let parts: Vec<[Option<Part<T>>; 3]> = (0..n.div_ceil(CHUNK))
        .map(|_| parts.each_mut().map(Iterator::next))
        .collect();
    let of_centers: Vec<Vec<Vec3<T>>> = parts
        .into_par_iter()
        .enumerate()
        .map(|(chunk, parts)| {
            let [sh0, rest, means] = parts.map(|part| part.map_or(&mut [][..], Part::cleared));
            let mut chunk = Chunk {
                rows: chunk * CHUNK..n.min((chunk + 1) * CHUNK),
                sh0,
                rest,
                means,
                directions: needs_grad.means || needs_grad.centers,
                is_clear: true,
            };
            let views = grad.chunks_exact(3 * n).enumerate();
            views
                .map(|(camera, grad)| chunk.add(&inputs, camera, grad))
                .collect()
        })
        .collect();

    let mut centers = vec![T::ZERO; 3 * c];
    for chunk in &of_centers {
        for (sum, value) in centers.iter_mut().zip(chunk.as_flattened()) {
            *sum += *value;
        }
    }
    let [sh0, rest, means] = out.map(Uncleared::written);
    ShColorTensors {
        sh0: needs_grad.sh0.then(|| tensor(sh0, [n, 1, 3])),
        sh_rest: needs_grad
            .sh_rest
            .then(|| tensor(rest, [n, inputs.stored, 3])),
        means: needs_grad.means.then(|| tensor(means, [n, 3])),
        centers: needs_grad.centers.then(|| tensor(centers, [c, 3])),
        seen: None,
    }
}
