//! PLY in the layout of the 3DGS paper's code, which viewers read.
//!
//! One element `vertex` per Gaussian with these properties, all `float`:
//!
//! ```text
//! x y z  nx ny nz  f_dc_0..2  f_rest_0..(3 (K - 1) - 1)  opacity  scale_0..2  rot_0..3
//! ```
//!
//! Here K = (degree + 1)^2, opacity is the logit, scale the natural logarithm, rot the quaternion
//! (w, x, y, z), and `f_rest_*` holds the coefficients of red, then green, then blue
//! (channel-major; [`SplatData`] is coefficient-major). The normals are written as 0 and not read.
//!
//! Comments of the header hold the origin and the render settings ([`SplatData::settings`]), in the
//! form of `ply/comments.rs`. Other programs see the scene without the offset of its origin.
//!
//! [`write()`] writes binary little endian. [`read()`] also accepts ASCII and big endian,
//! properties in any order and of any number type (such as `double`), ignores unknown properties
//! and elements, and tolerates variations of the header listed in `ply/header.rs`.

mod columns;
mod comments;
mod header;
mod points;
mod repetition;
mod rows;

use std::cell::Cell;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;

use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{
    ElementDef, Encoding, Header, Property, PropertyAccess, PropertyAccessResult, PropertyDef,
    PropertyType, ScalarType,
};
use ply_rs_bw::writer::Writer;

use super::{SceneFileError, SceneFormat, SplatData};
use crate::replace::write_durably_with;
use columns::{Columns, may_be};
pub(crate) use points::parse_points;
use rows::{FileRow, Rows};

/// PLY files with splats.
pub(super) const FORMAT: SceneFormat = SceneFormat {
    name: "PLY",
    endings: &["ply"],
    is: |head| head.trim_ascii_start().starts_with(b"ply"),
    read: |path| read(path),
    write: |path, scene| write(path, scene),
    losses: |_| vec![],
};

/// Writes `scene` to `path` atomically: to a temporary file beside it, which is then renamed. The
/// new file reaches the disk before the old one is removed, so that one of them survives a machine
/// crash.
///
/// # Errors
///
/// [`SceneFileError::Shape`] if the arrays of the scene are inconsistent,
/// [`SceneFileError::NotFinite`] and [`SceneFileError::Setting`] for values that no reader would
/// accept (NaN, or meaningless infinities), [`SceneFileError::Io`] if the file cannot be written.
pub fn write(path: impl AsRef<Path>, scene: &SplatData) -> Result<(), SceneFileError> {
    let path = path.as_ref();
    scene.check_shape()?;
    let names = property_names(scene.sh_rest_len());
    let io_error = |source| SceneFileError::Io {
        path: path.to_path_buf(),
        source,
    };
    let mut header = Header::new();
    header.encoding = Encoding::BinaryLittleEndian;
    let mut vertex = ElementDef::new("vertex".to_owned());
    vertex.count = scene.len();
    for name in &names {
        let property = PropertyDef::new(name.clone(), PropertyType::Scalar(ScalarType::Float));
        vertex.properties.insert(name.clone(), property);
    }
    header.elements.insert("vertex".to_owned(), vertex);
    header.comments = comments::write(path, scene)?;
    let vertex = &header.elements["vertex"];

    let writer = Writer::<Row>::new();
    write_durably_with(path, io_error, |out| {
        writer.write_header(out, &header).map_err(io_error)?;
        let mut row = Row::new();
        for index in 0..scene.len() {
            row.fill(scene, index);
            let bad =
                |(at, value): (usize, &f32)| !value.is_finite() && !may_be(&names[at], *value);
            if let Some(at) = row.values.iter().enumerate().position(bad) {
                return Err(SceneFileError::NotFinite {
                    path: path.to_path_buf(),
                    index,
                    property: names[at].clone(),
                    value: row.values[at],
                });
            }
            writer
                .write_little_endian_element(out, &row, vertex)
                .map_err(io_error)?;
        }
        Ok(())
    })
}

/// Reads the scene in the file `path`.
///
/// # Errors
///
/// [`SceneFileError`], naming the file and, if applicable, the property and the Gaussian.
pub fn read(path: impl AsRef<Path>) -> Result<SplatData, SceneFileError> {
    let path = path.as_ref();
    let io_error = |source| SceneFileError::Io {
        path: path.to_path_buf(),
        source,
    };
    let file = File::open(path).map_err(io_error)?;
    let bytes = file.metadata().map_err(io_error)?.len();
    read_from(path, BufReader::with_capacity(1 << 20, file), bytes)
}

