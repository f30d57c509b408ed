//! PLY in the layout of the 3DGS paper's code, the one that viewers read.
//!
//! One element `vertex` per Gaussian with the properties, all `float`,
//!
//! ```text
//! x y z  nx ny nz  f_dc_0..2  f_rest_0..(3 (K - 1) - 1)  opacity  scale_0..2  rot_0..3
//! ```
//!
//! where K = (degree + 1)^2, opacity is the logit, scale the natural logarithm, rot the quaternion (w, x, y, z), and
//! `f_rest_*` runs over the coefficients of red, then of green, then of blue (channel-major; in [`SplatData`] it is
//! coefficient-major). The normals are written as 0 and not read.
//!
//! A scene whose means do not count from the world's zero ([`SplatData::origin`]) says so in a comment,
//! `comment origin X Y Z`; other programs see it without that offset.
//!
//! [`write()`] writes binary little endian. [`read()`] also takes ASCII and big endian, properties in any order and of any
//! number type (such as `double`), and ignores properties and elements it does not know.

mod header;
mod names;
mod repetition;

use std::cell::Cell;
use std::fs::File;
use std::io::{BufRead, BufReader, BufWriter, ErrorKind, Write};
use std::path::Path;

use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{
    ElementDef, Encoding, Header, Property, PropertyAccess, PropertyAccessResult, PropertyDef,
    PropertyType, ScalarType,
};
use ply_rs_bw::writer::Writer;

use self::names::property_names;
use super::{SceneFileError, SplatData};

/// First word of the comment that holds the origin.
const ORIGIN: &str = "origin";

/// Writes `scene` to `path`, whole or not at all: beside it first, then renamed.
///
/// # Errors
///
/// [`SceneFileError::Shape`] where the arrays of the scene do not fit each other, [`SceneFileError::NotFinite`] where a
/// value is NaN or infinite (no reader would take the file), [`SceneFileError::Io`] where the file cannot be written.
pub fn write(path: &Path, scene: &SplatData) -> Result<(), SceneFileError> {
    scene.check_shape()?;
    let names = property_names(scene.sh_rest_len());
    let io_error = |source| SceneFileError::Io {
        path: path.to_path_buf(),
        source,
    };
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let mut file = tempfile::Builder::new();
    readable_by_all(&mut file);
    let file = file.tempfile_in(folder).map_err(io_error)?;

    let mut header = Header::new();
    header.encoding = Encoding::BinaryLittleEndian;
    let mut vertex = ElementDef::new("vertex".to_owned());
    vertex.count = scene.len();
    for name in &names {
        let property = PropertyDef::new(name.clone(), PropertyType::Scalar(ScalarType::Float));
        vertex.properties.insert(name.clone(), property);
    }
    header.elements.insert("vertex".to_owned(), vertex);
    if scene.origin != [0.0; 3] {
        let [x, y, z] = scene.origin;
        header.comments.push(format!("{ORIGIN} {x} {y} {z}"));
    }
    let vertex = &header.elements["vertex"];

    let writer = Writer::<Row>::new();
    let mut out = BufWriter::with_capacity(1 << 20, file);
    writer.write_header(&mut out, &header).map_err(io_error)?;
    let mut row = Row::new();
    for index in 0..scene.len() {
        row.fill(scene, index);
        if let Some(at) = row.values.iter().position(|value| !value.is_finite()) {
            return Err(SceneFileError::NotFinite {
                path: path.to_path_buf(),
                index,
                property: names[at].clone(),
                value: row.values[at],
            });
        }
        writer
            .write_little_endian_element(&mut out, &row, vertex)
            .map_err(io_error)?;
    }
    out.flush().map_err(io_error)?;
    let file = out
        .into_inner()
        .map_err(|error| io_error(error.into_error()))?;
    file.persist(path).map_err(|error| io_error(error.error))?;
    Ok(())
}

/// Reads the scene in the file `path`.
///
/// # Errors
///
/// [`SceneFileError`], naming the file and, where there is one, the property and the Gaussian.
pub fn read(path: &Path) -> Result<SplatData, SceneFileError> {
    let io_error = |source| SceneFileError::Io {
        path: path.to_path_buf(),
        source,
    };
    let file = File::open(path).map_err(io_error)?;
    let file_len = file.metadata().map_err(io_error)?.len();
    read_from(path, BufReader::with_capacity(1 << 20, file), file_len)
}

