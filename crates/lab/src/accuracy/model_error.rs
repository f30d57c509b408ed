//! Model error, as opposed to rounding error: the deviation of the affine (EWA) projection from the
//! 3D model.
//!
//! The rasteriser draws each Gaussian as a Gaussian on the screen: its density integrated along
//! lines, with the perspective at its mean applied to all of it (3DGS eq. 5; Zwicker et al. 2001).
//! The reference here makes no such approximation. The ray of a pixel from the camera centre o in
//! the unit direction d meets a Gaussian of mean mu and covariance Sigma = R diag(s^2) R^T with
//!
//! ```text
//! falloff(d) = I(d) / I(d0),   I(d) = integral over t of exp(-(o + t d - mu)^T Sigma^-1 (o + t d - mu) / 2)
//! ```
//!
//! Here d0 is the direction through the mean. The integral is used, not the peak along the ray,
//! because the screen Gaussian of EWA is the marginal of the 3D Gaussian along the line of sight,
//! scaled to 1 at the mean: the two are equal where the perspective is affine, and otherwise differ
//! by the model error. With w(v) = diag(1/s) R^T v, wd = w(d) and wm = w(mu - o) it has a closed
//! form,
//!
//! ```text
//! falloff(d) = sqrt(|w(d0)|^2 / |wd|^2) exp(-|wd x wm|^2 / (2 |wd|^2))
//! ```
//!
//! whose exponent, the squared distance at which the ray passes the mean, is not a difference and
//! so keeps its digits. Two consequences:
//! - The falloff may exceed 1: a ray along a needle meets more of it than the ray through its mean.
//!   Alpha is capped as usual.
//! - The integral is over the whole line, like EWA's. For a Gaussian whose mean is 4 standard
//!   deviations away along the ray, less than 4e-5 lies behind the camera.
//!
//! Depth order (camera z of the mean), `alpha_min`, `alpha_max`, early stop and background are
//! those of [`splat_ops::rasterize()`]. There is no low-pass filter: a pixel is a point. Compare
//! with [`render_affine`] at `eps2d` 0 for the model alone, and at 0.3 for model and filter.
//!
//! A measuring tool: no gradients, and every Gaussian at every pixel.

use burn::tensor::{DType, Device, Tensor, TensorData};
use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use serde::Serialize;
use splat_model::Camera;
use splat_ops::{
    CameraModel, Distortion, ImageSize, Intrinsics, OpError, ProjectSettings, RasterizeSettings,
    project, rasterize,
};

/// A Gaussian in the world, after activation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaussian3d {
    /// Centre.
    pub mean: DVec3,
    /// Rotation from its axes to the world, of any non-zero length.
    pub rotation: DQuat,
    /// Standard deviations along the axes, world units.
    pub scale: DVec3,
    /// Opacity in (0, 1).
    pub opacity: f64,
    /// Colour seen from the camera.
    pub color: DVec3,
}

/// An image in double precision, row by row from the top left.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Size in pixels.
    pub size: ImageSize,
    /// `[H * W]`.
    pub image: Vec<DVec3>,
    /// `[H * W]`: one minus the remaining transmittance.
    pub alpha: Vec<f64>,
}

/// Why the model error cannot be measured.
#[derive(Debug, thiserror::Error)]
pub enum ModelErrorFailure {
    /// Single precision would mix rounding into the model error.
    #[error("{device} does not compute in double precision; measure on the CPU (Flex)")]
    NoDoublePrecision {
        /// Name of the device.
        device: String,
    },
    /// An op refused its input.
    #[error(transparent)]
    Op(#[from] OpError),
    /// A result could not be read back.
    #[error("the picture cannot be read back: {0}")]
    ReadBack(String),
}

/// A Gaussian relative to the camera at the origin.
struct Seen {
    /// diag(1/s) R^T, from camera axes.
    whiten: DMat3,
    /// wm.
    mean: DVec3,
    /// |w(d0)|^2.
    through_mean: f64,
    depth: f64,
    opacity: f64,
    color: DVec3,
}

impl Seen {
    fn new(gaussian: &Gaussian3d, camera: &Camera) -> Self {
        let turn = DMat3::from_mat4(camera.viewmat);
        let mean = camera.viewmat.transform_point3(gaussian.mean);
        let axes = turn * DMat3::from_quat(gaussian.rotation.normalize());
        let whiten = DMat3::from_diagonal(gaussian.scale.recip()) * axes.transpose();
        Self {
            whiten,
            mean: whiten * mean,
            through_mean: (whiten * mean.normalize()).length_squared(),
            depth: camera.lens.depth(mean.to_array()),
            opacity: gaussian.opacity,
            color: gaussian.color,
        }
    }

