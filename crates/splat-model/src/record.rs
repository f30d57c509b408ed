//! Gaussians in burnpack, Burn's file format: tensors under their paths in the module.

use std::path::{Path, PathBuf};

use burn::tensor::{Bytes, DType, Device};
use burn_pack::{Reader, Scalar, Tensor, Writer};
use splat_data::{SplatData, write_durably};
use splat_ops::{SH_DEGREE_MAX, sh_coefficient_count};

use crate::Gaussians;

/// Names of the three coordinates of the origin, stored in double precision.
const ORIGIN: [&str; 3] = ["origin.x", "origin.y", "origin.z"];

/// Why a record of Gaussians cannot be written or read, in one line that names the file and the
/// field.
#[derive(Debug, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub struct RecordError {
    /// The file.
    pub path: PathBuf,
    /// The reason.
    pub reason: String,
}

impl Gaussians {
    /// Saves all parameters, in single precision, and the origin as a burnpack file, replacing an
    /// old file atomically. Gaussians of different degrees of spherical harmonics are saved at the
    /// highest of them, as [`to_data`](Self::to_data) gives them. Render settings are not included;
    /// a PLY file ([`splat_data::scene::ply`]) has them.
    ///
    /// ```
    /// # use splat_model::{Gaussians, SplatData};
    /// # use burn::tensor::Device;
    /// # let scene = SplatData {
    /// #     origin: [4e6, 0.0, 0.1],
    /// #     means: vec![[0.0; 3]],
    /// #     log_scales: vec![[0.0; 3]],
    /// #     quats: vec![[1.0, 0.0, 0.0, 0.0]],
    /// #     opacity_logits: vec![0.5],
    /// #     sh0: vec![[0.0; 3]],
    /// #     ..SplatData::default()
    /// # };
    /// # let device = Device::flex();
    /// # let folder = tempfile::tempdir()?;
    /// let gaussians = Gaussians::from_data(&scene, &device);
    /// let path = folder.path().join("gaussians.bpk");
    /// gaussians.save(&path)?;
    /// let same = Gaussians::load(&path, &device)?;
    /// assert_eq!(same.to_data(), gaussians.to_data());
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<(), RecordError> {
        let path = path.as_ref();
        let failed = |reason: String| RecordError {
            path: path.to_owned(),
            reason,
        };
        let data = self.to_data();
        let n = data.len();
        if let Some(field) = with_nan(&data) {
            return Err(failed(format!(
                "`{field}` of the model has a NaN, which no reader would take"
            )));
        }
        let mut tensors = vec![
            tensor("means", vec![n, 3], data.means.as_flattened()),
            tensor("log_scales", vec![n, 3], data.log_scales.as_flattened()),
            tensor("quats", vec![n, 4], data.quats.as_flattened()),
            tensor("opacity_logits", vec![n], &data.opacity_logits),
            tensor("sh0", vec![n, 1, 3], data.sh0.as_flattened()),
        ];
        if data.sh_degree > 0 {
            let shape = vec![n, data.sh_rest_len() / 3, 3];
            tensors.push(tensor("sh_rest", shape, &data.sh_rest));
        }
        let writer = ORIGIN
            .iter()
            .zip(data.origin)
            .fold(Writer::new(tensors), |writer, (name, value)| {
                writer.with_scalar(name, Scalar::Float(value))
            });
        let bytes = writer
            .into_bytes()
            .map_err(|error| failed(error.to_string()))?;
        write_durably(path, &bytes).map_err(|error| failed(error.to_string()))
    }

    /// Loads a file written by [`save`](Self::save), with its number of Gaussians.
    ///
    /// # Errors
    /// When the file cannot be read, is not such a file, or contains NaN.
    pub fn load(path: impl AsRef<Path>, device: &Device) -> Result<Self, RecordError> {
        let path = path.as_ref();
        let failed = |reason: String| RecordError {
            path: path.to_owned(),
            reason,
        };
        let bytes = std::fs::read(path).map_err(|error| failed(error.to_string()))?;
        Self::parse(path, bytes, device)
    }

    /// [`load`](Self::load) from the contents of a file; `path` is used in messages.
    ///
    /// # Errors
    /// Those of [`load`](Self::load).
    pub fn parse(path: &Path, bytes: Vec<u8>, device: &Device) -> Result<Self, RecordError> {
        let data = parse(bytes).map_err(|reason| RecordError {
            path: path.to_owned(),
            reason,
        })?;
        Ok(Self::from_data(&data, device))
    }
}

