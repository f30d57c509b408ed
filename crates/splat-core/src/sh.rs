//! Real spherical harmonics in the basis of 3DGS.
//!
//! Each constant is the shortest decimal that identifies its f64; single precision rounds it.

/// Highest degree of spherical harmonics.
pub const SH_DEGREE_MAX: usize = 3;

/// Constant basis function of degree 0, `1 / (2 sqrt(pi))`.
pub const SH_C0: f64 = 0.282_094_791_773_878_14;

/// Factor of the three functions of degree 1.
pub const SH_C1: f64 = 0.488_602_511_902_919_9;

/// Factors of the functions of degree 2: xy, yz and xz; 2 zz - xx - yy; xx - yy.
pub const SH_C2: [f64; 3] = [
    1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    0.546_274_215_296_039_6,
];

/// Factors of the functions of degree 3: y (3 xx - yy) and x (xx - 3 yy); xyz; y and x (4 zz - xx -
/// yy); z (2 zz - 3 xx - 3 yy); z (xx - yy).
pub const SH_C3: [f64; 5] = [
    0.590_043_589_926_643_5,
    2.890_611_442_640_554,
    0.457_045_799_464_465_8,
    0.373_176_332_590_115_4,
    1.445_305_721_320_277,
];

/// Number of basis functions up to a degree: `(degree + 1)^2`.
pub const fn sh_coefficient_count(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// The degree that has so many basis functions beyond that of degree 0: 0, 3, 8 or 15. `None` for
/// another number.
pub const fn sh_degree_of(rest: usize) -> Option<usize> {
    match rest {
        0 => Some(0),
        3 => Some(1),
        8 => Some(2),
        15 => Some(3),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn degrees_follow_from_their_numbers_of_coefficients() {
        let found: [_; 17] = core::array::from_fn(sh_degree_of);
        for degree in 0..=SH_DEGREE_MAX {
            assert_eq!(found[sh_coefficient_count(degree) - 1], Some(degree));
        }
        assert_eq!(found.iter().flatten().count(), SH_DEGREE_MAX + 1);
    }
}
