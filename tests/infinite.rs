//! Infinity is a valid value: opacity logits of plus and minus infinity are opacities of 1 and 0,
//! and a log-scale of minus infinity is a flat Gaussian. They render as their limits, and training
//! leaves them and their neighbours intact.
#![cfg(feature = "cpu")]

#[cfg(feature = "wgpu")]
mod adapter;

use burn::tensor::{Device, Tensor};
use burn_splat::data::SplatData;
use burn_splat::model::{
    Camera, CameraTensors, FieldStep, Gaussians, LearningRates, Optimized, RenderSettings,
    SceneScale, render,
};
use burn_splat::ops::{AdamRows, ImageSize};

const SIZE: ImageSize = ImageSize {
    width: 37,
    height: 29,
};

fn devices() -> Vec<Device> {
    #[allow(unused_mut)]
    let mut devices = vec![Device::flex()];
    #[cfg(feature = "wgpu")]
    devices.extend(adapter::adapter());
    devices
}

/// An ordinary Gaussian, one of opacity 1, one of opacity 0, a disc and a point, side by side.
fn scene([one, zero, flat]: [f32; 3]) -> SplatData {
    let n = 5;
    SplatData {
        means: (0..n).map(|i| [i as f32 * 0.4 - 0.8, 0.1, 3.0]).collect(),
        log_scales: vec![
            [-2.0; 3],
            [-1.5, -2.0, -2.0],
            [-1.0; 3],
            [-1.5, flat, -2.0],
            [flat; 3],
        ],
        quats: vec![[0.9, 0.1, -0.2, 0.3]; n],
        opacity_logits: vec![0.3, one, zero, 1.0, 2.0],
        sh0: vec![[0.5, 0.2, -0.1]; n],
        sh_rest: Vec::new(),
        sh_degree: 0,
        ..SplatData::default()
    }
}

fn cameras(device: &Device) -> burn_splat::model::CameraTensors {
    let camera = Camera {
        viewmat: glam::DMat4::IDENTITY,
        intrinsics: [40.0, 40.0, 18.0, 14.0],
        lens: burn_splat::data::Lens::Pinhole,
        size: SIZE,
    };
    CameraTensors::from_camera(&camera, device)
}

fn image(scene: &SplatData, device: &Device) -> Vec<f32> {
    let gaussians = Gaussians::from_data(scene, device);
    let rendered = render(&gaussians, &cameras(device), &RenderSettings::default()).unwrap();
    rendered.image().into_data().try_into_vec().unwrap()
}

#[test]
fn infinities_render_as_their_limits() {
    for device in devices() {
        let infinite = scene([f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY]);
        let found = image(&infinite, &device);
        // A sigmoid of 90 is 1 in single precision; a scale of e^-60 is invisible.
        let limit = image(&scene([90.0, -90.0, -60.0]), &device);
        assert!(limit.iter().any(|value| *value > 0.5), "{device:?}");
        let error = found.iter().zip(&limit).map(|(a, b)| (a - b).abs());
        let error = error.fold(0.0, f32::max);
        assert!(error <= 1e-6, "{device:?}: {error:e}");
        // Each is visible or invisible as it should be.
        let mut without = infinite.clone();
        without.opacity_logits[1] = f32::NEG_INFINITY;
        assert_ne!(image(&without, &device), found, "{device:?}");
        without = infinite.clone();
        without.means[2] = [50.0, 0.0, 3.0];
        assert_eq!(image(&without, &device), found, "{device:?}");
    }
}

#[test]
fn infinities_train() {
    for device in devices() {
        let device = device.autodiff();
        let infinite = scene([f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY]);
        let gaussians = Gaussians::from_data(&infinite, &device);
        let (unit, rates) = (SceneScale::new(1.0).unwrap(), LearningRates::default());
        let model = Optimized::with_adam(gaussians, &rates, AdamRows::All, unit);
        let mut model = model.unwrap();
        let target = Tensor::<4>::ones([1, SIZE.height as usize, SIZE.width as usize, 3], &device);
        let losses: Vec<f32> = (0..20)
            .map(|step| {
                let cameras = cameras(&device);
                let rendered = render(model.model(), &cameras, &RenderSettings::default()).unwrap();
                let loss = (rendered.image() - target.clone()).abs().mean();
                let gradients = model.gradients(&mut loss.backward());
                let stepped = model.step(gradients, |field| {
                    (field.rate_at(step, 20, unit), FieldStep::Step(1.0))
                });
                stepped.unwrap();
                loss.into_scalar::<f32>()
            })
            .collect();
        assert!(losses[19] < losses[0], "{device:?}: {losses:?}");
        let after = model.into_model().to_data();
        assert_eq!(after.opacity_logits[1..3], infinite.opacity_logits[1..3]);
        assert_eq!(after.log_scales[4], infinite.log_scales[4]);
        assert_eq!(after.log_scales[3][1], f32::NEG_INFINITY);
        let rest = [
            after.means.as_flattened(),
            after.quats.as_flattened(),
            after.sh0.as_flattened(),
            &after.opacity_logits[3..],
        ];
        assert!(rest.iter().all(|field| field.iter().all(|x| x.is_finite())));
        assert_ne!(after.means, infinite.means, "{device:?}");
    }
}
