//! Device utilities, mainly for benchmarks of CubeCL devices: what they are, what the kernels did
//! there, how fast their memory is. Without such a device (or the features for one) there is
//! nothing to tell.

use burn::tensor::{Device, Tensor};

use crate::OpError;
use crate::check::is_flex;
#[cfg(feature = "cpu")]
use crate::{Projected, RasterizeSettings, RasterizeWork};
pub use splat_core::memory::available_memory;

/// Work of the kernels since the process began, over all devices; a piece of work is a difference
/// of two.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct KernelWork {
    /// Kernels of ours that were launched; those of Burn are not seen here.
    pub launches: u64,
    /// Intersections of splats and tiles that were listed.
    pub intersections: u64,
    /// Bytes reserved for results and scratch of our kernels; the same memory may be reserved many
    /// times.
    pub reserved_bytes: u64,
    /// How often our kernels made the host wait for the device.
    pub waits: u64,
}

/// How large a training step is, for [`step_floor`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StepSizes {
    /// Gaussians.
    pub gaussians: u64,
    /// Those that reach into the view.
    pub visible: u64,
    /// Intersections of splats and tiles.
    pub intersections: u64,
    /// Width of the view in pixels.
    pub width: u64,
    /// Height of the view in pixels.
    pub height: u64,
    /// Degree of spherical harmonics that is evaluated.
    pub sh_degree: usize,
    /// Floats of one Gaussian that are trained.
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

/// The values of a float tensor on the host, in single precision.
///
/// # Errors
/// [`OpError::Device`] when the device failed, then or in whatever the tensor was computed by: a
/// device that works on its own says so only when something is read.
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

/// To be called where a training step or the like begins. On the CPU the threads that share the
/// work of an op, those of the pool that the caller is in or else of rayon's global one, otherwise
/// fall asleep behind each, and to wake one takes as long as a small op: on two threads, a
/// twentieth of a step of 15,000 Gaussians. From here on they look for work instead, until there
/// was none for much longer than a step lies between two ops. Elsewhere this does nothing.
pub fn keep_awake(device: &Device) {
    if is_flex(&device.clone().without_autodiff()) {
        #[cfg(feature = "cpu")]
        crate::cpu::keep_awake();
    }
}

/// Properties of a CubeCL device, and which variant of the kernels runs there: name and value, in
/// an order for reading. `None` for any other device.
pub fn device_info(device: &Device) -> Option<Vec<(&'static str, String)>> {
    #[cfg(feature = "cube")]
    return client(device).map(|client| splat_kernels::device_info(&client));
    #[cfg(not(feature = "cube"))]
    {
        let _ = device;
        None
    }
}

/// Whether [`sh_colors`](crate::sh_colors) reads coefficients in half precision (F16) on a device
/// as they are. Where it does not, it makes others of them, which costs more than it saves.
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
    /// The difference to `earlier`.
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

/// Bytes of device memory that the kernels of a training step with three colours cannot do without:
/// by stage, in order, read and written together. `splat_kernels::floor` says what is counted and
/// what is estimated. `None` where the device is none of CubeCL.
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

/// Bytes per second, read and written together, of a plain kernel that copies `bytes`: what a stage
/// bound by memory could reach. `None` where the device is none of CubeCL.
///
/// # Errors
/// The device's error.
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

/// Counts the work of [`rasterize`](crate::rasterize) with the same arguments, by doing it on their
/// device.
///
/// A CubeCL device tests other pairs than the CPU: there a block of the tile's pixels (8 x 8, or 4
/// x 4 where planes are not known) walks all splats of the tile whose ellipse meets the block, each
/// at all pixels of the block that are still open. On the CPU rows are cut to the ellipse in steps
/// of eight pixels.
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
