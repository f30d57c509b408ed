//! Random scenes, with their images and gradients through the public ops.

use burn::tensor::{DType, Device, Tensor, TensorData};
use burn_splat::ops::{
    ImageSize, ProjectSettings, Projected, RasterizeSettings, project, rasterize,
    spherical_harmonics,
};
use glam::{DMat4, DQuat, DVec3};
use proptest::collection::vec;
use proptest::prelude::*;

use super::support::weights;

/// Six tiles, four of them cut by the border.
pub const SIZE: ImageSize = ImageSize {
    width: 40,
    height: 24,
};
pub const PIXELS: usize = 40 * 24;

/// Degree 3 coefficients per Gaussian.
pub const COEFFS: usize = 16 * 3;

/// N Gaussians and a camera.
#[derive(Debug, Clone)]
pub struct Scene {
    /// `[N, 3]`.
    pub means: Vec<f64>,
    /// `[N, 4]`, (w, x, y, z).
    pub quats: Vec<f64>,
    /// `[N, 3]`.
    pub scales: Vec<f64>,
    /// `[N]`.
    pub opacities: Vec<f64>,
    /// `[N, 16, 3]`.
    pub coeffs: Vec<f64>,
    /// World to camera.
    pub viewmat: DMat4,
    pub intrinsics: [f64; 4],
    pub background: [f64; 3],
    pub sh_degree: usize,
    pub near: f64,
    pub far: f64,
}

/// The image of a scene, and the gradients of a weighted sum over it, shaped as in [`Scene`].
pub struct Outcome {
    pub image: Vec<f64>,
    pub alpha: Vec<f64>,
    pub means: Vec<f64>,
    pub quats: Vec<f64>,
    pub scales: Vec<f64>,
    pub opacities: Vec<f64>,
    pub coeffs: Vec<f64>,
    /// Row-major.
    pub viewmat: Vec<f64>,
    pub intrinsics: Vec<f64>,
    pub background: Vec<f64>,
}

impl Scene {
    pub fn len(&self) -> usize {
        self.opacities.len()
    }

    pub fn project_settings(&self) -> ProjectSettings {
        ProjectSettings {
            near: self.near,
            far: self.far,
            ..ProjectSettings::default()
        }
    }

    /// Screen splats, without gradients.
    pub fn project(&self, dtype: DType) -> Projected {
        let to = Upload { dtype };
        let n = self.len();
        project(
            to.constant(&self.means, [n, 3]),
            to.constant(&self.quats, [n, 4]),
            to.constant(&self.scales, [n, 3]),
            to.constant(&rows(self.viewmat), [1, 4, 4]),
            to.constant(&self.intrinsics, [1, 4]),
            SIZE,
            &self.project_settings(),
        )
        .expect("shapes fit")
    }

    /// Runs all three ops, forward and backward.
    pub fn run(&self, dtype: DType) -> Outcome {
        let to = Upload { dtype };
        let n = self.len();
        let means = to.leaf::<2>(&self.means, [n, 3]);
        let quats = to.leaf::<2>(&self.quats, [n, 4]);
        let scales = to.leaf::<2>(&self.scales, [n, 3]);
        let opacities = to.leaf::<1>(&self.opacities, [n]);
        let coeffs = to.leaf::<3>(&self.coeffs, [n, 16, 3]);
        let viewmats = to.leaf::<3>(&rows(self.viewmat), [1, 4, 4]);
        let intrinsics = to.leaf::<2>(&self.intrinsics, [1, 4]);
        let background = to.leaf::<2>(&self.background, [1, 3]);

        let projected = project(
            means.clone(),
            quats.clone(),
            scales.clone(),
            viewmats.clone(),
            intrinsics.clone(),
            SIZE,
            &self.project_settings(),
        )
        .expect("shapes fit");
        let rotation = viewmats.clone().narrow(1, 0, 3).narrow(2, 0, 3);
        let translation = viewmats.clone().narrow(1, 0, 3).narrow(2, 3, 1);
        let centre = (rotation * translation).sum_dim(1).neg(); // [1, 1, 3]
        let dirs = means.clone().reshape([1, n, 3]) - centre.repeat_dim(1, n);
        let colors =
            spherical_harmonics(coeffs.clone(), dirs, self.sh_degree).expect("shapes fit") + 0.5;
        let rendered = rasterize(
            &projected,
            colors,
            opacities.clone(),
            Some(background.clone()),
            &RasterizeSettings::default(),
        )
        .expect("shapes fit");
        let loss = (rendered.packed() * to.constant(&weights(PIXELS * 4), [1, 24, 40, 4])).sum();
        let grads = loss.backward();
        Outcome {
            image: host(rendered.image()),
            alpha: host(rendered.alpha()),
            means: host(means.grad(&grads).expect("tracked")),
            quats: host(quats.grad(&grads).expect("tracked")),
            scales: host(scales.grad(&grads).expect("tracked")),
            opacities: host(opacities.grad(&grads).expect("tracked")),
            coeffs: host(coeffs.grad(&grads).expect("tracked")),
            viewmat: host(viewmats.grad(&grads).expect("tracked")),
            intrinsics: host(intrinsics.grad(&grads).expect("tracked")),
            background: host(background.grad(&grads).expect("tracked")),
        }
    }
}

