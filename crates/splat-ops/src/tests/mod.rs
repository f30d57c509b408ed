//! Promises of every backend, tested on the native path and on the kernels if there is an adapter.

mod absgrad;
mod activation;
mod decisions;
mod perturb;
mod photometric;
mod poison;
mod probe;
mod project;
mod screen_statistics;
mod sh_colors;
mod sh_degrees;

use burn::tensor::Device;

/// Devices of this machine, with names.
fn devices() -> Vec<(&'static str, Device)> {
    #[allow(unused_mut)]
    let mut devices = vec![("Flex", Device::flex())];
    #[cfg(feature = "wgpu")]
    if crate::cube::tests::has_adapter() {
        let kind = burn::tensor::DeviceKind::DefaultDevice;
        devices.push(("wgpu", Device::wgpu(kind)));
    }
    devices
}
