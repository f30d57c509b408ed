//! Density control of one's own: splits Gaussians whose means the loss pulled hardest, along their
//! longest axis, and removes those that became transparent. Starts with every 20th point.
//!
//! The picture, of a held-out view: without splits, with splits, the photo.
//! Run it: `cargo run --release --example custom_strategy [STEPS [FOLDER [CAPTURE]]]`

mod common;

use burn_splat::prelude::*;
use glam::{DQuat, DVec3};

/// Splits this share of the Gaussians, ten times in a run.
struct SplitWherePulled {
    share: f64,
    /// Gradients of the means times sizes, `[N, 1]`, summed since the last split.
    pull: Option<Tensor<2>>,
}

impl<M: SplatModel> Strategy<M> for SplitWherePulled {
    fn before_step(&mut self, context: &mut StepContext<M>) -> Result<(), OpError> {
        let gradient = context.gradients["means"].clone();
        let size = context.model.model().scales().inner().max_dim(1);
        let pull = gradient.square().sum_dim(1).sqrt() * size;
        let sum = self.pull.take().map(|sum| sum + pull.clone());
        self.pull = Some(sum.unwrap_or(pull));
        Ok(())
    }

    fn after_step(&mut self, context: &mut StepContext<M>) -> Result<Option<Refinement>, OpError> {
        let every = context.at.run.steps.div_ceil(12);
        let due = context.at.step.is_multiple_of(every) && context.at.step <= 10 * every;
        let Some(pull) = self.pull.take_if(|_| due) else {
            return Ok(None);
        };
        let pull = burn_splat::ops::device::to_host(pull)?;
        let names = ["log_scales", "quats", "opacity_logits"];
        let [log_scales, quats, logits] = context.model.read_f64(names)?;
        let mut order: Vec<usize> = (0..pull.len()).collect();
        order.sort_by(|a, b| pull[*b].total_cmp(&pull[*a]));
        let (split, rest) = order.split_at((self.share * pull.len() as f64) as usize);
        let mut edit = RowEdit::default();
        for &row in rest.iter().filter(|row| logits[**row] > -5.0) {
            edit.push(row, Moments::Keep);
        }
        for &row in split {
            let scales = DVec3::from_slice(&log_scales[3 * row..]).exp();
            let longest = DVec3::AXES[scales.max_position()] * scales.max_element();
            let [w, x, y, z] = [0, 1, 2, 3].map(|i| quats[4 * row + i]);
            let axis = DQuat::from_xyzw(x, y, z, w).normalize() * longest;
            for offset in [axis * 0.5, axis * -0.5] {
                let half = edit.push(row, Moments::Restart);
                edit.offset(half, "means", &offset.to_array());
                edit.offset(half, "log_scales", &[-0.47; 3]); // ln(1 / 1.6), as in 3DGS
            }
        }
        context.model.edit_rows(&edit)?;
        let (mut report, removed) = (Refinement::default(), pull.len() + split.len() - edit.len());
        (report.split, report.pruned) = (split.len(), removed);
        Ok(Some(report))
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args = common::Arguments::read(2000, "examples/data/saharov")?;
    let mut capture = Capture::load(&args.input, &CaptureSettings::new().with_downscale(2))?;
    capture.points = capture.points.into_iter().step_by(20).collect();
    let train = |share: f64| -> Result<[Tensor<4>; 2], Box<dyn std::error::Error>> {
        let trainer = Trainer::builder(capture.clone()).device(Device::flex());
        let trainer = trainer.settings(TrainSettings::new().with_steps(args.size));
        let trainer = trainer.strategy(SplitWherePulled { share, pull: None });
        let trained = trainer.build()?.run()?;
        let [photo, image] = common::held_out(&capture, &trained)?;
        let (count, psnr) = (trained.model.len(), common::psnr(&image, &photo));
        println!("{count} Gaussians: {psnr:.2} dB in a held-out view");
        Ok([photo, image])
    };
    let [[_, without], [photo, with]] = [train(0.0)?, train(0.2)?];
    args.save("custom_strategy", &[without, with, photo])
}