    /// Falloff in a unit direction in camera space. NaN if the Gaussian has a field that is not
    /// finite or no extent.
    fn falloff(&self, direction: DVec3) -> f64 {
        let along = self.whiten * direction;
        let length2 = along.length_squared();
        let passes = along.cross(self.mean).length_squared() / length2;
        (self.through_mean / length2).sqrt() * (-0.5 * passes).exp()
    }
}

/// Renders by integrating every Gaussian along every pixel's ray.
///
/// Gaussians nearer than `near` or farther than `far` (depth of the mean), and those with a
/// non-finite field or a scale of zero, are not drawn.
pub fn render_rays(
    gaussians: &[Gaussian3d],
    camera: &Camera,
    background: DVec3,
    project: &ProjectSettings,
    rasterize: &RasterizeSettings,
) -> Picture {
    let mut seen: Vec<Seen> = gaussians
        .iter()
        .map(|gaussian| Seen::new(gaussian, camera))
        .filter(|seen| seen.depth >= project.near && seen.depth <= project.far)
        .collect();
    seen.sort_by(|a, b| a.depth.total_cmp(&b.depth)); // stable: ties by index
    let [fx, fy, cx, cy] = camera.intrinsics;
    let width = camera.size.width as usize;
    let lens = camera.lens.bounded();
    let pixels: Vec<(DVec3, f64)> = (0..width * camera.size.height as usize)
        .into_par_iter()
        .map(|pixel| {
            let x = (pixel % width) as f64 + 0.5;
            let y = (pixel / width) as f64 + 0.5;
            // Beyond the lens's domain is the background.
            let direction = lens.undistort([(x - cx) / fx, (y - cy) / fy]);
            direction.map_or((background, 0.0), |direction| {
                blend(
                    &seen,
                    DVec3::from(direction).normalize(),
                    background,
                    rasterize,
                )
            })
        })
        .collect();
    let (image, alpha) = pixels.into_iter().unzip();
    Picture {
        size: camera.size,
        image,
        alpha,
    }
}

/// One pixel, front to back (3DGS eq. 3, appendix C): its colour and alpha.
fn blend(
    seen: &[Seen],
    direction: DVec3,
    background: DVec3,
    settings: &RasterizeSettings,
) -> (DVec3, f64) {
    let mut color = DVec3::ZERO;
    let mut transmittance = 1.0;
    for splat in seen {
        let raw = splat.opacity * splat.falloff(direction);
        // NaN is skipped.
        if !(raw >= settings.alpha_min) {
            continue;
        }
        let alpha = raw.min(settings.alpha_max);
        let after = transmittance * (1.0 - alpha);
        if after < settings.transmittance_min {
            break;
        }
        color += splat.color * alpha * transmittance;
        transmittance = after;
    }
    (color + background * transmittance, 1.0 - transmittance)
}

/// Renders the same scene with the ops, in double precision: the affine approximation.
///
/// # Errors
/// When the device lacks double precision, or an op refuses its input.
pub fn render_affine(
    gaussians: &[Gaussian3d],
    camera: &Camera,
    background: DVec3,
    project_settings: &ProjectSettings,
    rasterize_settings: &RasterizeSettings,
    device: &Device,
) -> Result<Picture, ModelErrorFailure> {
    if !device.supports_dtype(DType::F64) {
        return Err(ModelErrorFailure::NoDoublePrecision {
            device: format!("{device:?}"),
        });
    }
    let n = gaussians.len();
    let columns = |values: &dyn Fn(&Gaussian3d) -> Vec<f64>| {
        gaussians.iter().flat_map(values).collect::<Vec<f64>>()
    };
    let upload = |values: Vec<f64>, width: usize| {
        Tensor::<2>::from_data(TensorData::new(values, [n, width]), (device, DType::F64))
    };
    let viewmat = camera.viewmat.transpose().to_cols_array().to_vec();
    let viewmat = TensorData::new(viewmat, [1, 4, 4]);
    let row = |values: &[f64]| {
        let data = TensorData::new(values.to_vec(), [1, values.len()]);
        Tensor::<2>::from_data(data, (device, DType::F64))
    };
    let pinhole = row(&camera.intrinsics);
    let lens = camera.lens;
    let distortion = (lens.model() != CameraModel::Pinhole).then(|| {
        let domain = lens.domain(camera.intrinsics, camera.size);
        Distortion {
            model: lens.model(),
            coefficients: row(lens.coefficients()),
            domain: row(&[domain.limit, domain.clamp]),
        }
    });
    let opacities: Vec<f64> = gaussians.iter().map(|g| g.opacity).collect();
    let projected = project(
        upload(columns(&|g| g.mean.to_array().to_vec()), 3),
        upload(
            columns(&|g| vec![g.rotation.w, g.rotation.x, g.rotation.y, g.rotation.z]),
            4,
        ),
        upload(columns(&|g| g.scale.to_array().to_vec()), 3),
        Tensor::from_data(viewmat, (device, DType::F64)),
        Intrinsics {
            pinhole,
            distortion,
        },
        camera.size,
        project_settings,
    )?;
    let background = TensorData::new(background.to_array().to_vec(), [1, 3]);
    let rendered = rasterize(
        &projected,
        upload(columns(&|g| g.color.to_array().to_vec()), 3),
        Tensor::<1>::from_data(TensorData::new(opacities, [n]), (device, DType::F64)),
        Some(Tensor::from_data(background, (device, DType::F64))),
        rasterize_settings,
    )?;
    let values: Vec<f64> = rendered
        .packed()
        .try_into_vec_as()
        .map_err(|error| ModelErrorFailure::ReadBack(error.to_string()))?;
    let (image, alpha) = values
        .as_chunks::<4>()
        .0
        .iter()
        .map(|[r, g, b, alpha]| (DVec3::new(*r, *g, *b), *alpha))
        .unzip();
    Ok(Picture {
        size: camera.size,
        image,
        alpha,
    })
}

/// Shape of a measured Gaussian, rotated so that two of its axes are at 45 degrees to the line of
/// sight. On the optical axis, axes along or across that line would hide the error that is linear
/// in the size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// 1 : 1 : 1.
    Sphere,
    /// 1 : 0.1 : 0.1.
    Needle,
    /// 1 : 1 : 0.1.
    Pancake,
}

