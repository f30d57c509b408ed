//! The training views, as strategies see them.

use burn::tensor::{Device, Tensor};
use splat_data::Capture;
use splat_model::CameraTensors;
use splat_model::strategy::TrainingViews;
use splat_ops::OpError;

use crate::photo::photo;

/// The training views of a capture, at its own resolution.
pub(super) struct CaptureViews<'a> {
    pub(super) capture: &'a Capture,
    pub(super) origin: [f64; 3],
    pub(super) device: &'a Device,
}

impl CaptureViews<'_> {
    fn view(&self, view: usize) -> &splat_data::View {
        &self.capture.views[self.capture.split.train[view]]
    }
}

impl TrainingViews for CaptureViews<'_> {
    fn count(&self) -> usize {
        self.capture.split.train.len()
    }

    fn camera(&self, view: usize) -> CameraTensors {
        let camera = self.view(view).camera().relative_to(self.origin);
        CameraTensors::from_camera(&camera, self.device)
    }

    fn photo(&self, view: usize) -> Result<Tensor<4>, OpError> {
        photo(self.view(view), self.device)
    }
}
