//! Named inputs on the host, and conversion to tensors.

use burn::tensor::{DType, Device, Gradients, Tensor, TensorData};

use crate::gradcheck::Array;

/// A tensor as used in checks: double precision, on the CPU, tracked by autodiff.
///
/// For values that a function needs besides its inputs. Tensors of another device or precision do
/// not mix with them.
///
/// # Panics
/// When the number of values differs from the number of elements of the shape.
///
/// ```
/// let window = splat_lab::central::tensor([0.25, 0.5, 0.25], [3, 1]); // [3, 1]
/// assert_eq!(window.dims(), [3, 1]);
/// ```
pub fn tensor<const D: usize>(values: impl Into<Vec<f64>>, shape: [usize; D]) -> Tensor<D> {
    let device = Device::flex().autodiff();
    Tensor::from_data(TensorData::new(values.into(), shape), (&device, DType::F64))
}

/// Inputs whose number and ranks are known only at run time. If they are known at compile time, a
/// tuple of pairs `("name", tensor)` is shorter: see [`Arguments`].
///
/// ```
/// use burn::tensor::Tensor;
/// use splat_lab::central::{Inputs, NamedTensors, gradcheck, tensor};
///
/// let inputs = Inputs::new()
///     .with("x", tensor([1.0, 2.0, 3.0, 4.0], [2, 2]))
///     .with("shift", tensor([0.5, -0.5], [2]));
/// let function = |at: NamedTensors| -> Tensor<2> {
///     at.get::<2>("x").sin() + at.get::<1>("shift").unsqueeze()
/// };
/// gradcheck(function, inputs)?.expect();
/// # Ok::<(), splat_lab::central::CheckError>(())
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Inputs {
    pub(super) entries: Vec<(String, Array)>,
}

impl Inputs {
    /// An empty list of inputs.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds an input of any float type and device. Its values are kept in double precision.
    ///
    /// # Panics
    /// When the tensor cannot be read back.
    pub fn with<const D: usize>(self, name: impl Into<String>, tensor: Tensor<D>) -> Self {
        let shape = tensor.dims().to_vec();
        let values = read(tensor);
        self.with_array(name, Array { shape, values })
    }

    /// [`with`](Self::with) for values on the host.
    pub fn with_array(mut self, name: impl Into<String>, array: Array) -> Self {
        self.entries.push((name.into(), array));
        self
    }

    /// Names and values, in order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Array)> {
        self.entries
            .iter()
            .map(|(name, array)| (name.as_str(), array))
    }
}

/// Inputs by name, as a function of [`Inputs`] receives them.
#[derive(Debug, Clone)]
pub struct NamedTensors {
    /// Flattened, with the original shapes.
    entries: Vec<(String, Vec<usize>, Tensor<1>)>,
}

impl NamedTensors {
    /// The input with this name.
    ///
    /// # Panics
    /// When there is no such input, or it has another rank.
    pub fn get<const D: usize>(&self, name: &str) -> Tensor<D> {
        let Some((_, shape, flat)) = self.entries.iter().find(|(n, ..)| n == name) else {
            let names: Vec<_> = self.entries.iter().map(|(name, ..)| name).collect();
            panic!("there is no input `{name}`; there are {names:?}");
        };
        let Ok(shape) = <[usize; D]>::try_from(shape.as_slice()) else {
            panic!("input `{name}` has shape {shape:?}, not {D} dimensions");
        };
        flat.clone().reshape(shape)
    }
}

/// Named inputs of a function, and the form in which it receives them.
///
/// | inputs | the function receives |
/// |---|---|
/// | `("x", x)` | `x` |
/// | `(("x", x), ("y", y))`, up to eight of any ranks | `(x, y)` |
/// | `[("x", x), ("y", y)]`, all of one rank | `[x, y]` |
/// | [`Inputs`] | [`NamedTensors`] |
pub trait Arguments {
    /// The function's argument: the same shapes, in double precision on the CPU.
    type Tensors;

    /// The inputs on the host.
    fn into_inputs(self) -> Inputs;

    /// The tensors of inputs with these names and ranks, tracked where `tracked` says so.
    #[doc(hidden)]
    fn tensors(inputs: &Inputs, tracked: &[bool]) -> Self::Tensors;

    /// Gradients of those tensors; `None` for untracked ones.
    #[doc(hidden)]
    fn gradients(tensors: &Self::Tensors, gradients: &Gradients) -> Vec<Option<Vec<f64>>>;

