//! Losses still on the device, until they are read into the history.

use burn::tensor::{Tensor, Transaction};
use splat_ops::OpError;

use super::{LossRecord, TrainError};

/// Number of steps whose losses are read from the device at once.
pub const LOSS_BATCH: usize = 10;

/// Steps in a row without a finite loss after which a run ends; a single photo cannot be the cause.
const NOT_FINITE_LIMIT: usize = 100;

/// A loss on the device.
pub(super) struct UnreadLoss {
    /// The step, from 1.
    pub(super) step: usize,
    /// Indices of its views in the capture.
    pub(super) views: Vec<usize>,
    /// Total, then the terms.
    pub(super) values: Vec<Tensor<1>>,
}

/// Losses not yet read.
#[derive(Default)]
pub(super) struct LossLog {
    unread: Vec<UnreadLoss>,
}

/// The result of reading a loss.
pub(super) enum ReadLoss {
    Finite(LossRecord),
    /// Step, views and value.
    NotFinite(usize, Vec<usize>, f32),
}

impl LossLog {
    pub(super) fn push(&mut self, loss: UnreadLoss) {
        self.unread.push(loss);
    }

    /// True if a full batch is waiting.
    pub(super) fn is_full(&self) -> bool {
        self.unread.len() >= LOSS_BATCH
    }

    /// Reads all waiting losses, each a total and `terms` terms, in one transfer.
    pub(super) fn read(&mut self, terms: usize) -> Result<Vec<ReadLoss>, OpError> {
        let unread = core::mem::take(&mut self.unread);
        if unread.is_empty() {
            return Ok(Vec::new());
        }
        let values = unread.iter().flat_map(|loss| loss.values.clone());
        let read = values.fold(Transaction::default(), Transaction::register);
        let read = read.try_execute().map_err(|error| OpError::Device {
            op: "training step",
            what: error.to_string(),
        })?;
        let values: Vec<f32> = read
            .into_iter()
            .map(|data| data.convert::<f32>())
            .flat_map(|data| data.try_into_vec::<f32>().unwrap_or_default())
            .collect();
        let losses = unread.iter().zip(values.chunks(1 + terms));
        Ok(losses
            .map(|(loss, values)| match values[0].is_finite() {
                true => ReadLoss::Finite(LossRecord {
                    step: loss.step,
                    total: values[0],
                    terms: values[1..].to_vec(),
                }),
                false => ReadLoss::NotFinite(loss.step, loss.views.clone(), values[0]),
            })
            .collect())
    }
}

/// Checks how many steps in a row had no finite loss.
///
/// # Errors
/// [`TrainError::NotFinite`] after 100 such steps in a row, or after all of a shorter run.
pub(super) fn check_finite(
    step: usize,
    view: &str,
    value: f32,
    last_finite: Option<&LossRecord>,
    steps: usize,
) -> Result<(), TrainError> {
    let in_a_row = step - last_finite.map_or(0, |record| record.step);
    if in_a_row < NOT_FINITE_LIMIT.min(steps) {
        return Ok(());
    }
    Err(TrainError::NotFinite {
        step,
        view: view.to_owned(),
        value,
        in_a_row,
    })
}
