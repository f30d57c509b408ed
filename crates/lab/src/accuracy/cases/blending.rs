//! Cases of blending: transmittance, cap, cut, stop, and the order of splats.

use burn::tensor::{Device, Tensor, TensorData};
use splat_ops::{ProjectSettings, RasterizeSettings, project, rasterize};

use super::super::case::{Case, Check};
use super::super::measure::{
    AccuracyError, Outcome, against_double, clear, clear_but, gradients, single,
};
use super::super::sketch::{Sketch, about_z, neighbours};
use crate::gradcheck::{Scene, relative_l2};

pub(super) const CASES: [Case; 14] = [
    Case::scenes(
        1,
        "2,000 layers at alpha about 1/255",
        "transmittance drifts, tail gradient 2 % off",
        faint_layers,
    ),
    Case::scenes(
        2,
        "first splat at alpha 0.99, detail behind it",
        "replay cancels",
        opaque_first,
    ),
    Case::scenes(
        3,
        "alpha at the cap arriving at T just above the stop",
        "forward and backward stop at different splats",
        cap_above_stop,
    ),
    Case::scenes(
        5,
        "o exp(-sigma) exactly at the cap",
        "gradient on one side only",
        exactly_at_cap,
    ),
    Case::scenes(
        6,
        "alpha within 1 ulp of 1/255",
        "forward and backward decide differently",
        exactly_at_cut,
    ),
    Case::scenes(
        21,
        "one splat covering the whole image",
        "intersection blow-up, one hot tile",
        covering,
    ),
    Case::scenes(
        22,
        "mean bit-exactly on a pixel centre and on a tile edge",
        "dropped from a tile it touches",
        on_edges,
    ),
    Case::scenes(
        23,
        "image 1x1, 1x17, not a multiple of the tile",
        "out of bounds, unwritten pixels",
        odd_sizes,
    ),
    Case::own(
        24,
        "equal depths, duplicated Gaussians",
        "order changes from run to run",
        "the same bits in every run",
        equal_depths,
    ),
    Case::scenes(
        25,
        "depths 1 ulp apart at z = 1e4",
        "order flips between devices",
        depths_an_ulp_apart,
    ),
    Case {
        number: 30,
        name: "no Gaussians; all culled; empty tiles",
        naive: "zero-size dispatch, stale pixels",
        demand: "exactly the background",
        check: Check::Own(nothing_visible),
    },
    Case::own(
        33,
        "background, alpha, depth and feature losses",
        "final-transmittance gradient missing",
        "19 channels at once too",
        all_losses,
    ),
    Case::scenes(
        34,
        "a million mixed-sign contributions to one Gaussian",
        "order-dependent",
        million_contributions,
    ),
    Case::own(
        32,
        "more than 2^31 intersections (counts simulated)",
        "overflow",
        "a clean error",
        too_many_pairs,
    ),
];

fn faint_layers() -> Vec<Scene> {
    let mut sketch = Sketch::new("2,000 layers", 16, 16, 1);
    for i in 0..2_000 {
        let pixel = [sketch.uniform(6.0, 10.0), sketch.uniform(6.0, 10.0)];
        let opacity = sketch.uniform(1.05, 1.12) / 255.0;
        let quat = sketch.turn();
        sketch.splat(
            pixel,
            2.0 + 0.01 * f64::from(i),
            [120.0, 90.0, 110.0],
            quat,
            opacity,
        );
    }
    vec![sketch.scene()]
}

fn opaque_first() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("opaque first", 32, 32, seed).tilted();
        sketch.splat([16.0, 16.0], 1.5, [60.0; 3], about_z(0.3), 0.999);
        sketch.scatter(40, (0.2, 0.6));
        sketch.scene()
    })]
}

fn cap_above_stop() -> Vec<Scene> {
    // Two capped splats leave 1e-4, just above the stop; a third would cross it.
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("stop after two at the cap", 32, 32, seed);
        for depth in [1.0, 1.5, 2.0] {
            sketch.splat([16.0, 16.0], depth, [9.0; 3], about_z(0.0), 1.0);
        }
        sketch.scatter(30, (0.3, 0.95));
        sketch.scene()
    })]
}

