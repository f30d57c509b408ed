//! Builds scenes by appearance: splats are placed at a pixel and a depth, and sized in pixels.

use glam::{DMat3, DMat4, DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use splat_ops::{ImageSize, Lens, ProjectSettings, RasterizeSettings};

use crate::gradcheck::{Array, Inputs, Outputs, Scene};

/// Value of the constant spherical harmonic.
const SH_C0: f64 = 0.282_094_791_773_878_14;

/// One Gaussian of a sketch.
#[derive(Debug, Clone)]
pub(crate) struct Blob {
    /// Centre in the world.
    pub mean: DVec3,
    /// (w, x, y, z)
    pub quat: [f64; 4],
    /// Standard deviations in the world.
    pub scale: [f64; 3],
    pub opacity: f64,
    /// 16 coefficients of three channels.
    pub sh: [[f64; 3]; 16],
}

/// A scene under construction: a camera with splats in front of it.
pub(crate) struct Sketch {
    pub name: &'static str,
    pub size: ImageSize,
    /// fx, fy, cx, cy.
    pub intrinsics: [f64; 4],
    /// A pinhole unless set, before splats are placed.
    pub lens: Lens,
    pub viewmat: DMat4,
    pub sh_degree: usize,
    pub antialias: bool,
    pub project: ProjectSettings,
    pub rasterize: RasterizeSettings,
    pub background: [f64; 3],
    pub depth_loss: bool,
    pub blobs: Vec<Blob>,
    pub rng: Pcg64Mcg,
}

impl Sketch {
    /// An empty scene with a camera at the world's origin; the focal length is a power of two, the
    /// principal point in the middle.
    pub fn new(name: &'static str, width: u32, height: u32, seed: u64) -> Self {
        let focal = f64::from(width.max(height)).log2().round().exp2();
        Self {
            name,
            size: ImageSize { width, height },
            intrinsics: [
                focal,
                focal,
                f64::from(width) / 2.0,
                f64::from(height) / 2.0,
            ],
            lens: Lens::Pinhole,
            viewmat: DMat4::IDENTITY,
            sh_degree: 1,
            antialias: false,
            project: ProjectSettings::default(),
            rasterize: RasterizeSettings::default(),
            background: [0.2, 0.5, 0.3],
            depth_loss: false,
            blobs: vec![],
            rng: Pcg64Mcg::seed_from_u64(seed),
        }
    }

    /// Rotates and shifts the camera a little. Call it before placing splats.
    pub fn tilted(mut self) -> Self {
        let axis = DVec3::from_array(std::array::from_fn(|_| self.uniform(-1.0, 1.0)));
        let angle = self.uniform(0.1, 0.4);
        let shift = DVec3::from_array(std::array::from_fn(|_| self.uniform(-0.5, 0.5)));
        let rotation = DMat3::from_quat(DQuat::from_axis_angle(axis.normalize(), angle));
        // The camera is the single-precision one.
        let mut viewmat = DMat4::from_mat3(rotation);
        viewmat.w_axis = shift.extend(1.0);
        self.viewmat = DMat4::from_cols_array(&viewmat.to_cols_array().map(rounded));
        self
    }

    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.rng.random_range(low..high)
    }

    /// The world point seen at `pixel` and depth `depth`.
    ///
    /// # Panics
    /// When the lens sees nothing at that pixel.
    pub fn at(&self, pixel: [f64; 2], depth: f64) -> DVec3 {
        let [fx, fy, cx, cy] = self.intrinsics;
        let point = [(pixel[0] - cx) / fx, (pixel[1] - cy) / fy];
        let direction = self
            .lens
            .undistort(point)
            .expect("a pixel inside of the lens's domain");
        let seen = DVec3::from(direction) * depth;
        self.viewmat.inverse().transform_point3(seen)
    }

    /// Random coefficients for a base colour in [0.15, 1].
    pub fn colors(&mut self) -> [[f64; 3]; 16] {
        let mut sh = [[0.0; 3]; 16];
        for (k, coefficient) in sh.iter_mut().enumerate() {
            for value in coefficient {
                *value = if k == 0 {
                    (self.uniform(0.15, 1.0) - 0.5) / SH_C0
                } else {
                    self.uniform(-0.1, 0.1)
                };
            }
        }
        sh
    }

    /// A random unit quaternion.
    pub fn turn(&mut self) -> [f64; 4] {
        loop {
            let q: [f64; 4] = std::array::from_fn(|_| self.uniform(-1.0, 1.0));
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            if (0.2..1.0).contains(&length) {
                return q.map(|x| x / length);
            }
        }
    }

    /// Adds a splat with random colours at a pixel, with axes in pixels at its depth.
    pub fn splat(
        &mut self,
        pixel: [f64; 2],
        depth: f64,
        axes: [f64; 3],
        quat: [f64; 4],
        opacity: f64,
    ) -> &mut Blob {
        let blob = Blob {
            mean: self.at(pixel, depth),
            quat,
            scale: axes.map(|axis| axis * depth.abs() / self.intrinsics[0]),
            opacity,
            sh: self.colors(),
        };
        self.blobs.push(blob);
        let last = self.blobs.len() - 1;
        &mut self.blobs[last]
    }

    /// Adds `count` random splats over the whole image, with axes of 1 to 4 pixels, well separated
    /// in depth.
    pub fn scatter(&mut self, count: usize, opacity: (f64, f64)) {
        let (width, height) = (f64::from(self.size.width), f64::from(self.size.height));
        let mut depths: Vec<f64> = (0..count)
            .map(|i| 2.0 + 4.0 * (i as f64 + 0.5) / count as f64)
            .collect();
        for i in (1..count).rev() {
            let j = self.rng.random_range(0..=i);
            depths.swap(i, j);
        }
        for depth in depths {
            let pixel = [
                self.uniform(0.05, 0.95) * width,
                self.uniform(0.05, 0.95) * height,
            ];
            let axes = std::array::from_fn(|_| self.uniform(1.0, 4.0));
            let quat = self.turn();
            let opacity = self.uniform(opacity.0, opacity.1);
            self.splat(pixel, depth, axes, quat, opacity);
        }
    }

    /// The scene, with every value rounded to single precision and random upstream gradients.
    pub fn scene(mut self) -> Scene {
        let n = self.blobs.len();
        let (h, w) = (self.size.height as usize, self.size.width as usize);
        let mut upstream = |channels: usize| Array {
            shape: vec![h, w, channels],
            values: (0..h * w * channels)
                .map(|_| rounded(self.rng.random_range(-1.0..1.0)))
                .collect(),
        };
        let (image, alpha) = (upstream(3), upstream(1));
        let depth = self.depth_loss.then(|| upstream(1));
        let blobs = &self.blobs;
        let gather = |shape: Vec<usize>, values: Vec<f64>| Array {
            shape,
            values: values.into_iter().map(rounded).collect(),
        };
        let rows = self.viewmat.transpose().to_cols_array();
        let distortion = self.lens.coefficients().to_vec();
        let mut scene = Scene {
            source: self.name.into(),
            cameras: 1,
            gaussians: n,
            size: self.size,
            sh_degree: self.sh_degree,
            antialias: self.antialias,
            model: self.lens.model(),
            domain: vec![],
            project: self.project,
            rasterize: self.rasterize,
            inputs: Inputs {
                means: gather(
                    vec![n, 3],
                    blobs.iter().flat_map(|b| b.mean.to_array()).collect(),
                ),
                quats: gather(vec![n, 4], blobs.iter().flat_map(|b| b.quat).collect()),
                scales: gather(vec![n, 3], blobs.iter().flat_map(|b| b.scale).collect()),
                opacities: gather(vec![n], blobs.iter().map(|b| b.opacity).collect()),
                sh_coeffs: gather(
                    vec![n, 16, 3],
                    blobs
                        .iter()
                        .flat_map(|b| b.sh.into_iter().flatten())
                        .collect(),
                ),
                viewmat: gather(vec![4, 4], rows.to_vec()),
                intrinsics: gather(vec![4], self.intrinsics.to_vec()),
                background: gather(vec![3], self.background.to_vec()),
                distortion: (!distortion.is_empty())
                    .then(|| gather(vec![distortion.len()], distortion)),
            },
            upstream: Outputs {
                image,
                alpha,
                depth,
            },
            absgrad: true,
        };
        // Of the rounded coefficients.
        scene.domain = scene.defined_domain().into_iter().map(rounded).collect();
        scene
    }
}

/// Rounds to single precision.
pub(super) fn rounded(value: f64) -> f64 {
    f64::from(value as f32)
}

/// A rotation about the camera's axis.
pub(super) fn about_z(angle: f64) -> [f64; 4] {
    [(angle / 2.0).cos(), 0.0, 0.0, (angle / 2.0).sin()]
}

/// The next larger and the next smaller f32.
pub(crate) fn neighbours(value: f64) -> [f64; 2] {
    let value = value as f32;
    [f64::from(value.next_down()), f64::from(value.next_up())]
}
