//! Device utilities, mainly for benchmarks of CubeCL devices: properties, counts of kernel work,
//! memory bandwidth. They return nothing for other devices, or without the features for CubeCL.

use burn::tensor::{Device, Tensor};

use crate::OpError;
use crate::check::is_flex;
#[cfg(feature = "cpu")]
use crate::{Projected, RasterizeSettings, RasterizeWork};
pub use splat_core::memory::available_memory;

/// Work of the kernels since the start of the process, over all devices. Subtract two to measure a
/// piece of work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct KernelWork {
    /// Launches of this project's kernels; Burn's are not counted.
    pub launches: u64,
    /// Intersections listed, each of a splat and a tile.
    pub intersections: u64,
    /// Bytes reserved for results and scratch; the same memory counts every time it is reserved.
    pub reserved_bytes: u64,
    /// Times that the host waited for the device.
    pub waits: u64,
}

/// Size of a training step, for [`step_floor`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StepSizes {
    /// Gaussians.
    pub gaussians: u64,
    /// Gaussians that reach into the view.
    pub visible: u64,
    /// Intersections, each of a splat and a tile.
    pub intersections: u64,
    /// Width of the view in pixels.
    pub width: u64,
    /// Height of the view in pixels.
    pub height: u64,
    /// Degree of spherical harmonics that is evaluated.
    pub sh_degree: usize,
    /// Trained floats per Gaussian.
    pub parameters: u64,
}

#[cfg(feature = "cube")]
pub(crate) fn client(device: &Device) -> Option<cubecl::client::Client> {
    use burn::backend::DispatchDevice;
    match device.clone().without_autodiff().as_dispatch() {
        DispatchDevice::Cube(device) => Some(device.client()),
        #[allow(unreachable_patterns, reason = "not so without the feature `cpu`")]
        _ => None,
    }
}

/// Reads a float tensor to the host, in single precision.
///
/// # Errors
/// [`OpError::Device`] when the device failed, now or while computing the tensor: an asynchronous
/// device reports errors only when something is read.
pub fn to_host<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f32>, OpError> {
    let failed = |what: String| OpError::Device {
        op: "reading a tensor",
        what,
    };
    let data = tensor
        .try_into_data()
        .map_err(|error| failed(error.to_string()))?;
    let values = data.convert::<f32>().try_into_vec();
    values.map_err(|error| failed(format!("{error:?}")))
}

/// Keeps CPU worker threads awake between the ops of a training step; call it at the start of each
/// step.
///
/// The threads are those of the rayon pool that the caller runs in, else of the global one. By
/// default they sleep after each op, and waking one takes as long as a small op: on two threads, a
/// twentieth of a step of 15,000 Gaussians. After this call they spin until there has been no work
/// for much longer than the gap between two ops. Does nothing on other devices.
pub fn keep_awake(device: &Device) {
    if is_flex(&device.clone().without_autodiff()) {
        #[cfg(feature = "cpu")]
        crate::cpu::keep_awake();
    }
}

/// Properties of a CubeCL device and the kernel variants that run on it, as names and values in
/// display order. `None` for other devices.
pub fn device_info(device: &Device) -> Option<Vec<(&'static str, String)>> {
    #[cfg(feature = "cube")]
    return client(device).map(|client| splat_kernels::device_info(&client));
    #[cfg(not(feature = "cube"))]
    {
        let _ = device;
        None
    }
}

/// True if [`sh_colors`](crate::sh_colors) reads half-precision (F16) coefficients directly on this
/// device. Elsewhere it converts them, which costs more than it saves.
pub fn reads_half(device: &Device) -> bool {
    #[cfg(feature = "cube")]
    return client(device).is_some_and(|client| splat_kernels::reads_half(&client));
    #[cfg(not(feature = "cube"))]
    {
        let _ = device;
        false
    }
}

/// Work of the kernels so far.
pub fn kernel_work() -> KernelWork {
    #[cfg(feature = "cube")]
    {
        let work = splat_kernels::work();
        KernelWork {
            launches: work.launches,
            intersections: work.intersections,
            reserved_bytes: work.reserved_bytes,
            waits: work.waits,
        }
    }
    #[cfg(not(feature = "cube"))]
    KernelWork::default()
}

impl KernelWork {
    /// Work done after `earlier`.
    #[must_use]
    pub fn since(self, earlier: Self) -> Self {
        Self {
            launches: self.launches - earlier.launches,
            intersections: self.intersections - earlier.intersections,
            reserved_bytes: self.reserved_bytes - earlier.reserved_bytes,
            waits: self.waits - earlier.waits,
        }
    }
}

/// Bytes of device memory that a training step with three colour channels must read and write, by
/// stage, in order. `splat_kernels::floor` states what is counted and what is estimated. `None` for
/// devices other than CubeCL's.
pub fn step_floor(device: &Device, sizes: &StepSizes) -> Option<Vec<(&'static str, u64)>> {
    #[cfg(feature = "cube")]
    {
        let sizes = splat_kernels::floor::Sizes {
            gaussians: sizes.gaussians,
            visible: sizes.visible,
            intersections: sizes.intersections,
            width: sizes.width,
            height: sizes.height,
            channels: 3,
            degree: sizes.sh_degree,
            parameters: sizes.parameters,
            digit_bits: splat_kernels::sort::digit_bits(&client(device)?),
        };
        let stages = splat_kernels::floor::step(&sizes).into_iter();
        Some(stages.map(|(name, bytes)| (name, bytes.total())).collect())
    }
    #[cfg(not(feature = "cube"))]
    {
        let _ = (device, sizes);
        None
    }
}

/// Bandwidth of a plain copy kernel over `bytes`, in bytes read and written per second: the limit
/// of a memory-bound stage. `None` for devices other than CubeCL's.
///
/// # Errors
/// When the device fails.
pub fn copy_bandwidth(device: &Device, bytes: usize) -> Result<Option<f64>, OpError> {
    #[cfg(feature = "cube")]
    {
        let Some(client) = client(device) else {
            return Ok(None);
        };
        let measured = splat_kernels::copy::bandwidth(&client, bytes / 4);
        measured
            .map(Some)
            .map_err(|what| OpError::Device { op: "copy", what })
    }
    #[cfg(not(feature = "cube"))]
    {
        let _ = (device, bytes);
        Ok(None)
    }
}

/// Counts the work of [`rasterize`](crate::rasterize) with the same arguments by running it on
/// their device.
///
/// A CubeCL device tests other pairs than the CPU. There a block of the tile's pixels (8 x 8, or 4
/// x 4 if the plane size is not known) walks all splats of the tile whose ellipse meets the block,
/// at all pixels of the block that are still open. The CPU cuts rows to the ellipse in steps of
/// eight pixels.
///
/// # Errors
/// As [`rasterize`](crate::rasterize).
#[cfg(feature = "cpu")]
pub fn rasterize_work<const DC: usize, const DO: usize>(
    projected: &Projected,
    colors: Tensor<DC>,
    opacities: Tensor<DO>,
    settings: &RasterizeSettings,
) -> Result<RasterizeWork, OpError> {
    #[cfg(feature = "cube")]
    if let Some(client) = client(&projected.packed().device()) {
        let (colors, opacities) = crate::rasterize::per_camera(projected, colors, opacities)?;
        return crate::cube::rasterize_work(&client, projected, colors, opacities, settings);
    }
    crate::cpu::rasterize_work(projected, colors, opacities, settings)
}
