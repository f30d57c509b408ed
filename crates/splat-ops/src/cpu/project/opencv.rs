//! The perspective lens with radial and tangential distortion (OpenCV's rational model).
//!
//! ```text
//! a = x/z, b = y/z, q = a^2 + b^2          L = N(q) / M(q), N = 1 + k1 q + k2 q^2 + k3 q^3, M with k4, k5, k6
//! a' = a L + 2 p1 a b + p2 (q + 2 a^2)     b' = b L + p1 (q + 2 b^2) + 2 p2 a b
//! D = d(a', b')/d(a, b), symmetric         J = D(A, B) (1/z) [1 0 -A; 0 1 -B]
//! ```
//!
//! (A, B) is (a, b), pulled back to the circle of the clamp if it is beyond.

use super::super::math::*;
use super::super::real::Real;
use super::camera::COEFFICIENTS;
use super::distorted::{Bend, Plane};

/// Coefficients and domain.
#[derive(Clone, Copy)]
pub(super) struct OpenCv<T> {
    /// k1, k2, k3, and k4, k5, k6.
    above: [T; 3],
    below: [T; 3],
    p1: T,
    p2: T,
    /// Square of the largest radius.
    limit: T,
    /// Radius of the clamp.
    clamp: T,
}

/// The radial factor L, its first two derivatives by q, and what they are made of.
#[derive(Clone, Copy)]
struct Radial<T> {
    l: T,
    l1: T,
    l2: T,
    /// 1 / M and M'.
    over: T,
    m1: T,
}

/// A polynomial with constant 1 at `q`, and its first two derivatives.
#[inline(always)]
fn polynomial<T: Real>([a, b, c]: [T; 3], q: T) -> [T; 3] {
    let (two, three) = (T::of(2.0), T::of(3.0));
    [
        T::ONE + q * (a + q * (b + q * c)),
        a + q * (two * b + three * q * c),
        two * (b + three * q * c),
    ]
}

impl<T: Real> OpenCv<T> {
    #[inline(always)]
    fn radial(&self, q: T) -> Radial<T> {
        let [n, n1, n2] = polynomial(self.above, q);
        let [m, m1, m2] = polynomial(self.below, q);
        let over = T::ONE / m;
        let l = n * over;
        let l1 = (n1 - l * m1) * over;
        let l2 = (n2 - T::of(2.0) * l1 * m1 - l * m2) * over;
        Radial {
            l,
            l1,
            l2,
            over,
            m1,
        }
    }

    /// (a', b').
    #[inline(always)]
    fn point(&self, [a, b]: [T; 2], q: T, r: &Radial<T>) -> [T; 2] {
        let two = T::of(2.0);
        let ab = two * a * b;
        [
            a * r.l + self.p1 * ab + self.p2 * (q + two * a * a),
            b * r.l + self.p1 * (q + two * b * b) + self.p2 * ab,
        ]
    }

    /// D: d a'/d a, d a'/d b = d b'/d a, d b'/d b.
    #[inline(always)]
    fn slopes(&self, [a, b]: [T; 2], r: &Radial<T>) -> [T; 3] {
        let (two, six) = (T::of(2.0), T::of(6.0));
        let Self { p1, p2, .. } = *self;
        [
            r.l + two * a * a * r.l1 + two * p1 * b + six * p2 * a,
            two * (a * b * r.l1 + p1 * a + p2 * b),
            r.l + two * b * b * r.l1 + six * p1 * b + two * p2 * a,
        ]
    }

    /// The factor that pulls a point at radius `r` back to the clamp.
    #[inline(always)]
    fn pull(&self, r: T) -> T {
        let pull = self.clamp / r;
        if r > self.clamp { pull } else { T::ONE }
    }

    /// Adds the gradients of k1, k2, k3 and k4, k5, k6, from those of L and L' at q.
    #[inline(always)]
    fn add_radial(dk: &mut [T; COEFFICIENTS], q: T, r: &Radial<T>, dl: T, dl1: T) {
        let (mut power, mut slope) = (q, T::ONE);
        for (above, below) in [(0, 5), (1, 6), (4, 7)] {
            // dN = q^j, dN' = j q^(j-1), and the same for M.
            let share = power * r.over;
            dk[above] += dl * share + dl1 * (slope - share * r.m1) * r.over;
            let through_l = share * r.m1 - slope;
            dk[below] += -dl * r.l * share + dl1 * (r.l * through_l - r.l1 * power) * r.over;
            let next = power * q;
            slope = power + slope * q;
            power = next;
        }
    }
}

