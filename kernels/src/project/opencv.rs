//! The perspective lens with radial and tangential distortion (OpenCV's rational model).
//!
//! ```text
//! a = x/z, b = y/z, q = a² + b²            L = N(q) / M(q), N = 1 + k1 q + k2 q² + k3 q³, M with k4, k5, k6
//! a' = a L + 2 p1 a b + p2 (q + 2 a²)      b' = b L + p1 (q + 2 b²) + 2 p2 a b
//! D = d(a', b')/d(a, b), symmetric         J = D(A, B) (1/z) [1 0 -A; 0 1 -B]
//! ```
//!
//! (A, B) is (a, b), pulled back to the circle of the clamp if it is beyond.

use cubecl::prelude::*;

use super::camera::{Coefficients, Lens};
use super::distorted::{LensGradient, Plane, PlaneGradient};
use crate::math::Vec3;

/// The radial factor L, its first two derivatives by q, and what they are made of.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Radial {
    q: f32,
    l: f32,
    l1: f32,
    l2: f32,
    /// 1 / M and M'.
    over: f32,
    m1: f32,
}

/// D: d a'/d a, d a'/d b = d b'/d a, d b'/d b.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Slopes {
    aa: f32,
    ab: f32,
    bb: f32,
}

#[cube]
fn radial(k: Coefficients, a: f32, b: f32) -> Radial {
    let q = a * a + b * b;
    let n = 1.0f32 + q * (k.c0 + q * (k.c1 + q * k.c4));
    let n1 = k.c0 + q * (2.0f32 * k.c1 + 3.0f32 * q * k.c4);
    let n2 = 2.0f32 * (k.c1 + 3.0f32 * q * k.c4);
    let m = 1.0f32 + q * (k.c5 + q * (k.c6 + q * k.c7));
    let m1 = k.c5 + q * (2.0f32 * k.c6 + 3.0f32 * q * k.c7);
    let m2 = 2.0f32 * (k.c6 + 3.0f32 * q * k.c7);
    let over = 1.0f32 / m;
    let l = n * over;
    let l1 = (n1 - l * m1) * over;
    let l2 = (n2 - 2.0f32 * l1 * m1 - l * m2) * over;
    Radial {
        q,
        l,
        l1,
        l2,
        over,
        m1,
    }
}

#[cube]
fn slopes(k: Coefficients, a: f32, b: f32, r: Radial) -> Slopes {
    Slopes {
        aa: r.l + 2.0f32 * a * a * r.l1 + 2.0f32 * k.c2 * b + 6.0f32 * k.c3 * a,
        ab: 2.0f32 * (a * b * r.l1 + k.c2 * a + k.c3 * b),
        bb: r.l + 2.0f32 * b * b * r.l1 + 6.0f32 * k.c2 * b + 2.0f32 * k.c3 * a,
    }
}

/// The factor that pulls (a, b) back to the clamp; 1 inside.
#[cube]
fn pull(lens: Lens, q: f32) -> f32 {
    let r = f32::sqrt(q);
    select(r > lens.clamp, lens.clamp / max(r, 1e-30f32), 1.0f32)
}

#[cube]
pub(super) fn opencv_plane(lens: Lens, p: Vec3) -> Plane {
    let k = lens.k;
    let over = 1.0f32 / p.z;
    let a = p.x / p.z;
    let b = p.y / p.z;
    let r = radial(k, a, b);
    let d = slopes(k, a, b, r);
    let pull = pull(lens, r.q);
    let ha = a * pull;
    let hb = b * pull;
    let h = slopes(k, ha, hb, radial(k, ha, hb));
    let ab = 2.0f32 * a * b;
    Plane {
        a: a * r.l + k.c2 * ab + k.c3 * (r.q + 2.0f32 * a * a),
        b: b * r.l + k.c2 * (r.q + 2.0f32 * b * b) + k.c3 * ab,
        depth: p.z,
        inside: r.q < lens.limit * lens.limit && d.aa * d.bb - d.ab * d.ab > 0.0f32,
        n1: Vec3::new(h.aa, h.ab, -(h.aa * ha + h.ab * hb)).scale(over),
        n2: Vec3::new(h.ab, h.bb, -(h.ab * ha + h.bb * hb)).scale(over),
    }
}

/// Gradients of a coefficient of N and of the one of M that belong to `power` = q^j, whose
/// derivative is `slope`, from those of L and L'.
#[cube]
fn radial_vjp(r: Radial, power: f32, slope: f32, g_l: f32, g_l1: f32) -> (f32, f32) {
    let share = power * r.over;
    let above = g_l * share + g_l1 * (slope - share * r.m1) * r.over;
    let through_l = r.l * (share * r.m1 - slope) - r.l1 * power;
    let below = g_l1 * through_l * r.over - g_l * r.l * share;
    (above, below)
}

