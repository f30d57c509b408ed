//! Return values of checked functions.

use burn::tensor::Tensor;

/// Return value of a checked function: a tensor, a tuple of up to four, or a `Result` of either.
pub trait Outputs {
    /// The tensors in order, or the error.
    #[doc(hidden)]
    fn parts(self) -> Result<Vec<Part>, String>;
}

/// One tensor of any rank.
#[doc(hidden)]
#[derive(Debug, Clone)]
pub struct Part {
    pub(super) shape: Vec<usize>,
    pub(super) flat: Tensor<1>,
}

impl Part {
    fn new<const D: usize>(tensor: Tensor<D>) -> Self {
        let shape = tensor.dims().to_vec();
        let count = shape.iter().product::<usize>();
        Self {
            flat: tensor.reshape([count]),
            shape,
        }
    }
}

impl<const D: usize> Outputs for Tensor<D> {
    fn parts(self) -> Result<Vec<Part>, String> {
        Ok(vec![Part::new(self)])
    }
}

impl<T: Outputs, E: std::fmt::Display> Outputs for Result<T, E> {
    fn parts(self) -> Result<Vec<Part>, String> {
        self.map_err(|error| error.to_string())?.parts()
    }
}

macro_rules! tuple {
    ($($rank:ident $place:tt)+) => {
        impl<$(const $rank: usize),+> Outputs for ($(Tensor<$rank>,)+) {
            fn parts(self) -> Result<Vec<Part>, String> {
                Ok(vec![$(Part::new(self.$place)),+])
            }
        }
    };
}

tuple!(A 0);
tuple!(A 0 B 1);
tuple!(A 0 B 1 C 2);
tuple!(A 0 B 1 C 2 D 3);
