//! The adapter that tests run on.

use cubecl::client::Client;
use cubecl::device::WgpuDeviceKind::{Cpu, DefaultDevice};

/// A client of the default wgpu adapter, software ones included; `None`, loudly, where there is none.
pub fn find() -> Option<Client> {
    let device = [DefaultDevice, Cpu]
        .into_iter()
        .find_map(|kind| cubecl::Device::wgpu(kind).ok());
    if device.is_none() {
        eprintln!("\n*** SKIPPED: no wgpu adapter here, the kernels were NOT tested ***\n");
    }
    Some(device?.client())
}
