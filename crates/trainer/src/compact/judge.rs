//! The loss of a scene, by rendering it.

use burn::tensor::Device;
use splat_data::{SplatData, View};
use splat_model::ops::OpError;
use splat_model::{CameraTensors, Gaussians, RenderSettings};

use crate::evaluate;

/// Views that scenes are judged by.
#[derive(Debug)]
pub struct Judge<'a> {
    views: &'a [&'a View],
    device: Device,
}

impl<'a> Judge<'a> {
    /// Judges by these views, on a device.
    pub fn new(views: &'a [&'a View], device: &Device) -> Self {
        Self {
            views,
            device: device.clone().without_autodiff(),
        }
    }

    /// The mean PSNR over the views, in dB.
    ///
    /// # Errors
    /// When an op refuses its input, or the device fails.
    pub fn psnr(&self, splats: &SplatData) -> Result<f64, OpError> {
        let (model, settings) = self.model(splats);
        Ok(evaluate(&model, self.views, &settings, &self.device, |_, _| {})?.psnr)
    }

    pub(super) fn model(&self, splats: &SplatData) -> (Gaussians, RenderSettings) {
        let model = Gaussians::from_data(splats, &self.device);
        (model, RenderSettings::of_scene(splats))
    }

    /// The cameras of the views, relative to an origin.
    pub(super) fn cameras(&self, origin: [f64; 3]) -> impl Iterator<Item = CameraTensors> {
        let cameras = self
            .views
            .iter()
            .map(move |view| view.camera().relative_to(origin));
        cameras.map(|camera| CameraTensors::from_camera(&camera, &self.device))
    }
}
