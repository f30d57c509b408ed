//! Rotation by a quaternion (w, x, y, z) of any length, and its vector-Jacobian product.

use cubecl::prelude::*;

use super::{Mat3, Vec3};

/// A quaternion w + xi + yj + zk.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Quat {
    /// Real part.
    pub w: f32,
    /// Coefficient of i.
    pub x: f32,
    /// Coefficient of j.
    pub y: f32,
    /// Coefficient of k.
    pub z: f32,
}

#[cube]
impl Quat {
    /// The quaternion (w, x, y, z).
    pub fn new(w: f32, x: f32, y: f32, z: f32) -> Quat {
        Quat { w, x, y, z }
    }

    /// Components `at` to `at + 3` of `from`.
    pub fn load(from: &[f32], at: usize) -> Quat {
        Quat {
            w: from[at],
            x: from[at + 1],
            y: from[at + 2],
            z: from[at + 3],
        }
    }

    /// Writes the components to `at` to `at + 3` of `to`.
    pub fn store(self, to: &mut [f32], at: usize) {
        to[at] = self.w;
        to[at + 1] = self.x;
        to[at + 2] = self.y;
        to[at + 3] = self.z;
    }

    /// Scalar product.
    pub fn dot(self, other: Quat) -> f32 {
        self.w * other.w + self.x * other.x + self.y * other.y + self.z * other.z
    }

    /// Largest magnitude of a component.
    pub fn max_abs(self) -> f32 {
        max(
            max(f32::abs(self.w), f32::abs(self.x)),
            max(f32::abs(self.y), f32::abs(self.z)),
        )
    }

    /// Length, without overflow or underflow of the squares. 0 for the zero quaternion.
    pub fn length(self) -> f32 {
        let largest = self.max_abs();
        let mut length = 0.0f32;
        if largest > 0.0f32 {
            let scaled = self.div(largest);
            length = largest * f32::sqrt(scaled.dot(scaled));
        }
        length
    }

    /// self / divisor
    pub fn div(self, divisor: f32) -> Quat {
        Quat {
            w: self.w / divisor,
            x: self.x / divisor,
            y: self.y / divisor,
            z: self.z / divisor,
        }
    }

    /// q / |q|, computed from q / max|qᵢ| so that the squares neither overflow nor underflow.
    pub fn normalize(self) -> Quat {
        let scaled = self.div(self.max_abs());
        scaled.div(f32::sqrt(scaled.dot(scaled)))
    }

    /// The rotation matrix of a unit quaternion.
    pub fn to_matrix(self) -> Mat3 {
        let Quat { w, x, y, z } = self;
        Mat3 {
            r0: Vec3::new(
                1.0f32 - 2.0f32 * (y * y + z * z),
                2.0f32 * (x * y - w * z),
                2.0f32 * (x * z + w * y),
            ),
            r1: Vec3::new(
                2.0f32 * (x * y + w * z),
                1.0f32 - 2.0f32 * (x * x + z * z),
                2.0f32 * (y * z - w * x),
            ),
            r2: Vec3::new(
                2.0f32 * (x * z - w * y),
                2.0f32 * (y * z + w * x),
                1.0f32 - 2.0f32 * (x * x + y * y),
            ),
        }
    }

    /// Vector-Jacobian product of [`Quat::to_matrix`]: gradient of the unit quaternion from that of
    /// the matrix.
    pub fn to_matrix_vjp(self, grad: Mat3) -> Quat {
        let Quat { w, x, y, z } = self;
        // Antisymmetric and symmetric parts of the gradient.
        let a21 = grad.r2.y - grad.r1.z;
        let a02 = grad.r0.z - grad.r2.x;
        let a10 = grad.r1.x - grad.r0.y;
        let s01 = grad.r0.y + grad.r1.x;
        let s02 = grad.r0.z + grad.r2.x;
        let s12 = grad.r1.z + grad.r2.y;
        let g00 = grad.r0.x;
        let g11 = grad.r1.y;
        let g22 = grad.r2.z;
        Quat {
            w: 2.0f32 * (x * a21 + y * a02 + z * a10),
            x: 2.0f32 * (y * s01 + z * s02 + w * a21 - 2.0f32 * x * (g11 + g22)),
            y: 2.0f32 * (x * s01 + z * s12 + w * a02 - 2.0f32 * y * (g00 + g22)),
            z: 2.0f32 * (x * s02 + y * s12 + w * a10 - 2.0f32 * z * (g00 + g11)),
        }
    }

    /// Vector-Jacobian product of [`Quat::normalize`] at the unit quaternion `self` = q / |q|: (g -
    /// self (self · g)) / |q|.
    pub fn normalize_vjp(self, length: f32, grad: Quat) -> Quat {
        let radial = self.dot(grad);
        Quat {
            w: (grad.w - self.w * radial) / length,
            x: (grad.x - self.x * radial) / length,
            y: (grad.y - self.y * radial) / length,
            z: (grad.z - self.z * radial) / length,
        }
    }
}
