//! A model with a feature vector per Gaussian beside its colour, trained on a feature image of each
//! photo: here the colour at full brightness, elsewhere what a network sees.
//!
//! The picture, of a held-out view: photo, render, features of the photo, rendered features.
//! Run it: `cargo run --release --example custom_model [STEPS [FOLDER [CAPTURE]]]`

mod common;

use burn_splat::prelude::*;

#[derive(Module, Debug)]
struct Featured {
    gaussians: Gaussians,
    features: Param<Tensor<2>>, // [N, 3]
}

impl SplatModel for Featured {
    /// Six channels: colour and features.
    fn shade(
        &self,
        cameras: &CameraTensors,
        projected: &Projected,
        settings: &RenderSettings,
    ) -> Result<Tensor<3>, OpError> {
        let colors = self.gaussians.shade(cameras, projected, settings)?;
        let features = self.features.val().unsqueeze();
        Ok(Tensor::cat(vec![colors, features], 2))
    }
    /// Features are rows too: they follow when Gaussians are cloned, split or removed.
    fn fields(&self, rates: &LearningRates) -> Vec<Field> {
        let fields = self.gaussians.fields(rates).into_iter();
        let fields = fields.map(|field| field.nested("gaussians"));
        fields.chain([Field::rows("features", 1e-2)]).collect()
    }
    // The rest is that of the Gaussians.
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
    fn to_data(&self) -> SplatData {
        self.gaussians.to_data()
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args = common::Arguments::read(2000, "examples/data/saharov")?;
    let capture = Capture::load(&args.input, &CaptureSettings::new().with_downscale(2))?;
    // The features of an image `[1, H, W, 3]`.
    let hue = |image: Tensor<4>| image.clone() / (image.max_dim(3) + 0.1);
    let loss = LossTerms::l1_ssim(0.2).term("features", 0.5, move |view, rendered| {
        let features = rendered.image().narrow(3, 3, 3);
        Ok(losses::l1(features, hue(view.image())))
    });
    let model = |first: &SplatData, device: &Device| Featured {
        gaussians: Gaussians::from_data(first, device),
        features: Param::from_tensor(Tensor::zeros([first.len(), 3], device)),
    };
    let trainer = Trainer::builder(capture.clone()).device(Device::flex());
    let trainer = trainer.settings(TrainSettings::new().with_steps(args.size));
    let trained = trainer.loss(loss).model(model).build()?.run()?;

    let [photo, image] = common::held_out(&capture, &trained)?;
    let [color, features] = [0, 3].map(|first| image.clone().narrow(3, first, 3));
    let target = hue(photo.clone());
    let [a, b] = [(&color, &photo), (&features, &target)].map(|(a, b)| common::psnr(a, b));
    println!("in a held-out view: colour {a:.2} dB, features {b:.2} dB");
    args.save("custom_model", &[photo, color, target, features])
}
