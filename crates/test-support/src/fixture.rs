//! Files of reference tensors under `tests/fixtures`.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors};

/// The tensors of a file in double precision, and its metadata.
///
/// Every method panics where the file has not what is asked for: fixtures are part of the tests.
#[derive(Debug, Clone)]
pub struct Reference {
    /// For messages.
    pub file: PathBuf,
    /// Shape and values of each tensor, row-major.
    pub tensors: BTreeMap<String, (Vec<usize>, Vec<f64>)>,
    /// Settings, as text.
    pub metadata: HashMap<String, String>,
}

impl Reference {
    /// Reads a file of `tests/fixtures`, named without its extension.
    ///
    /// # Panics
    /// When it cannot be read.
    pub fn read(name: &str) -> Self {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/fixtures");
        let file = folder.join(name).with_extension("safetensors");
        let bytes = std::fs::read(&file).unwrap_or_else(|error| panic!("{file:?}: {error}"));
        let (_, header) = SafeTensors::read_metadata(&bytes).expect("a safetensors file");
        let read = SafeTensors::deserialize(&bytes).expect("a safetensors file");
        let tensors = read.tensors().into_iter().map(|(name, view)| {
            let data = view.data();
            let values = match view.dtype() {
                Dtype::F64 => {
                    let (numbers, _) = data.as_chunks();
                    numbers
                        .iter()
                        .map(|bytes| f64::from_le_bytes(*bytes))
                        .collect()
                }
                Dtype::F32 => {
                    let (numbers, _) = data.as_chunks();
                    let number = |bytes: &[u8; 4]| f64::from(f32::from_le_bytes(*bytes));
                    numbers.iter().map(number).collect()
                }
                other => panic!("{file:?}: `{name}` is of type {other:?}"),
            };
            (name, (view.shape().to_vec(), values))
        });
        let tensors = tensors.collect();
        Self {
            tensors,
            metadata: header.metadata().clone().unwrap_or_default(),
            file,
        }
    }

    /// Whether it has a tensor.
    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// The values of a tensor.
    ///
    /// # Panics
    /// When there is none of that name.
    pub fn values(&self, name: &str) -> &[f64] {
        let tensor = self.tensors.get(name);
        &tensor
            .unwrap_or_else(|| panic!("{:?} has no `{name}`", self.file))
            .1
    }

    /// The values of a tensor, which are indices.
    ///
    /// # Panics
    /// As [`values`](Self::values).
    pub fn indices(&self, name: &str) -> Vec<usize> {
        self.values(name)
            .iter()
            .map(|value| *value as usize)
            .collect()
    }

    /// The shape of a tensor.
    ///
    /// # Panics
    /// As [`values`](Self::values).
    pub fn shape(&self, name: &str) -> &[usize] {
        self.values(name);
        &self.tensors[name].0
    }

    /// A setting.
    ///
    /// # Panics
    /// When there is none of that name.
    pub fn setting(&self, name: &str) -> &str {
        let setting = self.metadata.get(name);
        setting.unwrap_or_else(|| panic!("{:?} has no setting `{name}`", self.file))
    }

    /// A setting that is a number.
    ///
    /// # Panics
    /// When there is none of that name, or it is no number.
    pub fn number(&self, name: &str) -> f64 {
        let text = self.setting(name);
        let number = text.parse();
        number.unwrap_or_else(|_| panic!("{:?}: `{name}` is `{text}`", self.file))
    }

    /// A setting that is true or false.
    ///
    /// # Panics
    /// When there is none of that name.
    pub fn flag(&self, name: &str) -> bool {
        matches!(self.setting(name), "True" | "true" | "1")
    }
}

/// `|ours - reference| / |reference|`; where the reference is zero, `|ours|`. Infinite where the
/// lengths differ or something is not a number.
pub fn relative_error(ours: &[f64], reference: &[f64]) -> f64 {
    if ours.len() != reference.len() {
        return f64::INFINITY;
    }
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|x| x * x).sum::<f64>().sqrt();
    let length = norm(&mut reference.iter().copied());
    let difference = norm(&mut ours.iter().zip(reference).map(|(a, b)| a - b));
    let error = if length > 0.0 {
        difference / length
    } else {
        difference
    };
    if error.is_nan() { f64::INFINITY } else { error }
}
