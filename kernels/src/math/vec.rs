//! Three-component vectors.

use cubecl::prelude::*;

use super::is_finite;

/// A vector of three floats.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Vec3 {
    /// First component.
    pub x: f32,
    /// Second component.
    pub y: f32,
    /// Third component.
    pub z: f32,
}

#[cube]
impl Vec3 {
    /// The vector (x, y, z).
    pub fn new(x: f32, y: f32, z: f32) -> Vec3 {
        Vec3 { x, y, z }
    }

    /// Components `at`, `at + 1`, `at + 2` of `from`.
    pub fn load(from: &[f32], at: usize) -> Vec3 {
        Vec3 {
            x: from[at],
            y: from[at + 1],
            z: from[at + 2],
        }
    }

    /// Writes the components to `at`, `at + 1`, `at + 2` of `to`.
    pub fn store(self, to: &mut [f32], at: usize) {
        to[at] = self.x;
        to[at + 1] = self.y;
        to[at + 2] = self.z;
    }

    /// self + other
    pub fn add(self, other: Vec3) -> Vec3 {
        Vec3 {
            x: self.x + other.x,
            y: self.y + other.y,
            z: self.z + other.z,
        }
    }

    /// self - other
    pub fn sub(self, other: Vec3) -> Vec3 {
        Vec3 {
            x: self.x - other.x,
            y: self.y - other.y,
            z: self.z - other.z,
        }
    }

    /// self factor
    pub fn scale(self, factor: f32) -> Vec3 {
        Vec3 {
            x: self.x * factor,
            y: self.y * factor,
            z: self.z * factor,
        }
    }

    /// Component-wise product.
    pub fn mul(self, other: Vec3) -> Vec3 {
        Vec3 {
            x: self.x * other.x,
            y: self.y * other.y,
            z: self.z * other.z,
        }
    }

    /// Scalar product.
    pub fn dot(self, other: Vec3) -> f32 {
        self.x * other.x + self.y * other.y + self.z * other.z
    }

    /// Cross product.
    pub fn cross(self, other: Vec3) -> Vec3 {
        Vec3 {
            x: self.y * other.z - self.z * other.y,
            y: self.z * other.x - self.x * other.z,
            z: self.x * other.y - self.y * other.x,
        }
    }

    /// Largest magnitude of a component.
    pub fn max_abs(self) -> f32 {
        max(max(f32::abs(self.x), f32::abs(self.y)), f32::abs(self.z))
    }

    /// self / divisor; zero if the divisor is zero.
    pub fn over(self, divisor: f32) -> Vec3 {
        let safe = select(divisor == 0.0f32, 1.0f32, divisor);
        Vec3 {
            x: self.x / safe,
            y: self.y / safe,
            z: self.z / safe,
        }
    }

    /// True if no component is infinite or NaN.
    pub fn is_finite(self) -> bool {
        is_finite(self.x) && is_finite(self.y) && is_finite(self.z)
    }
}
