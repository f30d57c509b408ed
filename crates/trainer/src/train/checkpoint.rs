//! The whole state of a run in one safetensors file: the model, the optimiser's moments, the
//! statistics of density control, how far it got, its settings, and what tells its capture from another. A resumed run
//! goes on with the same numbers, or not at all.

mod check;
mod run;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use burn::module::{Param, ParamId};
use burn::store::RecordError;
use burn::tensor::{Bytes, Device, Tensor, TensorData};
use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use splat_model::Gaussians;

use super::{History, State};
use splat_data::write_durably;

pub(super) use run::RunRecord;

/// File format version; a reader refuses others.
const VERSION: u32 = 3;
/// Key of the metadata entry that holds everything but tensors.
const META: &str = "burn_splat";
/// Key of the metadata entry with the checksum of everything else: a number that the disk lost would go on silently.
const CHECKSUM: &str = "burn_splat_checksum";

/// Why a checkpoint cannot be written or used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// Reading or writing failed.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Not a checkpoint of this program, or damaged.
    #[error("{path}: not a usable checkpoint: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The checkpoint of a run on another capture.
    #[error(
        "{path}: the run was begun on another capture (`{name}`): {difference}; give the capture it was begun on, or begin another run in another folder"
    )]
    OtherCapture {
        /// The file.
        path: PathBuf,
        /// Name of the run's capture.
        name: String,
        /// What differs, the first thing.
        difference: String,
    },
    /// The checkpoint of a run with other settings.
    #[error(
        "{path}: the run was begun with {difference}; leave that out to go on with the run's settings, or begin another run in another folder"
    )]
    OtherSettings {
        /// The file.
        path: PathBuf,
        /// Every such setting, with the two values.
        difference: String,
    },
    /// Nothing would be left to train.
    #[error(
        "{path}: {done} of the run's {steps} steps are done; {wanted} would leave nothing to train, ask for more than {done}"
    )]
    NothingLeft {
        /// The file.
        path: PathBuf,
        /// Steps done.
        done: usize,
        /// Steps of the run.
        steps: usize,
        /// Steps asked for.
        wanted: usize,
    },
    /// The optimiser's state could not be packed.
    #[error("the optimiser's state cannot be saved: {0}")]
    Optimizer(#[from] RecordError),
}

/// Name, shape and values.
type SavedTensor = (String, Vec<usize>, Vec<f32>);

impl CheckpointError {
    /// What failures of one kind share, so that a kind is told once.
    pub(super) fn kind(&self) -> String {
        match self {
            Self::Io { path, source } => format!("{} {:?}", path.display(), source.kind()),
            other => other.to_string(),
        }
    }
}

/// The state of a run, on the host.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    path: PathBuf,
    meta: Meta,
    tensors: Vec<SavedTensor>,
    optimizer: Vec<u8>,
}

/// The part of [`Meta`] that all versions have.
#[derive(Deserialize)]
struct Versioned {
    version: u32,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct Meta {
    version: u32,
    step: usize,
    run: RunRecord,
    elapsed_seconds: f64,
    /// As bits, which JSON does not round.
    origin_bits: [u64; 3],
    /// Parameter ids, by which the optimiser knows its states; as strings, JSON has no u64.
    param_ids: Vec<(String, String)>,
    edits_seen: Vec<usize>,
    history: History,
}

impl Checkpoint {
    /// The state of a run. The optimiser must have followed all edits of rows.
    pub(super) fn of(
        gaussians: &Gaussians,
        state: &State,
        run: &RunRecord,
    ) -> Result<Self, CheckpointError> {
        let data = gaussians.to_data();
        let n = data.len();
        let rest = data.sh_rest_len();
        let mut tensors = vec![
            ("means", vec![n, 3], data.means.into_flattened()),
            ("log_scales", vec![n, 3], data.log_scales.into_flattened()),
            ("quats", vec![n, 4], data.quats.into_flattened()),
            ("opacity_logits", vec![n], data.opacity_logits),
            ("sh0", vec![n, 1, 3], data.sh0.into_flattened()),
        ];
        if rest > 0 {
            tensors.push(("sh_rest", vec![n, rest / 3, 3], data.sh_rest));
        }
        if let Some((gradients, views)) = state.density.statistics() {
            tensors.push(("density.gradients", vec![n], gradients));
            tensors.push(("density.views", vec![n], views));
        }
        Ok(Self {
            path: PathBuf::from("checkpoint"),
            meta: Meta {
                version: VERSION,
                step: state.step,
                run: run.clone(),
                elapsed_seconds: state.elapsed.as_secs_f64(),
                origin_bits: gaussians.origin.map(f64::to_bits),
                param_ids: param_ids(gaussians),
                edits_seen: state.edits.iter().map(|log| log.count()).collect(),
                history: state.history.clone(),
            },
            tensors: tensors
                .into_iter()
                .map(|(name, shape, values)| (name.to_owned(), shape, values))
                .collect(),
            optimizer: state.optimizer.into_bytes()?.to_vec(),
        })
    }

