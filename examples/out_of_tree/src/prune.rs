//! A strategy without state in checkpoints: every 25 steps the faintest Gaussians go, and those
//! with the largest gradients are cloned.

use burn_splat::ops::ScreenStatistics;
use burn_splat::ops::device::to_host;
use burn_splat::prelude::*;

const EVERY: usize = 25;
const FAINT: f32 = -5.0;
const CLONED_SHARE: usize = 50;

#[derive(Default)]
pub struct PruneAndClone {
    statistics: Option<ScreenStatistics>,
}

impl<M: SplatModel> Strategy<M> for PruneAndClone {
    fn screen_wants(&self, _: &StepInfo) -> ScreenWants {
        ScreenWants::gradients()
    }

    fn before_step(&mut self, context: &mut StepContext<M>) -> Result<(), OpError> {
        for view in context.screen {
            let Some(gradient) = view.gradient.clone() else { continue };
            let [_, n, _] = gradient.dims();
            let sums = self.statistics.take().filter(|sums| sums.views.dims() == [n]);
            let zeros = || Tensor::zeros([n], &gradient.device());
            let sums = sums.unwrap_or_else(|| ScreenStatistics {
                gradients: zeros(),
                views: zeros(),
            });
            self.statistics = Some(sums.add(gradient, &view.projected)?);
        }
        Ok(())
    }

    fn after_step(&mut self, context: &mut StepContext<M>) -> Result<Option<Refinement>, OpError> {
        let due = context.at.step.is_multiple_of(EVERY);
        let Some(sums) = self.statistics.take_if(|_| due) else {
            return Ok(None);
        };
        let gradients = to_host(sums.gradients)?;
        let [logits] = context.model.read(["opacity_logits"])?;
        let mut order: Vec<usize> = (0..gradients.len()).collect();
        order.sort_by(|a, b| gradients[*b].total_cmp(&gradients[*a]));
        order.truncate(gradients.len() / CLONED_SHARE);
        let mut edit = RowEdit::identity(gradients.len());
        for row in &order {
            edit.push(*row, Moments::Restart);
        }
        let sources = edit.sources();
        edit.retain(|row| logits[sources[row] as usize] > FAINT);
        let pruned = sources.len() - edit.len();
        if !edit.is_empty() {
            context.model.edit_rows(&edit)?;
        }
        Ok(Some(Refinement {
            cloned: order.len(),
            pruned,
            ..Refinement::default()
        }))
    }
}
