//! Gradients of the colours.

use core::marker::PhantomData;
use core::ops::Range;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::super::buffer::{Buffer, tensor};
use super::super::math::{Vec3, dot};
use super::super::real::Real;
use super::super::simd::{LANES, Lanes, vectorized};
use super::super::spherical_harmonics::{COUNT_MAX, basis_gradient, guarded_dot, is_zero};
use super::super::uninit::{Part, Uncleared};
use super::{CHUNK, Inputs, evaluate, starts_of};
use crate::backend::{
    OpInputs, ShColorGradients, ShColorInputs, ShColorTensors, ShColorsBackend, ShLayout,
};
use crate::settings::ShColorSettings;
use crate::spherical_harmonics::{SH_DEGREE_MAX, sh_coefficient_count};

impl ShColorsBackend for Flex {
    fn sh_colors_backward(
        OpInputs(inputs): ShColorInputs<Self>,
        layout: ShLayout<Self>,
        grad_colors: FlexTensor,
        settings: ShColorSettings,
        needs_grad: ShColorTensors<bool>,
    ) -> ShColorGradients<Self> {
        in_precision!(
            grad_colors,
            backward,
            inputs,
            layout,
            grad_colors,
            settings,
            needs_grad
        )
    }
}

vectorized! {
    /// Gradients of the directions, from the gradients `weights` of the basis functions. d = v /
    /// |v|: the gradient of v is the tangential part, divided by |v|.
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

/// Gradients of one chunk of Gaussians, in the output; empty if not wanted.
struct Chunk<'a, T> {
    rows: Range<usize>,
    sh0: &'a mut [T],
    rest: &'a mut [T],
    means: &'a mut [T],
    /// True if the gradients of means or centres are wanted.
    directions: bool,
    /// True while all are still zero.
    is_clear: bool,
}

impl<T: Real> Chunk<'_, T> {
    /// Adds the gradients through one camera, from those of its colours; returns the gradient of
    /// its centre.
    fn add(&mut self, inputs: &Inputs<T>, camera: usize, grad: &[T]) -> Vec3<T> {
        let mut of_center = [T::ZERO; 3];
        let (center, is_seen) = inputs.camera(camera);
        let is_graded = |row: usize| !is_zero(&grad[3 * row..3 * row + 3]) && is_seen(row);
        inputs.for_each_block(self.rows.clone(), is_graded, |degree, rows| {
            self.add_block(degree, rows, inputs, center, grad, &mut of_center);
        });
        self.is_clear = false;
        of_center
    }

    fn add_block(
        &mut self,
        degree: usize,
        rows: &[usize],
        inputs: &Inputs<T>,
        center: &[T],
        grad: &[T],
        of_center: &mut Vec3<T>,
    ) {
        let mut units = [[T::ZERO; LANES]; 4];
        let mut basis = [[T::ZERO; LANES]; COUNT_MAX];
        let directions = inputs.directions(rows.iter().copied(), center);
        evaluate(degree, &directions, &mut units, &mut basis);

        let mut weights = [[T::ZERO; LANES]; COUNT_MAX];
        add_to_rows(self, degree, rows, inputs, &basis, grad, &mut weights);
        if !self.directions {
            return;
        }
        let mut gradients = [[T::ZERO; LANES]; 3];
        evaluate_backward(degree, &units, &weights, &mut gradients);
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
    /// Adds the gradients of the coefficients of up to [`LANES`] Gaussians, from the basis in their
    /// directions and the gradients of all colours, and writes the gradients of the basis
    /// functions.
    fn add_to_rows<T: Real, const FMA: bool>(
        chunk: &mut Chunk<T>,
        degree: usize,
        rows: &[usize],
        inputs: &Inputs<T>,
        basis: &[Lanes<T>; COUNT_MAX],
        grad: &[T],
        weights: &mut [Lanes<T>; COUNT_MAX],
    ) {
        by_degree!(degree, add_to_degree::<T>(chunk, rows, inputs, basis, grad, weights));
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
        // The gradient of a coefficient is its basis function times the gradient of the colour.
        let i = n - chunk.rows.start;
        if !chunk.sh0.is_empty() {
            add_scaled(&mut chunk.sh0[3 * i..3 * i + 3], basis[0][lane], grad);
        }
        if !chunk.rest.is_empty() {
            let row = inputs.first_row(*n) - inputs.first_row(chunk.rows.start);
            let rest = &mut chunk.rest[3 * row..][..3 * REST];
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

/// `out = scale values` for each scale in turn. Writes four numbers at a time; the next three
/// overwrite the last one.
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
    layout: ShLayout<Flex>,
    grad: FlexTensor,
    settings: ShColorSettings,
    needs_grad: ShColorTensors<bool>,
) -> ShColorGradients<Flex> {
    let (buffers, starts) = (inputs.map_inputs(Buffer::new), starts_of(layout));
    let inputs = Inputs::<T>::new(&buffers, starts.as_ref(), settings);
    let grad = Buffer::new(grad);
    let grad = grad.slice::<T>();
    let (c, n) = (inputs.centers.len() / 3, inputs.count());

    let rest_shape = buffers.sh_rest.as_ref().map_or([0; 3], Buffer::dims);
    let lengths = [3 * n, rest_shape.iter().product(), 3 * n];
    let needed = [needs_grad.sh0, needs_grad.sh_rest, needs_grad.means];
    let mut out = [0, 1, 2].map(|i| Uncleared::<T>::new(if needed[i] { lengths[i] } else { 0 }));
    let [sh0, rest, means] = &mut out;
    let chunks = || {
        let firsts = (0..n).step_by(CHUNK);
        firsts.map(|first| first..n.min(first + CHUNK))
    };
    let rest_lengths =
        chunks().map(|rows| 3 * (inputs.first_row(rows.end) - inputs.first_row(rows.start)));
    let mut parts = [
        sh0.chunks(3 * CHUNK),
        rest.parts(rest_lengths.filter(|_| needed[1])),
        means.chunks(3 * CHUNK),
    ]
    .map(Vec::into_iter);
    let parts: Vec<_> = chunks()
        .map(|rows| (rows, parts.each_mut().map(Iterator::next)))
        .collect();
    let of_centers: Vec<Vec<Vec3<T>>> = parts
        .into_par_iter()
        .map(|(rows, parts)| {
            let [sh0, rest, means] = parts.map(|part| part.map_or(&mut [][..], Part::cleared));
            let mut chunk = Chunk {
                rows,
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
        sh_rest: needs_grad.sh_rest.then(|| tensor(rest, rest_shape)),
        means: needs_grad.means.then(|| tensor(means, [n, 3])),
        centers: needs_grad.centers.then(|| tensor(centers, [c, 3])),
        seen: None,
    }
}
