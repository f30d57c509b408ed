//! Gaussians with a trained tint each, which multiplies their colours.

use burn_splat::prelude::*;

#[derive(Module, Debug)]
pub struct Tinted {
    gaussians: Gaussians,
    /// Logarithms, `[N, 3]`.
    tint: Param<Tensor<2>>,
}

impl Tinted {
    pub fn new(first: &SplatData, device: &Device) -> Self {
        Self {
            gaussians: Gaussians::from_data(first, device),
            tint: Param::from_tensor(Tensor::zeros([first.len(), 3], device)),
        }
    }
}

impl SplatModel for Tinted {
    fn origin(&self) -> [f64; 3] {
        self.gaussians.origin
    }

    fn means(&self) -> Tensor<2> {
        self.gaussians.means.val()
    }

    fn quats(&self) -> Tensor<2> {
        self.gaussians.quats.val()
    }

    fn scales(&self) -> Tensor<2> {
        self.gaussians.scales()
    }

    fn opacities(&self) -> Tensor<1> {
        self.gaussians.opacities()
    }

    fn shade(
        &self,
        cameras: &CameraTensors,
        projected: &Projected,
        settings: &RenderSettings,
    ) -> Result<Tensor<3>, OpError> {
        let colors = self.gaussians.shade(cameras, projected, settings)?;
        Ok(colors * self.tint.val().exp().unsqueeze_dim(0))
    }

    fn fields(&self, rates: &LearningRates) -> Vec<Field> {
        let fields = self.gaussians.fields(rates).into_iter();
        let mut fields: Vec<Field> = fields.map(|field| field.nested("gaussians")).collect();
        // Its rows follow those of the Gaussians, and so do its moments.
        fields.push(Field::rows("tint", 1e-3));
        fields
    }

    fn to_data(&self) -> SplatData {
        self.gaussians.to_data()
    }
}
