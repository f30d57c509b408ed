//! Real spherical harmonics in the basis of 3DGS, and their gradient.
//!
//! Each basis function of degree l is a homogeneous polynomial of degree l in the unit direction,
//! so that it is defined at the zero vector (zero beyond degree 0).

use core::marker::PhantomData;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use rayon::prelude::*;
use splat_core::{SH_C0 as C0, SH_C1 as C1, SH_C2 as C2, SH_C3 as C3};

use super::buffer::{Buffer, overwritten, tensor, zeros};
use super::math::{Vec3, dot, largest, over, scale};
use super::real::Real;
use crate::backend::{
    OpInputs, SphericalHarmonicsBackend, SphericalHarmonicsGradients, SphericalHarmonicsInputs,
    SphericalHarmonicsOps, SphericalHarmonicsTensors,
};
use crate::spherical_harmonics::{SH_DEGREE_MAX, sh_coefficient_count};

pub(super) const COUNT_MAX: usize = sh_coefficient_count(SH_DEGREE_MAX);
/// Gaussians per unit of parallel work.
const CHUNK: usize = 512;

/// Values of the first `(degree + 1)^2` basis functions in a unit direction; the rest are zero.
#[inline(always)]
pub(super) fn basis<T: Real>(degree: usize, [x, y, z]: Vec3<T>) -> [T; COUNT_MAX] {
    let k = T::of;
    let mut b = [T::ZERO; COUNT_MAX];
    b[0] = k(C0);
    if degree >= 1 {
        b[1] = -k(C1) * y;
        b[2] = k(C1) * z;
        b[3] = -k(C1) * x;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree >= 2 {
        b[4] = k(C2[0]) * x * y;
        b[5] = -k(C2[0]) * y * z;
        b[6] = k(C2[1]) * (k(2.0) * zz - xx - yy);
        b[7] = -k(C2[0]) * x * z;
        b[8] = k(C2[2]) * (xx - yy);
    }
    if degree >= 3 {
        b[9] = -k(C3[0]) * y * (k(3.0) * xx - yy);
        b[10] = k(C3[1]) * x * y * z;
        b[11] = -k(C3[2]) * y * (k(4.0) * zz - xx - yy);
        b[12] = k(C3[3]) * z * (k(2.0) * zz - k(3.0) * xx - k(3.0) * yy);
        b[13] = -k(C3[2]) * x * (k(4.0) * zz - xx - yy);
        b[14] = k(C3[4]) * z * (xx - yy);
        b[15] = -k(C3[0]) * x * (xx - k(3.0) * yy);
    }
    b
}

/// Derivatives of [`basis`] by x, y and z.
#[inline(always)]
pub(super) fn basis_gradient<T: Real>(degree: usize, [x, y, z]: Vec3<T>) -> [Vec3<T>; COUNT_MAX] {
    let k = T::of;
    let o = T::ZERO;
    let mut d = [[o; 3]; COUNT_MAX];
    if degree >= 1 {
        d[1] = [o, -k(C1), o];
        d[2] = [o, o, k(C1)];
        d[3] = [-k(C1), o, o];
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree >= 2 {
        d[4] = scale([y, x, o], k(C2[0]));
        d[5] = scale([o, z, y], -k(C2[0]));
        d[6] = scale([-x, -y, k(2.0) * z], k(2.0 * C2[1]));
        d[7] = scale([z, o, x], -k(C2[0]));
        d[8] = scale([x, -y, o], k(2.0 * C2[2]));
    }
    if degree >= 3 {
        d[9] = scale([k(6.0) * x * y, k(3.0) * (xx - yy), o], -k(C3[0]));
        d[10] = scale([y * z, x * z, x * y], k(C3[1]));
        d[11] = scale(
            [
                -k(2.0) * x * y,
                k(4.0) * zz - xx - k(3.0) * yy,
                k(8.0) * y * z,
            ],
            -k(C3[2]),
        );
        d[12] = scale(
            [
                -k(6.0) * x * z,
                -k(6.0) * y * z,
                k(6.0) * zz - k(3.0) * (xx + yy),
            ],
            k(C3[3]),
        );
        d[13] = scale(
            [
                k(4.0) * zz - k(3.0) * xx - yy,
                -k(2.0) * x * y,
                k(8.0) * x * z,
            ],
            -k(C3[2]),
        );
        d[14] = scale([k(2.0) * x * z, -k(2.0) * y * z, xx - yy], k(C3[4]));
        d[15] = scale([k(3.0) * (xx - yy), -k(6.0) * x * y, o], -k(C3[0]));
    }
    d
}

/// Unit vector and the inverse of the length; both zero for the zero vector.
#[inline(always)]
pub(super) fn normalize<T: Real>(v: Vec3<T>) -> (Vec3<T>, T) {
    let largest = largest(v);
    let [x, y, z] = over(v, largest);
    let length = dot([x, y, z], [x, y, z]).sqrt();
    let known = largest > T::ZERO;
    let kept = |value: T| if known { value } else { T::ZERO };
    let unit = [kept(x / length), kept(y / length), kept(z / length)];
    (unit, kept(T::ONE / (length * largest)))
}

fn direction<T: Real>(dirs: &[T], row: usize) -> Vec3<T> {
    core::array::from_fn(|i| dirs[3 * row + i])
}

impl SphericalHarmonicsOps for Flex {
    fn spherical_harmonics(
        OpInputs(inputs): SphericalHarmonicsInputs<Self>,
        degree: usize,
    ) -> FlexTensor {
        in_precision!(inputs.coeffs, forward, inputs, degree)
    }
}

impl SphericalHarmonicsBackend for Flex {
    fn spherical_harmonics_backward(
        OpInputs(inputs): SphericalHarmonicsInputs<Self>,
        grad_colors: FlexTensor,
        degree: usize,
        needs_grad: SphericalHarmonicsTensors<bool>,
    ) -> SphericalHarmonicsGradients<Self> {
        in_precision!(
            inputs.coeffs,
            backward,
            inputs,
            grad_colors,
            degree,
            needs_grad
        )
    }
}

fn forward<T: Real>(
    _: PhantomData<T>,
    inputs: SphericalHarmonicsTensors<FlexTensor>,
    degree: usize,
) -> FlexTensor {
    let SphericalHarmonicsTensors { coeffs, dirs } = inputs.map(Buffer::new);
    let [n, k, _] = coeffs.dims();
    let [c, _, _] = dirs.dims();
    let (coeffs, dirs) = (coeffs.slice::<T>(), dirs.slice::<T>());
    let count = sh_coefficient_count(degree);
    let mut colors = zeros::<T>(c * n * 3);
    colors
        .par_chunks_mut(3)
        .with_min_len(CHUNK)
        .enumerate()
        .for_each(|(row, color)| {
            let coeffs = &coeffs[row % n * k * 3..][..count * 3];
            let basis = basis(degree, normalize(direction(dirs, row)).0);
            for (coeff, value) in coeffs.chunks_exact(3).zip(basis) {
                for (color, coeff) in color.iter_mut().zip(coeff) {
                    *color += value * *coeff;
                }
            }
        });
    tensor(colors, [c, n, 3])
}

/// Tests whether a gradient is all zero, as for most splats of most views. Skipping those also
/// keeps zero times NaN of a broken splat out of the camera's gradient.
#[inline(always)]
pub(super) fn is_zero<T: Real>(grad: &[T]) -> bool {
    grad.iter().all(|g| *g == T::ZERO)
}

/// `grad . coeff`, ignoring the coefficient, which may be infinite, of a channel without gradient
/// (black, and clamped there).
// Computes every product, to avoid branches.
#[inline(always)]
pub(super) fn guarded_dot<T: Real>(grad: Vec3<T>, coeff: Vec3<T>) -> T {
    let mut sum = T::ZERO;
    for i in 0..3 {
        let product = grad[i] * coeff[i];
        sum += if grad[i] == T::ZERO { T::ZERO } else { product };
    }
    sum
}

fn backward<T: Real>(
    _: PhantomData<T>,
    inputs: SphericalHarmonicsTensors<FlexTensor>,
    grad: FlexTensor,
    degree: usize,
    needs_grad: SphericalHarmonicsTensors<bool>,
) -> SphericalHarmonicsGradients<Flex> {
    let SphericalHarmonicsTensors { coeffs, dirs } = inputs.map(Buffer::new);
    let grad = Buffer::new(grad);
    let [n, k, _] = coeffs.dims();
    let [c, _, _] = dirs.dims();
    let (coeffs, dirs, grad) = (coeffs.slice::<T>(), dirs.slice::<T>(), grad.slice::<T>());
    let count = sh_coefficient_count(degree);

    // color = sum_i B_i(d) coeff_i: the gradient of a coefficient is B_i(d) times that of the
    // colour, summed over cameras.
    let grad_coeffs = needs_grad.coeffs.then(|| {
        let mut values = zeros::<T>(n * k * 3);
        values
            .par_chunks_mut(k * 3)
            .with_min_len(CHUNK)
            .enumerate()
            .for_each(|(index, out)| {
                for camera in 0..c {
                    let row = camera * n + index;
                    if is_zero(&grad[3 * row..3 * row + 3]) {
                        continue;
                    }
                    let basis = basis(degree, normalize(direction(dirs, row)).0);
                    let grad = &grad[3 * row..3 * row + 3];
                    for (out, value) in out.chunks_exact_mut(3).zip(&basis[..count]) {
                        for (out, grad) in out.iter_mut().zip(grad) {
                            *out += *value * *grad;
                        }
                    }
                }
            });
        tensor(values, [n, k, 3])
    });

    // d = v / |v|: the gradient of v is the tangential part, divided by |v|.
    let grad_dirs = needs_grad.dirs.then(|| {
        let mut values = overwritten::<T>(c * n * 3);
        values
            .par_chunks_mut(3)
            .with_min_len(CHUNK)
            .enumerate()
            .for_each(|(row, out)| {
                if is_zero(&grad[3 * row..3 * row + 3]) {
                    out.fill(T::ZERO);
                    return;
                }
                let (unit, inverse_length) = normalize(direction(dirs, row));
                let coeffs = &coeffs[row % n * k * 3..][..count * 3];
                let grad: Vec3<T> = core::array::from_fn(|i| grad[3 * row + i]);
                let mut sum = [T::ZERO; 3];
                for (coeff, derivative) in coeffs.chunks_exact(3).zip(basis_gradient(degree, unit))
                {
                    let weight = guarded_dot(grad, [coeff[0], coeff[1], coeff[2]]);
                    for (sum, derivative) in sum.iter_mut().zip(derivative) {
                        *sum += weight * derivative;
                    }
                }
                let radial = dot(sum, unit);
                for i in 0..3 {
                    out[i] = (sum[i] - unit[i] * radial) * inverse_length;
                }
            });
        tensor(values, [c, n, 3])
    });
    SphericalHarmonicsTensors {
        coeffs: grad_coeffs,
        dirs: grad_dirs,
    }
}
