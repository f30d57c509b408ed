//! Arithmetic on rows, in blocks of [`LANES`] values. Rows are [`padded`]: the last block of a
//! range may extend past its end, into values that do not matter.

use core::ops::Range;

use crate::cpu::real::Real;
use crate::cpu::simd::vectorized;

/// mx, my, q, p.
pub(super) const MOMENTS: usize = 4;
/// Derivatives by mx, q, p; the first and last are halved.
pub(super) const FIELDS: usize = 3;

/// Values summed at once along a row.
const LANES: usize = 16;
/// Moments of each of two rows summed at once; the sums of all four must fit into registers.
const PAIR: usize = LANES / 2;

/// Length in memory of a row of `values`: whole blocks, and one more.
pub(super) fn padded(values: usize) -> usize {
    values.next_multiple_of(LANES) + LANES
}

/// A block of a row.
#[inline(always)]
fn block<T: Real, const L: usize>(row: &[T], start: usize) -> [T; L] {
    let mut block = [T::ZERO; L];
    block.copy_from_slice(&row[start..start + L]);
    block
}

/// `sums += weight values`.
#[inline(always)]
fn add<T: Real, const FMA: bool, const L: usize, const N: usize>(
    sums: &mut [[T; L]; N],
    weight: T,
    values: &[[T; L]; N],
) {
    for n in 0..N {
        for i in 0..L {
            sums[n][i] = T::multiply_add::<FMA>(weight, values[n][i], sums[n][i]);
        }
    }
}

/// Blurs two adjacent rows of N values along the columns. `rows` are those under the window of
/// either; `values` finds a block in one. Two rows at once, as loads cost more than arithmetic.
#[inline(always)]
fn blur_down<T: Real, Row, const FMA: bool, const L: usize, const N: usize>(
    rows: &[Row],
    window: &[T],
    out: &mut [[&mut [T]; N]; 2],
    values: impl Fn(&Row, usize) -> [[T; L]; N],
) {
    let last = window.len() - 1;
    let [upper, lower] = out;
    for start in (0..upper[0].len()).step_by(L) {
        let [mut above, mut below] = [[[T::ZERO; L]; N]; 2];
        add::<T, FMA, L, N>(&mut above, window[0], &values(&rows[0], start));
        for (row, weights) in rows[1..].iter().zip(window.windows(2)) {
            let values = values(row, start);
            add::<T, FMA, L, N>(&mut above, weights[1], &values);
            add::<T, FMA, L, N>(&mut below, weights[0], &values);
        }
        add::<T, FMA, L, N>(&mut below, window[last], &values(&rows[last + 1], start));
        for n in 0..N {
            upper[n][start..start + L].copy_from_slice(&above[n]);
            lower[n][start..start + L].copy_from_slice(&below[n]);
        }
    }
}

/// x, y, x^2 + y^2 and xy of a block.
#[inline(always)]
fn moments<T: Real, const FMA: bool>([x, y]: &[&[T]; 2], start: usize) -> [[T; PAIR]; MOMENTS] {
    let (x, y) = (block(x, start), block(y, start));
    let [mut squares, mut products] = [[T::ZERO; PAIR]; 2];
    for i in 0..PAIR {
        squares[i] = T::multiply_add::<FMA>(x[i], x[i], y[i] * y[i]);
        products[i] = x[i] * y[i];
    }
    [x, y, squares, products]
}

/// A block of N rows, each the weighted sum of values at `start`, `start + step`, ...
#[inline(always)]
fn blur_along<T: Real, const FMA: bool, const N: usize>(
    rows: &[&[T]; N],
    start: usize,
    step: usize,
    window: &[T],
) -> [[T; LANES]; N] {
    let mut sums = [[T::ZERO; LANES]; N];
    for (k, weight) in window.iter().enumerate() {
        let values = rows.map(|row| block(row, start + k * step));
        add::<T, FMA, LANES, N>(&mut sums, *weight, &values);
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
        let ((x, last_x), (y, last_y)) = (x.as_chunks::<LANES>(), y.as_chunks::<LANES>());
        for (x, y) in x.iter().zip(y) {
            for i in 0..LANES {
                sums[i] += (x[i] - y[i]).abs().wide();
            }
        }
        for ((sum, x), y) in sums.iter_mut().zip(last_x).zip(last_y) {
            *sum += (*x - *y).abs().wide();
        }
        sums.iter().sum()
    }
}

vectorized! {
    /// The sum, in double precision.
    pub(super) fn sum<T: Real, const FMA: bool>(values: &[T]) -> f64 {
        let mut sums = [0.0; LANES];
        let (values, last) = values.as_chunks::<LANES>();
        for values in values {
            for i in 0..LANES {
                sums[i] += values[i].wide();
            }
        }
        for (sum, value) in sums.iter_mut().zip(last) {
            *sum += value.wide();
        }
        sums.iter().sum()
    }
}

vectorized! {
    /// Blurs two rows of moments along the columns, from the rows of x and y under the window of
    /// either.
    pub(super) fn moments_down<T: Real, const FMA: bool>(
        rows: &[[&[T]; 2]],
        window: &[T],
        out: &mut [[&mut [T]; MOMENTS]; 2],
    ) {
        blur_down::<T, _, FMA, PAIR, MOMENTS>(rows, window, out, moments::<T, FMA>);
    }
}

vectorized! {
    /// Blurs two rows of fields along the columns, from the rows under the window of either.
    pub(super) fn fields_down<T: Real, const FMA: bool>(
        rows: &[[&[T]; FIELDS]],
        window: &[T],
        out: &mut [[&mut [T]; FIELDS]; 2],
    ) {
        let [upper, lower] = out;
        for n in 0..FIELDS {
            let out = &mut [[&mut *upper[n]], [&mut *lower[n]]];
            blur_down::<T, _, FMA, LANES, 1>(rows, window, out, |fields, start| [block(fields[n], start)]);
        }
    }
}

vectorized! {
    /// Fields and similarity at `range`, by blurring rows of moments, already blurred along the
    /// columns, along the row too. Outside the range the fields are zero.
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
            out[..range.start].fill(T::ZERO);
            out[range.end..].fill(T::ZERO);
        }
    }
}

vectorized! {
    /// `scale (f0 + x f1 + y f2)` at `range`; f are fields, already blurred along the columns and
    /// blurred here along the row.
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
            let [x, y] = pictures.map(|row| block::<T, LANES>(row, start));
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
