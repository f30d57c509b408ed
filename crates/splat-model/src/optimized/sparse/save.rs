//! Saving and restoring of rows that are behind, as they are: saving changes nothing, and a run
//! that goes on from a checkpoint catches them up as the first one would have.

use burn::tensor::{Device, TensorData};
use burn_pack::Scalar;
use splat_ops::OpError;

use super::bounds::{Bounds, GroupBox};
use super::missed::MissedSteps;
use super::{LARGEST_GROUP, SparseOptimized};
use crate::SplatModel;
use crate::optimizer::StateRecord;

/// Names in a checkpoint. No field has such a one.
const SPARSE: &str = "sparse/rows";
const MISSED: &str = "missed";
const TAKEN: &str = "taken";
const BOXES: &str = "boxes";
const GROUP: &str = "group";
const STEPS: &str = "steps";
const WIDENED: &str = "widened";

impl<M: SplatModel> SparseOptimized<M> {
    /// The state: that of [`Optimized::save`](crate::Optimized::save), and which rows are behind.
    ///
    /// # Errors
    /// When the device fails.
    pub fn save(&self) -> Result<StateRecord, OpError> {
        let mut record = self.behind.save()?;
        let mut sparse = StateRecord::default();
        let group = Scalar::UInt(self.group as u64);
        sparse.scalars.insert(GROUP.to_owned(), group);
        if self.missed.len() > 0 {
            let steps = self.missed.len() as u64;
            sparse.scalars.insert(STEPS.to_owned(), Scalar::UInt(steps));
            sparse.put_under(MISSED, self.missed.save());
            let taken: Vec<f32> = self.taken.iter().map(|last| *last as f32).collect();
            let groups = taken.len();
            let taken = TensorData::new(taken, [groups]);
            sparse.tensors.insert(TAKEN.to_owned(), taken);
        }
        let bounds = self.bounds.as_ref();
        if let Some(bounds) = bounds.filter(|bounds| bounds.version == self.behind.version) {
            let widened = bounds.widened as u64;
            sparse
                .scalars
                .insert(WIDENED.to_owned(), Scalar::UInt(widened));
            let values: Vec<f32> = bounds.boxes.iter().flat_map(|own| own.to_array()).collect();
            let shape = [bounds.boxes.len(), GroupBox::WIDTH];
            let values = TensorData::new(values, shape);
            sparse.tensors.insert(BOXES.to_owned(), values);
        }
        record.put_under(SPARSE, sparse);
        Ok(record)
    }

    /// Restores the output of [`save`](Self::save).
    ///
    /// # Errors
    /// Those of [`Optimized::restore`](crate::Optimized::restore), and a mismatch of the rows that
    /// are behind.
    pub fn restore(&mut self, mut record: StateRecord, device: &Device) -> Result<(), String> {
        let mut sparse = record.take_under(SPARSE);
        self.behind.restore(record, device)?;
        // Older checkpoints know of none.
        let group = take_number(&mut sparse, GROUP)?.unwrap_or(self.group);
        if !(1..=LARGEST_GROUP).contains(&group) {
            return Err(format!(
                "`{GROUP}` must be 1 to {LARGEST_GROUP}, it is {group}"
            ));
        }
        self.group = group;
        let groups = self.count().div_ceil(self.group);
        let steps = take_number(&mut sparse, STEPS)?.unwrap_or(0);
        self.missed = MissedSteps::restore(sparse.take_under(MISSED), steps)?;
        self.taken = match sparse.tensors.remove(TAKEN) {
            None if steps == 0 => Vec::new(),
            taken => {
                let taken = taken.and_then(|data| data.convert::<f32>().try_into_vec::<f32>().ok());
                let taken: Vec<u32> = taken
                    .unwrap_or_default()
                    .iter()
                    .map(|x| *x as u32)
                    .collect();
                let fits = taken.len() == groups && taken.iter().all(|x| *x as usize <= steps);
                match fits {
                    true => taken,
                    false => return Err(format!("`{TAKEN}` is not for {groups} groups")),
                }
            }
        };
        self.bounds = match (
            sparse.tensors.remove(BOXES),
            take_number(&mut sparse, WIDENED)?,
        ) {
            (None, None) => None,
            (Some(data), Some(widened)) => {
                let values = data
                    .convert::<f32>()
                    .try_into_vec::<f32>()
                    .unwrap_or_default();
                let boxes = values.as_chunks::<{ GroupBox::WIDTH }>().0.iter();
                let boxes: Vec<_> = boxes.map(|own| GroupBox::from_array(*own)).collect();
                if boxes.len() != groups {
                    return Err(format!("`{BOXES}` is not for {groups} groups"));
                }
                Some(Bounds {
                    boxes,
                    version: self.behind.version,
                    widened,
                })
            }
            _ => return Err(format!("of `{BOXES}` and `{WIDENED}` one is missing")),
        };
        match sparse.tensors.keys().chain(sparse.scalars.keys()).next() {
            None => Ok(()),
            Some(name) => Err(format!("`{name}` is nothing that rows need")),
        }
    }
}

fn take_number(record: &mut StateRecord, name: &str) -> Result<Option<usize>, String> {
    let value = record.scalars.remove(name);
    let number = value.map(usize::try_from).transpose();
    number.map_err(|_| format!("`{name}` is no number"))
}
