//! Focal lengths, principal points and distortion, refined with the scene.

use std::collections::HashMap;

use burn::module::{Module, Param};
use burn::tensor::{Device, Gradients, Tensor, TensorData};
use splat_data::View;
use splat_model::optimizer::{SplatAdam, StateRecord};
use splat_model::strategy::StepInfo;
use splat_model::{Camera, CameraModel, CameraTensors, FieldStep, Lens, Optimized};
use splat_ops::{Distortion, OpError};

use super::{CalibrationSchedule, CalibrationSettings};
use crate::{Hook, HookView};

/// Coefficients of the model with the most.
const COEFFICIENTS: usize = 8;
/// A coefficient of a higher power moves so much slower than the one before: within the photo both
/// bend its corner alike, and what the lower one can explain is left to it.
const NEXT_POWER: f64 = 0.1;
/// Steps between two looks at the domains of the lenses: a lens moves fastest at first, and outside
/// of the domain that it began with nothing is drawn.
const REFRESH: usize = 20;
/// Name of the domains in a checkpoint, apart from those of parameters.
const DOMAINS: &str = "domains";

#[derive(Module, Debug)]
struct Corrections {
    /// Logarithms of factors of fx and fy `[cameras, 2]`.
    focal: Param<Tensor<2>>,
    /// Shifts of cx and cy `[cameras, 2]`, in sides of the photo.
    principal: Param<Tensor<2>>,
    /// Added to the coefficients `[cameras, 8]`, in units of [`Physical::unit`].
    distortion: Param<Tensor<2>>,
}

/// A camera that several views may share.
#[derive(Debug, Clone, PartialEq)]
struct Physical {
    /// As the capture has it.
    camera: Camera,
    /// The model that is trained: a pinhole becomes a perspective lens with distortion.
    model: CameraModel,
    /// Coefficients at the start, filled up with zeros.
    start: [f64; COEFFICIENTS],
    /// What a unit of each coefficient's correction is; 0 for those that are not trained.
    unit: [f64; COEFFICIENTS],
    /// Whether fx and fy have one factor, as those of (nearly) square pixels.
    square: bool,
}

impl Physical {
    fn of(camera: &Camera) -> Self {
        let lens = &camera.lens;
        let model = match lens.model() {
            CameraModel::Pinhole => CameraModel::OpenCv,
            model => model,
        };
        let mut start = [0.0; COEFFICIENTS];
        start[..lens.coefficients().len()].copy_from_slice(lens.coefficients());
        // The higher coefficients of a perspective lens can hardly be told apart by one capture;
        // those that it has are kept and trained.
        let trained = |k: usize| k < 4 || (k < model.coefficients() && start[k] != 0.0);
        // Powers of the square of the radius, or the angle, after the first.
        let power = |k: usize| match (model, k) {
            (CameraModel::OpenCvFisheye, k) => k,
            (_, 1 | 6) => 1,
            (_, 4 | 7) => 2,
            _ => 0,
        };
        let unit = std::array::from_fn(|k| match trained(k) {
            true => NEXT_POWER.powi(power(k) as i32),
            false => 0.0,
        });
        let [fx, fy, ..] = camera.intrinsics;
        Self {
            camera: *camera,
            model,
            start,
            unit,
            square: (fx / fy - 1.0).abs() < 0.01,
        }
    }

    /// True if both are one camera, in one place or another.
    fn is(&self, camera: &Camera) -> bool {
        let own = &self.camera;
        own.intrinsics == camera.intrinsics && own.size == camera.size && own.lens == camera.lens
    }

    /// The camera with these corrections.
    fn corrected(&self, camera: &Camera, c: &Correction) -> Camera {
        let [fx, fy, cx, cy] = camera.intrinsics;
        let (w, h) = (f64::from(camera.size.width), f64::from(camera.size.height));
        let [log_x, log_y] = if self.square {
            [c.focal[0]; 2]
        } else {
            c.focal
        };
        let k: Vec<f64> = (0..self.model.coefficients())
            .map(|k| self.start[k] + self.unit[k] * c.distortion[k])
            .collect();
        Camera {
            intrinsics: [
                fx * log_x.exp(),
                fy * log_y.exp(),
                cx + w * c.principal[0],
                cy + h * c.principal[1],
            ],
            lens: Lens::new(self.model, &k).unwrap_or(camera.lens),
            ..*camera
        }
    }
}