/// Creates tensors on the CPU from values in double precision.
#[derive(Clone, Copy)]
pub struct Upload {
    pub dtype: DType,
}

impl Upload {
    pub fn constant<const D: usize>(self, values: &[f64], shape: [usize; D]) -> Tensor<D> {
        let device = Device::flex().autodiff();
        Tensor::from_data(
            TensorData::new(values.to_vec(), shape),
            (&device, self.dtype),
        )
    }

    pub fn leaf<const D: usize>(self, values: &[f64], shape: [usize; D]) -> Tensor<D> {
        self.constant(values, shape).require_grad()
    }
}

pub fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.try_into_vec_as().expect("a float tensor")
}

/// A matrix in row-major order, as in the ops.
pub fn rows(matrix: DMat4) -> Vec<f64> {
    matrix.transpose().to_cols_array().to_vec()
}

/// A quaternion (w, x, y, z), not normalised.
pub fn quat([w, x, y, z]: [f64; 4]) -> DQuat {
    DQuat::from_xyzw(x, y, z, w)
}

/// A random rotation, as a unit quaternion.
pub fn rotations() -> impl Strategy<Value = DQuat> {
    quats().prop_map(|q| quat(q).normalize())
}

/// Quaternions (w, x, y, z) of lengths 0.1 to 2.
fn quats() -> impl Strategy<Value = [f64; 4]> {
    proptest::array::uniform4(-1.0..1.0).prop_filter("too short", |q| quat(*q).length() > 0.1)
}

pub fn vectors(reach: f64) -> impl Strategy<Value = DVec3> {
    proptest::array::uniform3(-reach..reach).prop_map(DVec3::from_array)
}

/// A Gaussian, described by where the camera sees it.
#[derive(Debug, Clone)]
struct Seen {
    /// Position in the image, from -1 to 1.
    at: [f64; 2],
    /// Camera z is `1.5 + 0.4 (depth rank) + nudge`.
    nudge: f64,
    quat: [f64; 4],
    scale: [f64; 3],
    opacity: f64,
    coeffs: Vec<f64>,
}

/// Some outside the image, some beyond the clamp, some above the cap of alpha, some below the cut;
/// one to thirty pixels wide.
fn seen() -> impl Strategy<Value = Seen> {
    let at = prop_oneof![2 => -0.5..0.5, 1 => -2.0..2.0];
    let at = proptest::array::uniform2(at);
    let scale = proptest::array::uniform3((0.02f64.ln()..0.8f64.ln()).prop_map(f64::exp));
    let opacity = prop_oneof![1 => 0.002..0.1, 3 => 0.1..0.9, 3 => 0.99..1.0];
    let coeffs = vec(-0.5..0.5, COEFFS);
    (at, 0.0..0.3, quats(), scale, opacity, coeffs).prop_map(
        |(at, nudge, quat, scale, opacity, coeffs)| Seen {
            at,
            nudge,
            quat,
            scale,
            opacity,
            coeffs,
        },
    )
}

/// Thresholds of the rasteriser that many pixels meet, and the default ones.
pub fn thresholds() -> impl Strategy<Value = RasterizeSettings> {
    let any = (0.002..0.05, 0.5..0.95, 0.005..0.1).prop_map(
        |(alpha_min, alpha_max, transmittance_min)| RasterizeSettings {
            alpha_min,
            alpha_max,
            transmittance_min,
            ..RasterizeSettings::default()
        },
    );
    prop_oneof![3 => any, 1 => Just(RasterizeSettings::default())]
}

/// Scenes of `count` Gaussians at depths at least 0.1 apart, in random order, in front of a random
/// camera.
pub fn scenes(count: core::ops::RangeInclusive<usize>) -> impl Strategy<Value = Scene> {
    count.prop_flat_map(|count| {
        (
            vec(seen(), count),
            Just((0..count).collect::<Vec<_>>()).prop_shuffle(),
            rotations(),
            vectors(3.0),
            (25.0..60.0, 25.0..60.0, 15.0..25.0, 8.0..16.0),
            proptest::array::uniform3(-1.0..1.0),
        )
            .prop_map(
                |(seen, places, rotation, translation, (fx, fy, cx, cy), background)| {
                    let mut scene = Scene {
                        means: Vec::new(),
                        quats: Vec::new(),
                        scales: Vec::new(),
                        opacities: Vec::new(),
                        coeffs: Vec::new(),
                        viewmat: DMat4::from_rotation_translation(rotation, translation),
                        intrinsics: [fx, fy, cx, cy],
                        background,
                        sh_degree: 3,
                        near: 0.5,
                        far: 50.0,
                    };
                    for (gaussian, place) in seen.into_iter().zip(places) {
                        let z = 1.5 + 0.4 * place as f64 + gaussian.nudge;
                        let x = gaussian.at[0] * z * 20.0 / fx;
                        let y = gaussian.at[1] * z * 12.0 / fy;
                        let mean = rotation.inverse() * (DVec3::new(x, y, z) - translation);
                        scene.means.extend(mean.to_array());
                        scene.quats.extend(gaussian.quat);
                        scene.scales.extend(gaussian.scale);
                        scene.opacities.push(gaussian.opacity);
                        scene.coeffs.extend(gaussian.coeffs);
                    }
                    scene
                },
            )
    })
}
