//! Input checks that all ops share.

use burn::backend::DispatchDevice;
use burn::tensor::{DType, Device, Tensor, kind::Basic};

use crate::OpError;

/// Checks the tensors of one call against each other.
pub(crate) struct Checker {
    op: &'static str,
    dtype: DType,
    device: Device,
}

impl Checker {
    /// The first tensor of a call, which sets its type and device.
    pub(crate) fn new<const R: usize>(
        op: &'static str,
        name: &'static str,
        first: &Tensor<R>,
    ) -> Result<Self, OpError> {
        let checker = Self {
            op,
            dtype: first.dtype(),
            device: first.device().without_autodiff(),
        };
        let reason = match checker.dtype {
            DType::F32 => None,
            DType::F64 if is_flex(&checker.device) => None,
            DType::F64 => Some("double precision runs on the CPU (Flex) device only"),
            _ => Some("the ops compute in F32, and in F64 on the CPU (Flex) device; cast it first"),
        };
        match reason {
            None => Ok(checker),
            Some(reason) => Err(checker.dtype_error(name, checker.dtype, reason)),
        }
    }

    /// Checks type, device and shape (`None`: any length).
    pub(crate) fn tensor<const R: usize>(
        &self,
        name: &'static str,
        tensor: &Tensor<R>,
        shape: [Option<usize>; R],
        expected: &'static str,
    ) -> Result<(), OpError> {
        self.place(name, tensor, shape, expected)?;
        if tensor.dtype() != self.dtype {
            return Err(self.dtype_error(
                name,
                tensor.dtype(),
                "all tensors of one call must have the same type",
            ));
        }
        Ok(())
    }

    /// Checks device and shape of a tensor of any kind and type.
    pub(crate) fn place<const R: usize, K: Basic>(
        &self,
        name: &'static str,
        tensor: &Tensor<R, K>,
        shape: [Option<usize>; R],
        expected: &'static str,
    ) -> Result<(), OpError> {
        let got = tensor.dims();
        let fits = shape
            .iter()
            .zip(got)
            .all(|(want, got)| want.is_none_or(|want| want == got));
        if !fits {
            return Err(OpError::Shape {
                op: self.op,
                tensor: name,
                expected,
                got: got.to_vec(),
            });
        }
        if tensor.device().without_autodiff() != self.device {
            return Err(self.argument(format!(
                "`{name}` is on {:?}, the first tensor on {:?}; move them to one device",
                tensor.device(),
                self.device
            )));
        }
        Ok(())
    }

    /// Checks the window of a separable convolution.
    pub(crate) fn window(&self, window: &[f64]) -> Result<(), OpError> {
        let symmetric = window.iter().eq(window.iter().rev());
        if window.len().is_multiple_of(2) || !symmetric {
            return Err(self.argument(format!(
                "the window must be symmetric and of odd length, got {window:?}"
            )));
        }
        Ok(())
    }

    pub(crate) fn argument(&self, what: String) -> OpError {
        OpError::Argument { op: self.op, what }
    }

    fn dtype_error(&self, tensor: &'static str, got: DType, reason: &'static str) -> OpError {
        OpError::DType {
            op: self.op,
            tensor,
            got,
            reason,
        }
    }
}

/// True for devices of Burn's Flex backend, given without autodiff.
pub(crate) fn is_flex(device: &Device) -> bool {
    #[cfg(feature = "cpu")]
    return matches!(device.as_dispatch(), DispatchDevice::Flex(_));
    #[cfg(not(feature = "cpu"))]
    {
        let _: &DispatchDevice = device.as_dispatch();
        false
    }
}
