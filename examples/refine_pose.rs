//! Finds back a camera that was moved, by gradient descent through the renderer: the gradients of
//! poses are those of any other input. To run it: `cargo run --release --example refine_pose`

use burn_splat::model::{InitSettings, splats_from_points};
use burn_splat::prelude::*;
use glam::{DMat4, DQuat, DVec2, DVec3};

/// The capture's points as small Gaussians.
fn scene(capture: &Capture, device: &Device) -> Result<Gaussians, Box<dyn std::error::Error>> {
    let points = capture.points.iter();
    let (positions, colors): (Vec<_>, Vec<_>) = points
        .map(|point| (point.position.map(|x| x as f32), point.color))
        .unzip();
    let scale = SceneScale::new(1.0).ok_or("a positive size")?;
    let settings = InitSettings::new()
        .with_opacity(0.8)
        .with_scale(0.2)
        .with_sh_degree(0);
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
    // How far points lie from their places in the picture, in pixels.
    let off = |camera: &Camera| {
        let points = capture
            .points
            .iter()
            .map(|point| DVec3::from(point.position));
        let distances: Vec<f64> = points
            .map(|point| (pixel(camera, point) - pixel(&truth, point)).length())
            .collect();
        distances.iter().sum::<f64>() / distances.len() as f64
    };
    let before = off(&camera);
    let mut adam = PoseAdam::default();
    for step in 0..STEPS {
        let mut tensors = CameraTensors::from_camera(&camera, &device);
        tensors.viewmats = tensors.viewmats.require_grad();
        let image = render(&gaussians, &tensors, &rendering)?.image();
        let loss = (image - target.clone()).square().mean();
        let gradient = tensors.viewmats.grad(&loss.backward());
        let gradient = gradient.ok_or("the picture depends on the pose")?;
        let gradient: Vec<f32> = gradient.into_data().try_into_vec()?;
        camera.viewmat = adam.step(camera.viewmat, &gradient, step);
        if step % 50 == 0 {
            let loss = loss.into_scalar::<f32>();
            println!(
                "step {step:3}: loss {loss:.2e}, {:.3} pixels off",
                off(&camera)
            );
        }
    }
    println!("{before:.3} pixels off before, {:.3} after", off(&camera));
    if off(&camera) < 0.1 * before {
        return Ok(());
    }
    Err("the camera was not found back".into())
}

const STEPS: usize = 300;

/// Where a camera sees a point.
fn pixel(camera: &Camera, point: DVec3) -> DVec2 {
    let seen = camera.viewmat.transform_point3(point);
    let [fx, fy, cx, cy] = camera.intrinsics;
    DVec2::new(fx * seen.x / seen.z + cx, fy * seen.y / seen.z + cy)
}

/// Adam on the six numbers of a small motion of the camera: a turn and a shift in its own frame.
#[derive(Default)]
struct PoseAdam {
    first: [f64; 6],
    second: [f64; 6],
}

impl PoseAdam {
    fn step(&mut self, viewmat: DMat4, gradient: &[f32], step: usize) -> DMat4 {
        let entry = |row: usize, column: usize| f64::from(gradient[row * 4 + column]);
        // dL/d(motion) of `motion * viewmat`, whose first rows are those of G V^T.
        let product = |row: usize, column: usize| -> f64 {
            let terms = (0..4).map(|k| entry(row, k) * viewmat.row(column)[k]);
            terms.sum()
        };
        let motion = [
            product(2, 1) - product(1, 2),
            product(0, 2) - product(2, 0),
            product(1, 0) - product(0, 1),
            product(0, 3),
            product(1, 3),
            product(2, 3),
        ];
        let time = step as i32 + 1;
        let rate = 2e-3 * 0.01f64.powf(step as f64 / STEPS as f64);
        let moved: Vec<f64> = (0..6)
            .map(|k| {
                self.first[k] = 0.9 * self.first[k] + 0.1 * motion[k];
                self.second[k] = 0.99 * self.second[k] + 0.01 * motion[k].powi(2);
                let mean = self.first[k] / (1.0 - 0.9f64.powi(time));
                let size = (self.second[k] / (1.0 - 0.99f64.powi(time))).sqrt();
                -rate * mean / (size + 1e-12)
            })
            .collect();
        let turn = DQuat::from_scaled_axis(DVec3::new(moved[0], moved[1], moved[2]));
        let shift = DVec3::new(moved[3], moved[4], moved[5]);
        DMat4::from_rotation_translation(turn, shift) * viewmat
    }
}
