//! Files that are written whole or not at all.

use std::io::{BufWriter, Write};
use std::path::Path;

use super::ReportError;

/// Replaces the file `path` by `contents`; folders on the way are made.
///
/// # Errors
///
/// [`ReportError::Io`]; the old file, if there was one, is then untouched.
pub fn write(path: &Path, contents: &[u8]) -> Result<(), ReportError> {
    write_with(path, |out| out.write_all(contents))
}

/// Replaces the file `path` by what `write` puts into it, see [`write()`].
///
/// # Errors
///
/// [`ReportError::Io`], also for an error of `write` itself.
pub fn write_with(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
) -> Result<(), ReportError> {
    let replace = || -> std::io::Result<()> {
        let folder = match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        std::fs::create_dir_all(folder)?;
        // On the same file system as its place, so that the rename is one step.
        let mut builder = tempfile::Builder::new();
        readable_by_all(&mut builder);
        let mut out = BufWriter::new(builder.tempfile_in(folder)?);
        write(&mut out)?;
        let file = out.into_inner().map_err(|error| error.into_error())?;
        file.persist(path)?;
        Ok(())
    };
    replace().map_err(|source| ReportError::Io {
        path: path.to_path_buf(),
        source,
    })
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
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("new/report.txt");
        write(&path, b"old").unwrap();
        let failed = write_with(&path, |out| {
            out.write_all(b"half")?;
            Err(std::io::Error::other("power cut"))
        });
        let message = failed.unwrap_err().to_string();
        assert!(message.contains("report.txt") && message.contains("power cut"));
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        write(&path, b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert_eq!(
            std::fs::read_dir(path.parent().unwrap()).unwrap().count(),
            1
        );
    }
}
