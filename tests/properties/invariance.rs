//! Changes that leave the image unchanged, and their effect on the gradients.
//!
//! Double precision, unless bits are compared. Tolerances are relative L2 errors per tensor, ten to
//! sixty times the largest error measured over these cases.

use burn::tensor::DType;
use glam::{DMat4, DVec3};
use proptest::prelude::*;

use super::scene::{COEFFS, Outcome, Scene, quat, rotations, rows, scenes, vectors};
use super::support::{close, config, identical, map_rows, norm, reorder};

/// Compares every image and gradient of `a` with that of `b`.
fn all_close(a: &Outcome, b: &Outcome, tolerance: f64) -> Result<(), TestCaseError> {
    close("image", &a.image, &b.image, tolerance)?;
    close("alpha", &a.alpha, &b.alpha, tolerance)?;
    close("means", &a.means, &b.means, tolerance)?;
    close("quats", &a.quats, &b.quats, tolerance)?;
    close("scales", &a.scales, &b.scales, tolerance)?;
    close("opacities", &a.opacities, &b.opacities, tolerance)?;
    close("coeffs", &a.coeffs, &b.coeffs, tolerance)?;
    close("viewmat", &a.viewmat, &b.viewmat, tolerance)?;
    close("intrinsics", &a.intrinsics, &b.intrinsics, tolerance)?;
    close("background", &a.background, &b.background, tolerance)
}

proptest! {
    #![proptest_config(config(48))]

    /// q and k q are the same rotation for every k but 0: the image is the same, the gradient is
    /// divided by k, and none of it is along q.
    #[test]
    fn quaternion_sign_and_length_change_nothing(
        scene in scenes(1..=8),
        length in 0.1..10.0f64,
        negative: bool,
    ) {
        let factor = if negative { -length } else { length };
        let plain = scene.run(DType::F64);
        let mut other = Scene {
            quats: scene.quats.iter().map(|q| q * factor).collect(),
            ..scene.clone()
        }
        .run(DType::F64);
        for (q, g) in scene.quats.chunks_exact(4).zip(plain.quats.chunks_exact(4)) {
            let radial: f64 = q.iter().zip(g).map(|(q, g)| q * g).sum();
            prop_assert!(radial.abs() <= 1e-13 * norm(q) * norm(&plain.quats), "{radial} along {q:?}");
        }
        other.quats.iter_mut().for_each(|g| *g *= factor);
        all_close(&other, &plain, 1e-12)?;
    }

    /// The order of Gaussians at different depths is irrelevant: same bits in single precision.
    /// Only sums over Gaussians (the camera's gradient) are in another order.
    #[test]
    fn permuting_gaussians_changes_no_bit(
        (scene, order) in scenes(2..=12).prop_flat_map(|scene| {
            let order: Vec<usize> = (0..scene.len()).collect();
            (Just(scene), Just(order).prop_shuffle())
        }),
    ) {
        let plain = scene.run(DType::F32);
        let other = Scene {
            means: reorder(&scene.means, 3, &order),
            quats: reorder(&scene.quats, 4, &order),
            scales: reorder(&scene.scales, 3, &order),
            opacities: reorder(&scene.opacities, 1, &order),
            coeffs: reorder(&scene.coeffs, COEFFS, &order),
            ..scene.clone()
        }
        .run(DType::F32);
        identical("image", &other.image, &plain.image)?;
        identical("alpha", &other.alpha, &plain.alpha)?;
        identical("means", &other.means, &reorder(&plain.means, 3, &order))?;
        identical("quats", &other.quats, &reorder(&plain.quats, 4, &order))?;
        identical("scales", &other.scales, &reorder(&plain.scales, 3, &order))?;
        identical("opacities", &other.opacities, &reorder(&plain.opacities, 1, &order))?;
        identical("coeffs", &other.coeffs, &reorder(&plain.coeffs, COEFFS, &order))?;
        identical("background", &other.background, &plain.background)?;
        close("viewmat", &other.viewmat, &plain.viewmat, 1e-5)?;
        close("intrinsics", &other.intrinsics, &plain.intrinsics, 1e-5)?;
    }

    /// Moving the world by M, with the camera (viewmat M^-1), shows the same image. Only degree 0
    /// of the spherical harmonics is used, as higher degrees are fixed to the world's axes and
    /// would rotate.
    #[test]
    fn moving_world_and_camera_together_changes_nothing(
        scene in scenes(1..=8),
        turn in rotations(),
        shift in vectors(5.0),
    ) {
        let scene = Scene { sh_degree: 0, ..scene };
        let motion = DMat4::from_rotation_translation(turn, shift);
        let plain = scene.run(DType::F64);
        let moved = Scene {
            means: map_rows(&scene.means, |m| motion.transform_point3(m.into()).to_array()),
            quats: map_rows(&scene.quats, |q| times(turn, q)),
            viewmat: scene.viewmat * motion.inverse(),
            ..scene.clone()
        }
        .run(DType::F64);

        // L(V) = L'(V M^-1): the gradient G' of V' = V M^-1 is G M^T.
        let gradient = DMat4::from_cols_slice(&plain.viewmat).transpose();
        let expected = Outcome {
            means: map_rows(&plain.means, |g| (turn * DVec3::from(g)).to_array()),
            quats: map_rows(&plain.quats, |g| times(turn, g)),
            viewmat: rows(gradient * motion.transpose()),
            ..plain
        };
        all_close(&moved, &expected, 1e-11)?;
    }

    /// Scaling the world, its Gaussians, the camera's position and the near and far planes by k
    /// shows the same image; gradients with respect to lengths are divided by k.
    #[test]
    fn scaling_everything_changes_nothing(scene in scenes(1..=8), log_factor in -7.0..7.0f64) {
        let factor = log_factor.exp();
        let scaled = |values: &[f64]| values.iter().map(|v| v * factor).collect::<Vec<_>>();
        let plain = scene.run(DType::F64);
        let mut viewmat = scene.viewmat;
        viewmat.w_axis = (viewmat.w_axis.truncate() * factor).extend(1.0);
        let mut large = Scene {
            means: scaled(&scene.means),
            scales: scaled(&scene.scales),
            viewmat,
            near: scene.near * factor,
            far: scene.far * factor,
            ..scene
        }
        .run(DType::F64);
        large.means = scaled(&large.means);
        large.scales = scaled(&large.scales);
        for row in large.viewmat.chunks_exact_mut(4) {
            row[3] *= factor;
        }
        all_close(&large, &plain, 1e-11)?;
    }
}

/// Product of a rotation and a quaternion (w, x, y, z). Linear and orthogonal in the second, so
/// that it moves gradients like quaternions.
fn times(turn: glam::DQuat, q: [f64; 4]) -> [f64; 4] {
    let product = turn * quat(q);
    [product.w, product.x, product.y, product.z]
}