/// Splats whose means project exactly onto pixel centres, with these opacities.
fn on_pixel_centres(name: &'static str, seed: u64, opacities: &[f64]) -> Scene {
    let mut sketch = Sketch::new(name, 32, 32, seed);
    let count = opacities.len();
    for (i, opacity) in opacities.iter().enumerate() {
        let pixel = [4.5 + 24.0 * i as f64 / count as f64, 16.5];
        // Integers plus a half, and depths that are powers of two: exact in every precision.
        let pixel = [pixel[0].floor() + 0.5, pixel[1]];
        let axes = [sketch.uniform(1.0, 2.5), sketch.uniform(1.0, 2.5), 1.0];
        let depth = (1.0 + (i % 3) as f64).exp2();
        sketch.splat(pixel, depth, axes, about_z(0.7), *opacity);
    }
    sketch.scene()
}

fn exactly_at_cap() -> Vec<Scene> {
    let cap = 0.99;
    let [below, above] = neighbours(cap);
    vec![clear_elsewhere(&[cap, below, above, 1.0], "at the cap")]
}

fn exactly_at_cut() -> Vec<Scene> {
    let cut = 1.0 / 255.0;
    let [below, above] = neighbours(cut);
    vec![clear_elsewhere(
        &[cut, below, above, 0.5, cut],
        "at the cut",
    )]
}

/// These opacities at pixel centres; only those pixels are near a threshold.
fn clear_elsewhere(opacities: &[f64], name: &'static str) -> Scene {
    clear_but(opacities.len(), 1e-5, |seed| {
        on_pixel_centres(name, seed, opacities)
    })
}

fn covering() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("covers the picture", 80, 48, seed).tilted();
        sketch.splat(
            [40.0, 24.0],
            1.0,
            [4_000.0, 900.0, 2_000.0],
            about_z(0.4),
            0.6,
        );
        sketch.scatter(20, (0.2, 0.9));
        sketch.scene()
    })]
}

fn on_edges() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("on centres and edges", 64, 64, seed);
        let places = [
            [16.0, 16.0],
            [32.0, 8.5],
            [8.5, 48.0],
            [24.5, 24.5],
            [48.0, 47.5],
            [0.0, 32.0],
            [64.0, 64.0],
        ];
        for (i, pixel) in places.into_iter().enumerate() {
            let axes = [sketch.uniform(0.3, 1.5), sketch.uniform(0.3, 1.5), 0.7];
            sketch.splat(pixel, ((i % 3) as f64).exp2(), axes, about_z(i as f64), 0.8);
        }
        sketch.scene()
    })]
}

fn odd_sizes() -> Vec<Scene> {
    [
        ("1x1", 1, 1),
        ("1x17", 1, 17),
        ("33x1", 33, 1),
        ("37x23", 37, 23),
    ]
    .into_iter()
    .map(|(name, width, height)| {
        clear(1e-5, |seed| {
            let mut sketch = Sketch::new(name, width, height, seed).tilted();
            sketch.scatter(12, (0.2, 0.8));
            sketch.scene()
        })
    })
    .collect()
}

fn duplicates() -> Scene {
    clear(1e-5, |seed| {
        let mut sketch = Sketch::new("duplicates", 32, 32, seed);
        for _ in 0..8 {
            let pixel = [sketch.uniform(8.0, 24.0), sketch.uniform(8.0, 24.0)];
            let quat = sketch.turn();
            sketch.splat(pixel, 2.0, [5.0, 3.0, 4.0], quat, 0.5);
        }
        // The same positions and shapes again, in other colours.
        let copies: Vec<_> = sketch.blobs.iter().rev().cloned().collect();
        for mut copy in copies {
            copy.sh = sketch.colors();
            sketch.blobs.push(copy);
        }
        sketch.scene()
    })
}

