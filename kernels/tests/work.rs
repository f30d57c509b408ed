//! The counters. Alone in its process: they count for all threads.

use cubecl::device::WgpuDeviceKind::{Cpu, DefaultDevice};
use splat_kernels::{Buffer, Work, scan, work};

#[test]
fn launches_bytes_and_waits_are_counted() {
    let device = [DefaultDevice, Cpu]
        .into_iter()
        .find_map(|kind| cubecl::Device::wgpu(kind).ok());
    let Some(device) = device else {
        eprintln!("\n*** SKIPPED: no wgpu adapter on this machine ***\n");
        return;
    };
    let client = device.client();
    let input = Buffer::from_u32(&client, &[1; 5000]);
    let before = work();
    // Three blocks: their sums, the sums' own scan, the blocks' scans.
    let sums = scan::inclusive_sum(&client, &input);
    assert_eq!(sums.read_u32(&client).unwrap()[4999], 5000);
    let expected = Work {
        launches: 3,
        reserved_bytes: 4 * (5000 + 3 + 3 + 1),
        waits: 1,
        instances: 0,
    };
    assert_eq!(work().since(before), expected);
}
