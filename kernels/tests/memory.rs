//! Memory by the allocator's own count, and its bandwidth. A process of its own, as the count is
//! process-wide.

#[path = "kernels/adapter.rs"]
mod adapter;
#[path = "kernels/alone.rs"]
mod alone;

use alone::alone;
use cubecl::MemoryScope;
use splat_kernels::intersect::Frames;
use splat_kernels::rasterize::{
    Kept, RasterizeInputs, RasterizeSettings, Sums, rasterize, rasterize_vjp,
};
use splat_kernels::{Buffer, copy, work};

#[test]
fn a_picture_keeps_the_bytes_that_are_stated() {
    let Some((_guard, client)) = alone() else {
        return;
    };
    let in_use = || {
        let report = client.memory_report(MemoryScope::Device);
        report.usage().bytes_in_use
    };
    for (splats, spread, width) in [(300, 0.5, 160), (20_000, 1.0, 160), (20_000, 0.5, 1600)] {
        let frames = Frames {
            cameras: 1,
            gaussians: splats,
            width,
            height: 128,
            alpha_min: splat_core::ALPHA_MIN as f32,
        };
        let mut packed = Vec::new();
        for i in 0..splats {
            let (x, y) = ((i * 37 % 160) as f32, (i * 53 % 128) as f32);
            packed.extend([x, y, i as f32, spread, 0.0, spread, 1.0, 40.0, 40.0]);
        }
        let inputs = RasterizeInputs {
            packed: Buffer::from_f32(&client, &packed),
            colors: Buffer::from_f32(&client, &vec![0.5; splats]),
            opacities: Buffer::from_f32(&client, &vec![0.3; splats]),
            background: None,
            channels: 1,
        };
        for sums in [Sums::Ordered, Sums::Atomic, Sums::Exchange] {
            let settings = RasterizeSettings {
                alpha_max: 0.99,
                transmittance_min: 9.999e-5,
                sums,
            };
            let before = in_use();
            let (image, state) = rasterize(&client, &inputs, &frames, &settings).unwrap();
            image.read_f32(&client).unwrap();
            let used = in_use() - before;
            let room = state.lists.splats.len() as u64;
            // The image has one channel and alpha.
            let stated = Kept::per_splat(sums) * splats as u64
                + Kept::per_intersection(sums) * room
                + Kept::PER_TILE * frames.tiles() as u64
                + (Kept::PER_PIXEL + 8) * u64::from(width) * 128;
            println!(
                "{splats} splats, {room} intersections, {sums:?}: {used} bytes, stated {stated}"
            );
            assert!(room >= state.lists.intersections as u64 && room > 0);
            // Memory of the last launches is still held: a fixed number of bytes for any size.
            assert!((stated..stated + 4096).contains(&used));

            let before = work().reserved_bytes;
            let needs_grad = [true, true, true, false, false].into();
            rasterize_vjp(
                &client, &inputs, &state, &image, &frames, &settings, needs_grad,
            );
            let reserved = work().reserved_bytes - before;
            // Gradients of nine floats per packed splat, one colour and the opacity; and a
            // placeholder for a missing input.
            let stated = 44 * splats as u64
                + Kept::gradient_per_intersection(1, sums) * state.lists.intersections as u64;
            println!("gradient: {reserved} bytes, stated {stated}");
            assert!((stated..=stated + 12).contains(&reserved));
        }
    }
}

#[test]
fn a_copy_has_a_bandwidth() {
    let Some((_guard, client)) = alone() else {
        return;
    };
    let [small, large] = [1 << 22, 1 << 25].map(|len| copy::bandwidth(&client, len).unwrap());
    println!("{:.2} and {:.2} GB/s", small / 1e9, large / 1e9);
    // Slower than a disk or faster than any memory would mean that something else was timed.
    assert!((5e7..1e14).contains(&large), "{large}");
    // If only launches were timed, eight times the size would take the same time.
    assert!(large < 4.0 * small, "{small} {large}");
    assert!(copy::bandwidth(&client, 0).is_err());
}