fn equal_depths(device: &Device) -> Result<Outcome, AccuracyError> {
    let scene = duplicates();
    let first = single(&scene, device)?;
    let mut same = true;
    for _ in 0..5 {
        let again = single(&scene, device)?;
        same &= first.outputs == again.outputs && gradients(&first) == gradients(&again);
    }
    let outcome = against_double(&scene, device, &[])?;
    Ok(outcome
        .note("6 runs, same bits")
        .demand(same, "the same bits in every run"))
}

fn depths_an_ulp_apart() -> Vec<Scene> {
    vec![clear(1e-5, |seed| {
        let mut sketch = Sketch::new("depths an ulp apart", 32, 32, seed);
        let ulp = f64::from(1e4f32.next_up()) - 1e4;
        // Farthest first, so that the list is in reverse order.
        for i in (0..12).rev() {
            let pixel = [sketch.uniform(10.0, 22.0), sketch.uniform(10.0, 22.0)];
            sketch
                .splat(pixel, 1e4, [6.0, 4.0, 5.0], about_z(f64::from(i)), 0.6)
                .mean
                .z = 1e4 + f64::from(i) * ulp;
        }
        sketch.scene()
    })]
}

fn nothing_visible(device: &Device) -> Result<Outcome, AccuracyError> {
    let none = Sketch::new("no Gaussians", 20, 18, 1);
    let mut culled = Sketch::new("all culled", 20, 18, 2);
    for (pixel, depth) in [
        ([10.0, 10.0], -2.0),
        ([10.0, 10.0], 0.005),
        ([900.0, 5.0], 2.0),
    ] {
        culled.splat(pixel, depth, [2.0; 3], about_z(0.1), 0.9);
    }
    let mut outcome = Outcome::new();
    for sketch in [none, culled] {
        let scene = sketch.scene();
        let computed = single(&scene, device)?;
        let background = &scene.inputs.background.values;
        let exact = computed
            .outputs
            .image
            .values
            .chunks(3)
            .all(|pixel| pixel == background)
            && computed.outputs.alpha.values.iter().all(|a| *a == 0.0);
        outcome = outcome.and(against_double(&scene, device, &[])?).demand(
            exact,
            format!("{}: exactly the background", scene.source.display()),
        );
    }
    // One splat in a corner of six tiles; the others are empty.
    let mut corner = Sketch::new("empty tiles", 48, 32, 3);
    corner.splat([5.0, 5.0], 2.0, [1.5, 1.0, 1.2], about_z(0.2), 0.8);
    Ok(outcome.and(against_double(&corner.scene(), device, &[])?))
}

fn all_losses(device: &Device) -> Result<Outcome, AccuracyError> {
    let scene = clear(1e-5, |seed| {
        let mut sketch = Sketch::new("depth and alpha losses", 32, 24, seed).tilted();
        sketch.depth_loss = true;
        sketch.scatter(24, (0.2, 0.8));
        sketch.scene()
    });
    let outcome = against_double(&scene, device, &[])?;
    let ours = features(&scene, device, burn::tensor::DType::F32)?;
    let reference = features(&scene, &Device::flex(), burn::tensor::DType::F64)?;
    let errors: Vec<f64> = ours
        .iter()
        .zip(&reference)
        .map(|(a, b)| relative_l2(a, b))
        .collect();
    let worst = errors.iter().copied().fold(0.0, f64::max);
    Ok(outcome
        .note(format!("19 channels: {worst:.1e}"))
        .demand(errors.iter().all(|e| *e <= 1e-3), "19 channels within 1e-3"))
}

