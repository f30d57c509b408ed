//! Points with colours in a PLY file, as structure from motion writes them.

use std::path::Path;

use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{
    ElementDef, Property, PropertyAccess, PropertyAccessResult, PropertyType, ScalarType,
};

use super::super::SceneFileError;
use super::header;
use super::rows::{FileRow, Rows};

/// A position, and 8-bit RGB.
type ColoredPoint = ([f64; 3], [u8; 3]);

/// Colour of a point of a file without colours.
const GREY: u8 = 128;

/// Names of the properties of a colour, as different programs write them.
const COLORS: [[&str; 3]; 3] = [
    ["red", "green", "blue"],
    ["r", "g", "b"],
    ["diffuse_red", "diffuse_green", "diffuse_blue"],
];

/// The points of the element `vertex`, from the contents of a file; `path` is used in messages.
///
/// Colours of bytes are taken as they are, and those of real numbers as from 0 to 1. Points without
/// colours are grey.
///
/// # Errors
///
/// [`SceneFileError`], naming the property and the point if applicable.
pub(crate) fn parse_points(path: &Path, bytes: &[u8]) -> Result<Vec<ColoredPoint>, SceneFileError> {
    let mut reader = bytes;
    let header = header::read(&mut reader, path)?;
    let parser = Parser::<PointRow>::new();
    for element in header.elements.values() {
        let mut rows = Rows::new(path, &parser, header.encoding, element);
        if element.properties.is_empty() {
            continue; // whatever its count, nothing of it is in the file
        }
        if element.name != "vertex" {
            rows.skip(&mut reader)?;
            continue;
        }
        let columns = Columns::find(path, element)?;
        // Every property takes at least one byte of the file.
        let most = bytes.len() / element.properties.len();
        let mut points = Vec::with_capacity(element.count.min(most));
        for index in 0..element.count {
            let row = rows.next(&mut reader, index)?;
            points.push(
                columns
                    .point(&row)
                    .map_err(|column| SceneFileError::NotFinite {
                        path: path.to_path_buf(),
                        index,
                        property: rows.property(column),
                        value: row.values[column] as f32,
                    })?,
            );
        }
        return Ok(points);
    }
    Err(SceneFileError::Header {
        path: path.to_path_buf(),
        reason: "no element `vertex`; this is no file of points".to_owned(),
    })
}

/// Columns of a point's values.
struct Columns {
    position: [usize; 3],
    /// With the value that stands for full intensity.
    color: Option<[(usize, f64); 3]>,
}

impl Columns {
    fn find(path: &Path, vertex: &ElementDef) -> Result<Self, SceneFileError> {
        let number = |name: &str| match vertex.properties.get_full(name) {
            Some((column, _, property)) => match &property.data_type {
                PropertyType::Scalar(scalar) => Some((column, most(scalar))),
                PropertyType::List(..) => None,
            },
            None => None,
        };
        let mut position = [0; 3];
        for (column, name) in position.iter_mut().zip(["x", "y", "z"]) {
            let missing = || SceneFileError::MissingProperty {
                path: path.to_path_buf(),
                property: name.to_owned(),
            };
            (*column, _) = number(name).ok_or_else(missing)?;
        }
        let color = COLORS.iter().find_map(|[r, g, b]| {
            let [r, g, b] = [number(r)?, number(g)?, number(b)?];
            Some([r, g, b])
        });
        Ok(Self { position, color })
    }

    /// The point of a row, or the column of a value that is not finite.
    fn point(&self, row: &PointRow) -> Result<ColoredPoint, usize> {
        let value = |column: usize| {
            let value = row.values[column];
            if value.is_finite() {
                Ok(value)
            } else {
                Err(column)
            }
        };
        let [x, y, z] = self.position;
        let position = [value(x)?, value(y)?, value(z)?];
        let mut color = [GREY; 3];
        if let Some(columns) = self.color {
            for (channel, (column, most)) in color.iter_mut().zip(columns) {
                // The conversion saturates.
                *channel = (value(column)? * 255.0 / most).round() as u8;
            }
        }
        Ok((position, color))
    }
}

/// The value of a colour's full intensity.
fn most(scalar: &ScalarType) -> f64 {
    match scalar {
        ScalarType::Float | ScalarType::Double => 1.0,
        ScalarType::UShort => 65_535.0,
        _ => 255.0,
    }
}

/// The values of one point in double precision, in the order of the header.
struct PointRow {
    values: Vec<f64>,
}

impl PropertyAccess for PointRow {
    fn new() -> Self {
        Self {
            values: Vec::with_capacity(16),
        }
    }

    fn set_property(&mut self, _name: &str, property: Property) -> PropertyAccessResult {
        self.values.push(match property {
            Property::Double(value) => value,
            other => other.to_f32_lossy().map_or(f64::NAN, f64::from),
        });
        PropertyAccessResult::Set
    }
}

impl FileRow for PointRow {
    fn push_word(&mut self, word: &str) -> bool {
        let value = word.parse();
        self.values.extend(&value);
        value.is_ok()
    }

    fn push_list(&mut self) {
        self.values.push(f64::NAN);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str, tail: &[u8]) -> Result<Vec<ColoredPoint>, String> {
        let file = [text.as_bytes(), tail].concat();
        parse_points(Path::new("points.ply"), &file).map_err(|error| error.to_string())
    }

    #[test]
    fn positions_keep_double_precision_and_colours_any_type() {
        let head = "ply\nformat ascii 1.0\nelement camera 1\nproperty int id\nelement vertex 2\n";
        let body = "property uchar blue\nproperty double x\nproperty double y\nproperty double z\n\
            property uchar red\nproperty list uchar int seen\nproperty uchar green\nend_header\n\
            7\n3 16777217 -2 1e-9 1 2 8 9 2\n0 0 0 0 255 0 7\n";
        let expected = vec![
            ([16_777_217.0, -2.0, 1e-9], [1, 2, 3]),
            ([0.0; 3], [255, 7, 0]),
        ];
        assert_eq!(parse(head, body.as_bytes()), Ok(expected));

        let binary = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty double x\n\
            property float y\nproperty short z\nproperty float r\nproperty float g\n\
            property float b\nend_header\n";
        let mut row = 16_777_217.0f64.to_le_bytes().to_vec();
        row.extend(0.5f32.to_le_bytes());
        row.extend((-3i16).to_le_bytes());
        row.extend([0.0f32, 0.5, 1.5].iter().flat_map(|x| x.to_le_bytes()));
        let expected = vec![([16_777_217.0, 0.5, -3.0], [0, 128, 255])];
        assert_eq!(parse(binary, &row), Ok(expected));

        let plain = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
            property float z\nend_header\n1 2 3\n";
        assert_eq!(parse(plain, b""), Ok(vec![([1.0, 2.0, 3.0], [128; 3])]));
        assert_eq!(
            parse(&plain.replace("vertex 1", "vertex 0"), b""),
            Ok(vec![])
        );
    }

    #[test]
    fn a_bad_file_of_points_is_named() {
        let plain = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
            property float z\nend_header\n1 2 3\n";
        for (text, word) in [
            (plain.to_owned(), "truncated"),
            (format!("{plain}1 inf 2\n"), "y"),
            (format!("{plain}1 two 2\n"), "`two`"),
            (plain.replace("float z", "list uchar int z"), "`z`"),
            (plain.replace("vertex 2", "face 1"), "no element `vertex`"),
            (String::new(), "does not begin"),
        ] {
            let message = parse(&text, b"").unwrap_err();
            assert!(
                message.contains("points.ply") && message.contains(word),
                "{message}"
            );
        }
    }
}
