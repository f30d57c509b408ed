//! Poses of the training views, refined with the scene.

use burn::module::{Module, Param};
use burn::tensor::{Device, Gradients, Tensor, TensorData};
use burn_pack::Scalar;
use splat_model::optimizer::{SplatAdam, StateRecord};
use splat_model::strategy::StepInfo;
use splat_model::{Camera, CameraTensors, FieldStep, Optimized, SceneScale};
use splat_ops::OpError;

use super::motion::{MOTION, motion_between, moved, moved_f64};
use super::{BundleAdjustment, CalibrationSchedule, CalibrationSettings};
use crate::{Hook, HookView};

/// Name of the rate in a checkpoint.
const RATE: &str = "pose_rate";

#[derive(Module, Debug)]
struct Motions {
    /// `[views, 6]`: a rotation vector, and a translation in sizes of the scene.
    motions: Param<Tensor<2>>,
}

/// Refines the pose of every training view by gradients of the loss, as gsplat's pose optimisation
/// does: a rigid motion per view in the camera's own axes, zero at first, stepped by Adam with a
/// rate that falls exponentially.
///
/// Held-out views are left as they are, since nothing was learned about them; see
/// [`align_pose`](super::align_pose).
pub struct RefinePoses {
    motions: Optimized<Motions>,
    rate: f64,
    schedule: CalibrationSchedule,
    scene: SceneScale,
}

impl RefinePoses {
    /// Poses of this many training views, on a device.
    ///
    /// # Errors
    /// When the device fails.
    pub fn new(
        views: usize,
        scene: SceneScale,
        settings: &CalibrationSettings,
        schedule: CalibrationSchedule,
        device: &Device,
    ) -> Result<Self, OpError> {
        let device = device.clone().without_autodiff().autodiff();
        let motions = Motions {
            motions: Param::from_tensor(Tensor::zeros([views, MOTION], &device)),
        };
        let rate = settings.pose_rate;
        Ok(Self {
            motions: Optimized::of_module(motions, rate, |_| SplatAdam::new().into())?,
            rate,
            schedule,
            scene,
        })
    }

    /// These poses, which begin as the adjusted ones, and go on at their rate if all were adjusted
    /// and the lens stays as it is.
    ///
    /// # Errors
    /// When the device fails.
    pub fn adjusted(
        mut self,
        cameras: &[Camera],
        adjusted: &BundleAdjustment,
        settings: &CalibrationSettings,
    ) -> Result<Self, OpError> {
        let length = self.scene.length();
        let motions: Vec<f32> = (cameras.iter().zip(&adjusted.viewmats))
            .flat_map(|(camera, after)| motion_between(camera.viewmat, *after, length))
            .map(|x| x as f32)
            .collect();
        let data = TensorData::new(motions, [cameras.len(), MOTION]);
        (self.motions).update("motions", |old| Tensor::from_data(data, &old.device()))?;
        // Views that were not adjusted have their way still to go, and so have all with a new lens.
        if adjusted.views == cameras.len() && !settings.intrinsics {
            self.rate = settings.adjusted_pose_rate;
        }
        Ok(self)
    }

    /// Cameras of training views, in their order, after what was refined so far.
    ///
    /// # Errors
    /// When the device fails.
    pub fn refined(&self, cameras: &[Camera]) -> Result<Vec<Camera>, OpError> {
        let [motions] = self.motions.read_f64(["motions"])?;
        let motions = motions.as_chunks::<MOTION>().0;
        let moved = |(camera, motion): (&Camera, &[f64; MOTION])| Camera {
            viewmat: moved_f64(camera.viewmat, *motion, self.scene.length()),
            ..*camera
        };
        Ok(cameras.iter().zip(motions).map(moved).collect())
    }
}

impl Hook for RefinePoses {
    fn name(&self) -> &str {
        "poses"
    }

    fn cameras(
        &self,
        view: &HookView,
        mut cameras: CameraTensors,
    ) -> Result<CameraTensors, OpError> {
        let Some(index) = view.training_index else {
            return Ok(cameras);
        };
        let motion = self.motions.model().motions.val().narrow(0, index, 1);
        cameras.viewmats = moved(cameras.viewmats, motion, self.scene.length());
        Ok(cameras)
    }

    fn step(&mut self, gradients: &mut Gradients, at: &StepInfo) -> Result<(), OpError> {
        let Some(factor) = self.schedule.factor(at.step) else {
            return Ok(());
        };
        let gradients = self.motions.gradients(gradients);
        self.motions
            .step(gradients, |_| (self.rate * factor, FieldStep::Step(1.0)))
    }

    fn save(&self) -> Result<StateRecord, OpError> {
        let mut record = self.motions.save()?;
        let rate = Scalar::Float(self.rate);
        record.scalars.insert(RATE.to_owned(), rate);
        Ok(record)
    }

    fn restore(&mut self, mut record: StateRecord, device: &Device) -> Result<(), String> {
        match record.scalars.remove(RATE) {
            Some(Scalar::Float(rate)) if (0.0..=1.0).contains(&rate) => self.rate = rate,
            // From before there were adjusted poses.
            None => {}
            Some(other) => return Err(format!("`{RATE}` is {other:?}, which is no rate")),
        }
        self.motions.restore(record, device)
    }
}
