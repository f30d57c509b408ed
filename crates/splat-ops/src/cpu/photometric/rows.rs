//! What is done to rows, in blocks of [`LANES`] values. Rows are [`padded`]: the last block of a range may reach over its
//! end, where nothing is read that matters.

use core::ops::Range;

use super::sweep::{FIELDS, MOMENTS};
use crate::cpu::real::Real;
use crate::cpu::simd::vectorized;

/// Values that are summed at once.
const LANES: usize = 16;

type Lanes<T> = [T; LANES];

/// The length of a row in memory that holds `values`: whole blocks, and one beyond.
pub(super) fn padded(values: usize) -> usize {
    values.next_multiple_of(LANES) + LANES
}

/// A block of a row.
#[inline(always)]
fn block<T: Real>(row: &[T], start: usize) -> Lanes<T> {
    let mut block = [T::ZERO; LANES];
    block.copy_from_slice(&row[start..start + LANES]);
    block
}

/// A block of N rows, each the weighted sum of its values at `start`, `start + step` and so on.
#[inline(always)]
fn blur_along<T: Real, const FMA: bool, const N: usize>(
    rows: &[&[T]; N],
    start: usize,
    step: usize,
    window: &[T],
) -> [Lanes<T>; N] {
    let mut sums = [[T::ZERO; LANES]; N];
    for (k, weight) in window.iter().enumerate() {
        for n in 0..N {
            let values = block(rows[n], start + k * step);
            for i in 0..LANES {
                sums[n][i] = T::multiply_add::<FMA>(*weight, values[i], sums[n][i]);
            }
        }
    }
    sums
}

vectorized! {
    /// `v / 255`.
    pub(super) fn values_of_levels<T: Real, const FMA: bool>(levels: &[u8], out: &mut [T]) {
        for (out, level) in out.iter_mut().zip(levels) {
            *out = T::of_level(*level);
        }
    }
}

vectorized! {
    /// The sum of `|x - y|`, in double precision.
    pub(super) fn sum_of_differences<T: Real, const FMA: bool>(x: &[T], y: &[T]) -> f64 {
        let mut sums = [0.0; LANES];
        for (x, y) in x.chunks(LANES).zip(y.chunks(LANES)) {
            for ((sum, x), y) in sums.iter_mut().zip(x).zip(y) {
                *sum += (*x - *y).abs().wide();
            }
        }
        sums.iter().sum()
    }
}

vectorized! {
    /// The sum, in double precision.
    pub(super) fn sum<T: Real, const FMA: bool>(values: &[T]) -> f64 {
        let mut sums = [0.0; LANES];
        for values in values.chunks(LANES) {
            for (sum, value) in sums.iter_mut().zip(values) {
                *sum += value.wide();
            }
        }
        sums.iter().sum()
    }
}

vectorized! {
    /// x, y, x^2 + y^2 and xy blurred down the columns: `rows` are those under the window.
    pub(super) fn moments_down<T: Real, const FMA: bool>(
        rows: &[[&[T]; 2]],
        window: &[T],
        out: &mut [&mut [T]; MOMENTS],
    ) {
        for start in (0..out[0].len()).step_by(LANES) {
            let mut sums = [[T::ZERO; LANES]; MOMENTS];
            for ([x, y], weight) in rows.iter().zip(window) {
                let (x, y) = (block(x, start), block(y, start));
                for i in 0..LANES {
                    let squares = T::multiply_add::<FMA>(x[i], x[i], y[i] * y[i]);
                    let values = [x[i], y[i], squares, x[i] * y[i]];
                    for n in 0..MOMENTS {
                        sums[n][i] = T::multiply_add::<FMA>(*weight, values[n], sums[n][i]);
                    }
                }
            }
            for n in 0..MOMENTS {
                out[n][start..start + LANES].copy_from_slice(&sums[n]);
            }
        }
    }
}