/// [`read()`] on the content of a file; `path` is for messages.
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
    file_len: u64,
) -> Result<SplatData, SceneFileError> {
    let header = header::read(path, &mut reader)?;
    let parser = Parser::<Row>::new();
    let columns = Columns::find(path, &header)?;
    for element in header.elements.values() {
        let mut rows = Rows {
            path,
            parser: &parser,
            encoding: header.encoding,
            element,
            line: String::new(),
        };
        if element.properties.is_empty() {
            continue; // whatever its count, nothing of it is in the file
        }
        if element.name != "vertex" {
            for index in 0..element.count {
                rows.next(&mut reader, index)?;
            }
            continue;
        }
        // A damaged count must not become a huge allocation: every property takes at least a byte.
        let most = file_len / element.properties.len().max(1) as u64;
        let mut scene = columns.empty_scene(element.count.min(most as usize));
        scene.origin = origin(path, &header)?;
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
    // `Columns::find` has made sure that there is an element `vertex`.
    Err(SceneFileError::Empty {
        path: path.to_path_buf(),
    })
}

/// The origin that the header's comments tell, or zero.
fn origin(path: &Path, header: &Header) -> Result<[f64; 3], SceneFileError> {
    let words = |comment: &str| comment.split_whitespace().map(str::to_owned).collect();
    let mut comments = header.comments.iter().map(|comment| words(comment));
    let found: Option<Vec<String>> =
        comments.find(|words: &Vec<String>| words.len() == 4 && words[0] == ORIGIN);
    let Some(words) = found else {
        return Ok([0.0; 3]);
    };
    let mut origin = [0.0; 3];
    for (value, word) in origin.iter_mut().zip(&words[1..]) {
        *value = match word.parse() {
            Ok(number) if f64::is_finite(number) => number,
            _ => {
                return Err(SceneFileError::Header {
                    path: path.to_path_buf(),
                    reason: format!(
                        "comment `{}`: `{word}` is no finite number",
                        words.join(" ")
                    ),
                });
            }
        };
    }
    Ok(origin)
}

/// The values of one element in the order of the header.
///
/// The PLY library hands values over and asks for them by name, once each and in the order of the header; keeping the
/// order and not looking at the names makes a million Gaussians of 62 properties cheap.
struct Row {
    values: Vec<f32>,
    /// Next value to be written.
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
        // A list keeps its place in the order; `Columns::find` refuses lists where a number is needed.
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

/// Reads the elements of one kind, one by one.
struct Rows<'a> {
    path: &'a Path,
    parser: &'a Parser<Row>,
    encoding: Encoding,
    element: &'a ElementDef,
    line: String,
}

impl Rows<'_> {
    fn next(&mut self, reader: &mut impl BufRead, index: usize) -> Result<Row, SceneFileError> {
        let row = match self.encoding {
            Encoding::Ascii => return self.next_line(reader, index),
            Encoding::BinaryLittleEndian => {
                self.parser.read_little_endian_element(reader, self.element)
            }
            Encoding::BinaryBigEndian => self.parser.read_big_endian_element(reader, self.element),
        };
        row.map_err(|error| match error.kind() {
            ErrorKind::UnexpectedEof => self.truncated(index),
            _ => self.bad(index, &error.to_string()),
        })
    }

    fn next_line(
        &mut self,
        reader: &mut impl BufRead,
        index: usize,
    ) -> Result<Row, SceneFileError> {
        loop {
            self.line.clear();
            match reader.read_line(&mut self.line) {
                Ok(0) => return Err(self.truncated(index)),
                Ok(_) if self.line.trim().is_empty() => {}
                Ok(_) => break,
                Err(error) => return Err(self.bad(index, &error.to_string())),
            }
        }
        self.parse_line()
            .map_err(|(property, reason)| self.bad(index, &format!("{property} {reason}")))
    }

    /// The line's values, or a property and what is wrong with it. The library's own grammar of lines knows neither
    /// NaN nor infinity, and it is worth naming the property that has them.
    fn parse_line(&self) -> Result<Row, (&str, String)> {
        let mut words = self.line.split_whitespace();
        let mut row = Row::new();
        for (name, property) in &self.element.properties {
            let mut word = || words.next().ok_or((name.as_str(), "is missing".to_owned()));
            let unreadable = |word: &str| (name.as_str(), format!("`{word}` is no number"));
            match property.data_type {
                PropertyType::Scalar(_) => {
                    let word = word()?;
                    let value = word.parse().map_err(|_| unreadable(word))?;
                    row.values.push(value);
                }
                PropertyType::List(..) => {
                    let length = word()?;
                    let length: usize = length.parse().map_err(|_| unreadable(length))?;
                    for _ in 0..length {
                        word()?;
                    }
                    row.values.push(f32::NAN);
                }
            }
        }
        match (words.next(), self.element.properties.last()) {
            (Some(word), Some((name, _))) => Err((
                name,
                format!("is followed by `{word}`, of which the header knows nothing"),
            )),
            _ => Ok(row),
        }
    }

    /// Name of the property in column `column`.
    fn property(&self, column: usize) -> String {
        let name = self.element.properties.get_index(column);
        name.map_or_else(String::new, |(name, _)| name.clone())
    }

    fn truncated(&self, index: usize) -> SceneFileError {
        SceneFileError::Truncated {
            path: self.path.to_path_buf(),
            index,
            count: self.element.count,
        }
    }

    fn bad(&self, index: usize, reason: &str) -> SceneFileError {
        SceneFileError::BadElement {
            path: self.path.to_path_buf(),
            index,
            reason: one_line(reason),
        }
    }
}

