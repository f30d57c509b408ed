//! Reads a gradient fixture: a safetensors file with a scene, upstream gradients, and the results
//! of a reference implementation.

mod metadata;
pub(crate) mod unique;

use std::path::Path;

use safetensors::{Dtype, SafeTensors};
use splat_ops::{CameraModel, ImageSize, sh_coefficient_count};

pub use self::metadata::KEYS;
use self::metadata::Metadata;
use super::GradcheckError;
use super::scene::{Array, Inputs, Outputs, Scene, index_of};

/// Inputs. The gradient of each is named `grad.` and its name.
const INPUTS: [&str; 8] = [
    "means",
    "quats",
    "scales",
    "opacities",
    "sh_coeffs",
    "viewmat",
    "intrinsics",
    "background",
];

/// Images. The upstream gradient of each is named `grad_` and its name.
const PICTURES: [&str; 3] = ["image", "alpha", "depth"];

/// Optional absolute gradients of the reference.
const ABSGRAD: &str = "absgrad";

/// A validated fixture.
#[derive(Debug, Clone)]
pub struct Fixture {
    /// Description of the case.
    pub case: String,
    /// Marked by its author as numerically hard, for a milder gate in single precision.
    pub hard: bool,
    /// The scene to render and differentiate; `upstream.depth` is zero if the file has a depth
    /// without a gradient.
    pub scene: Scene,
    /// Images of the reference.
    pub expected: Outputs,
    /// Gradients of the reference's autograd.
    pub gradients: Inputs,
    /// Sums over pixels of the absolute gradients of the screen means, `[N, 2]` or `[C, N, 2]`,
    /// if the file has them.
    pub absgrad: Option<Array>,
}

impl Fixture {
    /// Reads and validates a file.
    ///
    /// Missing metadata default to the ops' defaults; `width` and `height` to those of the image,
    /// `sh_degree` to the highest.
    ///
    /// # Errors
    /// When the file cannot be read, a tensor is missing, has a wrong type or shape or a value that
    /// is not finite, a metadata entry does not parse, or the file contains something that would
    /// not be checked. The message names the file and the tensor.
    pub fn read(path: &Path) -> Result<Self, GradcheckError> {
        let bytes = std::fs::read(path).map_err(|source| GradcheckError::Read {
            file: path.to_path_buf(),
            source,
        })?;
        Self::parse(path, &bytes)
    }

    /// [`read`](Self::read) from the contents of a file; `path` is used in messages.
    ///
    /// # Errors
    /// Those of [`read`](Self::read).
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, GradcheckError> {
        let format = |reason: safetensors::SafeTensorError| GradcheckError::Format {
            file: path.to_path_buf(),
            reason: reason.to_string(),
        };
        let (length, header) = SafeTensors::read_metadata(bytes).map_err(format)?;
        unique::check(bytes, length).map_err(|reason| GradcheckError::Format {
            file: path.to_path_buf(),
            reason,
        })?;
        let reader = Reader {
            file: path,
            tensors: SafeTensors::deserialize(bytes).map_err(format)?,
            metadata: Metadata {
                file: path,
                entries: header.metadata().clone().unwrap_or_default(),
            },
        };
        reader.fixture()
    }
}

struct Reader<'a> {
    file: &'a Path,
    tensors: SafeTensors<'a>,
    metadata: Metadata<'a>,
}

