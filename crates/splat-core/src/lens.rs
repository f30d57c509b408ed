//! Lenses: what lies between a point in camera space and the image plane.
//!
//! A point p = (x, y, z) in camera space falls on the normalised image plane at (a', b'), and in
//! the image at (fx a' + cx, fy b' + cy):
//!
//! ```text
//! pinhole         a' = x/z,  b' = y/z
//! opencv          a = x/z, b = y/z, q = a^2 + b^2
//!                 L = (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3)
//!                 a' = a L + 2 p1 a b + p2 (q + 2 a^2),  b' = b L + p1 (q + 2 b^2) + 2 p2 a b
//! opencv_fisheye  rho = hypot(x, y), theta = atan2(rho, z)
//!                 theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
//!                 a' = theta_d x / rho,  b' = theta_d y / rho
//! ```
//!
//! These are the models of OpenCV's `calib3d` and `fisheye` modules, and COLMAP's of the same
//! names.

mod fisheye;
mod opencv;
mod polynomial;
#[cfg(test)]
mod tests;

use crate::ImageSize;

/// A family of lenses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum CameraModel {
    /// Perspective without distortion.
    #[default]
    Pinhole,
    /// Perspective with radial and tangential distortion: OpenCV's rational model.
    OpenCv,
    /// Equidistant, with a polynomial of the angle: OpenCV's fisheye model.
    OpenCvFisheye,
}

impl CameraModel {
    /// All models.
    pub const ALL: [Self; 3] = [Self::Pinhole, Self::OpenCv, Self::OpenCvFisheye];

    /// Name in files: `pinhole`, `opencv` or `opencv_fisheye`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Pinhole => "pinhole",
            Self::OpenCv => "opencv",
            Self::OpenCvFisheye => "opencv_fisheye",
        }
    }

    /// The model of this [`name`](Self::name).
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.name() == name)
    }

    /// Number of distortion coefficients.
    pub const fn coefficients(self) -> usize {
        match self {
            Self::Pinhole => 0,
            Self::OpenCv => 8,
            Self::OpenCvFisheye => 4,
        }
    }

    /// Names of the coefficients, in their order.
    pub const fn coefficient_names(self) -> &'static [&'static str] {
        match self {
            Self::Pinhole => &[],
            Self::OpenCv => &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
            Self::OpenCvFisheye => &["k1", "k2", "k3", "k4"],
        }
    }
}

/// A camera model with its distortion coefficients. Focal lengths and principal point are apart
/// from it, because another resolution changes those and leaves these.
///
/// ```
/// use splat_core::Lens;
///
/// let barrel = Lens::OpenCv([-0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
/// let [a, b] = barrel.distort([0.5, 0.0, 1.0]).unwrap();
/// assert!((a - 0.5 * (1.0 - 0.1 * 0.25)).abs() < 1e-15 && b == 0.0);
/// let [x, _, z] = barrel.undistort([a, b]).unwrap();
/// assert!((x / z - 0.5).abs() < 1e-14);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Lens {
    /// No distortion.
    #[default]
    Pinhole,
    /// k1, k2, p1, p2, k3, k4, k5, k6 of [`CameraModel::OpenCv`].
    OpenCv([f64; 8]),
    /// k1, k2, k3, k4 of [`CameraModel::OpenCvFisheye`].
    OpenCvFisheye([f64; 4]),
}

/// Where a lens is defined, in [`CameraModel`]'s own variable.
///
/// Beyond `limit` the model folds back on itself, so that two directions would share a pixel;
/// splats there are culled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LensDomain {
    /// Largest radius `hypot(x, y) / z` (perspective) or angle from the axis in radians (fisheye).
    pub limit: f64,
    /// Radius at which the Jacobian of a perspective lens is evaluated at most; 0 for others.
    pub clamp: f64,
}

impl Lens {
    /// The lens of this model with these coefficients; `None` when their number is wrong.
    pub fn new(model: CameraModel, coefficients: &[f64]) -> Option<Self> {
        Some(match model {
            CameraModel::Pinhole => coefficients.is_empty().then_some(Self::Pinhole)?,
            CameraModel::OpenCv => Self::OpenCv(coefficients.try_into().ok()?),
            CameraModel::OpenCvFisheye => Self::OpenCvFisheye(coefficients.try_into().ok()?),
        })
    }

    /// The camera model.
    pub const fn model(&self) -> CameraModel {
        match self {
            Self::Pinhole => CameraModel::Pinhole,
            Self::OpenCv(_) => CameraModel::OpenCv,
            Self::OpenCvFisheye(_) => CameraModel::OpenCvFisheye,
        }
    }

    /// The distortion coefficients, as many as [`CameraModel::coefficients`] says.
    pub fn coefficients(&self) -> &[f64] {
        match self {
            Self::Pinhole => &[],
            Self::OpenCv(coefficients) => coefficients,
            Self::OpenCvFisheye(coefficients) => coefficients,
        }
    }

    /// The lens with the limit of its domain, for many points.
    pub fn bounded(&self) -> BoundedLens {
        let limit = match self {
            Self::Pinhole => f64::INFINITY,
            Self::OpenCv(k) => opencv::limit(k),
            Self::OpenCvFisheye(k) => fisheye::limit(k),
        };
        BoundedLens { lens: *self, limit }
    }

