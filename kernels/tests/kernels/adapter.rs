//! The adapter for tests.

use std::sync::OnceLock;

use cubecl::client::Client;
use cubecl::device::WgpuDeviceKind::{Cpu, DefaultDevice};
use cubecl::future::block_on;
use cubecl::wgpu::wgpu::{DeviceDescriptor, Features, Limits, MemoryHints};
use cubecl::wgpu::{
    AutoGraphicsApi, RuntimeOptions, WgpuDevice, WgpuSetup, try_init_device, try_init_setup,
};
use splat_kernels::MOST_BUFFERS;

/// A client of the default wgpu adapter, software ones included. Prints a message and returns
/// `None` if there is none. With WGSL it binds only as many buffers as the kernels claim to need.
pub fn find() -> Option<Client> {
    // A process can open the device only once.
    static CLIENT: OnceLock<Option<Client>> = OnceLock::new();
    CLIENT
        .get_or_init(|| {
            splat_test_support::adapter_or_skip(open().ok_or("neither a GPU nor a software one"))
        })
        .clone()
}

fn open() -> Option<Client> {
    let (device, setup) = [DefaultDevice, Cpu].into_iter().find_map(|kind| {
        let device = WgpuDevice::new(kind);
        let setup = try_init_setup::<AutoGraphicsApi>(&device, RuntimeOptions::default());
        Some((device, setup.ok()?))
    })?;
    let client = cubecl::Device::Wgpu(device).client();
    // SPIR-V and MSL need a device that CubeCL opens itself.
    if client.name() != "wgpu<wgsl>" {
        return Some(client);
    }
    Some(cubecl::Device::Wgpu(with_few_bindings(setup)).client())
}

fn with_few_bindings(mut setup: WgpuSetup) -> WgpuDevice {
    let request = setup.adapter.request_device(&DeviceDescriptor {
        required_features: setup
            .device
            .features()
            .difference(Features::all_experimental_mask()),
        required_limits: Limits {
            // One buffer is CubeCL's own, for lengths and scalars.
            max_storage_buffers_per_shader_stage: MOST_BUFFERS + 1,
            ..setup.device.limits()
        },
        memory_hints: MemoryHints::MemoryUsage,
        ..DeviceDescriptor::default()
    });
    (setup.device, setup.queue) = block_on(request).expect("a device within its adapter's limits");
    try_init_device(setup, RuntimeOptions::default()).expect("a setup of our own")
}