    /// Steps done.
    pub fn step(&self) -> usize {
        self.meta.step
    }

    /// Number of Gaussians.
    pub fn gaussians(&self) -> usize {
        self.find("means").map_or(0, |(_, shape, _)| shape[0])
    }

    /// Writes the file beside its place and renames it, so that a crash, of the machine too, leaves the old one or the
    /// new one.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn save(&self, path: &Path) -> Result<(), CheckpointError> {
        let format = |reason: String| CheckpointError::Format {
            path: path.to_path_buf(),
            reason,
        };
        // What could not be read again must not replace what can.
        check::tensors(&self.tensors)
            .map_err(|reason| format(format!("the run has left all bounds: {reason}")))?;
        let bytes: Vec<(&str, &[usize], Vec<u8>)> = self
            .tensors
            .iter()
            .map(|(name, shape, values)| {
                let bytes = values
                    .iter()
                    .flat_map(|value| value.to_le_bytes())
                    .collect();
                (name.as_str(), shape.as_slice(), bytes)
            })
            .collect();
        let bad = |error: SafeTensorError| format(error.to_string());
        let mut views = Vec::with_capacity(bytes.len() + 1);
        for (name, shape, bytes) in &bytes {
            let view = TensorView::new(Dtype::F32, shape.to_vec(), bytes).map_err(bad)?;
            views.push((*name, view));
        }
        let length = vec![self.optimizer.len()];
        let optimizer = TensorView::new(Dtype::U8, length, &self.optimizer).map_err(bad)?;
        views.push(("optimizer", optimizer));
        let meta = serde_json::to_string(&self.meta).map_err(|error| format(error.to_string()))?;
        let contents = views.iter().map(|(name, view)| (*name, view.data()));
        let checksum = checksum(&meta, contents.collect());
        let meta = HashMap::from([(META.to_owned(), meta), (CHECKSUM.to_owned(), checksum)]);
        let file = safetensors::serialize(views, Some(meta)).map_err(bad)?;
        write_durably(path, &file).map_err(|source| CheckpointError::Io {
            path: path.to_path_buf(),
            source,
        })
    }

    /// Reads a file that [`save`](Self::save) wrote.
    ///
    /// # Errors
    /// When it cannot be read or is not such a file.
    pub fn load(path: &Path) -> Result<Self, CheckpointError> {
        let bytes = std::fs::read(path).map_err(|source| CheckpointError::Io {
            path: path.to_path_buf(),
            source,
        })?;
        Self::parse(path, &bytes)
    }

