//! Cases beyond a single rendered image: opacity logits, poisoned Gaussians, SSIM, Adam.

use burn::optim::Optimizer;
use burn::tensor::{DType, Device, Tensor, TensorData};
use splat_data::SplatData;
use splat_model::losses::{SsimSettings, ssim};
use splat_model::optimizer::SplatAdam;
use splat_model::{CameraTensors, Gaussians, RenderSettings, render};

use super::super::case::Case;
use super::super::measure::{AccuracyError, Outcome, clear, double, single};
use super::super::sketch::Sketch;
use crate::gradcheck::{Array, Computed, Scene, relative_l2};

pub(super) const CASES: [Case; 4] = [
    Case::own(
        4,
        "opacity logit +-30, +-100",
        "overflow, dead gradient, NaN",
        "gradient of every logit to 1e-3",
        opacity_logits,
    ),
    Case::own(
        31,
        "one Gaussian with a NaN or Inf field",
        "poisons neighbours and the sort",
        "the same bits as behind the camera",
        poisoned,
    ),
    Case::own(
        35,
        "SSIM on flat and on identical patches",
        "negative variance",
        "finite, gradient to 1e-3",
        ssim_patches,
    ),
    Case::own(
        36,
        "zero gradient for 10,000 steps, then a spike",
        "Adam epsilon and bias correction",
        "1e-6 of double precision",
        adam_spike,
    ),
];

fn read<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f64>, AccuracyError> {
    tensor
        .try_into_vec_as::<f64>()
        .map_err(|error| AccuracyError::Read(error.to_string()))
}

fn opacity_logits(device: &Device) -> Result<Outcome, AccuracyError> {
    let logits = [-100.0, -30.0, -3.0, 0.0, 0.5, 3.0, 17.0, 30.0, 100.0f32];
    let wide = logits.map(f64::from);
    let make = |seed| {
        let mut sketch = Sketch::new("opacity logits", 48, 32, seed);
        sketch.sh_degree = 0;
        for (i, logit) in wide.into_iter().enumerate() {
            let pixel = [4.0 + 5.0 * i as f64, 16.0];
            let quat = sketch.turn();
            sketch.splat(
                pixel,
                2.0 + 0.5 * i as f64,
                [2.0, 3.0, 2.5],
                quat,
                1.0 / (1.0 + (-logit).exp()),
            );
        }
        let mut scene = sketch.scene();
        // Not rounded: at a logit of 30, 1 - o is far below an ulp of one.
        scene.inputs.opacities.values = wide.map(|x| 1.0 / (1.0 + (-x).exp())).to_vec();
        scene
    };
    let scene = clear(1e-5, make);
    let reference = double(&scene)?;
    let slopes = wide.map(|x| 1.0 / ((1.0 + (-x).exp()) * (1.0 + x.exp())));
    let expected: Vec<f64> = reference
        .gradients
        .opacities
        .values
        .iter()
        .zip(slopes)
        .map(|(g, s)| g * s)
        .collect();

    let (gaussians, rendered) = rendered_model(&scene, &logits, device)?;
    let image = read(rendered.image())?;
    let weigh = |picture: Tensor<4>, weights: &Array| {
        let data = TensorData::new(weights.values.clone(), picture.dims());
        let weights = Tensor::<4>::from_data(data, (&picture.device(), DType::F32));
        (picture * weights).sum()
    };
    let upstream = &scene.upstream;
    let loss = weigh(rendered.image(), &upstream.image) + weigh(rendered.alpha(), &upstream.alpha);
    let gradient = gaussians.opacity_logits.val().grad(&loss.backward());
    let gradient = read(gradient.ok_or_else(|| AccuracyError::Read("no gradient".into()))?)?;
    // Judged per logit, as the extreme ones would vanish in the norm of the others. Values below
    // the smallest normal float can only be approximately zero.
    let error = |i: usize| match expected[i].abs() < f64::from(f32::MIN_POSITIVE) {
        true => gradient[i].abs().min(1.0),
        false => relative_l2(&gradient[i..=i], &expected[i..=i]),
    };
    let worst = (0..logits.len()).map(error).fold(0.0, f64::max);
    let outcome = Outcome {
        forward: relative_l2(&image, &reference.outputs.image.values),
        gradient: worst,
        worst_group: "opacity_logits".into(),
        ..Outcome::new()
    };
    let holds = outcome.forward <= 1e-3 && outcome.gradient <= 1e-3;
    Ok(outcome.demand(
        holds,
        format!("gradients {gradient:?}, expected {expected:?}"),
    ))
}

