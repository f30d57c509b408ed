//! 3x3 matrices by rows.

use cubecl::prelude::*;

use super::Vec3;

/// A 3x3 matrix.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Mat3 {
    /// First row.
    pub r0: Vec3,
    /// Second row.
    pub r1: Vec3,
    /// Third row.
    pub r2: Vec3,
}

#[cube]
impl Mat3 {
    /// M v
    pub fn mul_vec(self, v: Vec3) -> Vec3 {
        Vec3 {
            x: self.r0.dot(v),
            y: self.r1.dot(v),
            z: self.r2.dot(v),
        }
    }

    /// Mᵀ v, which is also the row vᵀ M.
    pub fn transpose_mul_vec(self, v: Vec3) -> Vec3 {
        self.r0
            .scale(v.x)
            .add(self.r1.scale(v.y))
            .add(self.r2.scale(v.z))
    }
}
