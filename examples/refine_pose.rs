//! Finds a camera back that was turned and shifted, by comparing renders of a trained scene with
//! the photo: `project` and `rasterize` give the gradient of the pose like any other.
//!
//! The picture: what the moved and the found camera see, each alone and over the photo; the photo.
//! Run it: `cargo run --release --example refine_pose [STEPS [FOLDER [CAPTURE]]]`

mod common;

use burn::optim::Optimizer;
use burn_splat::prelude::*;

/// The rigid motion `exp(M)`, `[1, 4, 4]`, of a twist `[6]`: turns about three axes in radians,
/// then shifts along them in sizes of the scene.
fn motion(twist: Tensor<1>, scene: SceneScale) -> Tensor<3> {
    let mut generators = [[0.0; 16]; 6];
    for (axis, [i, j]) in [[1, 2], [2, 0], [0, 1]].into_iter().enumerate() {
        (generators[axis][4 * j + i], generators[axis][4 * i + j]) = (1.0, -1.0);
        generators[3 + axis][4 * axis + 3] = scene.length() as f32;
    }
    let generators = Tensor::from_floats(generators, &twist.device());
    let m = twist.unsqueeze::<2>().matmul(generators).reshape([1, 4, 4]);
    let identity = Tensor::<2>::eye(4, &m.device()).unsqueeze();
    // I + M (I + M/2 (I + M/3 (...))), the series of the exponential.
    let add = |sum, k| identity.clone() + m.clone().matmul(sum) / k;
    [4, 3, 2, 1].into_iter().fold(identity.clone(), add)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args = common::Arguments::read(1000, "examples/data/saharov")?;
    let capture = Capture::load(&args.input, &CaptureSettings::new().with_downscale(2))?;
    let trainer = Trainer::builder(capture.clone()).device(Device::flex());
    let settings = TrainSettings::new().with_steps(args.size);
    let trainer = trainer.settings(settings).build()?;
    let scale = trainer.scene_scale();
    let trained = trainer.run()?;

    // The scene is constant now, and its render a function of the pose.
    let (scene, settings) = (trained.model.train().no_grad(), trained.render_settings);
    let device = Device::flex().autodiff();
    let view = capture.test_views().next().ok_or("no view is held out")?;
    let camera = CameraTensors::from_camera(&view.camera().relative_to(scene.origin), &device);
    let look = |viewmats: Tensor<3>| -> Result<(Projected, Tensor<4>), OpError> {
        let mut camera = camera.clone();
        camera.viewmats = viewmats.clone();
        let (means, quats, scales) = (scene.means(), scene.quats(), scene.scales());
        let (intrinsics, size, how) = (camera.intrinsics.clone(), camera.size, &settings.project);
        let splats = project(means, quats, scales, viewmats, intrinsics, size, how)?;
        let (colors, opacities) = (scene.colors(camera.centers(), 3, None)?, scene.opacities());
        let rendered = rasterize(&splats, colors, opacities, None, &settings.rasterize)?;
        Ok((splats, rendered.image()))
    };

    let photo = burn_splat::train::photo(view, &device)?;
    let (there, _) = look(camera.viewmats.clone())?;
    let shake = Tensor::from_floats([0.02, -0.04, 0.03, 0.02, -0.01, 0.03], &device);
    let moved = motion(shake, scale).matmul(camera.viewmats.clone());
    let mut twist = Tensor::zeros([6], &device).require_grad();
    let (adam, mut state) = (SplatAdam::new(), None);
    for step in 0..args.size {
        let (_, image) = look(motion(twist.clone(), scale).matmul(moved.clone()))?;
        let gradients = losses::l1(image, photo.clone()).backward();
        let gradient = twist.grad(&gradients).ok_or("no splat is in view")?;
        let rate = 3e-3 * 0.01f64.powf(step as f64 / args.size as f64);
        let (stepped, after) = adam.step(rate, twist.inner(), gradient, state);
        (twist, state) = (Tensor::from_inner(stepped).require_grad(), after);
    }

    let mut images = Vec::new();
    for pose in [moved.clone(), motion(twist, scale).matmul(moved)] {
        let (splats, image) = look(pose)?;
        let seen = (splats.depths() * there.depths()).sign(); // Out of view depths are 0.
        let squares = (splats.means2d() - there.means2d()).square().sum_dim(2);
        let off = (squares.sqrt().squeeze_dim(2) * seen.clone()).sum() / seen.sum();
        println!("off by {:.2} pixels", off.into_scalar::<f32>());
        images.extend([image.clone(), (image + photo.clone()) / 2.0]);
    }
    images.push(photo);
    args.save("refine_pose", &images)
}
