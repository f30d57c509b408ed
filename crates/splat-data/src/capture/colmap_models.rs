//! COLMAP's camera models: numbers, names, parameters, and the lens of each.
//!
//! The parameters of every model that is read are one or two focal lengths, the principal point,
//! and coefficients in the order of [`Lens::OpenCv`] or [`Lens::OpenCvFisheye`], of which a model
//! has the first few: the others are zero.

use splat_core::{CameraModel, Lens};

/// Most parameters of a model that is read.
pub(super) const MOST_PARAMETERS: usize = 12;

/// A camera model of COLMAP.
#[derive(Debug)]
pub(super) struct Model {
    /// COLMAP's name.
    pub name: &'static str,
    /// COLMAP's number.
    pub number: i32,
    /// How it is read; `None` if it is not.
    pub layout: Option<Layout>,
}

/// The parameters of a model, in their order: focal lengths, principal point, coefficients.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    /// Number of focal lengths: 1 or 2.
    focals: usize,
    lens: CameraModel,
    /// Number of coefficients.
    coefficients: usize,
}

use CameraModel::{OpenCv, OpenCvFisheye, Pinhole};

/// All models, in the order of their numbers, to which COLMAP only appends.
static MODELS: [Model; 18] = [
    read("SIMPLE_PINHOLE", 0, 1, Pinhole, 0),
    read("PINHOLE", 1, 2, Pinhole, 0),
    read("SIMPLE_RADIAL", 2, 1, OpenCv, 1),
    read("RADIAL", 3, 1, OpenCv, 2),
    read("OPENCV", 4, 2, OpenCv, 4),
    read("OPENCV_FISHEYE", 5, 2, OpenCvFisheye, 4),
    read("FULL_OPENCV", 6, 2, OpenCv, 8),
    not_read("FOV", 7),
    read("SIMPLE_RADIAL_FISHEYE", 8, 1, OpenCvFisheye, 1),
    read("RADIAL_FISHEYE", 9, 1, OpenCvFisheye, 2),
    not_read("THIN_PRISM_FISHEYE", 10),
    not_read("RAD_TAN_THIN_PRISM_FISHEYE", 11),
    not_read("SIMPLE_DIVISION", 12),
    not_read("DIVISION", 13),
    read("SIMPLE_FISHEYE", 14, 1, OpenCvFisheye, 0),
    read("FISHEYE", 15, 2, OpenCvFisheye, 0),
    not_read("EUCM", 16),
    not_read(EQUIRECTANGULAR, 17),
];

/// The model of panoramas, which no undistortion makes perspective.
const EQUIRECTANGULAR: &str = "EQUIRECTANGULAR";

const fn read(
    name: &'static str,
    number: i32,
    focals: usize,
    lens: CameraModel,
    coefficients: usize,
) -> Model {
    Model {
        name,
        number,
        layout: Some(Layout {
            focals,
            lens,
            coefficients,
        }),
    }
}

const fn not_read(name: &'static str, number: i32) -> Model {
    Model {
        name,
        number,
        layout: None,
    }
}

/// The model of this number, or the description of one that cannot be read.
pub(super) fn by_number(number: i32) -> Result<Layout, String> {
    let known = MODELS.iter().find(|model| model.number == number);
    known.map_or_else(|| Err(format!("number {number}")), Model::readable)
}

/// The model of this name, or the description of one that cannot be read.
pub(super) fn by_name(name: &str) -> Result<Layout, String> {
    let known = MODELS.iter().find(|model| model.name == name);
    known.map_or_else(
        || Err(crate::text::Excerpt(name).to_string()),
        Model::readable,
    )
}

/// What helps if this model is refused.
pub(super) fn remedy(description: &str) -> &'static str {
    if description.starts_with(EQUIRECTANGULAR) {
        "cut perspective views out of the panoramas, and run COLMAP on these"
    } else {
        "undistort the photos (`colmap image_undistorter`), or run COLMAP again with another camera model, such as OPENCV or OPENCV_FISHEYE"
    }
}

impl Model {
    fn readable(&self) -> Result<Layout, String> {
        let description = || format!("{} (number {})", self.name, self.number);
        self.layout.ok_or_else(description)
    }
}

impl Layout {
    /// Number of parameters.
    pub fn parameters(self) -> usize {
        self.focals + 2 + self.coefficients
    }

    /// `[fx, fy, cx, cy]` and the lens, from as many values as there are parameters. A perspective
    /// lens without distortion is a pinhole.
    pub fn camera(self, parameters: &[f64]) -> ([f64; 4], Lens) {
        let (focals, rest) = parameters.split_at(self.focals);
        let (center, coefficients) = rest.split_at(2);
        let intrinsics = [focals[0], focals[self.focals - 1], center[0], center[1]];
        (intrinsics, lens(self.lens, coefficients))
    }
}