    /// [`load`](Self::load) on the content of a file; `path` is for messages.
    ///
    /// # Errors
    /// When it is not such a file, or its parts do not fit together.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, CheckpointError> {
        let format = |reason: String| CheckpointError::Format {
            path: path.to_path_buf(),
            reason,
        };
        let bad = |error: SafeTensorError| format(error.to_string());
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(bad)?;
        let entry = |key| header.metadata().as_ref().and_then(|map| map.get(key));
        let meta =
            entry(META).ok_or_else(|| format("it was not written by `splat train`".into()))?;
        let json = |error: serde_json::Error| format(error.to_string());
        let Versioned { version } = serde_json::from_str(meta).map_err(json)?;
        if version != VERSION {
            return Err(format(format!(
                "its format is version {version}, this program reads {VERSION}; go on with the program that wrote it, or begin the run again"
            )));
        }
        let file = SafeTensors::deserialize(bytes).map_err(bad)?;
        if entry(CHECKSUM) != Some(&checksum_of(meta, &file)) {
            return Err(format(
                "damaged: its checksum is another; go on from a copy, or begin the run again"
                    .into(),
            ));
        }
        let meta: Meta = serde_json::from_str(meta).map_err(json)?;
        let mut tensors = Vec::new();
        let mut optimizer = Vec::new();
        for (name, view) in file.tensors() {
            if name == "optimizer" && view.dtype() == Dtype::U8 {
                optimizer = view.data().to_vec();
                continue;
            }
            if view.dtype() != Dtype::F32 {
                return Err(format(format!(
                    "tensor `{name}` is {:?}, not F32",
                    view.dtype()
                )));
            }
            let (chunks, _) = view.data().as_chunks::<4>();
            let values = chunks
                .iter()
                .map(|bytes| f32::from_le_bytes(*bytes))
                .collect();
            tensors.push((name, view.shape().to_vec(), values));
        }
        check::tensors(&tensors).map_err(format)?;
        check::meta(&meta).map_err(format)?;
        check::optimizer(&optimizer, &meta, &tensors).map_err(format)?;
        Ok(Self {
            path: path.to_path_buf(),
            meta,
            tensors,
            optimizer,
        })
    }

    /// Puts a run back to where it was, and returns its model.
    pub(super) fn restore(
        self,
        state: &mut State,
        device: &Device,
    ) -> Result<Gaussians, CheckpointError> {
        let gaussians = Gaussians {
            origin: self.meta.origin_bits.map(f64::from_bits),
            means: self.param("means", device)?,
            log_scales: self.param("log_scales", device)?,
            quats: self.param("quats", device)?,
            opacity_logits: self.param("opacity_logits", device)?,
            sh0: self.param("sh0", device)?,
            sh_rest: match self.find("sh_rest") {
                Some(_) => Some(self.param("sh_rest", device)?),
                None => None,
            },
        };
        let inner = device.clone().without_autodiff();
        if self.find("density.views").is_some() {
            state.density.restore_statistics(
                self.tensor("density.gradients", &inner)?,
                self.tensor("density.views", &inner)?,
            );
        }
        for (log, count) in state.edits.iter().zip(&self.meta.edits_seen) {
            log.resume(*count);
        }
        let optimizer = Bytes::from_bytes_vec(self.optimizer);
        state.optimizer = state.optimizer.clone().from_bytes(optimizer)?;
        state.step = self.meta.step;
        state.elapsed = Duration::try_from_secs_f64(self.meta.elapsed_seconds).unwrap_or_default();
        state.history = self.meta.history;
        Ok(gaussians)
    }

    fn find(&self, name: &str) -> Option<&SavedTensor> {
        self.tensors.iter().find(|(found, ..)| found == name)
    }

    fn tensor<const D: usize>(
        &self,
        name: &str,
        device: &Device,
    ) -> Result<Tensor<D>, CheckpointError> {
        let format = |reason: String| CheckpointError::Format {
            path: self.path.clone(),
            reason,
        };
        let (_, shape, values) = self
            .find(name)
            .ok_or_else(|| format(format!("tensor `{name}` is missing")))?;
        let shape: [usize; D] = shape
            .as_slice()
            .try_into()
            .map_err(|_| format(format!("tensor `{name}` has shape {shape:?}")))?;
        Ok(Tensor::from_data(
            TensorData::new(values.clone(), shape),
            device,
        ))
    }

    fn param<const D: usize>(
        &self,
        name: &str,
        device: &Device,
    ) -> Result<Param<Tensor<D>>, CheckpointError> {
        let value = self.tensor::<D>(name, device)?;
        let id = self
            .meta
            .param_ids
            .iter()
            .find_map(|(field, id)| (field == name).then(|| id.parse::<u64>().ok()).flatten())
            .ok_or_else(|| CheckpointError::Format {
                path: self.path.clone(),
                reason: format!("the id of parameter `{name}` is missing"),
            })?;
        Ok(Param::initialized(ParamId::from(id), value.require_grad()))
    }
}

/// The checksum that a file must have to be what was saved; none of what is no checkpoint.
pub fn expected_checksum(bytes: &[u8]) -> Option<String> {
    let (_, header) = SafeTensors::read_metadata(bytes).ok()?;
    let meta = header.metadata().as_ref()?.get(META)?;
    Some(checksum_of(meta, &SafeTensors::deserialize(bytes).ok()?))
}

fn checksum_of(meta: &str, file: &SafeTensors) -> String {
    let contents = file.iter().map(|(name, view)| (name, view.data()));
    checksum(meta, contents.collect())
}

/// Checksum of a file's contents: the metadata, then each tensor's name and bytes in the order of the names.
fn checksum(meta: &str, mut contents: Vec<(&str, &[u8])>) -> String {
    contents.sort_unstable_by_key(|(name, _)| *name);
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(meta.as_bytes());
    for (name, bytes) in contents {
        hasher.update(name.as_bytes());
        hasher.update(bytes);
    }
    hasher.finalize().to_string()
}

fn param_ids(gaussians: &Gaussians) -> Vec<(String, String)> {
    let mut ids = vec![
        ("means", gaussians.means.id),
        ("log_scales", gaussians.log_scales.id),
        ("quats", gaussians.quats.id),
        ("opacity_logits", gaussians.opacity_logits.id),
        ("sh0", gaussians.sh0.id),
    ];
    ids.extend(
        gaussians
            .sh_rest
            .as_ref()
            .map(|param| ("sh_rest", param.id)),
    );
    ids.into_iter()
        .map(|(name, id)| (name.to_owned(), id.val().to_string()))
        .collect()
}

#[cfg(all(test, feature = "cpu"))]
mod tests;

#[cfg(test)]
impl Checkpoint {
    /// Damages a tensor, for tests.
    pub(super) fn drop_row(&mut self, name: &str) {
        for (found, shape, values) in &mut self.tensors {
            if found == name {
                shape[0] -= 1;
                values.truncate(shape.iter().product());
            }
        }
    }
}
