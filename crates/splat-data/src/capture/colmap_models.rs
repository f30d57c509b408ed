//! COLMAP's camera models: numbers, names, parameters. A model added here can be read.

/// Camera models in the order of COLMAP's numbers, with their parameter counts. COLMAP only appends
/// numbers, so unknown ones are refused by number.
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

/// Name of the camera model with this COLMAP number.
pub(super) fn model_name(number: i32) -> String {
    let known = usize::try_from(number).ok().and_then(|n| MODELS.get(n));
    known.map_or_else(|| format!("number {number}"), |(name, _)| name.to_string())
}

/// Number of parameters of a supported camera model.
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
