//! Host side of every stage: buffers with their lengths, and the folding of work into workgroups.

use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};

use cubecl::bytes::Bytes;
use cubecl::future::reader::try_read_sync;
use cubecl::ir::{ElemType, FloatKind};
use cubecl::prelude::*;
use cubecl::server::{Handle, ServerError};

use crate::copy::copied;
use crate::work;

/// Units of a workgroup in every one-dimensional kernel.
pub const CUBE_UNITS: u32 = 256;
/// [`CUBE_UNITS`] as an index.
pub(crate) const CUBE_UNITS_USIZE: usize = CUBE_UNITS as usize;

/// Most storage buffers that a kernel of this crate binds. In WGSL, CubeCL binds one more for
/// lengths and scalars.
///
/// WebGPU guarantees 8 (`max_storage_buffers_per_shader_stage`); wgpu reports 16 for DirectX
/// devices without resource binding tier 3, and 29 for Metal.
pub const MOST_BUFFERS: u32 = 12;

/// Storage buffers that kernels can bind on this device, excluding CubeCL's own.
pub fn bindable_buffers(client: &Client) -> u32 {
    client.properties().hardware.max_bindings
}

/// WebGPU's limit of workgroups along one dimension.
const MAX_CUBES_PER_DIMENSION: u32 = 65_535;

/// True if [`Buffer::empty`] fills memory with [`POISONED`].
static POISON: AtomicBool = AtomicBool::new(false);

/// NaN as a float; as an index, far outside any buffer.
const POISONED: u32 = 0x7fc0_0000;

/// Switches, for the whole process, whether reserved memory is filled with NaN. For tests: an
/// element that is read but was never written then shows in the results.
#[doc(hidden)]
pub fn poison(on: bool) {
    POISON.store(on, Ordering::Relaxed);
}

/// Contiguous device buffer of `len` four-byte elements (`f32` or `u32`).
///
/// Holds at least one element on the device, so that it can always be bound.
#[derive(Clone, Debug)]
pub struct Buffer {
    handle: Handle,
    len: usize,
}

impl Buffer {
    /// Wraps a contiguous `handle` of at least `len` four-byte elements.
    ///
    /// # Errors
    /// Returns the handle if it is too small.
    pub fn new(handle: Handle, len: usize) -> Result<Self, Handle> {
        if handle.size_in_used() / 4 >= len as u64 {
            Ok(Self { handle, len })
        } else {
            Err(handle)
        }
    }

    /// Reserves `len` uninitialised elements.
    pub fn empty(client: &Client, len: usize) -> Self {
        work::reserved(len.max(1) * 4);
        if POISON.load(Ordering::Relaxed) {
            return Self {
                handle: client.create_from_slice(u32::as_bytes(&vec![POISONED; len.max(1)])),
                len,
            };
        }
        Self {
            handle: client.empty(len.max(1) * 4),
            len,
        }
    }

    /// Uploads `values`.
    pub fn from_f32(client: &Client, values: &[f32]) -> Self {
        Self::from_bytes(client, f32::as_bytes(values), values.len())
    }

    /// Uploads `values`.
    pub fn from_u32(client: &Client, values: &[u32]) -> Self {
        Self::from_bytes(client, u32::as_bytes(values), values.len())
    }

    fn from_bytes(client: &Client, bytes: &[u8], len: usize) -> Self {
        if len == 0 {
            return Self::empty(client, 0);
        }
        Self {
            handle: client.create_from_slice(bytes),
            len,
        }
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.len
    }

    /// True if there are no elements.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The underlying device memory.
    pub fn into_handle(self) -> Handle {
        self.handle
    }

    /// Reads the elements back; waits for the device.
    ///
    /// # Errors
    /// The device's error, in words.
    pub fn read_u32(&self, client: &Client) -> Result<Vec<u32>, String> {
        Ok(u32::from_bytes(&self.read(client)?)[..self.len].to_vec())
    }

    /// Reads the elements back; waits for the device.
    ///
    /// # Errors
    /// The device's error, in words.
    pub fn read_f32(&self, client: &Client) -> Result<Vec<f32>, String> {
        Ok(f32::from_bytes(&self.read(client)?)[..self.len].to_vec())
    }

    fn read(&self, client: &Client) -> Result<cubecl::bytes::Bytes, String> {
        self.start_reading(client).wait()
    }