impl Shape {
    /// All shapes.
    pub const ALL: [Self; 3] = [Self::Sphere, Self::Needle, Self::Pancake];

    /// Standard deviations, the largest being 1.
    fn scale(self) -> DVec3 {
        match self {
            Self::Sphere => DVec3::ONE,
            Self::Needle => DVec3::new(1.0, 0.1, 0.1),
            Self::Pancake => DVec3::new(1.0, 1.0, 0.1),
        }
    }
}

/// A single Gaussian in both models.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ModelErrorRow {
    /// Its shape.
    pub shape: Shape,
    /// Distance from the camera to its mean, in units of its largest standard deviation.
    pub distance: f64,
    /// Angle between the optical axis and the direction to its mean, in degrees.
    pub angle: f64,
    /// Largest standard deviation on the screen of a sphere of this size, in pixels.
    pub pixels: f64,
    /// `|alpha affine - alpha rays| / |alpha rays|` over the pixels around it, without the low-pass
    /// filter: the model error.
    pub relative_l2: f64,
    /// Largest difference of alpha at a pixel, without the low-pass filter.
    pub largest: f64,
    /// `relative_l2` with the default low-pass filter in the affine model only: what a user sees.
    /// Falls with `pixels`.
    pub relative_l2_filtered: f64,
}

/// Distances of [`model_error_table`], in standard deviations.
pub const DISTANCES: [f64; 6] = [4.0, 8.0, 16.0, 32.0, 64.0, 128.0];

/// Angles of [`model_error_table`], in degrees.
pub const ANGLES: [f64; 5] = [0.0, 15.0, 30.0, 45.0, 60.0];

