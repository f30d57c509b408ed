//! Rigid motions of a camera, smooth at no motion, as tensors and on the host.
//!
//! A motion of six numbers turns by the rotation vector (r1, r2, r3), in radians for small angles,
//! about the point at `length` in front of the camera, and then shifts by `length` times the rest,
//! both in the axes of the camera. With u = r / 2 and K the matrix of the cross product with u, the
//! rotation is Cayley's: `I + 2 (K + K^2) / (1 + |u|^2)`. It is a rotation exactly, for any r, and
//! needs no sine.
//!
//! About its own centre, a turn of the camera moves the picture as a step to the side does, and
//! what tells them apart, the depths, is a small part of both: an optimiser that scales each number
//! by itself would settle where one stands in for the other. About a point in the scene, a turn
//! leaves the middle of the picture in place.

use burn::tensor::Tensor;
use glam::{DMat3, DMat4, DQuat, DVec3};

/// Numbers of a motion.
pub(super) const MOTION: usize = 6;

/// `K`, row by row, of each component of u.
const CROSS: [[f32; 9]; 3] = [
    [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0],
    [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
];

/// View matrices `[1, 4, 4]` after a motion `[1, 6]`.
pub(super) fn moved(viewmats: Tensor<3>, motion: Tensor<2>, length: f64) -> Tensor<3> {
    let device = motion.device();
    let half = motion.clone().narrow(1, 0, 3) / 2.0; // [1, 3]
    let shift = motion.narrow(1, 3, 3) * length;
    let square = half.clone().square().sum_dim(1).add_scalar(1.0); // [1, 1]
    let cross = half.matmul(Tensor::from_floats(CROSS, &device));
    let cross = cross.reshape([1, 3, 3]);
    let turn = (cross.clone() + cross.clone().matmul(cross)) * 2.0;
    let turn = turn / square.reshape([1, 1, 1]).repeat_dim(1, 3).repeat_dim(2, 3);
    let turn = turn + Tensor::<2>::eye(3, &device).unsqueeze();
    // The point p in front comes back to where it was: p - R p.
    let front = Tensor::<3>::from_floats([[[0.0], [0.0], [1.0]]], &device);
    let back = (front - turn.clone().narrow(2, 2, 1)) * length;
    let shift = shift.reshape([1, 3, 1]) + back;
    let rows = Tensor::cat(vec![turn, shift], 2); // [1, 3, 4]
    let last = Tensor::<3>::from_floats([[[0.0, 0.0, 0.0, 1.0]]], &device);
    Tensor::cat(vec![rows, last], 1).matmul(viewmats)
}

/// [`moved`] for one view matrix, in double precision.
pub(super) fn moved_f64(viewmat: DMat4, motion: [f64; MOTION], length: f64) -> DMat4 {
    let [r1, r2, r3, s1, s2, s3] = motion;
    let u = DVec3::new(r1, r2, r3) / 2.0;
    // Columns.
    let cross = DMat3::from_cols(u.cross(DVec3::X), u.cross(DVec3::Y), u.cross(DVec3::Z));
    // `u x e_i` as columns is the matrix of `u x`.
    let turn = DMat3::IDENTITY + (cross + cross * cross) * (2.0 / (1.0 + u.length_squared()));
    let mut rigid = DMat4::from_mat3(turn);
    let back = DVec3::Z - turn.z_axis;
    rigid.w_axis = ((DVec3::new(s1, s2, s3) + back) * length).extend(1.0);
    rigid * viewmat
}

/// The motion after which one view matrix is another.
pub(super) fn motion_between(before: DMat4, after: DMat4, length: f64) -> [f64; MOTION] {
    let rigid = after * before.inverse();
    let turn = DMat3::from_mat4(rigid);
    // Twice the tangent of half the angle, along the axis.
    let quaternion = DQuat::from_mat3(&turn);
    let rotation = quaternion.xyz() * (2.0 / quaternion.w);
    let shift = rigid.w_axis.truncate() / length - (DVec3::Z - turn.z_axis);
    let ([r1, r2, r3], [s1, s2, s3]) = (rotation.to_array(), shift.to_array());
    [r1, r2, r3, s1, s2, s3]
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};

    fn tensor(viewmat: DMat4) -> Tensor<3> {
        let rows = viewmat.transpose().to_cols_array().map(|x| x as f32);
        let data = TensorData::new(rows.to_vec(), [1, 4, 4]);
        Tensor::from_data(data, &Device::flex())
    }

    #[test]
    fn tensors_and_host_agree_and_turns_are_rotations() {
        let start = DMat4::from_rotation_translation(
            glam::DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.7, 1.1),
            DVec3::new(1.0, -2.0, 3.0),
        );
        for motion in [
            [0.0; 6],
            [0.02, -0.5, 0.3, 0.1, 0.2, -0.3],
            [3.0, 1.0, -2.0, 0.0, 0.0, 1.0],
        ] {
            let after = moved_f64(start, motion, 2.5);
            let turn = DMat3::from_mat4(after);
            let off = turn * turn.transpose() - DMat3::IDENTITY;
            assert!(off.to_cols_array().iter().all(|x| x.abs() < 1e-12));
            let found = motion_between(start, after, 2.5);
            assert!(
                found.iter().zip(motion).all(|(a, b)| (a - b).abs() < 1e-12),
                "{found:?} {motion:?}"
            );
            let values = Tensor::<2>::from_floats([motion.map(|x| x as f32)], &Device::flex());
            let rows = moved(tensor(start), values, 2.5).into_data();
            let rows = rows.try_into_vec::<f32>().unwrap();
            for (a, b) in rows.iter().zip(after.transpose().to_cols_array()) {
                assert!((f64::from(*a) - b).abs() < 1e-5, "{motion:?}: {a} {b}");
            }
        }
        assert_eq!(moved_f64(start, [0.0; 6], 1.0), start);
        // A small turn is by its rotation vector.
        let turn = DMat3::from_mat4(moved_f64(
            DMat4::IDENTITY,
            [1e-6, 0.0, 0.0, 0.0, 0.0, 0.0],
            1.0,
        ));
        assert!(((turn * DVec3::Y).z - 1e-6).abs() < 1e-15);
    }
}
