//! Input of a check: a scene, its cameras, and a loss.

use std::path::PathBuf;

use splat_ops::{CameraModel, ImageSize, Lens, ProjectSettings, RasterizeSettings};

/// A row-major tensor on the host, in double precision.
#[derive(Debug, Clone, PartialEq)]
pub struct Array {
    /// Lengths of the dimensions.
    pub shape: Vec<usize>,
    /// Elements, the last dimension fastest.
    pub values: Vec<f64>,
}

impl Array {
    /// All zeros.
    pub fn zeros(shape: &[usize]) -> Self {
        Self {
            shape: shape.to_vec(),
            values: vec![0.0; shape.iter().product()],
        }
    }

    /// Root mean square of the elements; 0 if there are none.
    pub fn rms(&self) -> f64 {
        if self.values.is_empty() {
            return 0.0;
        }
        (self.values.iter().map(|v| v * v).sum::<f64>() / self.values.len() as f64).sqrt()
    }
}

/// The differentiable inputs of a fixture, or their gradients.
#[derive(Debug, Clone, PartialEq)]
pub struct Inputs {
    /// `[N, 3]`, world space.
    pub means: Array,
    /// `[N, 4]`, (w, x, y, z), not normalised.
    pub quats: Array,
    /// `[N, 3]`, linear.
    pub scales: Array,
    /// `[N]`.
    pub opacities: Array,
    /// `[N, K, 3]` with K >= (degree + 1)^2.
    pub sh_coeffs: Array,
    /// `[4, 4]` or `[C, 4, 4]`, world to camera.
    pub viewmat: Array,
    /// `[4]` or `[C, 4]`: fx, fy, cx, cy in pixels.
    pub intrinsics: Array,
    /// `[3]`.
    pub background: Array,
    /// `[K]` or `[C, K]`: coefficients of the lens; `None` for a pinhole.
    pub distortion: Option<Array>,
}

/// Images of a fixture, or their upstream gradients; with a leading C if the viewmat has it.
#[derive(Debug, Clone, PartialEq)]
pub struct Outputs {
    /// `[H, W, 3]`.
    pub image: Array,
    /// `[H, W, 1]`.
    pub alpha: Array,
    /// `[H, W, 1]`, accumulated depth: camera z, or the distance for a fisheye. Present if the
    /// fixture has a depth loss or image.
    pub depth: Option<Array>,
}

/// A scene, its cameras, and the gradients of a loss with respect to the images.
#[derive(Debug, Clone)]
pub struct Scene {
    /// File or case of origin, for messages.
    pub source: PathBuf,
    /// C.
    pub cameras: usize,
    /// N.
    pub gaussians: usize,
    /// Size of the image.
    pub size: ImageSize,
    /// Degree of spherical harmonics to evaluate.
    pub sh_degree: usize,
    /// True if opacities are multiplied by the compensation of the low-pass filter.
    pub antialias: bool,
    /// Camera model.
    pub model: CameraModel,
    /// Largest radius or angle and radius of the clamp, one pair per camera; empty for a pinhole.
    pub domain: Vec<f64>,
    /// Settings of the projection.
    pub project: ProjectSettings,
    /// Settings of the rasteriser.
    pub rasterize: RasterizeSettings,
    /// Gaussians and cameras.
    pub inputs: Inputs,
    /// Gradients of the loss with respect to the images.
    pub upstream: Outputs,
    /// Whether the absolute gradients of the screen means are wanted too.
    pub absgrad: bool,
}

impl Scene {
    /// The lens of every camera.
    pub(crate) fn lenses(&self) -> Vec<Lens> {
        let values = self.inputs.distortion.as_ref().map(|array| &array.values);
        let k = self.model.coefficients();
        let lens = |camera: usize| {
            let coefficients = values?.get(k * camera..k * (camera + 1))?;
            Lens::new(self.model, coefficients)
        };
        let cameras = 0..self.cameras;
        cameras
            .map(|camera| lens(camera).unwrap_or_default())
            .collect()
    }

    /// Domains of the lenses by their definition, as [`Scene::domain`] has them.
    pub(crate) fn defined_domain(&self) -> Vec<f64> {
        if self.model == CameraModel::Pinhole {
            return vec![];
        }
        let intrinsics = self.inputs.intrinsics.values.as_chunks::<4>().0;
        let lenses = self.lenses().into_iter().zip(intrinsics);
        lenses
            .map(|(lens, intrinsics)| lens.domain(*intrinsics, self.size))
            .flat_map(|domain| [domain.limit, domain.clamp])
            .collect()
    }
}

/// Position in every dimension of a flat index into a row-major array.
pub(crate) fn index_of(mut flat: usize, shape: &[usize]) -> Vec<usize> {
    let mut index = vec![0; shape.len()];
    for (place, length) in index.iter_mut().zip(shape).rev() {
        *place = flat % length.max(&1);
        flat /= length.max(&1);
    }
    index
}
