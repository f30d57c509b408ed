//! What is counted for the whole process, and what depends on calls before: alone in its process, one after the other.

use std::sync::{Mutex, MutexGuard, PoisonError};

use cubecl::client::Client;
use cubecl::device::WgpuDeviceKind::{Cpu, DefaultDevice};
use splat_kernels::intersect::Frames;
use splat_kernels::rasterize::{RasterizeInputs, RasterizeSettings, rasterize};
use splat_kernels::{Buffer, Work, scan, work};

static ALONE: Mutex<()> = Mutex::new(());

fn alone() -> Option<(MutexGuard<'static, ()>, Client)> {
    let guard = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let device = [DefaultDevice, Cpu]
        .into_iter()
        .find_map(|kind| cubecl::Device::wgpu(kind).ok());
    let Some(device) = device else {
        eprintln!("\n*** SKIPPED: no wgpu adapter on this machine ***\n");
        return None;
    };
    Some((guard, device.client()))
}

#[test]
fn launches_bytes_and_waits_are_counted() {
    let Some((_guard, client)) = alone() else {
        return;
    };
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

/// An image of round splats over `reach` tiles each way, and what it took.
fn render(client: &Client, splats: usize, spread: f32) -> (Vec<f32>, Work) {
    let frames = Frames {
        cameras: 1,
        gaussians: splats,
        width: 160,
        height: 128,
        alpha_min: 1.0 / 255.0,
    };
    let mut packed = Vec::new();
    for i in 0..splats {
        let (x, y) = ((i * 37 % 160) as f32, (i * 53 % 128) as f32);
        packed.extend([x, y, i as f32, spread, 0.0, spread, 1.0, 40.0, 40.0]);
    }
    let colors: Vec<f32> = (0..splats).map(|i| (i % 7) as f32 / 7.0).collect();
    let inputs = RasterizeInputs {
        packed: Buffer::from_f32(client, &packed),
        colors: Buffer::from_f32(client, &colors),
        opacities: Buffer::from_f32(client, &vec![0.3; splats]),
        background: None,
        channels: 1,
    };
    let settings = RasterizeSettings {
        alpha_max: 0.99,
        transmittance_min: 9.999e-5,
    };
    let before = work();
    let (image, state) = rasterize(client, &inputs, &frames, &settings).unwrap();
    let done = work().since(before);
    assert_eq!(done.instances, state.lists.instances as u64);
    (image.read_f32(client).unwrap(), done)
}

#[test]
fn more_instances_than_there_was_room_for_are_listed_again() {
    let Some((_guard, client)) = alone() else {
        return;
    };
    let (_, few) = render(&client, 200, 0.5);
    let (first, again) = render(&client, 200, 0.05);
    let (second, at_once) = render(&client, 200, 0.05);
    println!("{few:?}\n{again:?}\n{at_once:?}");
    assert!(again.instances > 3 * few.instances);
    assert!(again.launches > at_once.launches, "nothing was done again");
    // What was tried with too little room left no trace, and room to spare makes no difference.
    assert_eq!(first, second);
    let lit = first.chunks(2).filter(|pixel| pixel[1] > 0.1).count();
    assert!(lit > 10_000, "{lit} pixels are lit");
    // The host waits once a picture.
    assert_eq!([few.waits, again.waits, at_once.waits], [1; 3]);
}