/// The first field that contains NaN.
fn with_nan(data: &SplatData) -> Option<&'static str> {
    let fields: [(&'static str, &[f32]); 6] = [
        ("means", data.means.as_flattened()),
        ("log_scales", data.log_scales.as_flattened()),
        ("quats", data.quats.as_flattened()),
        ("opacity_logits", &data.opacity_logits),
        ("sh0", data.sh0.as_flattened()),
        ("sh_rest", &data.sh_rest),
    ];
    let bad = fields
        .iter()
        .find(|(_, values)| values.iter().any(|value| value.is_nan()));
    bad.map(|(name, _)| *name)
}

fn tensor(name: &str, shape: Vec<usize>, values: &[f32]) -> Tensor {
    let bytes: Vec<u8> = values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    Tensor::new(
        name.into(),
        DType::F32,
        shape,
        None,
        Bytes::from_bytes_vec(bytes),
    )
}

fn parse(bytes: Vec<u8>) -> Result<SplatData, String> {
    let reader = Reader::from_bytes(Bytes::from_bytes_vec(bytes));
    let reader = reader.map_err(|error| format!("not a burnpack file: {error}"))?;
    let mut origin = [0.0; 3];
    for (name, value) in ORIGIN.iter().zip(&mut origin) {
        *value = match reader.scalars().get(*name) {
            Some(Scalar::Float(value)) if value.is_finite() => *value,
            found => {
                return Err(format!(
                    "`{name}` is {found:?}; a record of Gaussians has a finite number there"
                ));
            }
        };
    }
    let tensors = reader.into_tensors().map_err(|error| error.to_string())?;
    let mut fields = Fields::read(tensors)?;
    let (n, means) = fields.rows("means", None, 3)?;
    let rest = fields.take("sh_rest");
    let sh_degree = match &rest {
        None => 0,
        Some((shape, _)) => (1..=SH_DEGREE_MAX)
            .find(|degree| shape[..] == [n, sh_coefficient_count(*degree) - 1, 3])
            .ok_or_else(|| format!("`sh_rest` has shape {shape:?} beside {n} means"))?,
    };
    let data = SplatData {
        origin,
        means: means.as_chunks().0.to_vec(),
        log_scales: fields
            .rows("log_scales", Some(n), 3)?
            .1
            .as_chunks()
            .0
            .to_vec(),
        quats: fields.rows("quats", Some(n), 4)?.1.as_chunks().0.to_vec(),
        opacity_logits: fields.rows("opacity_logits", Some(n), 1)?.1,
        sh0: fields.rows("sh0", Some(n), 3)?.1.as_chunks().0.to_vec(),
        sh_rest: rest.map_or_else(Vec::new, |(_, values)| values),
        sh_degree,
        ..SplatData::default()
    };
    match fields.0.first() {
        None => Ok(data),
        Some((name, ..)) => Err(format!("`{name}` is no parameter of Gaussians")),
    }
}

/// Name, shape and values of each tensor.
struct Fields(Vec<(String, Vec<usize>, Vec<f32>)>);

impl Fields {
    fn read(tensors: Vec<Tensor>) -> Result<Self, String> {
        let read = |tensor: Tensor| {
            let (name, dtype, shape, _, bytes) = tensor.into_parts().map_err(|e| e.to_string())?;
            if dtype != DType::F32 {
                return Err(format!("`{name}` is {dtype:?}, not F32"));
            }
            let values: Vec<f32> = bytes
                .as_chunks::<4>()
                .0
                .iter()
                .copied()
                .map(f32::from_le_bytes)
                .collect();
            if shape
                .iter()
                .try_fold(1usize, |all, side| all.checked_mul(*side))
                != Some(values.len())
            {
                return Err(format!(
                    "`{name}` has shape {shape:?} and {} values",
                    values.len()
                ));
            }
            if let Some(at) = values.iter().position(|value| value.is_nan()) {
                return Err(format!("`{name}`: value {at} (counted from 0) is NaN"));
            }
            Ok((name, shape.to_vec(), values))
        };
        tensors
            .into_iter()
            .map(read)
            .collect::<Result<_, _>>()
            .map(Self)
    }

    fn take(&mut self, name: &str) -> Option<(Vec<usize>, Vec<f32>)> {
        let at = self.0.iter().position(|(found, ..)| found == name)?;
        let (_, shape, values) = self.0.swap_remove(at);
        Some((shape, values))
    }