/// Corrections of one camera.
struct Correction {
    focal: [f64; 2],
    principal: [f64; 2],
    distortion: [f64; COEFFICIENTS],
}

/// Refines focal lengths, principal points and distortion by gradients of the loss, one set for all
/// views that begin with the same camera.
///
/// A pinhole gets the coefficients k1, k2, p1, p2 of [`CameraModel::OpenCv`], zero at first; lenses
/// with distortion keep their model. Held-out views have the refined cameras too. The domains of
/// the lenses follow their coefficients every 20 steps, and at the end of the run.
pub struct RefineIntrinsics {
    corrections: Optimized<Corrections>,
    cameras: Vec<Physical>,
    /// Index of the camera of each view, by the view's name.
    of_view: HashMap<String, usize>,
    /// Limit and clamp of each lens.
    domains: Vec<[f64; 2]>,
    settings: CalibrationSettings,
    schedule: CalibrationSchedule,
}

impl RefineIntrinsics {
    /// The cameras of these views, of a whole capture, on a device.
    ///
    /// # Errors
    /// When the device fails.
    pub fn new(
        views: &[View],
        settings: CalibrationSettings,
        schedule: CalibrationSchedule,
        device: &Device,
    ) -> Result<Self, OpError> {
        let mut cameras: Vec<Physical> = Vec::new();
        let mut of_view = HashMap::new();
        for view in views {
            let camera = view.camera();
            let known = cameras.iter().position(|known| known.is(&camera));
            let index = known.unwrap_or(cameras.len());
            if known.is_none() {
                cameras.push(Physical::of(&camera));
            }
            of_view.insert(view.name.clone(), index);
        }
        let device = device.clone().without_autodiff().autodiff();
        let zeros =
            |width: usize| Param::from_tensor(Tensor::<2>::zeros([cameras.len(), width], &device));
        let corrections = Corrections {
            focal: zeros(2),
            principal: zeros(2),
            distortion: zeros(COEFFICIENTS),
        };
        let rate = settings.focal_rate;
        let mut refined = Self {
            corrections: Optimized::of_module(corrections, rate, |_| SplatAdam::new().into())?,
            domains: vec![[0.0; 2]; cameras.len()],
            cameras,
            of_view,
            settings,
            schedule,
        };
        refined.refresh()?;
        Ok(refined)
    }

    /// The camera of a view after what was refined so far.
    ///
    /// # Errors
    /// When the device fails.
    pub fn refined(&self, name: &str, camera: &Camera) -> Result<Camera, OpError> {
        let Some(&index) = self.of_view.get(name) else {
            return Ok(*camera);
        };
        let corrections = self.read()?;
        Ok(self.cameras[index].corrected(camera, &corrections[index]))
    }

    fn read(&self) -> Result<Vec<Correction>, OpError> {
        let names = ["focal", "principal", "distortion"];
        let [focal, principal, distortion] = self.corrections.read_f64(names)?;
        let parts = focal.as_chunks::<2>().0.iter();
        let parts = parts.zip(principal.as_chunks::<2>().0);
        let parts = parts.zip(distortion.as_chunks::<COEFFICIENTS>().0);
        let correction = |((focal, principal), distortion): ((&_, &_), &_)| Correction {
            focal: *focal,
            principal: *principal,
            distortion: *distortion,
        };
        Ok(parts.map(correction).collect())
    }

    /// Domains of the lenses as they are now. Waits for the device.
    fn refresh(&mut self) -> Result<(), OpError> {
        let corrections = self.read()?;
        for ((physical, correction), domain) in
            self.cameras.iter().zip(&corrections).zip(&mut self.domains)
        {
            let camera = physical.corrected(&physical.camera, correction);
            let found = camera.lens.photo_domain(camera.intrinsics, camera.size);
            // A step too far is no reason to lose the domain.
            if found.limit.is_finite() && found.limit > 0.0 {
                *domain = [found.limit, found.clamp];
            }
        }
        Ok(())
    }
}