    /// The domain in an image of this size: up to the first radius or angle at which the lens stops
    /// to bend outwards, or its formula has a pole; a fisheye at most to 175 degrees.
    ///
    /// `intrinsics` are fx, fy, cx, cy in pixels. The clamp of a perspective lens is 1.15 times the
    /// largest radius of a corner of the image, and stays inside of the limit.
    pub fn domain(&self, intrinsics: [f64; 4], size: ImageSize) -> LensDomain {
        let bounded = self.bounded();
        let limit = bounded.limit;
        let clamp = match self {
            Self::Pinhole | Self::OpenCvFisheye(_) => 0.0,
            Self::OpenCv(_) => {
                let radius = |[x, y, z]: [f64; 3]| x.hypot(y) / z;
                let corner = corners(intrinsics, size)
                    .map(|corner| bounded.undistort(corner).map_or(f64::INFINITY, radius))
                    .into_iter()
                    .fold(0.0, f64::max);
                (0.999 * limit).min(1.15 * corner)
            }
        };
        LensDomain { limit, clamp }
    }

    /// The [`domain`](Self::domain) in which a lens that fits photos of this size is drawn. A
    /// fisheye ends where its polynomial, which is of no use far outside of the photo, becomes
    /// twice as steep as anywhere in it: with positive coefficients the footprint of a splat behind
    /// the camera would grow with the eighth power of its angle, and cover the picture.
    ///
    /// ```
    /// use splat_core::{ImageSize, Lens};
    ///
    /// let lens = Lens::OpenCvFisheye([0.0, 0.0, 0.0, 0.01]);
    /// let (intrinsics, size) = ([150.0, 150.0, 68.0, 102.0], ImageSize { width: 136, height: 204 });
    /// assert_eq!(lens.domain(intrinsics, size).limit, 175f64.to_radians());
    /// let limit = lens.photo_domain(intrinsics, size).limit.to_degrees();
    /// assert!(limit > 75.0 && limit < 90.0);
    /// ```
    pub fn photo_domain(&self, intrinsics: [f64; 4], size: ImageSize) -> LensDomain {
        let domain = self.domain(intrinsics, size);
        let Self::OpenCvFisheye(k) = self else {
            return domain;
        };
        let bounded = self.bounded();
        let angle = |[x, y, z]: [f64; 3]| x.hypot(y).atan2(z);
        let farthest = corners(intrinsics, size)
            .map(|corner| bounded.undistort(corner).map_or(domain.limit, angle))
            .into_iter()
            .fold(0.0, f64::max);
        LensDomain {
            limit: fisheye::steep(k, farthest, domain.limit),
            ..domain
        }
    }

    /// [`BoundedLens::distort`] for one point.
    pub fn distort(&self, p: [f64; 3]) -> Option<[f64; 2]> {
        self.bounded().distort(p)
    }

    /// [`BoundedLens::undistort`] for one point.
    pub fn undistort(&self, point: [f64; 2]) -> Option<[f64; 3]> {
        self.bounded().undistort(point)
    }

    /// The depth of a point in camera space by which splats are culled and sorted: z, or for a
    /// fisheye, which sees behind the image plane, the distance.
    pub fn depth(&self, [x, y, z]: [f64; 3]) -> f64 {
        match self {
            Self::Pinhole | Self::OpenCv(_) => z,
            Self::OpenCvFisheye(_) => x.hypot(y).hypot(z),
        }
    }
}

/// A lens with the limit of its domain, which takes longer to find than a point to map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundedLens {
    lens: Lens,
    limit: f64,
}

impl BoundedLens {
    /// Where a point in camera space falls on the normalised image plane; `None` where the lens is
    /// not defined, for a perspective lens also behind the camera.
    pub fn distort(&self, [x, y, z]: [f64; 3]) -> Option<[f64; 2]> {
        match &self.lens {
            Lens::Pinhole => (z > 0.0).then(|| [x / z, y / z]),
            Lens::OpenCv(k) => (z > 0.0).then(|| opencv::distort(k, self.limit, [x / z, y / z]))?,
            Lens::OpenCvFisheye(k) => fisheye::distort(k, self.limit, [x, y, z]),
        }
    }

    /// The direction in camera space, of length 1 for a fisheye and with z = 1 else, that falls on
    /// a point of the normalised image plane; `None` where no direction of the domain does.
    pub fn undistort(&self, point: [f64; 2]) -> Option<[f64; 3]> {
        match &self.lens {
            Lens::Pinhole => Some([point[0], point[1], 1.0]),
            Lens::OpenCv(k) => opencv::undistort(k, self.limit, point).map(|[a, b]| [a, b, 1.0]),
            Lens::OpenCvFisheye(k) => fisheye::undistort(k, self.limit, point),
        }
    }
}

/// Corners of an image on the normalised image plane.
fn corners([fx, fy, cx, cy]: [f64; 4], size: ImageSize) -> [[f64; 2]; 4] {
    let (w, h) = (f64::from(size.width), f64::from(size.height));
    [[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]].map(|[x, y]| [(x - cx) / fx, (y - cy) / fy])
}