    /// Starts copying the elements to the host. Work launched from now on neither delays the copy
    /// nor waits for it.
    pub(crate) fn start_reading<'a>(&self, client: &'a Client) -> PendingRead<'a> {
        PendingRead(Box::pin(client.read_async(vec![self.handle.clone()])))
    }

    /// True if something else holds the memory too.
    pub(crate) fn is_held(&self) -> bool {
        !self.handle.can_mut()
    }

    /// The same elements, in memory that nothing else holds.
    pub(crate) fn owned(self, client: &Client) -> Self {
        match self.is_held() {
            true => copied(client, &self),
            false => self,
        }
    }

    /// Prepares a kernel that reads this buffer as its buffer number `position` and writes a result
    /// of the same length: returns the result's buffer, which shares the memory if nothing else
    /// holds it, and the arguments for both.
    pub(crate) fn overwritten(self, client: &Client, position: usize) -> (Self, [BufferArg; 2]) {
        if !self.is_held() {
            let arguments = [self.arg(), BufferArg::alias(position, self.len.max(1))];
            return (self, arguments);
        }
        let out = Self::empty(client, self.len);
        let arguments = [self.arg(), out.arg()];
        (out, arguments)
    }

    /// The buffer as a kernel argument.
    pub(crate) fn arg(&self) -> BufferArg {
        // SAFETY: both constructors ensure that the handle holds `len` elements of four bytes, and
        // every kernel of this crate views buffers as `f32` or `u32`.
        unsafe { BufferArg::from_raw_parts(self.handle.clone(), self.len.max(1)) }
    }
}

/// Contiguous device buffer of `len` half-precision floats, for devices whose kernels can read
/// them.
#[derive(Clone, Debug)]
pub struct HalfBuffer {
    handle: Handle,
    len: usize,
}

impl HalfBuffer {
    /// Wraps a contiguous `handle` of at least `len` two-byte elements.
    ///
    /// # Errors
    /// Returns the handle if it is too small.
    pub fn new(handle: Handle, len: usize) -> Result<Self, Handle> {
        if len > 0 && handle.size_in_used() / 2 >= len as u64 {
            Ok(Self { handle, len })
        } else {
            Err(handle)
        }
    }

    /// Number of elements; at least one.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.len
    }

    /// The buffer as a kernel argument, to be viewed as `f16`.
    pub(crate) fn arg(&self) -> BufferArg {
        // SAFETY: the constructor ensures that the handle holds `len` elements of two bytes.
        unsafe { BufferArg::from_raw_parts(self.handle.clone(), self.len) }
    }
}

/// True if kernels on this device can read half precision.
pub fn reads_half(client: &Client) -> bool {
    client.properties().supports_type(F16)
}

/// Single precision, for kernels generic over the element type.
pub(crate) const F32: ElemType = ElemType::Float(FloatKind::F32);
/// Half precision, for kernels generic over the element type.
pub(crate) const F16: ElemType = ElemType::Float(FloatKind::F16);

/// Elements being copied to the host.
pub(crate) struct PendingRead<'a>(
    Pin<Box<dyn Future<Output = Result<Vec<Bytes>, ServerError>> + Send + 'a>>,
);

impl PendingRead<'_> {
    /// Waits for the copy.
    pub fn wait(self) -> Result<Bytes, String> {
        work::waited();
        // On platforms where a thread cannot wait (browsers), the read succeeds only if it has
        // finished.
        let read = try_read_sync(self.0).ok_or("this platform cannot wait for the device")?;
        let read = read.map_err(|error| format!("{error:?}"))?;
        read.into_iter()
            .next()
            .ok_or_else(|| "nothing was read".into())
    }
}

/// `cubes` workgroups, folded into two dimensions if one is not enough. Kernels see a linear
/// `CUBE_POS` that may exceed `cubes`, and check it.
///
/// Every launch passes through here once, so launches are counted here.
pub(crate) fn cube_count(cubes: usize) -> CubeCount {
    work::launched();
    let cubes = u32::try_from(cubes).unwrap_or(u32::MAX);
    if cubes <= MAX_CUBES_PER_DIMENSION {
        return CubeCount::Static(cubes, 1, 1);
    }
    let rows = cubes.div_ceil(MAX_CUBES_PER_DIMENSION);
    CubeCount::Static(cubes.div_ceil(rows), rows, 1)
}

/// Workgroups and their size for one unit per element; `None` if there are no elements.
pub(crate) fn per_element(elements: usize) -> Option<(CubeCount, CubeDim)> {
    if elements == 0 {
        return None;
    }
    Some((
        cube_count(elements.div_ceil(CUBE_UNITS_USIZE)),
        CubeDim::new_1d(CUBE_UNITS),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dims(cubes: usize) -> (u64, u64) {
        match cube_count(cubes) {
            CubeCount::Static(x, y, 1) => (u64::from(x), u64::from(y)),
            other => panic!("unexpected {other:?}"),
        }
    }

    #[test]
    fn workgroups_fold_into_two_dimensions_and_cover_all_work() {
        for cubes in [
            1,
            2,
            65_535,
            65_536,
            65_537,
            131_071,
            1 << 24,
            1 << 31,
            (1 << 31) + 3,
        ] {
            let (x, y) = dims(cubes);
            assert!(x <= 65_535 && y <= 65_535, "{cubes}: {x} x {y}");
            assert!(x * y >= cubes as u64, "{cubes}: {x} x {y} is too few");
            assert!(
                x * y - (cubes as u64) < x,
                "{cubes}: {x} x {y} wastes a row"
            );
        }
    }
}
