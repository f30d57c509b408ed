//! Protection of a command's inputs from its outputs.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use super::ReportError;

/// Refuses outputs that are files which the command reads, under any name.
///
/// # Errors
///
/// [`ReportError::Input`], naming the first such file.
pub fn refuse_inputs<'a>(
    outputs: impl IntoIterator<Item = PathBuf>,
    inputs: impl IntoIterator<Item = &'a Path>,
) -> Result<(), ReportError> {
    let inputs = inputs
        .into_iter()
        .filter_map(|path| path.canonicalize().ok());
    let inputs: HashSet<PathBuf> = inputs.collect();
    // A file that does not exist is no input.
    let is_input = |path: &PathBuf| path.canonicalize().is_ok_and(|path| inputs.contains(&path));
    match outputs.into_iter().find(is_input) {
        None => Ok(()),
        Some(path) => Err(ReportError::Input { path }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_input_is_known_by_any_name() {
        let folder = tempfile::TempDir::new().unwrap();
        let [input, other] = ["in.png", "other.png"].map(|name| folder.path().join(name));
        std::fs::write(&input, b"photo").unwrap();
        std::fs::write(&other, b"picture").unwrap();
        let round_about = folder.path().join("sub/../in.png");
        std::fs::create_dir(folder.path().join("sub")).unwrap();
        let check = |output: PathBuf| refuse_inputs([other.clone(), output], [input.as_path()]);
        assert!(check(folder.path().join("new.png")).is_ok());
        for output in [input.clone(), round_about] {
            let message = check(output).unwrap_err().to_string();
            assert!(
                message.contains("in.png: the command reads it"),
                "{message}"
            );
        }
    }
}
