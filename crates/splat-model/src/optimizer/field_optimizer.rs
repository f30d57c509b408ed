//! The optimiser of one field, with the state that it owns.

use std::any::Any;

use burn::optim::{RecordState, StateSink, StateSource};
use burn::tensor::{Device, Tensor};

use super::edit::{MomentEdit, RowOptimizer};
use super::state_record::StateRecord;

/// Steps one field and edits its moments: a type-erased [`RowOptimizer`] with its state.
pub struct FieldOptimizer(pub(super) Box<dyn Erased>);

impl core::fmt::Debug for FieldOptimizer {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("FieldOptimizer").finish_non_exhaustive()
    }
}

impl<O: RowOptimizer> From<O> for FieldOptimizer {
    fn from(optimizer: O) -> Self {
        Self(Box::new(Owner {
            optimizer,
            state: None,
        }))
    }
}

impl FieldOptimizer {
    /// Value `[N, width]` after a step along the gradient of the same shape.
    pub fn step(&mut self, rate: f64, value: Tensor<2>, gradient: Tensor<2>) -> Tensor<2> {
        self.0.step(rate, value, gradient)
    }

    /// Applies a row edit to the moments.
    pub fn edit_rows(&mut self, edit: &MomentEdit) {
        self.0.edit_rows(edit);
    }

    /// The state on the host; empty before the first step.
    pub fn save(&self) -> StateRecord {
        self.0.save()
    }

    /// Restores the output of [`save`](Self::save), for a value of this shape.
    ///
    /// # Errors
    /// The missing entries, if the state belongs to another optimiser.
    pub fn restore(
        &mut self,
        record: StateRecord,
        shape: [usize; 2],
        device: &Device,
    ) -> Result<(), String> {
        self.0.restore(record, shape, device)
    }
}

pub(super) trait Erased: Send {
    /// For those that know a kind of optimiser more closely.
    fn as_any(&self) -> &dyn Any;
    fn as_any_mut(&mut self) -> &mut dyn Any;
    fn step(&mut self, rate: f64, value: Tensor<2>, gradient: Tensor<2>) -> Tensor<2>;
    fn edit_rows(&mut self, edit: &MomentEdit);
    fn save(&self) -> StateRecord;
    fn restore(
        &mut self,
        record: StateRecord,
        shape: [usize; 2],
        device: &Device,
    ) -> Result<(), String>;
}

pub(super) struct Owner<O: RowOptimizer> {
    pub(super) optimizer: O,
    pub(super) state: Option<O::State<2>>,
}

impl<O: RowOptimizer> Erased for Owner<O> {
    fn as_any(&self) -> &dyn Any {
        self
    }

    fn as_any_mut(&mut self) -> &mut dyn Any {
        self
    }

    fn step(&mut self, rate: f64, value: Tensor<2>, gradient: Tensor<2>) -> Tensor<2> {
        let (value, state) = self
            .optimizer
            .step(rate, value, gradient, self.state.take());
        self.state = state;
        value
    }

    fn edit_rows(&mut self, edit: &MomentEdit) {
        self.state = self.state.take().map(|state| O::edit_rows(state, edit));
    }

    fn save(&self) -> StateRecord {
        let mut sink = StateSink::default();
        if let Some(state) = &self.state {
            state.state_flatten("", &mut sink);
        }
        StateRecord {
            tensors: sink.tensors.into_iter().collect(),
            scalars: sink.scalars.into_iter().collect(),
        }
    }

    fn restore(
        &mut self,
        record: StateRecord,
        shape: [usize; 2],
        device: &Device,
    ) -> Result<(), String> {
        if record == StateRecord::default() {
            self.state = None;
            return Ok(());
        }
        O::check_state(&record, shape)?;
        let mut source = StateSource::new(record.scalars);
        for (name, data) in record.tensors {
            source.insert_tensor(name, data);
        }
        let state = O::State::<2>::state_unflatten("", &mut source, device);
        self.state = Some(state.ok_or("the state of another optimiser")?);
        Ok(())
    }
}
