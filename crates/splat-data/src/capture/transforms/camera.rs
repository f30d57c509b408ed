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
/// Coefficients of other programs, for which neither kind of camera has a term.
const WITHOUT_TERM: [&str; 2] = ["k5", "k6"];

impl Model {
    /// That of a frame: by its own `camera_model`, or else that of the top level, or else by
    /// instant-ngp's `is_fisheye`; perspective by default.
    pub fn read(top: &Fields<'_>, frame: &Fields<'_>) -> Result<Self, CaptureError> {
        let has = |field: &str| frame.get(field).is_some();
        // A frame that has a camera model of its own is not meant by the top level's `is_fisheye`.
        let named = if has("camera_model") { frame } else { top };
        let flagged = if has("is_fisheye") { frame } else { named };
        let is_fisheye = flagged.flag("is_fisheye")? == Some(true);
        match Self::named(named)? {
            Some(Self::Perspective) if is_fisheye => Err(flagged.error(
                "its is_fisheye is true, but its camera_model is none of a fisheye; set camera_model to OPENCV_FISHEYE, or is_fisheye to false",
            )),
            Some(model) => Ok(model),
            None if is_fisheye => Ok(Self::Fisheye),
            None => Ok(Self::Perspective),
        }
    }

    /// `camera_model`, if there is one.
    fn named(fields: &Fields<'_>) -> Result<Option<Self>, CaptureError> {
        match fields.text("camera_model")? {
            None => Ok(None),
            Some("SIMPLE_PINHOLE" | "PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV") => {
                Ok(Some(Self::Perspective))
            }
            Some("OPENCV_FISHEYE") => Ok(Some(Self::Fisheye)),
            Some(other) => Err(fields.error(&format!(
                "its camera_model is {}, which cannot be read: those of PINHOLE, OPENCV and OPENCV_FISHEYE can; cut perspective views out of the photos, or process them again with one of these",
                shown(&other.into())
            ))),
        }
    }

    fn kind(self) -> &'static str {
        match self {
            Self::Perspective => "perspective",
            Self::Fisheye => "a fisheye",
        }
    }
}

/// A number of the frame, or else of the top level.
fn number(top: &Fields<'_>, frame: &Fields<'_>, field: &str) -> Result<Option<f64>, CaptureError> {
    match frame.number(field)? {
        Some(value) => Ok(Some(value)),
        None => top.number(field),
    }
}

/// Focal lengths, principal point and size: each from the frame, or else from the top level.
pub(super) fn intrinsics(top: &Fields<'_>, frame: &Fields<'_>) -> Result<Intrinsics, CaptureError> {
    let side = |field: &str| -> Result<Option<u32>, CaptureError> {
        let Some(value) = number(top, frame, field)? else {
            return Ok(None);
        };
        // Sizes are often written as real numbers, 960.0.
        let whole = value.fract() == 0.0 && (1.0..=f64::from(u32::MAX)).contains(&value);
        if !whole {
            return Err(frame.error(&format!("its {field} is {value}, no number of pixels")));
        }
        Ok(Some(value as u32))
    };
    let intrinsics = Intrinsics::OfPhoto {
        focal: focal_lengths(top, frame)?,
        center: [number(top, frame, "cx")?, number(top, frame, "cy")?],
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

/// The focal lengths along x and y, of which at least one is there.
fn focal_lengths(top: &Fields<'_>, frame: &Fields<'_>) -> Result<[Option<Focal>; 2], CaptureError> {
    // A frame with an angle of its own is zoomed in another way than the top level says, along both
    // axes.
    let mut angles = ["camera_angle_x", "camera_angle_y"].into_iter();
    let has_own = angles.any(|field| frame.get(field).is_some());
    let top = if has_own { frame } else { top };
    let x = focal(top, frame, "fl_x", "camera_angle_x")?;
    let is_in_pixels = matches!(x, Some(Focal::Pixels(_)));
    // The angles are derived from the focal lengths; one alone is less exact.
    let y = if is_in_pixels && number(top, frame, "fl_y")?.is_none() {
        None
    } else {
        focal(top, frame, "fl_y", "camera_angle_y")?
    };
    if x.or(y).is_none() {
        return Err(frame.error(
            "its focal length is missing: fl_x or camera_angle_x, in the frame or at the top level",
        ));
    }
    Ok([x, y])
}

/// One focal length: in pixels, or else by its angle.
fn focal(
    top: &Fields<'_>,
    frame: &Fields<'_>,
    pixels: &str,
    angle: &str,
) -> Result<Option<Focal>, CaptureError> {
    if let Some(value) = number(top, frame, pixels)? {
        if !(value > 0.0) {
            return Err(frame.error(&format!("its {pixels} is {value}; it must be positive")));
        }
        return Ok(Some(Focal::Pixels(value)));
    }
    let Some(value) = number(top, frame, angle)? else {
        return Ok(None);
    };
    if !(value > NARROWEST && value < std::f64::consts::PI) {
        return Err(frame.error(&format!(
            "its {angle} is {value}; it must be an angle between 0 and pi radians"
        )));
    }
    Ok(Some(Focal::Angle(value)))
}

/// The lens, from the frame if it has any coefficient, or else from the top level.
pub(super) fn lens(
    top: &Fields<'_>,
    frame: &Fields<'_>,
    model: Model,
) -> Result<Lens, CaptureError> {
    let fields = if has_coefficients(frame) { frame } else { top };
    let values = coefficients(fields)?;
    // The coefficients of one kind of camera mean nothing in the formula of the other.
    let are_of_top = fields.frame.is_none() && values != [0.0; 6];
    if are_of_top && Model::read(top, top).ok() != Some(model) {
        return Err(frame.error(&format!(
            "its camera is {}, unlike that of the top level, whose distortion it therefore cannot have; give the frame coefficients of its own (k1 = 0 for no distortion), or the top level the same camera_model",
            model.kind()
        )));
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

fn has_coefficients(fields: &Fields<'_>) -> bool {
    let mut keys = COEFFICIENTS
        .iter()
        .chain(&WITHOUT_TERM)
        .chain(&["distortion_params"]);
    keys.any(|key| fields.get(key).is_some())
}

/// The values of [`COEFFICIENTS`], zero where they are missing.
fn coefficients(fields: &Fields<'_>) -> Result<[f64; 6], CaptureError> {
    for key in WITHOUT_TERM {
        let value = fields.number(key)?.unwrap_or(0.0);
        if value != 0.0 {
            return Err(fields.error(&format!(
                "its {key} is {value}: no camera model that can be read has it; calibrate again without it (k1, k2, k3, p1, p2, or k1 to k4 of a fisheye), or undistort the photos"
            )));
        }
    }
    let mut values = [0.0; 6];
    let Some(list) = fields.list("distortion_params")? else {
        for (value, key) in values.iter_mut().zip(COEFFICIENTS) {
            *value = fields.number(key)?.unwrap_or(0.0);
        }
        return Ok(values);
    };
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
    Ok(values)
}
