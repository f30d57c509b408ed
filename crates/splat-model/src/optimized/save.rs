//! Saving and restoring of values and moments.

use std::collections::BTreeMap;

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use splat_ops::OpError;

use super::Optimized;
use super::fields::{FieldVisitor, ValuesOf, change};
use super::owned::OwnedRows;
use crate::field::GAUSSIANS;
use crate::optimizer::StateRecord;

/// Name of an accumulated gradient, beside the moments.
const WAITING: &str = "waiting_gradient";

impl<M: Module> Optimized<M> {
    /// Values and optimiser states of all fields, on the host: value `means` is tensor `means`, a
    /// moment of it `means.moment_1`. Values are `[N, width]`. Parameters that are not fields are
    /// included under `fixed/`, numbers of the rows of row set 1 that belong to each Gaussian as
    /// `owned/65535`.
    ///
    /// # Errors
    /// When the device fails.
    pub fn save(&self) -> Result<StateRecord, OpError> {
        let mut record = StateRecord::default();
        let mut fixed = Vec::new();
        self.model().visit(&mut FieldVisitor::new(
            self.other_names(),
            ValuesOf(|name: &str, value: Tensor<2>| fixed.push((name.to_owned(), value))),
        ));
        for (name, value) in fixed {
            record.tensors.insert(name, value.into_data());
        }
        for rows in self.owned_rows() {
            rows.save(&mut record);
        }
        let shapes = self.shapes();
        for field in &self.fields {
            let name = &field.name;
            let [values] = self.read([name.as_str()])?;
            let [_, width] = shapes[name];
            let rows = values.len() / width.max(1);
            record
                .tensors
                .insert(name.clone(), TensorData::new(values, [rows, width]));
            let mut state = self.optimizers[name].save();
            if let Some(waiting) = self.waiting.get(name) {
                state.tensors.insert(WAITING.to_owned(), waiting.to_data());
            }
            record.put_under(name, state);
        }
        Ok(record)
    }

    /// Restores the output of [`save`](Self::save), with any number of rows, and with rows that
    /// belong to the Gaussians where they were not yet kept as such. Parameters keep their ids.
    ///
    /// # Errors
    /// A mismatch with the model or its optimisers, naming the field. The model is then unchanged;
    /// optimisers may have been restored.
    pub fn restore(&mut self, record: StateRecord, device: &Device) -> Result<(), String> {
        let before = (self.model.clone(), self.fields.clone());
        let restored = self.restore_all(record, device);
        if restored.is_err() {
            (self.model, self.fields) = before;
        }
        restored
    }

