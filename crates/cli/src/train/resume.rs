//! `--resume`: finds the run to resume, and refuses to start over an incomplete one.

use std::path::{Path, PathBuf};

use super::super::Failure;
use super::super::photos::is_same;
use super::results::{CHECKPOINT, METRICS, SCENE};
use splat_trainer::Checkpoint;

/// An interrupted run.
pub(super) struct Interrupted {
    /// Path of the checkpoint.
    pub path: PathBuf,
    pub checkpoint: Checkpoint,
}

impl Interrupted {
    /// Reads the run in a folder, or a checkpoint file. Errors describe what was found instead.
    pub(super) fn open(given: &Path) -> Result<Self, Failure> {
        let path = match given.is_dir() {
            true => given.join(CHECKPOINT),
            false => given.to_owned(),
        };
        if let Some(reason) = not_resumable(given, &path) {
            let given = given.display();
            return Err(Failure::BadInput(format!("--resume {given}: {reason}")));
        }
        let checkpoint = Checkpoint::load(&path)?;
        Ok(Self { path, checkpoint })
    }

    /// The folder of the run.
    pub(super) fn folder(&self) -> &Path {
        match self.path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        }
    }
}

/// Why there is nothing to resume, if that can be told without reading a file.
fn not_resumable(given: &Path, checkpoint: &Path) -> Option<String> {
    if !given.exists() {
        return Some("no such folder or file; give the folder of an interrupted run".to_owned());
    }
    if given.is_dir() {
        if checkpoint.exists() {
            return None;
        }
        if given.join(METRICS).exists() && given.join(SCENE).exists() {
            return Some(
                "the run in this folder is complete, nothing is left to go on with; to train longer, begin a run \
                 with more --steps in another folder"
                    .to_owned(),
            );
        }
        let beside = match given.join(SCENE).exists() {
            true => " beside its scene, which alone is not enough",
            false => "",
        };
        return Some(format!(
            "there is no {CHECKPOINT} in this folder{beside}; give the folder of an interrupted run"
        ));
    }
    match given.extension()?.to_str()? {
        "ply" => Some(format!(
            "a scene alone cannot be trained on, the optimiser's state is not in it; give the folder of an interrupted \
             run, with its {CHECKPOINT}"
        )),
        "toml" => Some(
            "these are settings, not the state of a run; to begin a run with them: --config"
                .to_owned(),
        ),
        "json" | "csv" | "svg" | "png" => Some(format!(
            "a result of a run, not its state; give the folder of an interrupted run, with its {CHECKPOINT}"
        )),
        _ => None,
    }
}

/// Refuses to write to a folder that contains the checkpoint of a run other than the `resumed` one:
/// it is all that is left of that run.
pub(super) fn refuse_unfinished(out: &Path, resumed: Option<&Path>) -> Result<(), Failure> {
    let path = out.join(CHECKPOINT);
    // A folder of that name is no checkpoint, and is reported as such.
    if !path.is_file() || resumed.is_some_and(|other| is_same(other, &path)) {
        return Ok(());
    }
    Err(Failure::BadInput(format!(
        "{}: the checkpoint of a run that is not complete; go on with it (--resume), write to another folder (--out), or \
         remove the file",
        path.display()
    )))
}