/// A row of constants on the device of another tensor.
fn row(values: &[f64], like: &Tensor<2>) -> Tensor<2> {
    let values: Vec<f32> = values.iter().map(|value| *value as f32).collect();
    let shape = [1, values.len()];
    Tensor::from_data(TensorData::new(values, shape), &like.device())
}

impl Hook for RefineIntrinsics {
    fn name(&self) -> &str {
        "intrinsics"
    }

    fn cameras(
        &self,
        view: &HookView,
        mut cameras: CameraTensors,
    ) -> Result<CameraTensors, OpError> {
        let Some(&index) = self.of_view.get(view.name) else {
            return Ok(cameras);
        };
        let physical = &self.cameras[index];
        let corrections = self.corrections.model();
        let of_camera = |all: &Param<Tensor<2>>| all.val().narrow(0, index, 1);

        // The photo may be smaller than the capture's, and its intrinsics with it.
        let (w, h) = (cameras.size.width, cameras.size.height);
        let mut logarithms = of_camera(&corrections.focal);
        if physical.square {
            logarithms = logarithms.narrow(1, 0, 1).repeat_dim(1, 2);
        }
        let focal = cameras.intrinsics.clone().narrow(1, 0, 2) * logarithms.exp();
        let principal = of_camera(&corrections.principal);
        let sides = row(&[f64::from(w), f64::from(h)], &principal);
        let principal = cameras.intrinsics.narrow(1, 2, 2) + principal * sides;
        cameras.intrinsics = Tensor::cat(vec![focal, principal], 1);

        let k = physical.model.coefficients();
        let change = of_camera(&corrections.distortion).narrow(1, 0, k);
        let unit = row(&physical.unit[..k], &change);
        let coefficients = row(&physical.start[..k], &change) + change * unit;
        cameras.distortion = Some(Distortion {
            model: physical.model,
            domain: row(&self.domains[index], &coefficients),
            coefficients,
        });
        Ok(cameras)
    }

    fn step(&mut self, gradients: &mut Gradients, at: &StepInfo) -> Result<(), OpError> {
        let Some(factor) = self.schedule.factor(at.step) else {
            return Ok(());
        };
        let gradients = self.corrections.gradients(gradients);
        let settings = &self.settings;
        self.corrections.step(gradients, |field| {
            let rate = match field.name.as_str() {
                "focal" => settings.focal_rate,
                "principal" => settings.principal_rate,
                _ => settings.distortion_rate,
            };
            (rate * factor, FieldStep::Step(1.0))
        })?;
        // The scores after the last step are those of the cameras that are written then.
        if at.step % REFRESH == REFRESH - 1 || at.step + 1 == at.run.steps {
            self.refresh()?;
        }
        Ok(())
    }

    fn save(&self) -> Result<StateRecord, OpError> {
        let mut record = self.corrections.save()?;
        let shape = [self.domains.len(), 2];
        let domains = TensorData::new(self.domains.as_flattened().to_vec(), shape);
        record.tensors.insert(DOMAINS.into(), domains);
        Ok(record)
    }

    fn restore(&mut self, mut record: StateRecord, device: &Device) -> Result<(), String> {
        let wrong = || {
            format!(
                "`{DOMAINS}` are not {} pairs of numbers",
                self.domains.len()
            )
        };
        let domains = record.tensors.remove(DOMAINS).ok_or_else(wrong)?;
        let domains = domains.convert::<f64>().try_into_vec::<f64>();
        let domains = domains.map_err(|_| wrong())?;
        let usable = |domain: &[f64; 2]| domain[0] > 0.0 && domain[1] >= 0.0;
        let pairs = domains.as_chunks::<2>().0;
        if pairs.len() != self.domains.len() || !pairs.iter().all(usable) {
            return Err(wrong());
        }
        self.domains = pairs.to_vec();
        self.corrections.restore(record, device)
    }
}
