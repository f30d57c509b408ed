//! Every element of outputs and of scratch memory is written before it is read: with reserved
//! memory full of NaN all ops give the same bits, and all images and gradients are finite.

use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::devices;
use crate::{
    AdamRows, AdamStep, ImageSize, ProjectSettings, RasterizeSettings, SsimArgs, adam_step, exp,
    gaussian_blur, photometric, project, rasterize, sh_colors, sigmoid, spherical_harmonics,
    ssim_map,
};

fn poison(on: bool) {
    crate::cpu::poison::poison(on);
    #[cfg(feature = "cube")]
    splat_kernels::poison(on);
}

struct Scene {
    cameras: usize,
    gaussians: usize,
    channels: usize,
    size: ImageSize,
    /// Opacities of the splats; large ones stop pixels before the end of their lists.
    scale: f32,
    /// Settings of the rasteriser's gradients.
    deterministic: bool,
}

impl Scene {
    /// Results and gradients of every op, as bits. Splats lie in the left part of the image, some
    /// behind the cameras, and some too faint to see.
    // Longer than a hundred lines, as it calls every op in turn.
    fn run(&self, device: &Device) -> Vec<(&'static str, Vec<u32>)> {
        let (c, n, d) = (self.cameras, self.gaussians, self.channels);
        let device = device.clone().autodiff();
        let mut rng = Pcg32::seed_from_u64(60);
        let mut uniform = |shape: &[usize], low: f32, high: f32| -> TensorData {
            let len = shape.iter().product();
            let values: Vec<f32> = (0..len).map(|_| rng.random_range(low..high)).collect();
            TensorData::new(values, shape.to_vec())
        };
        let leaf = |data: TensorData| Tensor::<2>::from_data(data, &device).require_grad();
        let leaf3 = |data: TensorData| Tensor::<3>::from_data(data, &device).require_grad();

        let means = leaf(uniform(&[n, 3], -1.0, 0.0));
        let quats = leaf(uniform(&[n, 4], -1.0, 1.0));
        let scales = leaf(uniform(&[n, 3], 0.1 * self.scale, self.scale));
        let opacities = leaf(uniform(&[c, n], 0.0, 0.9));
        let colors = leaf3(uniform(&[c, n, d], 0.0, 1.0));
        let background = leaf(uniform(&[c, d], 0.0, 1.0));
        let coeffs = leaf3(uniform(&[n, 16, 3], -0.3, 0.3));
        let dirs = leaf3(uniform(&[c, n, 3], -1.0, 1.0));
        // The cameras are 0.9 in front of the origin, so that a tenth of the splats is behind them.
        let mut viewmats = Vec::new();
        let mut intrinsics = Vec::new();
        for _ in 0..c {
            #[rustfmt::skip]
            viewmats.extend([1.0f32, 0.0, 0.0, 0.0,  0.0, 1.0, 0.0, 0.5,  0.0, 0.0, 1.0, 0.9,  0.0, 0.0, 0.0, 1.0]);
            let (w, h) = (self.size.width as f32, self.size.height as f32);
            intrinsics.extend([0.4 * w, 0.4 * w, 0.5 * w, 0.5 * h]);
        }
        let viewmats = leaf3(TensorData::new(viewmats, [c, 4, 4]));
        let intrinsics = leaf(TensorData::new(intrinsics, [c, 4]));

        let projected = project(
            means.clone(),
            quats.clone(),
            scales.clone(),
            viewmats.clone(),
            intrinsics.clone(),
            self.size,
            &ProjectSettings::default(),
        )
        .unwrap();
        let harmonics = spherical_harmonics(coeffs.clone(), dirs.clone(), 3).unwrap();
        let [sh0, sh_rest] = [(0, 1), (1, 15)].map(|(start, count)| {
            let part = coeffs.clone().inner().narrow(1, start, count);
            Tensor::from_inner(part).require_grad()
        });
        let centers = leaf(uniform(&[c, 3], -1.0, 1.0));
        let seen = sh_colors(
            sh0.clone(),
            Some(sh_rest.clone()),
            means.clone(),
            centers.clone(),
            3,
            Some(&projected),
        )
        .unwrap();
        let logits = leaf(uniform(&[c, n], -9.0, 9.0));
        let activated = [exp(logits.clone()), sigmoid(logits.clone())];
        let rendered = rasterize(
            &projected,
            colors.clone(),
            opacities.clone(),
            Some(background.clone()),
            &RasterizeSettings {
                deterministic: self.deterministic,
                ..RasterizeSettings::default()
            },
        )
        .unwrap();
        let blurred = gaussian_blur(rendered.packed(), &[0.25, 0.5, 0.25]).unwrap();
        let args = SsimArgs {
            window: vec![0.25, 0.5, 0.25],
            c1: 1e-4,
            c2: 9e-4,
        };
        let similarity = ssim_map(blurred.clone(), rendered.packed(), &args).unwrap();
        let target = blurred.clone().detach().narrow(3, 0, d);
        let measured = photometric(rendered.packed(), target, &args).unwrap();
        let averages = measured.losses();
        let mut loss = blurred.clone().square().sum() + similarity.clone().square().sum();
        loss = loss + averages.clone().square().sum();
        if n > 0 {
            // The rest has no gradient, so ops may skip those rows.
            let half = |colors: &Tensor<3>| colors.clone().narrow(1, 0, n.div_ceil(2));
            loss = loss + half(&harmonics).square().sum() + half(&seen).square().sum();
            for activated in &activated {
                loss = loss + activated.clone().square().sum();
            }
        }
        let grads = loss.backward();

        let bits = |data: TensorData| -> Vec<u32> {
            let values = data.try_to_vec::<f32>().unwrap();
            assert!(values.iter().all(|value| value.is_finite()));
            values.into_iter().map(f32::to_bits).collect()
        };
        let mut found = vec![
            ("projected", bits(projected.packed().into_data())),
            ("harmonics", bits(harmonics.into_data())),
            ("seen", bits(seen.into_data())),
            ("rendered", bits(rendered.packed().into_data())),
            ("blurred", bits(blurred.into_data())),
            ("similarity", bits(similarity.into_data())),
            ("averages", bits(averages.into_data())),
        ];
        for (name, leaf) in [
            ("means", &means),
            ("quats", &quats),
            ("scales", &scales),
            ("intrinsics", &intrinsics),
            ("opacities", &opacities),
            ("background", &background),
            ("centers", &centers),
            ("logits", &logits),
        ] {
            if let Some(grad) = leaf.grad(&grads) {
                found.push((name, bits(grad.into_data())));
            }
        }
        for (name, leaf) in [
            ("viewmats", &viewmats),
            ("colors", &colors),
            ("coeffs", &coeffs),
            ("dirs", &dirs),
            ("sh0", &sh0),
            ("sh_rest", &sh_rest),
        ] {
            if let Some(grad) = leaf.grad(&grads) {
                found.push((name, bits(grad.into_data())));
            }
        }
        let step = AdamStep {
            beta_1: 0.9,
            beta_2: 0.999,
            rate: 0.1,
            epsilon: 1e-8,
            rows: AdamRows::All,
        };
        let background = background.inner();
        let moments = [background.clone(), background.clone()];
        let (stepped, moments) = adam_step(background.clone(), background, moments, &step).unwrap();
        found.extend(activated.map(|activated| ("activated", bits(activated.into_data()))));
        found.push(("stepped", bits(stepped.into_data())));
        found.extend(moments.map(|moment| ("moment", bits(moment.into_data()))));
        found
    }
}

