//! Small vectors and row-major matrices.
//!
//! For loops meant to become SIMD code: no branches, and no array methods that take closures
//! (`map`, `from_fn`), which the compiler may leave as calls into another codegen unit.

use super::real::Real;

pub(super) type Vec3<T> = [T; 3];
/// Rows.
pub(super) type Mat3<T> = [[T; 3]; 3];
/// Two rows of three.
pub(super) type Mat23<T> = [[T; 3]; 2];

#[inline(always)]
pub(super) fn dot<T: Real>(a: Vec3<T>, b: Vec3<T>) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(super) fn cross<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

#[inline(always)]
pub(super) fn add<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
pub(super) fn scale<T: Real>(a: Vec3<T>, s: T) -> Vec3<T> {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// Largest absolute value.
#[inline(always)]
pub(super) fn largest<T: Real>(a: Vec3<T>) -> T {
    a[0].abs().greatest(a[1].abs()).greatest(a[2].abs())
}

/// `a / s`, or zero if s is zero.
#[inline(always)]
pub(super) fn over<T: Real>(a: Vec3<T>, s: T) -> Vec3<T> {
    if s == T::ZERO {
        a
    } else {
        [a[0] / s, a[1] / s, a[2] / s]
    }
}

/// Componentwise product.
#[inline(always)]
pub(super) fn hadamard<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [a[0] * b[0], a[1] * b[1], a[2] * b[2]]
}

/// `M v`.
#[inline(always)]
pub(super) fn apply<T: Real>(m: &Mat3<T>, v: Vec3<T>) -> Vec3<T> {
    [dot(m[0], v), dot(m[1], v), dot(m[2], v)]
}

/// `v^T M`, which is `M^T v`.
#[inline(always)]
pub(super) fn apply_transposed<T: Real>(m: &Mat3<T>, v: Vec3<T>) -> Vec3<T> {
    add(add(scale(m[0], v[0]), scale(m[1], v[1])), scale(m[2], v[2]))
}

/// `a b^T`.
#[inline(always)]
pub(super) fn outer<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Mat3<T> {
    [scale(b, a[0]), scale(b, a[1]), scale(b, a[2])]
}

#[inline(always)]
pub(super) fn add3<T: Real>(a: &Mat3<T>, b: &Mat3<T>) -> Mat3<T> {
    [add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2])]
}

/// Unit quaternion (w, x, y, z), the original length, and whether the input was finite and of
/// non-zero length; otherwise the results are meaningless. Divides by the largest entry first, so
/// that tiny and huge inputs neither underflow nor overflow.
#[inline(always)]
pub(super) fn normalize_quat<T: Real>(q: [T; 4]) -> ([T; 4], T, bool) {
    let mut largest = T::ZERO;
    let mut finite = true;
    for x in q {
        largest = largest.greatest(x.abs());
        finite &= x.is_finite();
    }
    let [w, x, y, z] = [
        q[0] / largest,
        q[1] / largest,
        q[2] / largest,
        q[3] / largest,
    ];
    let length = (w * w + x * x + y * y + z * z).sqrt();
    let unit = [w / length, x / length, y / length, z / length];
    (unit, length * largest, finite & (largest > T::ZERO))
}

/// Rotation matrix of a unit quaternion (w, x, y, z).
#[inline(always)]
pub(super) fn rotation<T: Real>([w, x, y, z]: [T; 4]) -> Mat3<T> {
    let (one, two) = (T::ONE, T::ONE + T::ONE);
    [
        [
            one - two * (y * y + z * z),
            two * (x * y - w * z),
            two * (x * z + w * y),
        ],
        [
            two * (x * y + w * z),
            one - two * (x * x + z * z),
            two * (y * z - w * x),
        ],
        [
            two * (x * z - w * y),
            two * (y * z + w * x),
            one - two * (x * x + y * y),
        ],
    ]
}

/// Gradient of the quaternion before normalisation, from the gradient `g` of its rotation matrix.
/// Orthogonal to the quaternion.
#[inline(always)]
pub(super) fn rotation_backward<T: Real>(unit: [T; 4], length: T, g: &Mat3<T>) -> [T; 4] {
    let [w, x, y, z] = unit;
    let two = T::ONE + T::ONE;
    let d = [
        x * (g[2][1] - g[1][2]) + y * (g[0][2] - g[2][0]) + z * (g[1][0] - g[0][1]),
        w * (g[2][1] - g[1][2]) + y * (g[0][1] + g[1][0]) + z * (g[0][2] + g[2][0])
            - two * x * (g[1][1] + g[2][2]),
        w * (g[0][2] - g[2][0]) + x * (g[0][1] + g[1][0]) + z * (g[1][2] + g[2][1])
            - two * y * (g[0][0] + g[2][2]),
        w * (g[1][0] - g[0][1]) + x * (g[0][2] + g[2][0]) + y * (g[1][2] + g[2][1])
            - two * z * (g[0][0] + g[1][1]),
    ];
    let radial = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
    [
        two * (d[0] - w * radial) / length,
        two * (d[1] - x * radial) / length,
        two * (d[2] - y * radial) / length,
        two * (d[3] - z * radial) / length,
    ]
}
