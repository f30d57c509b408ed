//! Reads a gradient fixture: one safetensors file with a scene, upstream gradients and what a
//! reference implementation made of them.

use std::collections::HashMap;
use std::path::Path;

use safetensors::{Dtype, SafeTensors};
use splat_ops::{ImageSize, ProjectSettings, RasterizeSettings, SH_DEGREE_MAX};

use super::GradcheckError;
use super::scene::{Array, Inputs, Outputs, Scene, index_of};

/// Coefficients per channel that a fixture holds, whatever its degree.
const SH_COEFFICIENTS: usize = 16;

/// One fixture, validated.
#[derive(Debug, Clone)]
pub struct Fixture {
    /// What it covers, in words.
    pub case: String,
    /// Marked by its author as numerically hard: judged more mildly in single precision.
    pub hard: bool,
    /// What is rendered and differentiated; `upstream.depth` is zero where the file has a depth without a gradient.
    pub scene: Scene,
    /// What the reference rendered.
    pub expected: Outputs,
    /// What the reference's autograd returned.
    pub gradients: Inputs,
}

impl Fixture {
    /// Reads and validates a file.
    ///
    /// Missing metadata take the defaults of the ops; `width` and `height` those of the image,
    /// `sh_degree` the highest.
    ///
    /// # Errors
    /// When the file cannot be read, a tensor is missing, has a wrong type or shape or a value
    /// that is not finite, or a metadata entry does not parse. The message names file and tensor.
    pub fn read(path: &Path) -> Result<Self, GradcheckError> {
        let file = path.to_path_buf();
        let bytes = std::fs::read(path).map_err(|source| GradcheckError::Read {
            file: file.clone(),
            source,
        })?;
        let format = |reason: safetensors::SafeTensorError| GradcheckError::Format {
            file: file.clone(),
            reason: reason.to_string(),
        };
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(format)?;
        let tensors = SafeTensors::deserialize(&bytes).map_err(format)?;
        let reader = Reader {
            file: &file,
            tensors,
            metadata: header.metadata().clone().unwrap_or_default(),
        };
        reader.fixture()
    }
}

struct Reader<'a> {
    file: &'a Path,
    tensors: SafeTensors<'a>,
    metadata: HashMap<String, String>,
}

