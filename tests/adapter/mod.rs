//! The device for tests of the CubeCL kernels.

use std::sync::OnceLock;

use burn_splat::burn::tensor::Device;
use splat_test_support::adapter_or_skip;

/// wgpu's adapter, a software one included.
pub fn adapter() -> Option<Device> {
    // A process can open the device only once.
    static ADAPTER: OnceLock<Option<Device>> = OnceLock::new();
    ADAPTER
        .get_or_init(|| adapter_or_skip(Device::wgpu_options().init()))
        .clone()
}
