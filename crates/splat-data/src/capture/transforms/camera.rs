//! Intrinsics and lens of a frame.

use splat_core::{CameraModel, Lens};

use super::super::CaptureError;
use super::super::colmap_models;
use super::super::sparse_model::{Focal, Intrinsics};
use super::fields::{Fields, shown};

/// Fields of view up to this, in radians, are none.
const NARROWEST: f64 = 1e-6;

/// Kinds of cameras in `camera_model`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Model {
    Perspective,
    Fisheye,
}

/// Distortion coefficients in the order of `distortion_params`.
const COEFFICIENTS: [&str; 6] = ["k1", "k2", "k3", "k4", "p1", "p2"];

impl Model {
    /// `camera_model`, or instant-ngp's `is_fisheye`; perspective by default.
    pub fn read(top: &Fields<'_>) -> Result<Self, CaptureError> {
        let fisheye = top.get("is_fisheye").and_then(serde_json::Value::as_bool);
        match top.text("camera_model")? {
            None if fisheye == Some(true) => Ok(Self::Fisheye),
            None | Some("SIMPLE_PINHOLE" | "PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV") => {
                Ok(Self::Perspective)
            }
            Some("OPENCV_FISHEYE") => Ok(Self::Fisheye),
            Some(other) => Err(top.error(&format!(
                "its camera_model is {}, which cannot be read: those of PINHOLE, OPENCV and OPENCV_FISHEYE can; cut perspective views out of the photos, or process them again with one of these",
                shown(&other.into())
            ))),
        }
    }
}

/// Focal lengths, principal point and size: each from the frame, or else from the top level.
pub(super) fn intrinsics(top: &Fields<'_>, frame: &Fields<'_>) -> Result<Intrinsics, CaptureError> {
    let number = |field: &str| match frame.number(field)? {
        Some(value) => Ok(Some(value)),
        None => top.number(field),
    };
    let side = |field: &str| -> Result<Option<u32>, CaptureError> {
        let Some(value) = number(field)? else {
            return Ok(None);
        };
        // Sizes are often written as real numbers, 960.0.
        let whole = value.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&value);
        if !whole {
            return Err(frame.error(&format!("its {field} is {value}, no number of pixels")));
        }
        Ok(Some(value as u32))
    };
    let focal = |pixels: &str, angle: &str| -> Result<Option<Focal>, CaptureError> {
        if let Some(value) = number(pixels)? {
            if !(value > 0.0) {
                return Err(frame.error(&format!("its {pixels} is {value}; it must be positive")));
            }
            return Ok(Some(Focal::Pixels(value)));
        }
        let Some(value) = number(angle)? else {
            return Ok(None);
        };
        if !(value > NARROWEST && value < std::f64::consts::PI) {
            return Err(frame.error(&format!(
                "its {angle} is {value}; it must be an angle between 0 and pi radians"
            )));
        }
        Ok(Some(Focal::Angle(value)))
    };
    let x = focal("fl_x", "camera_angle_x")?;
    // The angles are derived from the focal lengths; one alone is less exact.
    let y = match x {
        Some(Focal::Pixels(_)) => number("fl_y")?.map(|_| focal("fl_y", "camera_angle_y")),
        _ => Some(focal("fl_y", "camera_angle_y")),
    };
    let y = y.transpose()?.flatten();
    if x.or(y).is_none() {
        return Err(frame.error(
            "its focal length is missing: fl_x or camera_angle_x, in the frame or at the top level",
        ));
    }
    let intrinsics = Intrinsics::OfPhoto {
        focal: [x, y],
        center: [number("cx")?, number("cy")?],
    };
    match (side("w")?, side("h")?) {
        (Some(width), Some(height)) => Ok(intrinsics.of_size([width, height])),
        (None, None) => Ok(intrinsics),
        (width, _) => {
            let missing = if width.is_some() { "h" } else { "w" };
            Err(frame.error(&format!("it has only one of w and h: {missing} is missing")))
        }
    }
}

/// The lens, from the frame if it has any coefficient, or else from the top level.
pub(super) fn lens(
    top: &Fields<'_>,
    frame: &Fields<'_>,
    model: Model,
) -> Result<Lens, CaptureError> {
    let has_any = |fields: &Fields<'_>| {
        let mut keys = COEFFICIENTS.iter().chain(&["distortion_params"]);
        keys.any(|key| fields.get(key).is_some())
    };
    let fields = if has_any(frame) { frame } else { top };
    let mut values = [0.0; 6];
    if let Some(list) = fields.list("distortion_params")? {
        if list.len() > COEFFICIENTS.len() {
            return Err(fields.error(&format!(
                "its distortion_params are {}, more than k1, k2, k3, k4, p1, p2",
                list.len()
            )));
        }
        for (index, (value, entry)) in values.iter_mut().zip(list).enumerate() {
            let bad = || {
                let reason = format!(
                    "its distortion_params[{index}] is {}, no number",
                    shown(entry)
                );
                fields.error(&reason)
            };
            *value = entry.as_f64().ok_or_else(bad)?;
        }
    } else {
        for (value, key) in values.iter_mut().zip(COEFFICIENTS) {
            *value = fields.number(key)?.unwrap_or(0.0);
        }
    }
    let [k1, k2, k3, k4, p1, p2] = values;
    match model {
        Model::Perspective if k4 != 0.0 => Err(fields.error(&format!(
            "its k4 is {k4}: in this format it multiplies r^8, a term that OpenCV's camera model has not; calibrate again without it (k1, k2, k3, p1, p2), or undistort the photos"
        ))),
        Model::Perspective => {
            let first = [k1, k2, p1, p2, k3];
            Ok(colmap_models::lens(CameraModel::OpenCv, &first))
        }
        Model::Fisheye if (p1, p2) != (0.0, 0.0) => Err(fields.error(&format!(
            "its p1 and p2 are {p1} and {p2}, but OPENCV_FISHEYE has only k1 to k4; calibrate again without them"
        ))),
        Model::Fisheye => Ok(Lens::OpenCvFisheye([k1, k2, k3, k4])),
    }
}