/// Renders the scene as a model with these logits.
fn rendered_model(
    scene: &Scene,
    logits: &[f32],
    device: &Device,
) -> Result<(Gaussians, splat_ops::Rendered), AccuracyError> {
    let inputs = &scene.inputs;
    let rows = |array: &Array| array.values.iter().map(|v| *v as f32).collect::<Vec<f32>>();
    let triples = |values: Vec<f32>| values.as_chunks::<3>().0.to_vec();
    let data = SplatData {
        means: triples(rows(&inputs.means)),
        log_scales: triples(inputs.scales.values.iter().map(|s| s.ln() as f32).collect()),
        quats: rows(&inputs.quats).as_chunks::<4>().0.to_vec(),
        opacity_logits: logits.to_vec(),
        sh0: inputs
            .sh_coeffs
            .values
            .chunks(48)
            .map(|c| [c[0] as f32, c[1] as f32, c[2] as f32])
            .collect(),
        ..SplatData::default()
    };
    let device = device.clone().autodiff();
    let tensor =
        |array: &Array| Tensor::<1>::from_data(TensorData::from(rows(array).as_slice()), &device);
    let cameras = CameraTensors {
        viewmats: tensor(&inputs.viewmat).reshape([1, 4, 4]),
        intrinsics: tensor(&inputs.intrinsics).reshape([1, 4]),
        distortion: None,
        size: scene.size,
    };
    let background = &inputs.background.values;
    let settings = RenderSettings {
        background: Some([0, 1, 2].map(|i| background[i] as f32)),
        ..RenderSettings::default()
    };
    let gaussians = Gaussians::from_data(&data, &device);
    let rendered = render(&gaussians, &cameras, &settings)?;
    Ok((gaussians, rendered))
}

/// Everything except the rows of Gaussian `n`.
fn others(computed: &Computed, n: usize) -> Vec<f64> {
    let g = &computed.gradients;
    let mut values = computed.outputs.image.values.clone();
    values.extend(&computed.outputs.alpha.values);
    for array in [&g.means, &g.quats, &g.scales, &g.opacities, &g.sh_coeffs] {
        let width = array.values.len() / array.shape[0];
        values.extend(&array.values[..n * width]);
        values.extend(&array.values[(n + 1) * width..]);
    }
    for array in [&g.viewmat, &g.intrinsics, &g.background] {
        values.extend(&array.values);
    }
    values
}

fn poisoned(device: &Device) -> Result<Outcome, AccuracyError> {
    const VICTIM: usize = 5;
    let make = |seed| {
        let mut sketch = Sketch::new("poisoned", 32, 32, seed).tilted();
        sketch.scatter(12, (0.3, 0.8));
        sketch.scene()
    };
    let clean = clear(1e-5, make);
    let mut behind = clean.clone();
    let away = &mut behind.inputs.means.values[3 * VICTIM..3 * VICTIM + 3];
    away.copy_from_slice(&[0.0, 0.0, -50.0]);
    let expected = others(&single(&behind, device)?, VICTIM);

    let mut outcome = Outcome::new();
    let mut tried = 0;
    for poison in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for (field, width) in [
            ("means", 3),
            ("quats", 4),
            ("scales", 3),
            ("opacities", 1),
            ("sh_coeffs", 48),
        ] {
            let mut scene = clean.clone();
            let inputs = &mut scene.inputs;
            let array = match field {
                "means" => &mut inputs.means,
                "quats" => &mut inputs.quats,
                "scales" => &mut inputs.scales,
                "opacities" => &mut inputs.opacities,
                _ => &mut inputs.sh_coeffs,
            };
            array.values[width * VICTIM + width.min(3) / 2] = poison;
            let found = others(&single(&scene, device)?, VICTIM);
            // A colour of minus infinity is clamped to black, which is visible.
            let holds = match (field, poison == f64::NEG_INFINITY) {
                ("sh_coeffs", true) => found.iter().all(|value| value.is_finite()),
                _ => found == expected,
            };
            outcome = outcome.demand(holds, format!("{field} = {poison}"));
            tried += 1;
        }
    }
    Ok(outcome.note(format!("{tried} kinds of poison")))
}

