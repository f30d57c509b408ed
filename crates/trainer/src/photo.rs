//! Photos as tensors.

use std::borrow::Cow;

use burn::tensor::{DType, Device, Int, Tensor, TensorData};
use splat_data::View;
use splat_ops::OpError;

/// The photo of a view, `[1, H, W, 3]` in [0, 1].
///
/// # Errors
/// When the photo is on the disk ([`View::loaded`]) and cannot be read.
pub fn photo(view: &View, device: &Device) -> Result<Tensor<4>, OpError> {
    Ok(values(pixels_u8(&*loaded(view)?, device)))
}

/// The mask of a view, `[1, H, W, 1]` from 0 (ignored) to 1; `None` if all pixels count.
///
/// # Errors
/// When the mask is on the disk ([`View::loaded`]) and cannot be read.
pub fn mask(view: &View, device: &Device) -> Result<Option<Tensor<4>>, OpError> {
    Ok(mask_of(&*loaded(view)?, device))
}

/// The view with its photo in memory.
pub(crate) fn loaded(view: &View) -> Result<Cow<'_, View>, OpError> {
    view.loaded().map_err(|error| OpError::Argument {
        op: "photo",
        what: error.to_string(),
    })
}

/// The photo as stored, 8-bit levels `[1, H, W, 3]`, of type U8 if the device supports it. The view
/// is in memory.
pub(crate) fn pixels_u8(view: &View, device: &Device) -> Tensor<4, Int> {
    let dtype = match device.supports_dtype(DType::U8) {
        true => DType::U8,
        false => DType::I32,
    };
    let shape = [1, view.height as usize, view.width as usize, 3];
    Tensor::from_data(TensorData::new(view.image.to_vec(), shape), (device, dtype))
}

/// [`mask`] of a view in memory.
pub(crate) fn mask_of(view: &View, device: &Device) -> Option<Tensor<4>> {
    let mask = view.mask.as_ref()?;
    let values: Vec<f32> = mask.iter().map(|value| f32::from(*value) / 255.0).collect();
    let shape = [1, view.height as usize, view.width as usize, 1];
    Some(Tensor::from_data(TensorData::new(values, shape), device))
}

/// Converts levels from 0 to 255 to values in [0, 1].
pub(crate) fn values(pixels: Tensor<4, Int>) -> Tensor<4> {
    pixels.float() / 255.0
}
