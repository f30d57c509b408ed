//! A gain for each training view, trained beside the model by an optimiser of its own.

use burn_splat::prelude::*;

#[derive(Module, Debug)]
struct Gains {
    /// `[views]`.
    logarithms: Param<Tensor<1>>,
}

pub struct Exposure(Optimized<Gains>);

impl Exposure {
    pub fn new(views: usize, device: &Device) -> Result<Self, OpError> {
        let zeros = Tensor::zeros([views], &device.clone().autodiff());
        let gains = Gains {
            logarithms: Param::from_tensor(zeros),
        };
        let gains = Optimized::of_module(gains, 1e-3, |_| SplatAdam::new().into())?;
        Ok(Self(gains))
    }

    pub fn gains(&self) -> Result<Vec<f32>, OpError> {
        let [logarithms] = self.0.read(["logarithms"])?;
        Ok(logarithms.into_iter().map(f32::exp).collect())
    }
}

impl Hook for Exposure {
    fn name(&self) -> &str {
        "exposure"
    }

    fn image(&self, view: &HookView, rendered: Rendered) -> Result<Rendered, OpError> {
        // Nothing was learned about a view that is held out.
        let Some(index) = view.training_index else {
            return Ok(rendered);
        };
        let gain = self.0.model().logarithms.val().narrow(0, index, 1).exp();
        rendered.with_image(rendered.image() * gain.reshape([1, 1, 1, 1]))
    }

    fn step(&mut self, gradients: &mut Gradients, _: &StepInfo) -> Result<(), OpError> {
        let gradients = self.0.gradients(gradients);
        self.0
            .step(gradients, |field| (field.rate, FieldStep::Step(1.0)))
    }

    fn save(&self) -> Result<StateRecord, OpError> {
        self.0.save()
    }

    fn restore(&mut self, record: StateRecord, device: &Device) -> Result<(), String> {
        self.0.restore(record, device)
    }
}