vectorized! {
    /// The fields and the similarity at `range`, from rows of moments that are blurred down the columns, by blurring
    /// them along the row too. After the range the fields are zero.
    pub(super) fn fields_along<T: Real, const FMA: bool>(
        moments: [&[T]; MOMENTS],
        range: Range<usize>,
        step: usize,
        window: &[T],
        constants: [T; 2],
        out: &mut [&mut [T]; FIELDS],
        similarity: &mut [T],
    ) {
        let [c1, c2] = constants;
        let two = T::ONE + T::ONE;
        let reach = window.len() / 2 * step;
        for start in range.clone().step_by(LANES) {
            let [mx, my, q, p] =
                blur_along::<T, FMA, MOMENTS>(&moments, start - reach, step, window);
            let mut fields = [[T::ZERO; LANES]; FIELDS];
            let mut similarities = [T::ZERO; LANES];
            for i in 0..LANES {
                let (mx, my) = (mx[i], my[i]);
                let (product, squares) = (mx * my, mx * mx + my * my);
                let (a, b) = (two * product + c1, squares + c1);
                let (c, d) = (two * (p[i] - product) + c2, q[i] - squares + c2);
                let scale = T::ONE / (b * d);
                let s = a * c * scale;
                similarities[i] = s;
                fields[0][i] = (my * (c - a) + mx * s * (b - d)) * scale;
                fields[1][i] = -s * b * scale;
                fields[2][i] = a * scale;
            }
            for n in 0..FIELDS {
                out[n][start..start + LANES].copy_from_slice(&fields[n]);
            }
            similarity[start..start + LANES].copy_from_slice(&similarities);
        }
        for out in out {
            out[range.end..range.end + LANES].fill(T::ZERO);
        }
    }
}

vectorized! {
    /// The fields blurred down the columns: `rows` are those under the window.
    pub(super) fn fields_down<T: Real, const FMA: bool>(
        rows: &[[&[T]; FIELDS]],
        window: &[T],
        out: &mut [&mut [T]; FIELDS],
    ) {
        for start in (0..out[0].len()).step_by(LANES) {
            let mut sums = [[T::ZERO; LANES]; FIELDS];
            for (fields, weight) in rows.iter().zip(window) {
                for n in 0..FIELDS {
                    let values = block(fields[n], start);
                    for i in 0..LANES {
                        sums[n][i] = T::multiply_add::<FMA>(*weight, values[i], sums[n][i]);
                    }
                }
            }
            for n in 0..FIELDS {
                out[n][start..start + LANES].copy_from_slice(&sums[n]);
            }
        }
    }
}

vectorized! {
    /// `scale (f0 + x f1 + y f2)` at `range`, f being fields that are blurred down the columns, blurred along the row.
    pub(super) fn slope_along<T: Real, const FMA: bool>(
        fields: [&[T]; FIELDS],
        pictures: [&[T]; 2],
        range: Range<usize>,
        step: usize,
        window: &[T],
        scale: T,
        out: &mut [T],
    ) {
        let reach = window.len() / 2 * step;
        for start in range.step_by(LANES) {
            let [f0, f1, f2] = blur_along::<T, FMA, FIELDS>(&fields, start - reach, step, window);
            let (x, y) = (block(pictures[0], start), block(pictures[1], start));
            let out = &mut out[start..start + LANES];
            for i in 0..LANES {
                out[i] = scale * (f0[i] + x[i] * f1[i] + y[i] * f2[i]);
            }
        }
    }
}

vectorized! {
    /// `l1 sign(x - y) + ssim slope`.
    pub(super) fn gradient<T: Real, const FMA: bool>(
        rows: [&[T]; 3],
        weights: [T; 2],
        out: &mut [T],
    ) {
        let [x, y, slope] = rows;
        let [l1, ssim] = weights;
        for (((out, x), y), slope) in out.iter_mut().zip(x).zip(y).zip(slope) {
            let rising = if *x > *y { l1 } else { T::ZERO };
            let falling = if *x < *y { l1 } else { T::ZERO };
            *out = rising - falling + ssim * *slope;
        }
    }
}
