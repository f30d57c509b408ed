//! Poses of held-out views, aligned with a finished scene.

use burn::optim::Optimizer;
use burn::tensor::{Device, Tensor};
use serde::Serialize;
use splat_data::View;
use splat_model::losses::SsimSettings;
use splat_model::optimizer::SplatAdam;
use splat_model::{
    Camera, CameraTensors, RenderSettings, SceneScale, SplatModel, project_gaussians,
    render_projected_on,
};
use splat_ops::{OpError, photometric, photometric_masked};

use super::motion::{MOTION, moved, moved_f64};
use crate::Scores;
use crate::hooks::{HookView, Hooks, Purpose};
use crate::photo::{loaded, mask_of, pixels_u8};

/// Scores of held-out views whose poses were aligned with the scene, and those poses.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AlignedScores {
    /// With aligned poses.
    #[serde(flatten)]
    pub scores: Scores,
    /// The cameras, in the order of the views.
    #[serde(skip)]
    pub cameras: Vec<Camera>,
}

/// Rate of the first steps: radians, and sizes of the scene.
const RATE: f64 = 2e-3;

/// Aligns the pose of one view with a scene that stays as it is, by gradients of the training loss,
/// and returns the camera.
///
/// A scene that was trained with poses of its own has moved away from those of the capture, a
/// little and with all of its views. The score of a held-out view at its old pose measures that
/// move; at its aligned pose, the scene.
///
/// # Errors
/// When an op refuses its input, or the device fails.
pub fn align_pose<M: SplatModel>(
    model: &M,
    view: &View,
    settings: &RenderSettings,
    scene: SceneScale,
    device: &Device,
    steps: usize,
) -> Result<Camera, OpError> {
    let aligning = Aligning {
        settings,
        scene,
        device,
        steps,
        hooks: &Hooks::default(),
    };
    aligning.align(model, view)
}

/// What aligning takes besides the scene and the view.
pub(crate) struct Aligning<'a> {
    pub(crate) settings: &'a RenderSettings,
    pub(crate) scene: SceneScale,
    pub(crate) device: &'a Device,
    pub(crate) steps: usize,
    pub(crate) hooks: &'a Hooks,
}

impl Aligning<'_> {
    /// The camera of the view, with its pose aligned with the scene.
    pub(crate) fn align<M: SplatModel>(&self, model: &M, view: &View) -> Result<Camera, OpError> {
        let device = self.device.clone().without_autodiff().autodiff();
        // The scene is constant here, and its render a function of the pose.
        let model = model.clone().to_device(&device).no_grad();
        let length = self.scene.length();
        let hook_view = HookView {
            training_index: None,
            name: &view.name,
            purpose: Purpose::HeldOut,
        };
        let camera = view.camera();
        let cameras = CameraTensors::from_camera(&camera.relative_to(model.origin()), &device);
        // Of what is not aligned here, the graph would be used up by the first step.
        let cameras = self.hooks.cameras(&hook_view, cameras)?.detached();
        let view = &*loaded(view)?;
        let (photo, mask) = (pixels_u8(view, &device), mask_of(view, &device));
        let args = SsimSettings::default().args();
        let mut motion = Tensor::<2>::zeros([1, MOTION], &device);
        let (adam, mut state) = (SplatAdam::new(), None);
        for step in 0..self.steps {
            motion = motion.require_grad();
            let mut there = cameras.clone();
            there.viewmats = moved(there.viewmats, motion.clone(), length);
            let projected = project_gaussians(&model, &there, self.settings)?;
            let background = self.hooks.background(&hook_view, &there)?;
            let rendered =
                render_projected_on(&model, &projected, &there, background, self.settings)?;
            let rendered = self.hooks.image(&hook_view, rendered)?.packed();
            let measured = match mask.clone() {
                None => photometric(rendered, photo.clone(), &args)?,
                Some(mask) => photometric_masked(rendered, photo.clone(), mask, &args)?,
            };
            let loss = measured.l1() * 0.8 + measured.ssim().neg() * 0.2;
            let Some(gradient) = motion.grad(&loss.backward()) else {
                break;
            };
            let rate = RATE * 0.01f64.powf(step as f64 / self.steps as f64);
            let (stepped, after) = adam.step(rate, motion.inner(), gradient, state);
            (motion, state) = (Tensor::from_inner(stepped), after);
        }
        let values = motion.inner().try_into_vec_as::<f64>();
        let values = values.map_err(|error| OpError::Device {
            op: "align_pose",
            what: error.to_string(),
        })?;
        let motion = std::array::from_fn(|i| values.get(i).copied().unwrap_or(0.0));
        Ok(Camera {
            viewmat: moved_f64(camera.viewmat, motion, length),
            ..camera
        })
    }
}