    /// A copy of the same tensors.
    #[doc(hidden)]
    fn share(tensors: &Self::Tensors) -> Self::Tensors;
}

impl<const D: usize> Arguments for (&str, Tensor<D>) {
    type Tensors = Tensor<D>;

    fn into_inputs(self) -> Inputs {
        Inputs::new().with(self.0, self.1)
    }

    fn tensors(inputs: &Inputs, tracked: &[bool]) -> Tensor<D> {
        leaf(inputs, tracked, 0)
    }

    fn gradients(tensor: &Tensor<D>, gradients: &Gradients) -> Vec<Option<Vec<f64>>> {
        vec![tensor.grad(gradients).map(read)]
    }

    fn share(tensor: &Tensor<D>) -> Tensor<D> {
        tensor.clone()
    }
}

impl<const D: usize, const N: usize> Arguments for [(&str, Tensor<D>); N] {
    type Tensors = [Tensor<D>; N];

    fn into_inputs(self) -> Inputs {
        self.into_iter()
            .fold(Inputs::new(), |inputs, (name, x)| inputs.with(name, x))
    }

    fn tensors(inputs: &Inputs, tracked: &[bool]) -> Self::Tensors {
        std::array::from_fn(|i| leaf(inputs, tracked, i))
    }

    fn gradients(tensors: &Self::Tensors, gradients: &Gradients) -> Vec<Option<Vec<f64>>> {
        tensors
            .iter()
            .map(|x| x.grad(gradients).map(read))
            .collect()
    }

    fn share(tensors: &Self::Tensors) -> Self::Tensors {
        tensors.clone()
    }
}

impl Arguments for Inputs {
    type Tensors = NamedTensors;

    fn into_inputs(self) -> Inputs {
        self
    }

    fn tensors(inputs: &Inputs, tracked: &[bool]) -> NamedTensors {
        let flat = |((name, array), tracked): (&(String, Array), &bool)| {
            let flat = tensor(array.values.clone(), [array.values.len()]);
            let flat = if *tracked { flat.require_grad() } else { flat };
            (name.clone(), array.shape.clone(), flat)
        };
        NamedTensors {
            entries: inputs.entries.iter().zip(tracked).map(flat).collect(),
        }
    }

    fn gradients(tensors: &NamedTensors, gradients: &Gradients) -> Vec<Option<Vec<f64>>> {
        let entries = tensors.entries.iter();
        entries
            .map(|(.., flat)| flat.grad(gradients).map(read))
            .collect()
    }

    fn share(tensors: &NamedTensors) -> NamedTensors {
        tensors.clone()
    }
}

macro_rules! tuple {
    ($($rank:ident $place:tt)+) => {
        impl<$(const $rank: usize),+> Arguments for ($((&str, Tensor<$rank>),)+) {
            type Tensors = ($(Tensor<$rank>,)+);

            fn into_inputs(self) -> Inputs {
                Inputs::new()$(.with(self.$place.0, self.$place.1))+
            }

            fn tensors(inputs: &Inputs, tracked: &[bool]) -> Self::Tensors {
                ($(leaf::<$rank>(inputs, tracked, $place),)+)
            }

            fn gradients(tensors: &Self::Tensors, gradients: &Gradients) -> Vec<Option<Vec<f64>>> {
                vec![$(tensors.$place.grad(gradients).map(read)),+]
            }

            fn share(tensors: &Self::Tensors) -> Self::Tensors {
                tensors.clone()
            }
        }
    };
}

tuple!(A 0);
tuple!(A 0 B 1);
tuple!(A 0 B 1 C 2);
tuple!(A 0 B 1 C 2 D 3);
tuple!(A 0 B 1 C 2 D 3 E 4);
tuple!(A 0 B 1 C 2 D 3 E 4 F 5);
tuple!(A 0 B 1 C 2 D 3 E 4 F 5 G 6);
tuple!(A 0 B 1 C 2 D 3 E 4 F 5 G 6 H 7);

fn leaf<const D: usize>(inputs: &Inputs, tracked: &[bool], place: usize) -> Tensor<D> {
    let array = &inputs.entries[place].1;
    let shape = <[usize; D]>::try_from(array.shape.as_slice()).expect("of the rank it came with");
    let tensor = tensor(array.values.clone(), shape);
    if tracked[place] {
        tensor.require_grad()
    } else {
        tensor
    }
}

/// Values in double precision.
pub(super) fn read<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor
        .try_into_vec_as()
        .unwrap_or_else(|error| panic!("a tensor cannot be read back: {error}"))
}
