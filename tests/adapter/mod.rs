//! The device of the tests that check the CubeCL kernels.

use std::sync::OnceLock;

use burn::tensor::Device;

/// wgpu's adapter, a software one included. Set `SPLAT_REQUIRE_WGPU=1` to make a missing one a failure instead of a skip.
pub fn adapter() -> Option<Device> {
    // A process can open it once.
    static ADAPTER: OnceLock<Option<Device>> = OnceLock::new();
    ADAPTER.get_or_init(open).clone()
}

fn open() -> Option<Device> {
    match Device::wgpu_options().init() {
        Ok(device) => Some(device),
        Err(error) => {
            let message = format!("no wgpu adapter, the CubeCL kernels are NOT checked: {error}");
            assert!(
                std::env::var_os("SPLAT_REQUIRE_WGPU").is_none(),
                "SPLAT_REQUIRE_WGPU is set, but {message}"
            );
            eprintln!("\n*** SKIPPED: {message} ***\n");
            None
        }
    }
}