/// Image of 19 feature channels, and the gradients of a quadratic loss with respect to features,
/// opacities and background.
fn features(
    scene: &Scene,
    device: &Device,
    dtype: burn::tensor::DType,
) -> Result<[Vec<f64>; 4], AccuracyError> {
    const CHANNELS: usize = 19;
    let n = scene.gaussians;
    let device = device.clone().autodiff();
    let tensor = |values: Vec<f64>, shape: [usize; 2]| {
        Tensor::<2>::from_data(TensorData::new(values, shape), (&device, dtype))
    };
    let i = &scene.inputs;
    let projected = project(
        tensor(i.means.values.clone(), [n, 3]),
        tensor(i.quats.values.clone(), [n, 4]),
        tensor(i.scales.values.clone(), [n, 3]),
        tensor(i.viewmat.values.clone(), [4, 4]).unsqueeze(),
        tensor(i.intrinsics.values.clone(), [1, 4]),
        scene.size,
        &ProjectSettings::default(),
    )?;
    let ramp = |count: usize| {
        (0..count)
            .map(|k| f64::from(((k as f32) * 0.7).sin()))
            .collect()
    };
    let colors = tensor(ramp(n * CHANNELS), [n, CHANNELS]).require_grad();
    let background = tensor(ramp(CHANNELS), [1, CHANNELS]).require_grad();
    let opacities = tensor(i.opacities.values.clone(), [1, n]).require_grad();
    let rendered = rasterize(
        &projected,
        colors.clone(),
        opacities.clone(),
        Some(background.clone()),
        &RasterizeSettings::default(),
    )?;
    let image = rendered.image();
    let grads = (image.clone().square().sum() + rendered.alpha().sum()).backward();
    let host = |tensor: Option<Tensor<2>>| -> Result<Vec<f64>, AccuracyError> {
        let missing = || AccuracyError::Read("a gradient is missing".into());
        tensor
            .ok_or_else(missing)?
            .try_into_vec_as::<f64>()
            .map_err(|error| AccuracyError::Read(error.to_string()))
    };
    Ok([
        image
            .try_into_vec_as::<f64>()
            .map_err(|error| AccuracyError::Read(error.to_string()))?,
        host(colors.grad(&grads))?,
        host(opacities.grad(&grads))?,
        host(background.grad(&grads))?,
    ])
}

fn million_contributions() -> Vec<Scene> {
    // The picture has a million pixels; upstream gradients have random signs.
    let mut sketch = Sketch::new("a million pixels", 1024, 1024, 5);
    sketch.splat(
        [500.0, 530.0],
        2.0,
        [900.0, 700.0, 800.0],
        about_z(0.5),
        0.7,
    );
    vec![sketch.scene()]
}

fn too_many_pairs(device: &Device) -> Result<Outcome, AccuracyError> {
    // Every splat covers all 65,536 tiles. The 4.3e9 pairs exceed 32 bits; on a CubeCL device,
    // whose backward pass keeps up to 22 values per pair, 2.6e8 are too many. (Mesa's software
    // device, which ends any loop after 65,535 iterations, finds slightly fewer.)
    let side = 4096;
    let n = match *device == Device::flex() {
        true => 65_600,
        false => 4_000,
    };
    let column = |value: f32, width: usize| Tensor::<2>::full([n, width], value, device);
    let intrinsics = Tensor::<2>::from_floats([[4096.0, 4096.0, 2048.0, 2048.0]], device);
    let projected = project(
        Tensor::cat(vec![column(0.0, 2), column(2.0, 1)], 1),
        Tensor::cat(vec![column(1.0, 1), column(0.0, 3)], 1),
        column(1e4, 3),
        Tensor::<2>::eye(4, device).unsqueeze(),
        intrinsics,
        splat_ops::ImageSize {
            width: side,
            height: side,
        },
        &ProjectSettings::default(),
    )?;
    let opacities = Tensor::<1>::full([n], 0.5, device);
    let settings = RasterizeSettings::default();
    let outcome = Outcome::new();
    Ok(
        match rasterize(&projected, column(0.5, 1), opacities, None, &settings) {
            Err(error @ splat_ops::OpError::TooManyIntersections { .. }) => {
                outcome.note(format!("refused: {error}"))
            }
            Err(error) => outcome.demand(false, format!("another error: {error}")),
            Ok(_) => outcome.demand(false, format!("{n} splats were not refused")),
        },
    )
}