/// [`read()`] from the contents of a file; `path` is used in messages.
///
/// # Errors
///
/// Those of [`read()`].
pub fn parse(path: &Path, bytes: &[u8]) -> Result<SplatData, SceneFileError> {
    read_from(path, bytes, bytes.len() as u64)
}

fn read_from(
    path: &Path,
    mut reader: impl BufRead,
    bytes: u64,
) -> Result<SplatData, SceneFileError> {
    let parser = Parser::<Row>::new();
    let header = header::read(&mut reader, path)?;
    let columns = Columns::find(path, &header)?;
    for element in header.elements.values() {
        let mut rows = Rows::new(path, &parser, header.encoding, element);
        if element.properties.is_empty() {
            continue; // whatever its count, nothing of it is in the file
        }
        if element.name != "vertex" {
            rows.skip(&mut reader)?;
            continue;
        }
        // A damaged count must not cause a huge allocation: every property takes at least one byte.
        let most = bytes / element.properties.len().max(1) as u64;
        let mut scene = columns.empty_scene(element.count.min(most as usize));
        (scene.origin, scene.settings) = comments::read(path, &header.comments)?;
        for index in 0..element.count {
            let row = rows.next(&mut reader, index)?;
            columns
                .take(&row, &mut scene)
                .map_err(|column| SceneFileError::NotFinite {
                    path: path.to_path_buf(),
                    index,
                    property: rows.property(column),
                    value: row.values[column],
                })?;
        }
        return Ok(scene);
    }
    // `Columns::find` has checked that there is an element `vertex`.
    Err(SceneFileError::Empty {
        path: path.to_path_buf(),
    })
}

/// Property names in the order in which they are written, for `rest` values `f_rest_*`.
fn property_names(rest: usize) -> Vec<String> {
    let numbered = |stem: &'static str, count| (0..count).map(move |i| format!("{stem}_{i}"));
    ["x", "y", "z", "nx", "ny", "nz"]
        .into_iter()
        .map(str::to_owned)
        .chain(numbered("f_dc", 3))
        .chain(numbered("f_rest", rest))
        .chain(["opacity".to_owned()])
        .chain(numbered("scale", 3))
        .chain(numbered("rot", 4))
        .collect()
}

/// The values of one element in the order of the header.
///
/// The PLY library passes values by name, each once and in the order of the header. Relying on the
/// order instead of comparing names makes a million Gaussians of 62 properties cheap.
struct Row {
    values: Vec<f32>,
    /// Next value to write.
    next: Cell<usize>,
}

impl Row {
    /// Fills the row with Gaussian `index`, in the order of [`property_names`].
    fn fill(&mut self, scene: &SplatData, index: usize) {
        let rest = scene.sh_rest_len();
        let coefficients = &scene.sh_rest[index * rest..(index + 1) * rest];
        let values = &mut self.values;
        values.clear();
        values.extend(scene.means[index]);
        values.extend([0.0; 3]);
        values.extend(scene.sh0[index]);
        for channel in 0..3 {
            values.extend(coefficients.iter().skip(channel).step_by(3));
        }
        values.push(scene.opacity_logits[index]);
        values.extend(scene.log_scales[index]);
        values.extend(scene.quats[index]);
        self.next.set(0);
    }
}

impl PropertyAccess for Row {
    fn new() -> Self {
        Self {
            values: Vec::with_capacity(64),
            next: Cell::new(0),
        }
    }

    fn set_property(&mut self, _name: &str, property: Property) -> PropertyAccessResult {
        // A list keeps its position in the order; `Columns::find` refuses lists where a number is
        // required.
        self.values
            .push(property.to_f32_lossy().unwrap_or(f32::NAN));
        PropertyAccessResult::Set
    }

    fn set_float(&mut self, _name: &str, value: f32) -> PropertyAccessResult {
        self.values.push(value);
        PropertyAccessResult::Set
    }

    fn get_float(&self, _name: &str) -> Option<f32> {
        let at = self.next.replace(self.next.get() + 1);
        self.values.get(at).copied()
    }
}

impl FileRow for Row {
    fn push_word(&mut self, word: &str) -> bool {
        let value = word.parse();
        self.values.extend(&value);
        value.is_ok()
    }

    fn push_list(&mut self) {
        self.values.push(f32::NAN);
    }
}

#[cfg(test)]
mod tests;