fn ssim_patches(device: &Device) -> Result<Outcome, AccuracyError> {
    const SHAPE: [usize; 4] = [1, 24, 32, 3];
    let count = SHAPE.iter().product::<usize>();
    let flat = vec![0.7f32; count];
    let noise: Vec<f32> = (0..count)
        .map(|i| 0.5 + 0.4 * (i as f32 * 12.9898).sin())
        .collect();
    let bright: Vec<f32> = noise.iter().map(|v| 1.0 - 1e-3 * v).collect();
    let measure =
        |pair: [&[f32]; 2], device: &Device, dtype| -> Result<[Vec<f64>; 2], AccuracyError> {
            let device = device.clone().autodiff();
            let [image, target] = pair.map(|values| {
                Tensor::<4>::from_data(TensorData::new(values.to_vec(), SHAPE), (&device, dtype))
            });
            let image = image.require_grad();
            let loss = ssim(image.clone(), target, &SsimSettings::default())?;
            let gradient = image.grad(&loss.backward());
            let gradient = gradient.ok_or_else(|| AccuracyError::Read("no gradient".into()))?;
            Ok([read(loss)?, read(gradient)?])
        };
    let mut outcome = Outcome {
        worst_group: "image".into(),
        ..Outcome::new()
    };
    for (name, image, target) in [
        ("flat on flat", &flat, &flat),
        ("noise on itself", &noise, &noise),
        ("flat on noise", &flat, &noise),
        ("noise on flat", &noise, &flat),
        ("nearly white on itself", &bright, &flat),
    ] {
        let [loss, gradient] = measure([image, target], device, DType::F32)?;
        let [exact_loss, exact] = measure([image, target], &Device::flex(), DType::F64)?;
        outcome.forward = outcome.forward.max(relative_l2(&loss, &exact_loss));
        // At its maximum SSIM has no gradient; the remainder is compared with the gradient of a
        // visible difference.
        let largest = exact.iter().fold(0.0f64, |m, g| m.max(g.abs()));
        if largest > 1e-12 {
            outcome.gradient = outcome.gradient.max(relative_l2(&gradient, &exact));
        }
        let scale = largest.max(1.0 / count as f64);
        let off = gradient
            .iter()
            .zip(&exact)
            .map(|(a, b)| (a - b).abs() / scale)
            .fold(0.0, f64::max);
        let finite = loss.iter().chain(&gradient).all(|v| v.is_finite());
        outcome = outcome.demand(finite && off <= 1e-3, format!("{name}: {off:.1e} off"));
    }
    let holds = outcome.forward <= 1e-3;
    Ok(outcome.demand(holds, "value to 1e-3"))
}

fn adam_spike(device: &Device) -> Result<Outcome, AccuracyError> {
    const REST: usize = 10_000;
    const RATE: f64 = 1e-2;
    let spike = [1e-6, -1e-3, 1.0, 1e3f32];
    let adam = SplatAdam::new();
    let tensor = |values: [f32; 4]| Tensor::<1>::from_data(TensorData::from(values), device);
    let (mut value, mut state) = (tensor([0.0; 4]), None);
    for _ in 0..REST {
        (value, state) = adam.step(RATE, value, tensor([0.0; 4]), state);
    }
    for _ in 0..5 {
        (value, state) = adam.step(RATE, value, tensor(spike), state);
    }
    let ours = read(value)?;

    let exact = spike.map(|g| {
        let g = f64::from(g);
        let (mut x, mut m, mut v) = (0.0, 0.0, 0.0);
        for step in 1..=5 {
            let t = (REST + step) as i32;
            m = adam.beta_1 * m + (1.0 - adam.beta_1) * g;
            v = adam.beta_2 * v + (1.0 - adam.beta_2) * g * g;
            let (m_hat, v_hat) = (
                m / (1.0 - adam.beta_1.powi(t)),
                v / (1.0 - adam.beta_2.powi(t)),
            );
            x -= RATE * m_hat / (v_hat.sqrt() + adam.epsilon);
        }
        x
    });
    let outcome = Outcome {
        forward: relative_l2(&ours, &exact),
        ..Outcome::new()
    };
    let holds = outcome.forward <= 1e-6;
    Ok(outcome
        .note("gradients 1e-6 to 1e3")
        .demand(holds, format!("{ours:?} for {exact:?}")))
}