#[test]
fn reserved_memory_is_written_before_it_is_read() {
    for (name, device) in devices() {
        for (cameras, gaussians, channels, scale, [width, height]) in [
            (1, 60, 3, 0.03, [75, 50]),
            (2, 40, 1, 0.03, [33, 17]),
            (2, 300, 17, 0.03, [49, 31]),
            (2, 300, 3, 1.0, [49, 31]),
            (1, 7, 16, 0.03, [1, 19]),
            (2, 0, 3, 0.03, [20, 5]),
        ] {
            let scene = Scene {
                cameras,
                gaussians,
                channels,
                size: ImageSize { width, height },
                scale,
                deterministic: true,
            };
            poison(false);
            let clean = scene.run(&device);
            poison(true);
            let poisoned = scene.run(&device);
            // Not the same bits, but still no NaN.
            let as_they_come = Scene {
                deterministic: false,
                ..scene
            };
            as_they_come.run(&device);
            poison(false);
            let case = format!("{name}: C = {cameras}, N = {gaussians}, D = {channels}");
            // Without splats some gradients are empty; otherwise all are present.
            assert!(gaussians == 0 || clean.len() == 26, "{case}");
            for ((part, clean), (_, poisoned)) in clean.iter().zip(&poisoned) {
                assert!(clean == poisoned, "{case}: {part} differs");
            }
            let alpha = &clean[3].1;
            assert!(
                gaussians < 10 || scale > 0.1 || alpha.contains(&0),
                "{case}"
            );
        }
    }
}
