//! The state of a run.

use std::time::Duration;

use splat_model::optimizer::StateRecord;
use splat_model::strategy::Strategy;
use splat_model::{SparseOptimized, SplatModel};
use splat_ops::OpError;

use super::History;
use crate::hooks::Hooks;

/// The model, its optimisers, the strategy and hooks, and how far the run got.
pub(super) struct State<M: SplatModel> {
    pub(super) model: SparseOptimized<M>,
    pub(super) strategy: Box<dyn Strategy<M>>,
    pub(super) hooks: Hooks,
    pub(super) history: History,
    /// Steps done.
    pub(super) step: usize,
    pub(super) elapsed: Duration,
}

/// Names in a checkpoint under which the parts are.
const MODEL: &str = "model";
const STRATEGY: &str = "strategy";
const HOOK: &str = "hook";

impl<M: SplatModel> State<M> {
    /// Everything with tensors, under its name.
    pub(super) fn save(&self) -> Result<StateRecord, OpError> {
        let mut record = StateRecord::default();
        record.put_under(MODEL, self.model.save()?);
        record.put_under(STRATEGY, self.strategy.save()?);
        let mut hooks = StateRecord::default();
        for hook in &self.hooks.0 {
            hooks.put_under(hook.name(), hook.save()?);
        }
        record.put_under(HOOK, hooks);
        Ok(record)
    }

    /// Puts back what [`save`](Self::save) gave.
    pub(super) fn restore(
        &mut self,
        mut record: StateRecord,
        device: &burn::tensor::Device,
    ) -> Result<(), String> {
        self.model.restore(record.take_under(MODEL), device)?;
        let rows = self.model.count();
        let strategy = self
            .strategy
            .restore(record.take_under(STRATEGY), rows, device);
        strategy.map_err(|reason| format!("the strategy {}: {reason}", self.strategy.name()))?;
        let mut hooks = record.take_under(HOOK);
        for hook in &mut self.hooks.0 {
            let own = hooks.take_under(hook.name());
            let restored = hook.restore(own, device);
            restored.map_err(|reason| format!("the hook `{}`: {reason}", hook.name()))?;
        }
        let left = [&hooks, &record].map(|left| left.tensors.keys().chain(left.scalars.keys()));
        match left.into_iter().flatten().next() {
            None => Ok(()),
            Some(name) => Err(format!("`{name}` belongs to nothing of this run")),
        }
    }
}