impl Reader<'_> {
    fn fixture(&self) -> Result<Fixture, GradcheckError> {
        // N and C come from the first tensors that hold them; every other shape must agree.
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
            width: self.side("width", width)?,
            height: self.side("height", height)?,
        };

        let inputs = |prefix: &str| -> Result<Inputs, GradcheckError> {
            let get = |name: &str, shape: &[usize]| self.exactly(&format!("{prefix}{name}"), shape);
            Ok(Inputs {
                means: get("means", &[n, 3])?,
                quats: get("quats", &[n, 4])?,
                scales: get("scales", &[n, 3])?,
                opacities: get("opacities", &[n])?,
                sh_coeffs: get("sh_coeffs", &[n, SH_COEFFICIENTS, 3])?,
                viewmat: get("viewmat", &with(&[4, 4]))?,
                intrinsics: get("intrinsics", &with(&[4]))?,
                background: get("background", &[3])?,
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

        let (project, rasterize) = (ProjectSettings::default(), RasterizeSettings::default());
        let alpha_min = self.number("alpha_min", rasterize.alpha_min)?;
        let scene = Scene {
            source: self.file.to_path_buf(),
            cameras: front.first().copied().unwrap_or(1),
            gaussians: n,
            size,
            sh_degree: self.degree()?,
            antialias: self.flag("antialias")?,
            project: ProjectSettings {
                near: self.number("near", project.near)?,
                far: self.number("far", project.far)?,
                eps2d: self.number("eps2d", project.eps2d)?,
                alpha_min,
                ..project
            },
            rasterize: RasterizeSettings {
                alpha_min,
                alpha_max: self.number("alpha_max", rasterize.alpha_max)?,
                transmittance_min: self.number("transmittance_min", rasterize.transmittance_min)?,
                ..rasterize
            },
            inputs: inputs("")?,
            upstream,
        };
        Ok(Fixture {
            case: self.metadata.get("case").cloned().unwrap_or_default(),
            hard: self.flag("hard")?,
            scene,
            expected,
            gradients: inputs("grad.")?,
        })
    }

    /// A tensor of any shape, all of its values finite.
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

    fn entry(&self, key: &str, reason: String) -> GradcheckError {
        GradcheckError::Metadata {
            file: self.file.to_path_buf(),
            key: key.into(),
            reason,
        }
    }

    /// One side of the picture, from its tensor; the metadata must agree.
    fn side(&self, key: &str, pixels: usize) -> Result<u32, GradcheckError> {
        match self.metadata.get(key) {
            Some(text) if text.trim().parse() != Ok(pixels) => {
                Err(self.entry(key, format!("is `{text}`, but the image has {pixels}")))
            }
            _ => u32::try_from(pixels)
                .map_err(|_| self.entry(key, format!("{pixels} pixels are too many"))),
        }
    }

    fn number(&self, key: &str, default: f64) -> Result<f64, GradcheckError> {
        let Some(text) = self.metadata.get(key) else {
            return Ok(default);
        };
        match text.trim().parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            _ => Err(self.entry(key, format!("`{text}` is not a finite number"))),
        }
    }

    fn flag(&self, key: &str) -> Result<bool, GradcheckError> {
        match self.metadata.get(key).map(|text| text.trim()) {
            None | Some("0") => Ok(false),
            Some("1") => Ok(true),
            Some(other) => Err(self.entry(key, format!("`{other}` is neither 0 nor 1"))),
        }
    }

    fn degree(&self) -> Result<usize, GradcheckError> {
        let Some(text) = self.metadata.get("sh_degree") else {
            return Ok(SH_DEGREE_MAX);
        };
        match text.trim().parse() {
            Ok(degree) if degree <= SH_DEGREE_MAX => Ok(degree),
            _ => Err(self.entry(
                "sh_degree",
                format!("`{text}` is not a degree from 0 to {SH_DEGREE_MAX}"),
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use safetensors::tensor::TensorView;

    /// Name, type, shape and bytes of the tensors of a fixture, for tests to spoil.
    type Tensors = Vec<(String, Dtype, Vec<usize>, Vec<u8>)>;

    /// One Gaussian, one camera, a picture of 2 x 1 pixels.
    fn tensors() -> Tensors {
        let inputs: [(&str, &[usize]); 8] = [
            ("means", &[1, 3]),
            ("quats", &[1, 4]),
            ("scales", &[1, 3]),
            ("opacities", &[1]),
            ("sh_coeffs", &[1, 16, 3]),
            ("viewmat", &[4, 4]),
            ("intrinsics", &[4]),
            ("background", &[3]),
        ];
        let pictures: [(&str, &[usize]); 2] = [("image", &[1, 2, 3]), ("alpha", &[1, 2, 1])];
        let ones = |name: String, shape: &[usize]| {
            let count: usize = shape.iter().product();
            let bytes = vec![1.0f64.to_le_bytes(); count].concat();
            (name, Dtype::F64, shape.to_vec(), bytes)
        };
        let mut all = vec![];
        for (name, shape) in inputs {
            all.push(ones(name.into(), shape));
            all.push(ones(format!("grad.{name}"), shape));
        }
        for (name, shape) in pictures {
            all.push(ones(name.into(), shape));
            all.push(ones(format!("grad_{name}"), shape));
        }
        all
    }

    fn read(tensors: &Tensors, metadata: &[(&str, &str)]) -> Result<Fixture, GradcheckError> {
        let views = tensors.iter().map(|(name, dtype, shape, bytes)| {
            let view = TensorView::new(*dtype, shape.clone(), bytes).expect("a valid tensor");
            (name.as_str(), view)
        });
        let metadata = metadata
            .iter()
            .map(|(k, v)| (k.to_string(), v.to_string()))
            .collect();
        let bytes = safetensors::serialize(views, Some(metadata)).expect("a valid file");
        let folder = tempfile::tempdir().expect("a temporary folder");
        let file = folder.path().join("spoilt.safetensors");
        std::fs::write(&file, bytes).expect("a writable folder");
        Fixture::read(&file)
    }

    fn message(tensors: &Tensors, metadata: &[(&str, &str)]) -> String {
        match read(tensors, metadata) {
            Ok(_) => panic!("the fixture should be rejected"),
            Err(error) => error.to_string(),
        }
    }

    fn position(tensors: &Tensors, name: &str) -> usize {
        let found = tensors.iter().position(|(n, ..)| n == name);
        found.expect("a tensor of the fixture")
    }

    #[test]
    fn missing_metadata_take_the_defaults() {
        let fixture = read(&tensors(), &[]).unwrap();
        assert_eq!(
            fixture.scene.size,
            ImageSize {
                width: 2,
                height: 1
            }
        );
        assert_eq!((fixture.scene.cameras, fixture.scene.gaussians), (1, 1));
        assert_eq!(fixture.scene.project, ProjectSettings::default());
        assert_eq!(fixture.scene.rasterize, RasterizeSettings::default());
        assert!(!fixture.scene.antialias && !fixture.hard && fixture.expected.depth.is_none());
    }

    #[test]
    fn metadata_are_read() {
        let entries = [
            ("width", "2"),
            ("antialias", "1"),
            ("eps2d", "0.25"),
            ("alpha_min", "0.5"),
            ("sh_degree", "2"),
        ];
        let fixture = read(&tensors(), &entries).unwrap();
        assert!(fixture.scene.antialias);
        assert_eq!(
            (fixture.scene.project.eps2d, fixture.scene.sh_degree),
            (0.25, 2)
        );
        assert_eq!(
            (
                fixture.scene.project.alpha_min,
                fixture.scene.rasterize.alpha_min
            ),
            (0.5, 0.5)
        );
    }

    #[test]
    fn single_precision_tensors_are_read() {
        let mut tensors = tensors();
        let at = position(&tensors, "opacities");
        tensors[at] = (
            "opacities".into(),
            Dtype::F32,
            vec![1],
            0.5f32.to_le_bytes().to_vec(),
        );
        assert_eq!(
            read(&tensors, &[]).unwrap().scene.inputs.opacities.values,
            [0.5]
        );
    }

    #[test]
    fn every_missing_tensor_is_named() {
        let whole = tensors();
        for at in 0..whole.len() {
            let mut spoilt = whole.clone();
            let (name, ..) = spoilt.remove(at);
            let text = message(&spoilt, &[]);
            assert!(text.contains("spoilt.safetensors"), "{text}");
            assert!(text.contains(&format!("`{name}`: is missing")), "{text}");
        }
    }

    #[test]
    fn every_value_that_is_not_finite_is_named() {
        let whole = tensors();
        for at in 0..whole.len() {
            let mut spoilt = whole.clone();
            let end = spoilt[at].3.len();
            spoilt[at].3[end - 8..].copy_from_slice(&f64::NAN.to_le_bytes());
            let text = message(&spoilt, &[]);
            assert!(
                text.contains(&format!("`{}`: value NaN", spoilt[at].0)),
                "{text}"
            );
        }
    }

    #[test]
    fn every_wrong_shape_is_named() {
        let whole = tensors();
        for at in 0..whole.len() {
            let mut spoilt = whole.clone();
            spoilt[at].2.push(1);
            let text = message(&spoilt, &[]);
            assert!(
                text.contains(&format!("`{}`: must have shape", spoilt[at].0)),
                "{text}"
            );
        }
    }

    #[test]
    fn a_depth_loss_without_a_depth_is_rejected() {
        let mut tensors = tensors();
        tensors.push(("grad_depth".into(), Dtype::F64, vec![1, 2, 1], vec![0; 16]));
        assert!(message(&tensors, &[]).contains("`depth`: is missing"));
    }

    #[test]
    fn wrong_types_and_metadata_are_rejected() {
        let mut integers = tensors();
        let at = position(&integers, "quats");
        integers[at].1 = Dtype::I64;
        assert!(message(&integers, &[]).contains("`quats`: has type I64"));
        for (key, value) in [
            ("width", "3"),
            ("height", "x"),
            ("eps2d", "inf"),
            ("near", ""),
            ("antialias", "yes"),
            ("sh_degree", "4"),
        ] {
            let text = message(&tensors(), &[(key, value)]);
            assert!(text.contains(&format!("metadata `{key}`")), "{text}");
        }
    }

    #[test]
    fn a_file_that_is_no_fixture_is_rejected() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("text.safetensors");
        std::fs::write(&file, "not a tensor in sight").unwrap();
        let text = Fixture::read(&file).unwrap_err().to_string();
        assert!(
            text.contains("text.safetensors: not a safetensors file"),
            "{text}"
        );
        let text = Fixture::read(&folder.path().join("none"))
            .unwrap_err()
            .to_string();
        assert!(text.contains("none"), "{text}");
    }
}
