//! The files of a scene: in a zip archive, or beside `meta.json`.

use std::borrow::Cow;
use std::io::{Cursor, Write};
use std::path::{Component, Path};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::super::SceneFileError;
use super::super::limits::read_at_most;
use super::meta::Meta;
use crate::text::one_line;

/// First bytes of a zip archive.
pub(super) const ZIP: &[u8] = b"PK\x03\x04";
/// Bytes of a file that are read however small the archive is: `meta.json` may be deflated.
const ALWAYS: u64 = 1 << 20;

/// Files by name, all in memory.
#[derive(Debug, Default)]
pub(super) struct Files(Vec<(String, Vec<u8>)>);

impl Files {
    pub fn add(&mut self, name: &str, contents: Vec<u8>) {
        self.0.push((name.to_owned(), contents));
    }

    /// Bytes of all files.
    pub fn bytes(&self) -> u64 {
        self.0
            .iter()
            .map(|(_, contents)| contents.len() as u64)
            .sum()
    }

    /// The file that entry `at` of a list in `meta.json` names.
    pub fn get<'a>(
        &'a self,
        path: &Path,
        field: &'static str,
        names: &[String],
        at: usize,
    ) -> Result<Cow<'a, [u8]>, SceneFileError> {
        let name = names.get(at);
        let found = name.and_then(|name| self.0.iter().find(|(known, _)| known == name));
        match found {
            Some((_, contents)) => Ok(Cow::Borrowed(contents)),
            None => Err(SceneFileError::Field {
                path: path.to_path_buf(),
                field,
                reason: format!(
                    "meta.json names {} file(s) instead of {}",
                    names.len(),
                    at + 1
                ),
            }),
        }
    }

    /// A zip archive of the files, which are compressed already.
    pub fn pack(&self) -> std::io::Result<Vec<u8>> {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        for (name, contents) in &self.0 {
            zip.start_file(name.as_str(), stored)?;
            zip.write_all(contents)?;
        }
        Ok(zip.finish()?.into_inner())
    }
}

/// A zip archive in memory.
pub(super) struct Archive<'a> {
    path: &'a Path,
    zip: ZipArchive<Cursor<&'a [u8]>>,
    most: u64,
}

impl<'a> Archive<'a> {
    pub fn open(path: &'a Path, bytes: &'a [u8]) -> Result<Self, SceneFileError> {
        let zip = ZipArchive::new(Cursor::new(bytes)).map_err(|error| SceneFileError::Header {
            path: path.to_path_buf(),
            reason: format!("no zip archive of a SOG scene: {}", text(&error)),
        })?;
        Ok(Self {
            path,
            zip,
            // Images are compressed already.
            most: 2 * bytes.len() as u64 + ALWAYS,
        })
    }

    /// The contents of a file of the archive.
    pub fn file(&mut self, field: &'static str, name: &str) -> Result<Vec<u8>, SceneFileError> {
        let bad = |reason: String| SceneFileError::Field {
            path: self.path.to_path_buf(),
            field,
            reason: format!("`{}`: {reason}", name.escape_debug()),
        };
        let mut file = self.zip.by_name(name).map_err(|error| bad(text(&error)))?;
        let contents = read_at_most(&mut file, self.most + 1)
            .map_err(|error| bad(one_line(&error.to_string())))?;
        if contents.len() as u64 > self.most {
            return Err(bad(format!(
                "more than {} bytes, which this archive cannot hold; it is damaged",
                self.most
            )));
        }
        Ok(contents)
    }
}

fn text(error: &zip::result::ZipError) -> String {
    one_line(&error.to_string())
}

/// The images beside `meta.json`.
pub(super) fn open_folder(path: &Path, meta: &Meta) -> Result<Files, SceneFileError> {
    let mut files = Files::default();
    for (field, name) in meta.images() {
        let bad = |reason: String| SceneFileError::Field {
            path: path.to_path_buf(),
            field,
            reason: format!("`{}`: {reason}", name.escape_debug()),
        };
        let mut parts = Path::new(name).components();
        let (first, second) = (parts.next(), parts.next());
        if !matches!((first, second), (Some(Component::Normal(_)), None)) {
            return Err(bad("no name of a file beside it".into()));
        }
        let contents = std::fs::read(path.with_file_name(name));
        files.add(name, contents.map_err(|error| bad(error.to_string()))?);
    }
    Ok(files)
}