/// Where in a row each value of a Gaussian is.
struct Columns {
    means: [usize; 3],
    sh0: [usize; 3],
    /// In the order of [`SplatData::sh_rest`].
    sh_rest: Vec<usize>,
    opacity: usize,
    scales: [usize; 3],
    quats: [usize; 4],
    sh_degree: usize,
}

impl Columns {
    fn find(path: &Path, header: &Header) -> Result<Self, SceneFileError> {
        let header_error = |reason: &str| SceneFileError::Header {
            path: path.to_path_buf(),
            reason: reason.to_owned(),
        };
        let Some(vertex) = header.elements.get("vertex") else {
            return Err(header_error(
                "no element `vertex`; this is no PLY file in the 3DGS layout",
            ));
        };
        if vertex.properties.contains_key("packed_position") {
            return Err(header_error(
                "a compressed PLY file, which cannot be read yet; convert it to a plain one",
            ));
        }
        if vertex.count == 0 {
            return Err(SceneFileError::Empty {
                path: path.to_path_buf(),
            });
        }
        let column = |name: &str| match vertex.properties.get_full(name) {
            Some((column, _, property))
                if matches!(property.data_type, PropertyType::Scalar(_)) =>
            {
                Ok(column)
            }
            _ => Err(SceneFileError::MissingProperty {
                path: path.to_path_buf(),
                property: name.to_owned(),
            }),
        };
        let names = vertex.properties.keys();
        let rest = names.filter(|name| name.starts_with("f_rest_")).count();
        let sh_degree = match rest {
            0 => 0,
            9 => 1,
            24 => 2,
            45 => 3,
            count => {
                return Err(SceneFileError::RestCount {
                    path: path.to_path_buf(),
                    count,
                });
            }
        };
        // Coefficient k of channel c is f_rest_(c (K - 1) + k).
        let per_channel = rest / 3;
        let sh_rest = (0..rest)
            .map(|i| column(&format!("f_rest_{}", (i % 3) * per_channel + i / 3)))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            means: [column("x")?, column("y")?, column("z")?],
            sh0: [column("f_dc_0")?, column("f_dc_1")?, column("f_dc_2")?],
            sh_rest,
            opacity: column("opacity")?,
            scales: [column("scale_0")?, column("scale_1")?, column("scale_2")?],
            quats: [
                column("rot_0")?,
                column("rot_1")?,
                column("rot_2")?,
                column("rot_3")?,
            ],
            sh_degree,
        })
    }

    fn empty_scene(&self, capacity: usize) -> SplatData {
        SplatData {
            origin: [0.0; 3],
            means: Vec::with_capacity(capacity),
            log_scales: Vec::with_capacity(capacity),
            quats: Vec::with_capacity(capacity),
            opacity_logits: Vec::with_capacity(capacity),
            sh0: Vec::with_capacity(capacity),
            sh_rest: Vec::with_capacity(capacity * self.sh_rest.len()),
            sh_degree: self.sh_degree,
        }
    }

    /// Appends the row's Gaussian to `scene`; or returns the first column, in the order of the fields, whose value is
    /// not finite.
    fn take(&self, row: &Row, scene: &mut SplatData) -> Result<(), usize> {
        let value = |column: usize| {
            let value = row.values[column];
            if value.is_finite() {
                Ok(value)
            } else {
                Err(column)
            }
        };
        fn all<const N: usize>(
            columns: [usize; N],
            value: impl Fn(usize) -> Result<f32, usize>,
        ) -> Result<[f32; N], usize> {
            let mut values = [0.0; N];
            for (out, column) in values.iter_mut().zip(columns) {
                *out = value(column)?;
            }
            Ok(values)
        }
        scene.means.push(all(self.means, value)?);
        scene.sh0.push(all(self.sh0, value)?);
        for &column in &self.sh_rest {
            scene.sh_rest.push(value(column)?);
        }
        scene.opacity_logits.push(value(self.opacity)?);
        scene.log_scales.push(all(self.scales, value)?);
        scene.quats.push(all(self.quats, value)?);
        Ok(())
    }
}

/// The library's messages span lines; ours do not.
fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Temporary files are private by default; the file that replaces the old one should not be.
#[cfg(unix)]
fn readable_by_all(builder: &mut tempfile::Builder<'_, '_>) {
    use std::os::unix::fs::PermissionsExt;
    // The process's umask still applies.
    builder.permissions(std::fs::Permissions::from_mode(0o666));
}

#[cfg(not(unix))]
fn readable_by_all(_: &mut tempfile::Builder<'_, '_>) {}

#[cfg(test)]
mod tests;
