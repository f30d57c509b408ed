//! Real spherical harmonics in the basis of 3DGS.

/// Highest degree of spherical harmonics.
pub const SH_DEGREE_MAX: usize = 3;

/// Constant basis function of degree 0, `1 / (2 sqrt(pi))`.
pub const SH_C0: f64 = 0.282_094_791_773_878_14;

/// Number of basis functions up to a degree: `(degree + 1)^2`.
pub const fn sh_coefficient_count(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}
