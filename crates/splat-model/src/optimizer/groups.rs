//! Adam on some rows of a field at a time.

use burn::tensor::Tensor;
use splat_ops::{AdamGap, OpError, RowGroups, adam_catch_up, adam_step_groups};

use super::field_optimizer::{FieldOptimizer, Owner};
use super::{SplatAdam, SplatAdamState};

impl FieldOptimizer {
    /// The Adam that this is, whose rows can be stepped apart; `None` for other optimisers.
    pub(crate) fn adam(&self) -> Option<&SplatAdam> {
        self.owner().map(|owner| &owner.optimizer)
    }

    /// Steps taken, if this is [`SplatAdam`].
    pub(crate) fn time(&self) -> usize {
        let state = self.owner().and_then(|owner| owner.state.as_ref());
        state.map_or(0, |state| state.time)
    }

    /// Value `[N, width]` after a step of some rows along their gradient `[N', width]`.
    ///
    /// # Errors
    /// When shapes do not fit, or this is another optimiser than [`SplatAdam`].
    pub(crate) fn step_groups(
        &mut self,
        rate: f64,
        value: Tensor<2>,
        gradient: Tensor<2>,
        rows: &RowGroups,
    ) -> Result<Tensor<2>, OpError> {
        let owner = self.owner_mut()?;
        let SplatAdamState {
            mut time,
            moment_1,
            moment_2,
        } = owner.state.take().unwrap_or_else(|| SplatAdamState {
            time: 0,
            moment_1: value.zeros_like(),
            moment_2: value.zeros_like(),
        });
        time += 1;
        let step = owner.optimizer.step_at(rate, time);
        let moments = [moment_1, moment_2];
        let (value, [moment_1, moment_2]) =
            adam_step_groups(value, gradient, moments, rows, &step)?;
        owner.state = Some(SplatAdamState {
            time,
            moment_1,
            moment_2,
        });
        Ok(value)
    }

    /// Value `[N, width]` of which some rows have caught up on steps without a gradient.
    ///
    /// # Errors
    /// As those of [`step_groups`](Self::step_groups).
    pub(crate) fn catch_up(
        &mut self,
        value: Tensor<2>,
        rows: &RowGroups,
        gaps: &[AdamGap],
    ) -> Result<Tensor<2>, OpError> {
        let owner = self.owner_mut()?;
        let Some(state) = owner.state.take() else {
            return Ok(value);
        };
        let moments = [state.moment_1, state.moment_2];
        let (value, [moment_1, moment_2]) = adam_catch_up(value, moments, rows, gaps)?;
        owner.state = Some(SplatAdamState {
            time: state.time,
            moment_1,
            moment_2,
        });
        Ok(value)
    }

    /// The same value, without a change of the optimiser's own state.
    ///
    /// # Errors
    /// As those of [`step_groups`](Self::step_groups).
    pub(crate) fn caught_up(
        &self,
        value: Tensor<2>,
        rows: &RowGroups,
        gaps: &[AdamGap],
    ) -> Result<Tensor<2>, OpError> {
        match self.owner().and_then(|owner| owner.state.clone()) {
            None => Ok(value),
            Some(state) => {
                let moments = [state.moment_1, state.moment_2];
                Ok(adam_catch_up(value, moments, rows, gaps)?.0)
            }
        }
    }

    fn owner(&self) -> Option<&Owner<SplatAdam>> {
        self.0.as_any().downcast_ref()
    }

    fn owner_mut(&mut self) -> Result<&mut Owner<SplatAdam>, OpError> {
        let owner = self.0.as_any_mut().downcast_mut();
        owner.ok_or_else(|| OpError::Argument {
            op: "FieldOptimizer",
            what: "only `SplatAdam` steps some rows alone".to_owned(),
        })
    }
}