    fn restore_all(&mut self, record: StateRecord, device: &Device) -> Result<(), String> {
        let mut fields = record.by_field();
        let owned = OwnedRows::restore(&mut fields)?;
        self.arrange_owned(&owned)?;
        let shapes = self.shapes();
        let mut values = BTreeMap::new();
        let mut rows_of_set = BTreeMap::new();
        let mut waiting_gradients = BTreeMap::new();
        let mut fixed = self.restore_fixed(&mut fields, device)?;
        for field in &self.fields {
            let name = &field.name;
            let (value, mut state) = match fields.remove(name) {
                Some((Some(value), state)) => (value, state),
                _ => return Err(format!("`{name}` is missing")),
            };
            let [own_rows, width] = shapes[name];
            let rows = match (&value.shape()[..], field.row_set) {
                ([rows, found], Some(_)) if *found == width => *rows,
                ([rows, found], None) if [*rows, *found] == [own_rows, width] => *rows,
                (shape, _) => {
                    return Err(format!(
                        "`{name}` has shape {shape:?}, the model's has [{own_rows}, {width}]"
                    ));
                }
            };
            if let Some(set) = field.row_set {
                let first = *rows_of_set.entry(set).or_insert(rows);
                if first != rows {
                    return Err(format!("`{name}` has {rows} rows beside others of {first}"));
                }
            }
            if let Some(waiting) = state.tensors.remove(WAITING) {
                if waiting.shape()[..] != [rows, width] {
                    return Err(format!(
                        "the gradient of `{name}` has shape {:?}",
                        waiting.shape().to_vec()
                    ));
                }
                waiting_gradients.insert(name.clone(), Tensor::from_data(waiting, device));
            }
            if let Some(optimizer) = self.optimizers.get_mut(name) {
                let restored = optimizer.restore(state, [rows, width], device);
                restored.map_err(|reason| format!("the optimiser of `{name}`: {reason}"))?;
            }
            values.insert(name.clone(), Tensor::from_data(value, device));
        }
        if let Some(name) = fields.keys().next() {
            return Err(format!("`{name}` is no field of the model"));
        }
        for rows in &owned {
            let sizes = [(GAUSSIANS, rows.gaussians()), (rows.row_set(), rows.rows())];
            for (set, expected) in sizes {
                let found = rows_of_set.get(&set);
                if found.is_some_and(|found| *found != expected) {
                    return Err(format!(
                        "`owned/{}` is for {expected} rows of the set {set}, which has {found:?}",
                        rows.row_set()
                    ));
                }
            }
        }
        self.version += 1;
        self.waiting = waiting_gradients;
        let names = self.names();
        change(&mut self.model, names, |name, value| {
            values.remove(name).unwrap_or(value)
        });
        let names = self.other_names();
        change(&mut self.model, names, |name, value| {
            fixed.remove(name).unwrap_or(value)
        });
        for rows in &owned {
            if let (Some(owner), Some(model)) = (self.owner, &mut self.model) {
                (owner.set)(model, rows).map_err(|error| error.to_string())?;
            }
        }
        Ok(())
    }

    /// Gives the model the row sets of a record that belong to its Gaussians, empty where it had
    /// none.
    fn arrange_owned(&mut self, owned: &[OwnedRows]) -> Result<(), String> {
        let own = self.owned_rows();
        let missing = |own: &&OwnedRows| owned.iter().all(|rows| rows.row_set() != own.row_set());
        if let Some(missing) = own.iter().find(missing) {
            return Err(format!("`owned/{}` is missing", missing.row_set()));
        }
        for rows in owned {
            if own.iter().any(|own| own.row_set() == rows.row_set()) {
                continue;
            }
            let first = (self.fields.iter()).find(|field| field.row_set == Some(GAUSSIANS));
            let first = first.and_then(|field| self.field(&field.name));
            let count = first.map_or(0, |value| value.dims()[0]);
            let none = OwnedRows::of_counts(rows.row_set(), vec![0; count]);
            let kept = self.keep_owned_rows(&none);
            kept.map_err(|error| format!("`owned/{}`: {error}", rows.row_set()))?;
        }
        Ok(())
    }

    /// Takes the parameters that are not fields from a record: all of them, in the model's shapes.
    fn restore_fixed(
        &self,
        fields: &mut BTreeMap<String, (Option<TensorData>, StateRecord)>,
        device: &Device,
    ) -> Result<BTreeMap<String, Tensor<2>>, String> {
        let mut own = Vec::new();
        self.model().visit(&mut FieldVisitor::new(
            self.other_names(),
            ValuesOf(|name: &str, value: Tensor<2>| own.push((name.to_owned(), value.dims()))),
        ));
        let mut fixed = BTreeMap::new();
        for (name, shape) in own {
            match fields.remove(&name) {
                Some((Some(data), _)) if data.shape()[..] == shape => {
                    fixed.insert(name, Tensor::from_data(data, device));
                }
                Some((Some(data), _)) => {
                    let found = data.shape().to_vec();
                    return Err(format!(
                        "`{name}` has shape {found:?}, the model's has {shape:?}"
                    ));
                }
                _ => return Err(format!("`{name}` is missing")),
            }
        }
        Ok(fixed)
    }
}
