//! A file of inputs, outputs and gradients of a PyTorch function, and its comparison with a twin.

use std::collections::{BTreeMap, HashMap};
use std::fmt;

use burn::tensor::{Device, Tensor, TensorData};
use safetensors::SafeTensors;
use splat_lab::gradcheck::{Precision, gate};
use splat_ops::OpError;

/// Where the files are.
pub const FOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/functions");

/// Computes the outputs of a fixture, flat, in its order.
pub type Twin = fn(&Leaves) -> Result<Vec<Tensor<1>>, OpError>;

/// A device, and the precision to compute in.
pub struct Place {
    pub device: Device,
    pub precision: Precision,
}

impl Place {
    pub fn new(device: &Device, precision: Precision) -> Self {
        Self {
            device: device.clone(),
            precision,
        }
    }

    /// A tensor without gradient, on a device of choice.
    pub fn tensor<const D: usize>(&self, array: &Array, device: &Device) -> Tensor<D> {
        let Ok(shape) = <[usize; D]>::try_from(array.shape.as_slice()) else {
            panic!("a tensor of shape {:?} has not {D} dimensions", array.shape);
        };
        let data = TensorData::new(array.values.clone(), shape);
        Tensor::from_data(data, (device, self.precision.dtype()))
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Array {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

impl Array {
    pub fn norm(&self) -> f64 {
        self.values.iter().map(|x| x * x).sum::<f64>().sqrt()
    }
}

/// The inputs of a fixture on a device, those with an expected gradient tracked.
pub struct Leaves {
    /// Flat.
    tensors: BTreeMap<String, Tensor<1>>,
    shapes: BTreeMap<String, Vec<usize>>,
    metadata: HashMap<String, String>,
}

impl Leaves {
    pub fn get<const D: usize>(&self, name: &str) -> Tensor<D> {
        let Some(flat) = self.tensors.get(name) else {
            panic!("there is no input `{name}`");
        };
        let shape = <[usize; D]>::try_from(self.shapes[name].as_slice());
        flat.clone()
            .reshape(shape.unwrap_or_else(|_| panic!("`{name}` has not {D} dimensions")))
    }

    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    pub fn number(&self, name: &str) -> usize {
        let text = self.metadata.get(name).map(|text| text.parse());
        text.and_then(Result::ok)
            .unwrap_or_else(|| panic!("metadata has no number `{name}`"))
    }
}

/// How far one tensor is off.
pub struct Row {
    pub name: String,
    /// Relative L2 error; where everything expected is zero, the error in units of what could be.
    pub error: f64,
    pub gate: f64,
}

impl Row {
    /// No, where the error is NaN.
    pub fn passes(&self) -> bool {
        self.error <= self.gate
    }

    /// The error in gates; infinite where it is NaN.
    pub fn severity(&self) -> f64 {
        match self.error / self.gate {
            gates if gates.is_nan() => f64::INFINITY,
            gates => gates,
        }
    }
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { name, error, gate } = self;
        write!(f, "{name} {error:.1e} (gate {gate:.0e})")
    }
}

/// Outputs and gradients that a twin gave, by their names in the file.
pub type Found = BTreeMap<String, Vec<f64>>;

/// A file of `tests/fixtures/functions`.
#[derive(Clone)]
pub struct Fixture {
    name: String,
    pub tensors: BTreeMap<String, Array>,
    metadata: HashMap<String, String>,
}

impl Fixture {
    pub fn read(name: &str) -> Self {
        let path = format!("{FOLDER}/{name}.safetensors");
        let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{path}: {error}"));
        let header = SafeTensors::read_metadata(&bytes).expect("a safetensors file");
        let tensors = SafeTensors::deserialize(&bytes).expect("a safetensors file");
        let array = |name: &str| {
            let view = tensors.tensor(name).expect("one of its names");
            assert_eq!(view.dtype(), safetensors::Dtype::F64, "{path}: `{name}`");
            let values = view.data().as_chunks().0.iter();
            Array {
                shape: view.shape().to_vec(),
                values: values.map(|bytes| f64::from_le_bytes(*bytes)).collect(),
            }
        };
        let names = tensors.names().into_iter();
        Self {
            name: name.to_owned(),
            tensors: names.map(|name| (name.to_owned(), array(name))).collect(),
            metadata: header.1.metadata().clone().expect("metadata"),
        }
    }

    pub fn text(&self, name: &str) -> &str {
        let text = self.metadata.get(name);
        text.unwrap_or_else(|| panic!("{}: metadata has no `{name}`", self.name))
    }

    pub fn gate(&self, place: &Place) -> f64 {
        let hard = self.metadata.get("hard").is_some_and(|hard| hard == "1");
        gate(place.precision, hard)
    }

    fn outputs(&self) -> Vec<&str> {
        self.text("outputs").split(',').collect()
    }

    /// Names of all expected outputs and gradients.
    pub fn expected(&self) -> Vec<&str> {
        let gradients = self.tensors.keys().filter(|name| name.starts_with("grad."));
        let gradients = gradients.map(String::as_str);
        self.outputs().into_iter().chain(gradients).collect()
    }

    /// Whether a tensor is an input.
    fn is_input(&self, name: &str) -> bool {
        let outputs = self.outputs();
        let output = name.strip_prefix("grad_").unwrap_or(name);
        !name.starts_with("grad.") && !outputs.contains(&output)
    }

    fn upstream(&self) -> impl Iterator<Item = &Array> {
        let outputs = self.outputs().into_iter();
        outputs.map(|name| &self.tensors[&format!("grad_{name}")])
    }

    /// Evaluates and differentiates a twin.
    pub fn run(&self, place: &Place, twin: Twin) -> Found {
        let device = place.device.clone().autodiff();
        let mut leaves = Leaves {
            tensors: BTreeMap::new(),
            shapes: BTreeMap::new(),
            metadata: self.metadata.clone(),
        };
        for (name, array) in self.tensors.iter().filter(|(name, _)| self.is_input(name)) {
            let flat = Array {
                shape: vec![array.values.len()],
                values: array.values.clone(),
            };
            let mut tensor = place.tensor::<1>(&flat, &device);
            if self.tensors.contains_key(&format!("grad.{name}")) {
                tensor = tensor.require_grad();
            }
            leaves.tensors.insert(name.clone(), tensor);
            leaves.shapes.insert(name.clone(), array.shape.clone());
        }
        let outputs = twin(&leaves).unwrap_or_else(|error| panic!("{}: {error}", self.name));

        let weighted = outputs
            .iter()
            .zip(self.upstream())
            .map(|(output, weights)| {
                let weights = TensorData::new(weights.values.clone(), [weights.values.len()]);
                let weights = Tensor::<1>::from_data(weights, (&device, place.precision.dtype()));
                (output.clone() * weights).sum()
            });
        let loss = weighted.reduce(|a, b| a + b).expect("an output");
        let gradients = loss.is_tracked().then(|| loss.backward());
        let mut found: Found = self
            .outputs()
            .into_iter()
            .zip(outputs)
            .map(|(name, output)| (name.to_owned(), read(output)))
            .collect();
        for (name, tensor) in &leaves.tensors {
            let gradient = gradients.as_ref().and_then(|all| tensor.grad(all));
            if let Some(gradient) = gradient {
                found.insert(format!("grad.{name}"), read(gradient));
            }
        }
        found
    }

    /// Compares with what is expected. A gradient that is not there counts as zero.
    pub fn compare(&self, found: &Found, place: &Place) -> Vec<Row> {
        let compare = |name: &str| {
            let expected = &self.tensors[name];
            let zeros = vec![0.0; expected.values.len()];
            let found = found.get(name).unwrap_or(&zeros);
            Row {
                name: name.to_owned(),
                error: distance(found, &expected.values) / self.scale(name),
                gate: self.gate(place),
            }
        };
        self.expected().into_iter().map(compare).collect()
    }

    /// What an error is relative to: the norm of what is expected; where that is zero, that of the
    /// upstream gradients, and for outputs that of ones.
    fn scale(&self, name: &str) -> f64 {
        let expected = &self.tensors[name];
        match expected.norm() {
            0.0 if name.starts_with("grad.") => {
                self.upstream().map(Array::norm).fold(0.0, f64::hypot)
            }
            0.0 => (expected.values.len() as f64).sqrt(),
            norm => norm,
        }
    }

    /// The same with an error of this relative size at the largest element of one expected tensor.
    pub fn with_error(&self, name: &str, relative: f64) -> Self {
        let mut changed = self.clone();
        let values = &mut changed
            .tensors
            .get_mut(name)
            .expect("one of its names")
            .values;
        let largest = values.iter_mut().max_by(|a, b| a.abs().total_cmp(&b.abs()));
        *largest.expect("an element") += relative * self.scale(name);
        changed
    }
}

/// The values of a tensor.
pub fn read<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor
        .try_into_vec_as()
        .unwrap_or_else(|error| panic!("a tensor cannot be read back: {error}"))
}

/// |a - b|; NaN where they have not the same length.
pub fn distance(a: &[f64], b: &[f64]) -> f64 {
    if a.len() != b.len() {
        return f64::NAN;
    }
    let squares = a.iter().zip(b).map(|(a, b)| (a - b).powi(2));
    squares.sum::<f64>().sqrt()
}