impl<T: Real> Bend<T> for OpenCv<T> {
    const COEFFICIENTS: usize = 8;

    fn new(k: &[T], domain: &[T]) -> Self {
        Self {
            above: [k[0], k[1], k[4]],
            below: [k[5], k[6], k[7]],
            p1: k[2],
            p2: k[3],
            limit: domain[0] * domain[0],
            clamp: domain[1],
        }
    }

    #[inline(always)]
    fn plane(&self, [x, y, z]: Vec3<T>) -> Plane<T> {
        let [a, b] = [x / z, y / z];
        let q = a * a + b * b;
        let radial = self.radial(q);
        let [d11, d12, d22] = self.slopes([a, b], &radial);
        let folds = !(d11 * d22 - d12 * d12 > T::ZERO);

        let pull = self.pull(q.sqrt());
        let held = [a * pull, b * pull];
        let at = self.radial(held[0] * held[0] + held[1] * held[1]);
        let [h11, h12, h22] = self.slopes(held, &at);
        let over = T::ONE / z;
        Plane {
            point: self.point([a, b], q, &radial),
            depth: z,
            inside: (q < self.limit) & !folds,
            jacobian: [
                scale([h11, h12, -(h11 * held[0] + h12 * held[1])], over),
                scale([h12, h22, -(h12 * held[0] + h22 * held[1])], over),
            ],
        }
    }

    #[inline(always)]
    fn plane_backward(
        &self,
        [x, y, z]: Vec3<T>,
        [ga, gb]: [T; 2],
        ddepth: T,
        [g1, g2]: Mat23<T>,
    ) -> (Vec3<T>, [T; COEFFICIENTS]) {
        let (two, four, six) = (T::of(2.0), T::of(4.0), T::of(6.0));
        let over = T::ONE / z;
        let [a, b] = [x / z, y / z];
        let q = a * a + b * b;
        let radial = self.radial(q);
        let [d11, d12, d22] = self.slopes([a, b], &radial);
        let pull = self.pull(q.sqrt());
        let [ha, hb] = [a * pull, b * pull];
        let hq = ha * ha + hb * hb;
        let at = self.radial(hq);
        let [h11, h12, h22] = self.slopes([ha, hb], &at);

        // Jacobian -> D(A, B), A, B, 1/z.
        let g11 = over * (g1[0] - ha * g1[2]);
        let g12 = over * (g1[1] - hb * g1[2] + g2[0] - ha * g2[2]);
        let g22 = over * (g2[1] - hb * g2[2]);
        let along = h11 * g11 + h12 * g12 + h22 * g22;
        // D -> A, B, by the third derivatives of the lens.
        let aaa = six * (ha * at.l1 + self.p2) + four * ha * ha * ha * at.l2;
        let aab = two * (hb * at.l1 + self.p1) + four * ha * ha * hb * at.l2;
        let abb = two * (ha * at.l1 + self.p2) + four * ha * hb * hb * at.l2;
        let bbb = six * (hb * at.l1 + self.p1) + four * hb * hb * hb * at.l2;
        let dha = aaa * g11 + aab * g12 + abb * g22 - over * (h11 * g1[2] + h12 * g2[2]);
        let dhb = aab * g11 + abb * g12 + bbb * g22 - over * (h12 * g1[2] + h22 * g2[2]);
        // Beyond the clamp, (A, B) moves along its circle only.
        let outwards = (a * dha + b * dhb) / q;
        let outwards = if pull < T::ONE { outwards } else { T::ZERO };
        let da = pull * (dha - a * outwards) + d11 * ga + d12 * gb;
        let db = pull * (dhb - b * outwards) + d12 * ga + d22 * gb;

        let mut dk = [T::ZERO; COEFFICIENTS];
        let dl = g11 + g22;
        let dl1 = two * (ha * ha * g11 + ha * hb * g12 + hb * hb * g22);
        Self::add_radial(&mut dk, hq, &at, dl, dl1);
        Self::add_radial(&mut dk, q, &radial, ga * a + gb * b, T::ZERO);
        let ab = two * a * b;
        dk[2] = ga * ab + gb * (q + two * b * b) + two * (hb * g11 + ha * g12) + six * hb * g22;
        dk[3] = ga * (q + two * a * a) + gb * ab + six * ha * g11 + two * (hb * g12 + ha * g22);

        // The Jacobian is proportional to 1/z; a = x/z, b = y/z.
        let dp = [
            da * over,
            db * over,
            ddepth - over * (along + a * da + b * db),
        ];
        (dp, dk)
    }
}