impl Reader<'_> {
    fn fixture(&self) -> Result<Fixture, GradcheckError> {
        let model = self.metadata.camera_model()?;
        self.metadata.check_keys()?;
        self.check_names(model)?;
        // N and C come from the first tensors that have them; all other shapes must agree.
        let means = self.any("means")?;
        let n = match means.shape.as_slice() {
            [n, 3] => *n,
            got => return Err(self.shape("means", "[N, 3]", got)),
        };
        let viewmat = self.any("viewmat")?;
        let front: Vec<usize> = match viewmat.shape.as_slice() {
            [4, 4] => vec![],
            [c, 4, 4] if *c > 0 => vec![*c],
            got => return Err(self.shape("viewmat", "[4, 4] or [C, 4, 4] with C >= 1", got)),
        };
        let with = |tail: &[usize]| [front.as_slice(), tail].concat();

        let image = self.any("image")?;
        let (height, width) = match image.shape.strip_prefix(front.as_slice()) {
            Some([h, w, 3]) if *h > 0 && *w > 0 => (*h, *w),
            _ => {
                return Err(self.shape(
                    "image",
                    "[H, W, 3] (with C in front where `viewmat` has it), at least one pixel",
                    &image.shape,
                ));
            }
        };
        let size = ImageSize {
            width: self.metadata.side("width", width)?,
            height: self.metadata.side("height", height)?,
        };

        // Rows beyond the degree are not read; their gradient must be zero.
        let sh_degree = self.metadata.degree()?;
        let rows = match self.any("sh_coeffs")?.shape.as_slice() {
            [_, rows, _] if *rows >= sh_coefficient_count(sh_degree) => *rows,
            got => {
                let least = sh_coefficient_count(sh_degree);
                let expected = format!("[{n}, K, 3] with K >= {least} for degree {sh_degree}");
                return Err(self.shape("sh_coeffs", &expected, got));
            }
        };

        let inputs = |prefix: &str| -> Result<Inputs, GradcheckError> {
            let get = |name: &str, shape: &[usize]| self.exactly(&format!("{prefix}{name}"), shape);
            Ok(Inputs {
                means: get("means", &[n, 3])?,
                quats: get("quats", &[n, 4])?,
                scales: get("scales", &[n, 3])?,
                opacities: get("opacities", &[n])?,
                sh_coeffs: get("sh_coeffs", &[n, rows, 3])?,
                viewmat: get("viewmat", &with(&[4, 4]))?,
                intrinsics: get("intrinsics", &with(&[4]))?,
                background: get("background", &[3])?,
                distortion: (model != CameraModel::Pinhole)
                    .then(|| get("distortion", &with(&[model.coefficients()])))
                    .transpose()?,
            })
        };
        let (picture, single) = (with(&[height, width, 3]), with(&[height, width, 1]));
        let has = |name: &str| self.tensors.names().contains(&name);
        let depth = has("depth") || has("grad_depth");
        let expected = Outputs {
            image,
            alpha: self.exactly("alpha", &single)?,
            depth: depth.then(|| self.exactly("depth", &single)).transpose()?,
        };
        let upstream = Outputs {
            image: self.exactly("grad_image", &picture)?,
            alpha: self.exactly("grad_alpha", &single)?,
            depth: match (depth, has("grad_depth")) {
                (false, _) => None,
                (true, false) => Some(Array::zeros(&single)),
                (true, true) => Some(self.exactly("grad_depth", &single)?),
            },
        };

        let (project, rasterize) = self.metadata.settings()?;
        let scene_inputs = inputs("")?;
        let absgrad = has(ABSGRAD)
            .then(|| self.exactly(ABSGRAD, &with(&[n, 2])))
            .transpose()?;
        self.check_ranges(&scene_inputs)?;
        let mut scene = Scene {
            source: self.file.to_path_buf(),
            cameras: front.first().copied().unwrap_or(1),
            gaussians: n,
            size,
            sh_degree,
            antialias: self.metadata.flag("antialias")?,
            model,
            domain: vec![],
            project,
            rasterize,
            inputs: scene_inputs,
            upstream,
            absgrad: absgrad.is_some(),
        };
        scene.domain = self.domain(&scene, has("domain"), &with(&[2]))?;
        Ok(Fixture {
            case: self.metadata.case(),
            hard: self.metadata.flag("hard")?,
            scene,
            expected,
            gradients: inputs("grad.")?,
            absgrad,
        })
    }

    /// Domains of the lenses: those of the file if it `has` them, else by their definition.
    fn domain(
        &self,
        scene: &Scene,
        has: bool,
        shape: &[usize],
    ) -> Result<Vec<f64>, GradcheckError> {
        if has {
            let domain = self.exactly("domain", shape)?;
            let sign = |at: usize| {
                at.is_multiple_of(2) && domain.values[at] <= 0.0 || domain.values[at] < 0.0
            };
            return match (0..domain.values.len()).find(|at| sign(*at)) {
                None => Ok(domain.values),
                Some(at) => {
                    let (value, index) = (domain.values[at], index_of(at, shape));
                    let reason = format!("value {value} at {index:?} must be positive");
                    Err(self.tensor("domain", reason))
                }
            };
        }
        Ok(scene.defined_domain())
    }

    /// Refuses invalid Gaussians and cameras, which the reference and our ops might interpret
    /// differently.
    fn check_ranges(&self, inputs: &Inputs) -> Result<(), GradcheckError> {
        let opacities = (&inputs.opacities, 0.0..=1.0);
        let scales = (&inputs.scales, 0.0..=f64::INFINITY);
        for (name, (array, range)) in [("opacities", opacities), ("scales", scales)] {
            if let Some(at) = array.values.iter().position(|value| !range.contains(value)) {
                let (value, index) = (array.values[at], index_of(at, &array.shape));
                let (least, most) = range.into_inner();
                let reason = format!("value {value} at {index:?} is not from {least} to {most}");
                return Err(self.tensor(name, reason));
            }
        }
        let last_rows = inputs.viewmat.values.chunks_exact(16).map(|m| &m[12..]);
        match last_rows
            .enumerate()
            .find(|(_, row)| *row != [0.0, 0.0, 0.0, 1.0])
        {
            None => Ok(()),
            Some((camera, row)) => {
                let reason = format!("the last row of camera {camera} is {row:?}, not 0 0 0 1");
                Err(self.tensor("viewmat", reason))
            }
        }
    }

    /// Refuses tensors that nothing would check.
    fn check_names(&self, model: CameraModel) -> Result<(), GradcheckError> {
        let mut names = self.tensors.names();
        names.sort();
        for name in names {
            let input = name.strip_prefix("grad.").unwrap_or(name);
            let picture = name.strip_prefix("grad_").unwrap_or(name);
            if INPUTS.contains(&input) || PICTURES.contains(&picture) || name == ABSGRAD {
                continue;
            }
            let bent = model != CameraModel::Pinhole;
            if bent && (input == "distortion" || name == "domain") {
                continue;
            }
            let reason = match input {
                "distortion" => "is too many: the camera model `pinhole` has no distortion",
                "domain" if name == "grad.domain" => "is too many: a domain has no gradient",
                "domain" => "is too many: the camera model `pinhole` has no domain",
                _ => "is not part of the format; remove it, or correct its name",
            };
            return Err(self.tensor(name, reason.into()));
        }
        Ok(())
    }

    /// A tensor of any shape with finite values.
    fn any(&self, name: &str) -> Result<Array, GradcheckError> {
        let view = self
            .tensors
            .tensor(name)
            .map_err(|_| self.tensor(name, "is missing".into()))?;
        let data = view.data();
        let values: Vec<f64> = match view.dtype() {
            Dtype::F64 => data
                .as_chunks::<8>()
                .0
                .iter()
                .map(|b| f64::from_le_bytes(*b))
                .collect(),
            Dtype::F32 => data
                .as_chunks::<4>()
                .0
                .iter()
                .map(|b| f32::from_le_bytes(*b).into())
                .collect(),
            other => {
                return Err(self.tensor(name, format!("has type {other:?}, must be F64 or F32")));
            }
        };
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            let reason = format!(
                "value {} at {:?} is not finite",
                values[at],
                index_of(at, view.shape())
            );
            return Err(self.tensor(name, reason));
        }
        Ok(Array {
            shape: view.shape().to_vec(),
            values,
        })
    }

    fn exactly(&self, name: &str, shape: &[usize]) -> Result<Array, GradcheckError> {
        let array = self.any(name)?;
        if array.shape == shape {
            Ok(array)
        } else {
            Err(self.shape(name, &format!("{shape:?}"), &array.shape))
        }
    }

    fn shape(&self, name: &str, expected: &str, got: &[usize]) -> GradcheckError {
        self.tensor(name, format!("must have shape {expected}, has {got:?}"))
    }

    fn tensor(&self, name: &str, reason: String) -> GradcheckError {
        GradcheckError::Tensor {
            file: self.file.to_path_buf(),
            tensor: name.into(),
            reason,
        }
    }
}

#[cfg(test)]
mod tests;
