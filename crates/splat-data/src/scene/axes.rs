//! Axes of scene files: reversing some of them.

/// Axes to reverse, as the factors 1 and -1 of x, y and z. Applying it twice changes nothing.
///
/// Under the reversal F = diag(x, y, z), a position p becomes F p, and a rotation R becomes F R F,
/// whose quaternion is (w, yz q_x, xz q_y, xy q_z). A spherical harmonic is a polynomial in which
/// every term has the same powers of x, y and z up to even ones, so it is multiplied by the product
/// of those factors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct AxisFlip {
    /// Factors of x, y and z.
    pub signs: [f32; 3],
}

impl AxisFlip {
    /// A position with some axes reversed.
    pub fn position(self, position: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|axis| f64::from(self.signs[axis]) * position[axis])
    }

    /// A quaternion (w, x, y, z) with some axes reversed.
    pub fn quat(self, [w, qx, qy, qz]: [f64; 4]) -> [f64; 4] {
        let [x, y, z] = self.signs.map(f64::from);
        [w, y * z * qx, x * z * qy, x * y * qz]
    }

    /// Factors of the coefficients of degrees 1 to 3, in the order of
    /// [`SplatData::sh_rest`](super::SplatData::sh_rest).
    pub fn sh_rest(self) -> [f32; 15] {
        let [x, y, z] = self.signs;
        let degree_1 = [y, z, x];
        let degree_2 = [x * y, y * z, 1.0, x * z, 1.0];
        let degree_3 = [y, x * y * z, y, z, x, z, x];
        let mut factors = [1.0; 15];
        factors[..3].copy_from_slice(&degree_1);
        factors[3..8].copy_from_slice(&degree_2);
        factors[8..].copy_from_slice(&degree_3);
        factors
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DQuat, DVec3};
    use splat_core::{SH_C1, SH_C2, SH_C3};

    use super::*;

    /// Values of the basis functions of degrees 1 to 3 in a direction, written out from the 3DGS
    /// paper's code.
    fn basis([x, y, z]: [f64; 3]) -> [f64; 15] {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        [
            -SH_C1 * y,
            SH_C1 * z,
            -SH_C1 * x,
            SH_C2[0] * x * y,
            -SH_C2[0] * y * z,
            SH_C2[1] * (2.0 * zz - xx - yy),
            -SH_C2[0] * x * z,
            SH_C2[2] * (xx - yy),
            -SH_C3[0] * y * (3.0 * xx - yy),
            SH_C3[1] * x * y * z,
            -SH_C3[2] * y * (4.0 * zz - xx - yy),
            SH_C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -SH_C3[2] * x * (4.0 * zz - xx - yy),
            SH_C3[4] * z * (xx - yy),
            -SH_C3[0] * x * (xx - 3.0 * yy),
        ]
    }

    fn all_flips() -> impl Iterator<Item = AxisFlip> {
        (0..8).map(|bits| AxisFlip {
            signs: [0, 1, 2].map(|axis| if bits >> axis & 1 == 0 { 1.0 } else { -1.0 }),
        })
    }

    #[test]
    fn a_reversed_scene_has_the_same_colour_in_the_reversed_direction() {
        let coefficients: [f64; 15] = std::array::from_fn(|k| (k as f64 * 0.7 + 0.3).sin());
        let direction = DVec3::new(0.3, -0.5, 0.8).normalize().to_array();
        let color = |factors: [f32; 15], direction| {
            let terms = coefficients.iter().zip(factors).zip(basis(direction));
            terms
                .map(|((c, factor), y)| c * f64::from(factor) * y)
                .sum::<f64>()
        };
        for flip in all_flips() {
            let before = color([1.0; 15], direction);
            let after = color(flip.sh_rest(), flip.position(direction));
            assert!((before - after).abs() < 1e-14, "{flip:?}");
        }
    }

    #[test]
    fn a_reversed_scene_has_the_reversed_covariances() {
        let [w, x, y, z] = [0.7, -0.2, 0.5, 0.4];
        let covariance = |[w, x, y, z]: [f64; 4]| {
            let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
            let scales = DMat3::from_diagonal(DVec3::new(1.0, 4.0, 9.0));
            rotation * scales * rotation.transpose()
        };
        for flip in all_flips() {
            let reversal = DMat3::from_diagonal(flip.signs.map(f64::from).into());
            let expected = reversal * covariance([w, x, y, z]) * reversal;
            let found = covariance(flip.quat([w, x, y, z]));
            assert!(found.abs_diff_eq(expected, 1e-14), "{flip:?}");
        }
    }
}