    /// Values of a field of `width` numbers per row, and its number of rows, which must equal `n`
    /// if given.
    fn rows(
        &mut self,
        name: &str,
        n: Option<usize>,
        width: usize,
    ) -> Result<(usize, Vec<f32>), String> {
        let (shape, values) = self
            .take(name)
            .ok_or_else(|| format!("`{name}` is missing"))?;
        let rows = shape.first().copied().unwrap_or(0);
        let own_width: usize = shape.iter().skip(1).product();
        if shape.is_empty() || own_width != width || n.is_some_and(|n| n != rows) {
            let expected = n.map_or_else(|| "N".to_owned(), |n| n.to_string());
            return Err(format!(
                "`{name}` has shape {shape:?} instead of {expected} rows of {width}"
            ));
        }
        Ok((rows, values))
    }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;

    fn scene(n: usize, sh_degree: usize) -> SplatData {
        let value = |i: usize| i as f32 * 0.37 - 1.0;
        let rest = 3 * (sh_coefficient_count(sh_degree) - 1);
        SplatData {
            origin: [4.1e6, -0.1, 1.0 / 3.0],
            means: (0..n).map(|i| [value(i), 0.5, -2.0]).collect(),
            log_scales: vec![[0.0, f32::NEG_INFINITY, 1.0]; n],
            quats: vec![[0.3, 0.1, 0.2, 0.4]; n],
            opacity_logits: (0..n).map(value).collect(),
            sh0: vec![[0.7, 0.1, 0.2]; n],
            sh_rest: (0..n * rest).map(value).collect(),
            sh_degree,
            ..SplatData::default()
        }
    }

    #[test]
    fn what_was_saved_is_loaded_whatever_its_size_and_degree() {
        let device = Device::flex();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/gaussians.bpk");
        for (n, degree) in [(5, 3), (1, 1), (7, 0), (0, 2)] {
            let scene = scene(n, degree);
            Gaussians::from_data(&scene, &device.clone().autodiff())
                .save(&path)
                .unwrap();
            let loaded = Gaussians::load(&path, &device).unwrap();
            assert_eq!(loaded.to_data(), scene);
        }
    }

    #[test]
    fn another_file_is_refused_by_name() {
        let device = Device::flex();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gaussians.bpk");
        let message = || {
            Gaussians::load(&path, &device)
                .map(drop)
                .unwrap_err()
                .to_string()
        };
        assert!(message().contains("gaussians.bpk"));
        std::fs::write(&path, b"ply\n").unwrap();
        assert!(message().contains("not a burnpack file"));
        let pack = |tensors: Vec<Tensor>, origin: f64| {
            let writer = ORIGIN.iter().fold(Writer::new(tensors), |writer, name| {
                writer.with_scalar(name, Scalar::Float(origin))
            });
            std::fs::write(&path, &*writer.into_bytes().unwrap()).unwrap();
            message()
        };
        let full = || {
            vec![
                tensor("means", vec![1, 3], &[0.0; 3]),
                tensor("log_scales", vec![1, 3], &[0.0; 3]),
                tensor("quats", vec![1, 4], &[1.0; 4]),
                tensor("opacity_logits", vec![1], &[0.0]),
                tensor("sh0", vec![1, 1, 3], &[0.0; 3]),
            ]
        };
        assert!(pack(full(), f64::NAN).contains("origin.x"));
        let with = |change: &dyn Fn(&mut Vec<Tensor>)| {
            let mut tensors = full();
            change(&mut tensors);
            pack(tensors, 0.0)
        };
        assert!(with(&|tensors| drop(tensors.remove(2))).contains("`quats` is missing"));
        let two =
            |tensors: &mut Vec<Tensor>| tensors[3] = tensor("opacity_logits", vec![2], &[0.0; 2]);
        assert!(with(&two).contains("`opacity_logits` has shape [2] instead of 1 rows"));
        let rest =
            |tensors: &mut Vec<Tensor>| tensors.push(tensor("sh_rest", vec![1, 2, 3], &[0.0; 6]));
        assert!(with(&rest).contains("`sh_rest` has shape [1, 2, 3]"));
        let nan = |tensors: &mut Vec<Tensor>| {
            tensors[0] = tensor("means", vec![1, 3], &[0.0, f32::NAN, 0.0])
        };
        assert!(with(&nan).contains("`means`: value 1"));
        let scalar =
            |tensors: &mut Vec<Tensor>| tensors[3] = tensor("opacity_logits", vec![], &[0.0]);
        assert!(with(&scalar).contains("`opacity_logits` has shape []"));
        let more = |tensors: &mut Vec<Tensor>| tensors.push(tensor("heat", vec![1], &[0.0]));
        assert!(with(&more).contains("`heat`"));
    }
}
