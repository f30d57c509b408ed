//! Files that are written whole or not at all.

use std::io::Write;
use std::path::Path;

use super::ReportError;

/// Replaces the file `path` by `contents`; folders on the way are made.
///
/// # Errors
///
/// Whatever the system says; the old file, if there was one, is then untouched.
pub fn write_atomically(path: &Path, contents: &[u8]) -> std::io::Result<()> {
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    std::fs::create_dir_all(folder)?;
    // On the same file system as its place, so that the rename is one step.
    let mut builder = tempfile::Builder::new();
    readable_by_all(&mut builder);
    let mut file = builder.tempfile_in(folder)?;
    file.write_all(contents)?;
    file.persist(path)?;
    Ok(())
}

/// [`write_atomically`], its error naming the file.
pub(super) fn write(path: &Path, contents: &[u8]) -> Result<(), ReportError> {
    write_atomically(path, contents).map_err(|source| ReportError::Io {
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
    fn a_failed_write_leaves_nothing_behind() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("new/report.txt");
        write(&path, b"old").unwrap();
        write(&path, b"new").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");

        // A folder in the file's place cannot be replaced.
        let blocked = folder.path().join("new");
        let message = write(&blocked, b"half").unwrap_err().to_string();
        assert!(message.contains("new"), "{message}");
        // Neither beside the good file nor beside the blocked one is anything else.
        assert_eq!(std::fs::read_dir(&blocked).unwrap().count(), 1);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
