//! Row edits of values and moments.

use burn::module::Module;
use burn::tensor::{Bool, Int, Tensor, TensorData};
use splat_ops::OpError;

use super::Optimized;
use super::fields::change;
use crate::field::{Field, GAUSSIANS};
use crate::optimizer::MomentEdit;
use crate::rows::{FieldChanges, Moments, RowEdit};

impl<M: Module> Optimized<M> {
    /// Edits the rows of every field of a row set, with their moments, by one gather per field on
    /// the device. Parameters keep their ids.
    ///
    /// # Errors
    /// When the edit names an old row, a row set or a field that does not exist, has values of the
    /// wrong width, or leaves no Gaussian. The model is then unchanged.
    pub fn edit_rows(&mut self, edit: &RowEdit) -> Result<(), OpError> {
        self.check_edit(edit)?;
        self.edits += 1;
        self.version += 1;
        let device = match self
            .fields
            .iter()
            .find(|field| field.row_set == Some(edit.row_set()))
        {
            Some(field) => match self.field(&field.name) {
                Some(value) => value.device(),
                None => return Ok(()),
            },
            None => return Ok(()),
        };
        let n = edit.len();
        let sources: Vec<i32> = edit.sources().iter().map(|row| *row as i32).collect();
        let restarts: Vec<bool> = (edit.moments().iter())
            .map(|moments| *moments == Moments::Restart)
            .collect();
        let moment_sources: Vec<i32> = (edit.moment_sources().iter())
            .map(|row| *row as i32)
            .collect();
        let source = Tensor::<1, Int>::from_data(TensorData::new(sources.clone(), [n]), &device);
        let restarts = Tensor::<1, Bool>::from_data(TensorData::new(restarts, [n]), &device);
        let mut changes = edit.changes();
        let edited: Vec<String> = self
            .fields
            .iter()
            .filter(|field| field.row_set == Some(edit.row_set()))
            .map(|field| field.name.clone())
            .collect();
        let names = self.names();
        change(&mut self.model, names, |name, value| {
            if !edited.iter().any(|field| field == name) {
                return value;
            }
            let value = value.select(0, source.clone());
            match changes.remove(name) {
                Some(changes) => changed(value, changes),
                None => value,
            }
        });
        let source = match moment_sources == sources {
            true => source,
            false => Tensor::from_data(TensorData::new(moment_sources, [n]), &device),
        };
        let moments = MomentEdit::Gather { source, restarts };
        for field in &edited {
            if let Some(optimizer) = self.optimizers.get_mut(field) {
                optimizer.edit_rows(&moments);
            }
            if let Some(waiting) = self.waiting.remove(field) {
                self.waiting.insert(field.clone(), moments.apply(waiting));
            }
        }
        Ok(())
    }

    /// Checks every row and width of an edit before anything changes.
    fn check_edit(&self, edit: &RowEdit) -> Result<(), OpError> {
        let wrong = |what: String| {
            Err(OpError::Argument {
                op: "Optimized::edit_rows",
                what,
            })
        };
        let shapes = self.shapes();
        let in_set = |field: &&Field| field.row_set == Some(edit.row_set());
        if !self.fields.iter().any(|field| in_set(&field)) {
            return wrong(format!("the model has no row set {}", edit.row_set()));
        }
        if edit.row_set() == GAUSSIANS && edit.is_empty() {
            return wrong("no Gaussian would be left, and nothing could grow back".to_owned());
        }
        let sources = [
            ("is made from", edit.sources()),
            ("has the moments of", edit.moment_sources()),
        ];
        for field in self.fields.iter().filter(in_set) {
            let [rows, _] = shapes[&field.name];
            let beyond = |source: &u32| *source as usize >= rows;
            for (what, sources) in &sources {
                if let Some(index) = sources.iter().position(beyond) {
                    return wrong(format!(
                        "new row {index} {what} row {} of `{}`, which has {rows}",
                        sources[index], field.name
                    ));
                }
            }
        }
        for (row, name, width) in edit.widths() {
            let known = (self.fields.iter().filter(in_set)).any(|field| field.name == name);
            if !known {
                return wrong(format!(
                    "it changes `{name}`, which is no field of the row set"
                ));
            }
            let [_, expected] = shapes[name];
            if width != expected {
                return wrong(format!(
                    "new row {row} changes {width} values of `{name}`, which has {expected} a row"
                ));
            }
        }
        Ok(())
    }
}

/// Applies offsets and replacements to gathered rows.
fn changed(value: Tensor<2>, changes: FieldChanges) -> Tensor<2> {
    // Offsets and values are in double precision, whatever the field is in.
    let (device, dtype) = (value.device(), value.dtype());
    let [n, width] = value.dims();
    let value = match changes.offsets {
        Some(offsets) => {
            let offsets = TensorData::new(offsets, [n, width]);
            value + Tensor::from_data(offsets, (&device, dtype))
        }
        None => value,
    };
    if changes.set_rows.is_empty() {
        return value;
    }
    let mut set = vec![0.0; n * width];
    let mut is_set = vec![false; n * width];
    for (row, values) in changes
        .set_rows
        .iter()
        .zip(changes.set_values.chunks(width.max(1)))
    {
        let row = row * width..(row + 1) * width;
        set[row.clone()].copy_from_slice(values);
        is_set[row].fill(true);
    }
    let set = Tensor::from_data(TensorData::new(set, [n, width]), (&device, dtype));
    let mask = Tensor::from_data(TensorData::new(is_set, [n, width]), &device);
    value.mask_where(mask, set)
}