/// Vector-Jacobian product of [`opencv_plane`].
#[cube]
pub(super) fn opencv_vjp(lens: Lens, p: Vec3, g: PlaneGradient) -> LensGradient {
    let k = lens.k;
    let over = 1.0f32 / p.z;
    let a = p.x / p.z;
    let b = p.y / p.z;
    let r = radial(k, a, b);
    let d = slopes(k, a, b, r);
    let pull = pull(lens, r.q);
    let ha = a * pull;
    let hb = b * pull;
    let at = radial(k, ha, hb);
    let h = slopes(k, ha, hb, at);

    // Jacobian -> D(A, B), A, B, 1/z.
    let g_aa = over * (g.n1.x - ha * g.n1.z);
    let g_ab = over * (g.n1.y - hb * g.n1.z + g.n2.x - ha * g.n2.z);
    let g_bb = over * (g.n2.y - hb * g.n2.z);
    let along = h.aa * g_aa + h.ab * g_ab + h.bb * g_bb;
    // D -> A, B, by the third derivatives of the lens.
    let aaa = 6.0f32 * (ha * at.l1 + k.c3) + 4.0f32 * ha * ha * ha * at.l2;
    let aab = 2.0f32 * (hb * at.l1 + k.c2) + 4.0f32 * ha * ha * hb * at.l2;
    let abb = 2.0f32 * (ha * at.l1 + k.c3) + 4.0f32 * ha * hb * hb * at.l2;
    let bbb = 6.0f32 * (hb * at.l1 + k.c2) + 4.0f32 * hb * hb * hb * at.l2;
    let g_ha = aaa * g_aa + aab * g_ab + abb * g_bb - over * (h.aa * g.n1.z + h.ab * g.n2.z);
    let g_hb = aab * g_aa + abb * g_ab + bbb * g_bb - over * (h.ab * g.n1.z + h.bb * g.n2.z);
    // Beyond the clamp, (A, B) moves along its circle only.
    let outwards = (a * g_ha + b * g_hb) / max(r.q, 1e-30f32);
    let outwards = select(pull < 1.0f32, outwards, 0.0f32);
    let g_a = pull * (g_ha - a * outwards) + d.aa * g.a + d.ab * g.b;
    let g_b = pull * (g_hb - b * outwards) + d.ab * g.a + d.bb * g.b;

    // D has L and L' at (A, B); the point has L at (a, b).
    let g_l = g_aa + g_bb;
    let g_l1 = 2.0f32 * (ha * ha * g_aa + ha * hb * g_ab + hb * hb * g_bb);
    let g_far = g.a * a + g.b * b;
    let q = at.q;
    let (above1, below1) = radial_vjp(at, q, 1.0f32, g_l, g_l1);
    let (above2, below2) = radial_vjp(at, q * q, 2.0f32 * q, g_l, g_l1);
    let (above3, below3) = radial_vjp(at, q * q * q, 3.0f32 * q * q, g_l, g_l1);
    let q = r.q;
    let (far_above1, far_below1) = radial_vjp(r, q, 1.0f32, g_far, 0.0f32);
    let (far_above2, far_below2) = radial_vjp(r, q * q, 2.0f32 * q, g_far, 0.0f32);
    let (far_above3, far_below3) = radial_vjp(r, q * q * q, 3.0f32 * q * q, g_far, 0.0f32);
    let ab = 2.0f32 * a * b;
    LensGradient {
        // The Jacobian is proportional to 1/z; a = x/z, b = y/z.
        p: Vec3::new(
            g_a * over,
            g_b * over,
            g.depth - over * (along + a * g_a + b * g_b),
        ),
        k: Coefficients {
            c0: above1 + far_above1,
            c1: above2 + far_above2,
            c2: g.a * ab
                + g.b * (q + 2.0f32 * b * b)
                + 2.0f32 * (hb * g_aa + ha * g_ab)
                + 6.0f32 * hb * g_bb,
            c3: g.a * (q + 2.0f32 * a * a)
                + g.b * ab
                + 6.0f32 * ha * g_aa
                + 2.0f32 * (hb * g_ab + ha * g_bb),
            c4: above3 + far_above3,
            c5: below1 + far_below1,
            c6: below2 + far_below2,
            c7: below3 + far_below3,
        },
    }
}