/// Sizes of [`model_error_table`], in pixels.
pub const PIXELS: [f64; 3] = [1.0, 3.0, 9.0];

/// Measures every [`Shape`] at all of [`DISTANCES`], [`ANGLES`] and [`PIXELS`].
///
/// # Errors
/// Those of [`render_affine`].
pub fn model_error_table(device: &Device) -> Result<Vec<ModelErrorRow>, ModelErrorFailure> {
    let mut rows = Vec::new();
    for shape in Shape::ALL {
        for distance in DISTANCES {
            for angle in ANGLES {
                for pixels in PIXELS {
                    rows.push(model_error(shape, distance, angle, pixels, device)?);
                }
            }
        }
    }
    Ok(rows)
}

/// Opacity of a measured Gaussian.
const OPACITY: f64 = 0.9;

/// Alpha cut for comparing models, so low that no pixel's alpha is cut to 0 in one model only, as
/// at the default of 1/255.
const FAINTEST: f64 = 1e-9;

/// Half side of the image around a measured Gaussian, in standard deviations.
const WINDOW: f64 = 6.0;

/// Measures one Gaussian by shape, distance in standard deviations, angle off the optical axis in
/// degrees (below 90), and size on the screen in pixels; see [`ModelErrorRow`].
///
/// The principal point of the camera puts the Gaussian in the middle of a small image, so that the
/// clamp of the Jacobian, which is relative to the image, has no effect.
///
/// # Errors
/// Those of [`render_affine`].
pub fn model_error(
    shape: Shape,
    distance: f64,
    angle: f64,
    pixels: f64,
    device: &Device,
) -> Result<ModelErrorRow, ModelErrorFailure> {
    let theta = angle.to_radians();
    let sight = DVec3::new(theta.sin(), 0.0, theta.cos());
    let gaussian = Gaussian3d {
        mean: distance * sight,
        rotation: DQuat::from_rotation_y(theta + std::f64::consts::FRAC_PI_4),
        scale: shape.scale(),
        opacity: OPACITY,
        color: DVec3::ONE,
    };
    // A sphere's standard deviation on the screen, along the radius: f sigma / (z cos theta).
    let focal = pixels * distance * theta.cos().powi(2);
    let half = (WINDOW * pixels).ceil();
    let side = 2 * half as u32 + 1;
    let camera = Camera {
        viewmat: glam::DMat4::IDENTITY,
        intrinsics: [focal, focal, half + 0.5 - focal * theta.tan(), half + 0.5],
        lens: splat_data::Lens::Pinhole,
        size: ImageSize {
            width: side,
            height: side,
        },
    };
    let project = ProjectSettings {
        near: 0.0,
        eps2d: 0.0,
        alpha_min: FAINTEST,
        ..ProjectSettings::default()
    };
    let rasterize = RasterizeSettings {
        alpha_min: FAINTEST,
        ..RasterizeSettings::default()
    };
    let filtered = ProjectSettings {
        eps2d: ProjectSettings::default().eps2d,
        ..project
    };
    let affine = |project: &ProjectSettings| {
        render_affine(
            &[gaussian],
            &camera,
            DVec3::ZERO,
            project,
            &rasterize,
            device,
        )
    };
    let rays = render_rays(&[gaussian], &camera, DVec3::ZERO, &project, &rasterize);
    let plain = affine(&project)?;
    let differences = plain
        .alpha
        .iter()
        .zip(&rays.alpha)
        .map(|(a, b)| (a - b).abs());
    Ok(ModelErrorRow {
        shape,
        distance,
        angle,
        pixels,
        relative_l2: relative_l2(&plain.alpha, &rays.alpha),
        largest: differences.fold(0.0, f64::max),
        relative_l2_filtered: relative_l2(&affine(&filtered)?.alpha, &rays.alpha),
    })
}

/// `|a - b| / |b|`.
fn relative_l2(a: &[f64], b: &[f64]) -> f64 {
    let difference: f64 = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum();
    let size: f64 = b.iter().map(|b| b * b).sum();
    (difference / size).sqrt()
}

#[cfg(all(test, feature = "cpu"))]
mod tests;
