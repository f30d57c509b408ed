//! Rows of a PLY file, one by one, in any of its encodings.

use std::io::{BufRead, ErrorKind};
use std::path::Path;

use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{ElementDef, Encoding, PropertyAccess, PropertyType};

use super::super::SceneFileError;
use crate::text::one_line;

/// The values of a row in the order of the header.
pub(super) trait FileRow: PropertyAccess {
    /// Appends the number that a word of a text file stands for; false if it is none.
    fn push_word(&mut self, word: &str) -> bool;
    /// Appends the place of a list.
    fn push_list(&mut self);
}

/// Reads the elements of one kind, one by one.
pub(super) struct Rows<'a, R: FileRow> {
    path: &'a Path,
    parser: &'a Parser<R>,
    encoding: Encoding,
    element: &'a ElementDef,
    line: String,
}

impl<'a, R: FileRow> Rows<'a, R> {
    pub fn new(
        path: &'a Path,
        parser: &'a Parser<R>,
        encoding: Encoding,
        element: &'a ElementDef,
    ) -> Self {
        Self {
            path,
            parser,
            encoding,
            element,
            line: String::new(),
        }
    }

    /// Skips all of them.
    pub fn skip(&mut self, reader: &mut impl BufRead) -> Result<(), SceneFileError> {
        // A binary file stores nothing for an element without properties, whatever count the header
        // announces.
        let nothing = self.element.properties.is_empty() && self.encoding != Encoding::Ascii;
        for index in 0..if nothing { 0 } else { self.element.count } {
            self.next(reader, index)?;
        }
        Ok(())
    }

    pub fn next(&mut self, reader: &mut impl BufRead, index: usize) -> Result<R, SceneFileError> {
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

    fn next_line(&mut self, reader: &mut impl BufRead, index: usize) -> Result<R, SceneFileError> {
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

    /// The values of the line, or a property and its problem. The library's own line grammar has no
    /// NaN or infinity, and errors should name the property.
    fn parse_line(&self) -> Result<R, (&str, String)> {
        let mut words = self.line.split_whitespace();
        let mut row = R::new();
        for (name, property) in &self.element.properties {
            let mut word = || words.next().ok_or((name.as_str(), "is missing".to_owned()));
            let unreadable = |word: &str| (name.as_str(), format!("`{word}` is no number"));
            match property.data_type {
                PropertyType::Scalar(_) => {
                    let word = word()?;
                    if !row.push_word(word) {
                        return Err(unreadable(word));
                    }
                }
                PropertyType::List(..) => {
                    let length = word()?;
                    let length: usize = length.parse().map_err(|_| unreadable(length))?;
                    for _ in 0..length {
                        word()?;
                    }
                    row.push_list();
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
    pub fn property(&self, column: usize) -> String {
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