/// The lens with these first coefficients, the others zero; without distortion, a pinhole instead
/// of a perspective lens.
pub(super) fn lens(model: CameraModel, first: &[f64]) -> Lens {
    fn padded<const N: usize>(first: &[f64]) -> [f64; N] {
        std::array::from_fn(|index| first.get(index).copied().unwrap_or(0.0))
    }
    match model {
        CameraModel::OpenCv if first.iter().any(|value| *value != 0.0) => {
            Lens::OpenCv(padded(first))
        }
        CameraModel::Pinhole | CameraModel::OpenCv => Lens::Pinhole,
        CameraModel::OpenCvFisheye => Lens::OpenCvFisheye(padded(first)),
    }
}

/// COLMAP's number of the simplest model with two focal lengths that has this lens, and its
/// parameters.
pub(super) fn number_and_parameters(intrinsics: [f64; 4], lens: &Lens) -> (i32, Vec<f64>) {
    let (number, coefficients) = match lens {
        Lens::Pinhole => (1, &[][..]),
        Lens::OpenCv(k) if k[4..].iter().all(|value| *value == 0.0) => (4, &k[..4]),
        Lens::OpenCv(k) => (6, &k[..]),
        Lens::OpenCvFisheye(k) => (5, &k[..]),
    };
    (number, [&intrinsics[..], coefficients].concat())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_names_and_lengths_are_colmaps() {
        // src/colmap/sensor/models.h
        let expected = [
            ("SIMPLE_PINHOLE", Some(3)),
            ("PINHOLE", Some(4)),
            ("SIMPLE_RADIAL", Some(4)),
            ("RADIAL", Some(5)),
            ("OPENCV", Some(8)),
            ("OPENCV_FISHEYE", Some(8)),
            ("FULL_OPENCV", Some(12)),
            ("FOV", None),
            ("SIMPLE_RADIAL_FISHEYE", Some(4)),
            ("RADIAL_FISHEYE", Some(5)),
            ("THIN_PRISM_FISHEYE", None),
            ("RAD_TAN_THIN_PRISM_FISHEYE", None),
            ("SIMPLE_DIVISION", None),
            ("DIVISION", None),
            ("SIMPLE_FISHEYE", Some(3)),
            ("FISHEYE", Some(4)),
            ("EUCM", None),
            ("EQUIRECTANGULAR", None),
        ];
        for (number, (name, parameters)) in (0..).zip(expected) {
            assert_eq!(MODELS[number as usize].name, name);
            for found in [by_number(number), by_name(name)] {
                match parameters {
                    Some(count) => {
                        assert_eq!(found.unwrap().parameters(), count);
                        assert!(count <= MOST_PARAMETERS);
                    }
                    None => assert_eq!(found.unwrap_err(), format!("{name} (number {number})")),
                }
            }
        }
        assert_eq!(by_number(18).unwrap_err(), "number 18");
        assert_eq!(by_number(-1).unwrap_err(), "number -1");
        assert_eq!(by_name("opencv").unwrap_err(), "opencv");
    }

    #[test]
    fn parameters_are_in_colmaps_order() {
        let camera = |name: &str| {
            let layout = by_name(name).unwrap();
            let values: Vec<f64> = (1..=layout.parameters()).map(|i| i as f64).collect();
            layout.camera(&values)
        };
        let opencv = |k: &[f64]| lens(CameraModel::OpenCv, k);
        let fisheye = |k: &[f64]| lens(CameraModel::OpenCvFisheye, k);
        let one = [1.0, 1.0, 2.0, 3.0];
        let two = [1.0, 2.0, 3.0, 4.0];
        let full = [5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0];
        for (name, expected) in [
            ("SIMPLE_PINHOLE", (one, Lens::Pinhole)),
            ("PINHOLE", (two, Lens::Pinhole)),
            ("SIMPLE_RADIAL", (one, opencv(&[4.0]))),
            ("RADIAL", (one, opencv(&[4.0, 5.0]))),
            ("OPENCV", (two, opencv(&[5.0, 6.0, 7.0, 8.0]))),
            ("FULL_OPENCV", (two, Lens::OpenCv(full))),
            ("OPENCV_FISHEYE", (two, fisheye(&[5.0, 6.0, 7.0, 8.0]))),
            ("SIMPLE_RADIAL_FISHEYE", (one, fisheye(&[4.0]))),
            ("RADIAL_FISHEYE", (one, fisheye(&[4.0, 5.0]))),
            ("SIMPLE_FISHEYE", (one, Lens::OpenCvFisheye([0.0; 4]))),
            ("FISHEYE", (two, Lens::OpenCvFisheye([0.0; 4]))),
        ] {
            assert_eq!(camera(name), expected, "{name}");
            let (number, parameters) = number_and_parameters(expected.0, &expected.1);
            let again = by_number(number).unwrap();
            assert_eq!(again.parameters(), parameters.len());
            assert_eq!(again.camera(&parameters), expected, "{name} as {number}");
        }
        // No distortion is no lens, but a fisheye stays one.
        assert_eq!(opencv(&[0.0, -0.0, 0.0, 0.0]), Lens::Pinhole);
        assert_eq!(fisheye(&[0.0; 4]), Lens::OpenCvFisheye([0.0; 4]));
    }
}
