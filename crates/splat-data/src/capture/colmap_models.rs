//! COLMAP's camera models: numbers, names, parameters. What is added here is read.

/// Camera models in the order of COLMAP's numbers, with how many parameters each has. New numbers
/// are only ever appended, so what is missing here is refused by its number.
const MODELS: [(&str, usize); 12] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
];

/// Name of the camera model with COLMAP's number.
pub(super) fn model_name(number: i32) -> String {
    let known = usize::try_from(number).ok().and_then(|n| MODELS.get(n));
    known.map_or_else(|| format!("number {number}"), |(name, _)| name.to_string())
}

/// Number of parameters of a camera model that can be read.
pub(super) fn pinhole_parameters(model: &str) -> Option<usize> {
    MODELS[..2]
        .iter()
        .find(|(name, _)| *name == model)
        .map(|&(_, count)| count)
}

/// `[fx, fy, cx, cy]` from the 3 parameters of `SIMPLE_PINHOLE` (f, cx, cy) or the 4 of `PINHOLE`.
pub(super) fn pinhole_intrinsics(parameters: &[f64]) -> [f64; 4] {
    match *parameters {
        [f, cx, cy] => [f, f, cx, cy],
        [fx, fy, cx, cy] => [fx, fy, cx, cy],
        // Both readers read exactly `pinhole_parameters` numbers; anything else fails the checks
        // below.
        _ => [f64::NAN; 4],
    }
}
