//! The whole state of a run in one safetensors file: the model with its optimisers' moments, the
//! state of strategy and hooks, the progress, the settings, and a fingerprint of the capture. A
//! resumed run continues with exactly the same numbers, or not at all.
//!
//! Tensor names begin with their owner: `model.means` is a parameter, `[N, width]`,
//! `model.means.moment_1` a moment of it, `strategy.gradients` a sum of density control,
//! `hook.exposure.gain` a parameter of the hook `exposure`.

mod check;
mod error;
mod run;

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::time::Duration;

use burn::tensor::{Device, TensorData};
use burn_pack::Scalar;
use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use splat_data::write_durably;
use splat_model::SplatModel;
use splat_model::optimizer::StateRecord;

use super::History;
use super::state::State;

pub use error::CheckpointError;
pub(super) use run::RunRecord;

/// File format version; a reader refuses others.
const VERSION: u32 = 5;
/// Key of the metadata entry for everything except tensors.
const META: &str = "burn_splat";
/// Key of the metadata entry with the checksum of everything else, so that corruption on disk is
/// noticed.
const CHECKSUM: &str = "burn_splat_checksum";

/// Name, shape and values.
type SavedTensor = (String, Vec<usize>, Vec<f32>);

/// The state of a run, on the host.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    path: PathBuf,
    meta: Meta,
    tensors: Vec<SavedTensor>,
}

/// A number that JSON preserves to the last bit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
enum SavedScalar {
    Int(i64),
    UInt(u64),
    FloatBits(u64),
    Bool(bool),
}

impl From<Scalar> for SavedScalar {
    fn from(value: Scalar) -> Self {
        match value {
            Scalar::Int(value) => Self::Int(value),
            Scalar::UInt(value) => Self::UInt(value),
            Scalar::Float(value) => Self::FloatBits(value.to_bits()),
            Scalar::Bool(value) => Self::Bool(value),
        }
    }
}

impl From<SavedScalar> for Scalar {
    fn from(value: SavedScalar) -> Self {
        match value {
            SavedScalar::Int(value) => Self::Int(value),
            SavedScalar::UInt(value) => Self::UInt(value),
            SavedScalar::FloatBits(bits) => Self::Float(f64::from_bits(bits)),
            SavedScalar::Bool(value) => Self::Bool(value),
        }
    }
}

/// The part of [`Meta`] common to all versions.
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
    /// As bits, since JSON would round.
    origin_bits: [u64; 3],
    /// Name of the strategy.
    strategy: String,
    /// Names of the hooks, in order.
    hooks: Vec<String>,
    /// Number of Gaussians.
    gaussians: usize,
    /// Numbers of optimisers, strategy and hooks, named like tensors.
    scalars: BTreeMap<String, SavedScalar>,
    history: History,
}

impl Checkpoint {
    /// The current state of a run.
    pub(super) fn of<M: SplatModel>(
        state: &State<M>,
        run: &RunRecord,
    ) -> Result<Self, CheckpointError> {
        let unsaved = |reason: String| CheckpointError::State(reason);
        let record = state.save().map_err(|error| unsaved(error.to_string()))?;
        let tensors = record.tensors.into_iter().map(|(name, data)| {
            let shape = data.shape().to_vec();
            let float = data.dtype().is_float();
            let values = data.convert::<f32>().try_into_vec::<f32>();
            match (float, values) {
                (true, Ok(values)) => Ok((name, shape, values)),
                _ => Err(unsaved(format!("`{name}` is no tensor of floats"))),
            }
        });
        Ok(Self {
            path: PathBuf::from("checkpoint"),
            meta: Meta {
                version: VERSION,
                step: state.step,
                run: run.clone(),
                elapsed_seconds: state.elapsed.as_secs_f64(),
                origin_bits: state.model.origin().map(f64::to_bits),
                strategy: state.strategy.name(),
                hooks: state
                    .hooks
                    .0
                    .iter()
                    .map(|hook| hook.name().to_owned())
                    .collect(),
                gaussians: state.model.count(),
                scalars: (record.scalars.into_iter())
                    .map(|(name, value)| (name, value.into()))
                    .collect(),
                history: state.history.clone(),
            },
            tensors: tensors.collect::<Result<_, _>>()?,
        })
    }

    /// Steps done.
    pub fn step(&self) -> usize {
        self.meta.step
    }

    /// Number of Gaussians.
    pub fn gaussians(&self) -> usize {
        self.meta.gaussians
    }

    /// Origin of the means in the world.
    pub(super) fn origin(&self) -> [f64; 3] {
        self.meta.origin_bits.map(f64::from_bits)
    }

    /// Writes a temporary file and renames it, so that a crash, even of the machine, leaves the old
    /// file or the new one.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<(), CheckpointError> {
        let path = path.as_ref();
        let format = |reason: String| CheckpointError::Format {
            path: path.to_path_buf(),
            reason,
        };
        // A state that could not be read again must not replace one that can.
        check::tensors(&self.tensors)
            .and_then(|()| check::meta(&self.meta))
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
        let mut views = Vec::with_capacity(bytes.len());
        for (name, shape, bytes) in &bytes {
            let view = TensorView::new(Dtype::F32, shape.to_vec(), bytes).map_err(bad)?;
            views.push((*name, view));
        }
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

    /// Reads a file written by [`save`](Self::save).
    ///
    /// # Errors
    /// When the file cannot be read or is not a checkpoint.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, CheckpointError> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|source| CheckpointError::Io {
            path: path.to_path_buf(),
            source,
        })?;
        Self::parse(path, &bytes)
    }

    /// [`load`](Self::load) from the contents of a file; `path` is used in messages.
    ///
    /// # Errors
    /// When the file is not a checkpoint, or its parts are inconsistent.
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
        for (name, view) in file.tensors() {
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
        Ok(Self {
            path: path.to_path_buf(),
            meta,
            tensors,
        })
    }

    /// Restores the state of a run.
    pub(super) fn restore<M: SplatModel>(
        self,
        state: &mut State<M>,
        device: &Device,
    ) -> Result<(), CheckpointError> {
        let tensors = self.tensors.into_iter();
        let tensors = tensors.map(|(name, shape, values)| (name, TensorData::new(values, shape)));
        let record = StateRecord {
            tensors: tensors.collect(),
            scalars: (self.meta.scalars.into_iter())
                .map(|(name, value)| (name, value.into()))
                .collect(),
        };
        let inner = device.clone().without_autodiff();
        let restored = state.restore(record, &inner);
        restored.map_err(|reason| CheckpointError::Format {
            path: self.path,
            reason,
        })?;
        state.step = self.meta.step;
        state.elapsed = Duration::try_from_secs_f64(self.meta.elapsed_seconds).unwrap_or_default();
        state.history = self.meta.history;
        Ok(())
    }
}

/// Checksum that a file with these contents must carry; `None` if it is not a checkpoint.
pub fn expected_checksum(bytes: &[u8]) -> Option<String> {
    let (_, header) = SafeTensors::read_metadata(bytes).ok()?;
    let meta = header.metadata().as_ref()?.get(META)?;
    Some(checksum_of(meta, &SafeTensors::deserialize(bytes).ok()?))
}

fn checksum_of(meta: &str, file: &SafeTensors) -> String {
    let contents = file.iter().map(|(name, view)| (name, view.data()));
    checksum(meta, contents.collect())
}

/// Checksum of a file's contents: the metadata, then each tensor's name and bytes, sorted by name.
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
