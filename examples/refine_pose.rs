//! Finds back a camera that was moved, by gradient descent through the renderer: the gradients of
//! poses are those of any other input. To run it: `cargo run --release --example refine_pose`

use burn_splat::model::{InitSettings, splats_from_points};
use burn_splat::prelude::*;
use glam::{DMat4, DQuat, DVec3};

/// The capture's points as Gaussians.
fn scene(capture: &Capture, device: &Device) -> Result<Gaussians, Box<dyn std::error::Error>> {
    let points = capture.points.iter();
    let (positions, colors): (Vec<_>, Vec<_>) = points
        .map(|point| (point.position.map(|x| x as f32), point.color))
        .unzip();
    let scale = SceneScale::new(1.0).ok_or("a positive size")?;
    let settings = InitSettings::new().with_opacity(0.8).with_sh_degree(0);
    let splats = splats_from_points(&positions, &colors, scale, &settings)?;
    Ok(Gaussians::from_data(&splats, device))
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let settings = CaptureSettings::new().with_downscale(4);
    let capture = Capture::load("examples/data/saharov", &settings)?;
    let device = Device::flex().autodiff();
    let gaussians = scene(&capture, &device)?.no_grad();
    let truth = capture.views[0].camera();
    let rendering = RenderSettings::new();
    let target = CameraTensors::from_camera(&truth, &device);
    let target = render(&gaussians, &target, &rendering)?.image();

    let turn = DQuat::from_rotation_y(0.03);
    let moved = DMat4::from_rotation_translation(turn, DVec3::new(0.02, -0.01, 0.0));
    let mut camera = Camera {
        viewmat: moved * truth.viewmat,
        ..truth
    };
    let off = |camera: &Camera| (camera.position() - truth.position()).length();
    let before = off(&camera);
    let size = before;
    for step in 0..200 {
        let mut tensors = CameraTensors::from_camera(&camera, &device);
        tensors.viewmats = tensors.viewmats.require_grad();
        let image = render(&gaussians, &tensors, &rendering)?.image();
        let loss = (image - target.clone()).square().mean();
        let gradient = tensors.viewmats.grad(&loss.backward());
        let gradient = gradient.ok_or("the picture depends on the pose")?;
        let gradient: Vec<f32> = gradient.into_data().try_into_vec()?;
        camera.viewmat = descended(camera.viewmat, &gradient, size, step);
        if step % 40 == 0 {
            let loss = loss.into_scalar::<f32>();
            println!(
                "step {step:3}: loss {loss:.2e}, {:.4} units off",
                off(&camera)
            );
        }
    }
    println!("{before:.4} units off before, {:.4} after", off(&camera));
    if off(&camera) < 0.5 * before {
        return Ok(());
    }
    Err("the camera was not found back".into())
}

/// A step of constant length along the gradient of the pose: a turn and a shift in the camera's
/// frame.
fn descended(viewmat: DMat4, gradient: &[f32], size: f64, step: usize) -> DMat4 {
    let entry = |row: usize, column: usize| f64::from(gradient[row * 4 + column]);
    // dL/d(turn) of exp([turn]) V: the antisymmetric part of G V^T.
    let product = |row: usize, column: usize| -> f64 {
        (0..4).map(|k| entry(row, k) * viewmat.row(column)[k]).sum()
    };
    let turn = DVec3::new(
        product(2, 1) - product(1, 2),
        product(0, 2) - product(2, 0),
        product(1, 0) - product(0, 1),
    );
    let shift = DVec3::new(entry(0, 3), entry(1, 3), entry(2, 3));
    let rate = 0.05 * size * 0.98f64.powi(step as i32);
    let turn = DQuat::from_scaled_axis(-turn.normalize_or_zero() * rate * 0.2);
    let shift = -shift.normalize_or_zero() * rate;
    DMat4::from_rotation_translation(turn, shift) * viewmat
}
