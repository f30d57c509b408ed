//! Tests of process-wide counters, and of effects of earlier calls; they run one after the other in
//! a process of their own.

#[path = "kernels/adapter.rs"]
mod adapter;
#[path = "kernels/alone.rs"]
mod alone;

use alone::alone;
use cubecl::client::Client;
use splat_core::{Activation, AdamRows, AdamStep};
use splat_kernels::activation::activate;
use splat_kernels::adam::adam;
use splat_kernels::intersect::Frames;
use splat_kernels::rasterize::{RasterizeInputs, RasterizeSettings, Sums, rasterize};
use splat_kernels::screen_statistics::screen_statistics;
use splat_kernels::{Buffer, Work, scan, work};

#[test]
fn launches_bytes_and_waits_are_counted() {
    let Some((_guard, client)) = alone() else {
        return;
    };
    let input = Buffer::from_u32(&client, &[1; 5000]);
    let before = work();
    // Three blocks: their sums, the scan of the sums, the scans of the blocks.
    let sums = scan::inclusive_sum(&client, &input);
    assert_eq!(sums.read_u32(&client).unwrap()[4999], 5000);
    let expected = Work {
        launches: 3,
        reserved_bytes: 4 * (5000 + 3 + 3 + 1),
        waits: 1,
        intersections: 0,
    };
    assert_eq!(work().since(before), expected);
}

/// Renders round splats over `reach` tiles each way; returns the image and the work done.
fn render(client: &Client, splats: usize, spread: f32) -> (Vec<f32>, Work) {
    let frames = Frames {
        cameras: 1,
        gaussians: splats,
        width: 160,
        height: 128,
        alpha_min: splat_core::ALPHA_MIN as f32,
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
        sums: Sums::Ordered,
    };
    let before = work();
    let (image, state) = rasterize(client, &inputs, &frames, &settings).unwrap();
    let done = work().since(before);
    assert_eq!(done.intersections, state.lists.intersections as u64);
    (image.read_f32(client).unwrap(), done)
}

#[test]
fn more_intersections_than_there_was_room_for_are_listed_again() {
    let Some((_guard, client)) = alone() else {
        return;
    };
    let (_, few) = render(&client, 200, 0.5);
    let (first, again) = render(&client, 200, 0.05);
    let (second, at_once) = render(&client, 200, 0.05);
    println!("{few:?}\n{again:?}\n{at_once:?}");
    assert!(again.intersections > 3 * few.intersections);
    assert!(again.launches > at_once.launches, "nothing was done again");
    // A failed attempt with too little room leaves no trace, and spare room makes no difference.
    assert_eq!(first, second);
    let lit = first.chunks(2).filter(|pixel| pixel[1] > 0.1).count();
    assert!(lit > 10_000, "{lit} pixels are lit");
    // The host waits once per image.
    assert_eq!([few.waits, again.waits, at_once.waits], [1; 3]);
}

#[test]
fn results_take_the_memory_of_what_nothing_else_holds() {
    let Some((_guard, client)) = alone() else {
        return;
    };
    let x = Buffer::from_f32(&client, &[0.0, 1.0, -2.0]);
    let e = [0.0f32, 1.0, -2.0].map(f32::exp);
    let before = work();
    let y = activate(&client, x.clone(), Activation::Exp);
    assert_eq!(work().since(before).reserved_bytes, 12, "x is held");
    assert_eq!(x.read_f32(&client).unwrap(), [0.0, 1.0, -2.0]);
    let z = activate(&client, x, Activation::Exp);
    assert_eq!(work().since(before).reserved_bytes, 12, "x was given away");
    for values in [y, z].map(|y| y.read_f32(&client).unwrap()) {
        let close = |(a, b): (&f32, &f32)| (a - b).abs() <= 1e-6 * b;
        assert!(values.iter().zip(&e).all(close), "{values:?}");
    }

    let row = |values: [f32; 9]| Buffer::from_f32(&client, &values);
    let step = row([3.0, 4.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0]);
    let packed = row([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0]);
    let sums = [
        Buffer::from_f32(&client, &[1.0]),
        Buffer::from_f32(&client, &[7.0]),
    ];
    let held = sums[0].clone();
    let before = work();
    let [lengths, views] = screen_statistics(&client, [&step, &packed], sums, [2.0, 2.0], None);
    assert_eq!(work().since(before).reserved_bytes, 4, "one sum is held");
    let read = |buffer: Buffer| buffer.read_f32(&client).unwrap();
    assert_eq!([held, lengths, views].map(read), [[1.0], [11.0], [8.0]]);
}

/// Training gives up ownership of parameters and moments, so a step of Adam allocates nothing.
#[test]
fn a_step_of_adam_takes_no_memory_but_for_what_something_else_holds() {
    let Some((_guard, client)) = alone() else {
        return;
    };
    let grad = Buffer::from_f32(&client, &[1.0; 6]);
    for rows in [AdamRows::All, AdamRows::Seen] {
        let step = AdamStep {
            beta_1: 0.5,
            beta_2: 0.5,
            rate: 1.0,
            epsilon: 0.0,
            rows,
        };
        let three = || [(); 3].map(|()| Buffer::from_f32(&client, &[0.0; 6]));
        let reserved = |[param, moment_1, moment_2]: [Buffer; 3]| {
            let before = work();
            let after = adam(&client, param, &grad, [moment_1, moment_2], &step, 3);
            let done = work().since(before);
            assert_eq!(done.launches, 1);
            let expected = [-f32::sqrt(0.5), 0.5, 0.5];
            for (after, expected) in after.iter().zip(expected) {
                for value in after.read_f32(&client).unwrap() {
                    assert!((value - expected).abs() < 1e-6, "{value} {expected}");
                }
            }
            done.reserved_bytes
        };
        assert_eq!(reserved(three()), 0, "{rows:?}: given away");
        let held = three();
        assert_eq!(reserved(held.clone()), 3 * 24, "{rows:?}: held");
        for held in held {
            assert_eq!(held.read_f32(&client).unwrap(), [0.0; 6]);
        }
    }
}
