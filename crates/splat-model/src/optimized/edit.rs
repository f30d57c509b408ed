//! Row edits of values and moments.

use std::collections::BTreeMap;

use burn::module::Module;
use burn::tensor::{Bool, Int, Tensor, TensorData};
use splat_ops::OpError;

use super::Optimized;
use super::fields::change;
use super::owned::{Gather, OwnedRows};
use crate::field::{Field, GAUSSIANS};
use crate::optimizer::MomentEdit;
use crate::rows::{FieldChanges, RowEdit};

impl<M: Module> Optimized<M> {
    /// Edits the rows of every field of a row set, with their moments, by one gather per field on
    /// the device. Rows of other sets that belong to the Gaussians
    /// ([`OwnedRows`](crate::OwnedRows)) follow an edit of those. Parameters keep their ids.
    ///
    /// # Errors
    /// When the edit names an old row, a row set or a field that does not exist, has values of the
    /// wrong width, leaves no Gaussian, or is of rows that follow the Gaussians. The model is then
    /// unchanged.
    pub fn edit_rows(&mut self, edit: &RowEdit) -> Result<(), OpError> {
        let owned = self.owned_rows();
        self.check_edit(edit, &owned)?;
        let owned: Vec<_> = match edit.row_set() {
            GAUSSIANS => owned.iter().map(|rows| rows.follow(edit)).collect(),
            _ => Vec::new(),
        };
        for (_, after) in &owned {
            if i32::try_from(after.rows()).is_err() {
                return Err(wrong(format!(
                    "the row set {} would have more than 2^31 - 1 rows",
                    after.row_set()
                )));
            }
        }
        self.edits += 1;
        self.version += 1;
        self.gather(edit.row_set(), Gather::of(edit), edit.changes());
        for (gather, after) in owned {
            self.gather(after.row_set(), gather, BTreeMap::new());
            if let (Some(owner), Some(model)) = (self.owner, &mut self.model) {
                (owner.set)(model, &after)?;
            }
        }
        Ok(())
    }

    /// Gathers the new rows of every field of a row set, with their moments, and then changes
    /// values.
    fn gather(
        &mut self,
        row_set: usize,
        gather: Gather,
        mut changes: BTreeMap<&str, FieldChanges>,
    ) {
        let in_set = |field: &&Field| field.row_set == Some(row_set);
        let edited: Vec<String> = (self.fields.iter().filter(in_set))
            .map(|field| field.name.clone())
            .collect();
        let first = edited.first().and_then(|name| self.field(name));
        let Some(device) = first.map(|value| value.device()) else {
            return;
        };
        let Gather {
            sources,
            moments,
            restarts,
        } = gather;
        let n = sources.len();
        let same = moments == sources;
        let source = Tensor::<1, Int>::from_data(TensorData::new(sources, [n]), &device);
        let restarts = Tensor::<1, Bool>::from_data(TensorData::new(restarts, [n]), &device);
        let names = self.names();
        change(&mut self.model, names, |name, value| {
            if !edited.iter().any(|field| field == name) {
                return value;
            }
            let value = match n {
                0 => Tensor::zeros([0, value.dims()[1]], (&device, value.dtype())),
                _ => value.select(0, source.clone()),
            };
            match changes.remove(name) {
                Some(changes) => changed(value, changes),
                None => value,
            }
        });
        let source = match same {
            true => source,
            false => Tensor::from_data(TensorData::new(moments, [n]), &device),
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
    }

    /// Checks every row and width of an edit before anything changes.
    fn check_edit(&self, edit: &RowEdit, owned: &[OwnedRows]) -> Result<(), OpError> {
        let wrong = |what: String| Err(wrong(what));
        if owned.iter().any(|rows| rows.row_set() == edit.row_set()) {
            return wrong(format!(
                "rows of the set {} belong to the Gaussians and follow them; edit those",
                edit.row_set()
            ));
        }
        let shapes = self.shapes();
        let in_set = |field: &&Field| field.row_set == Some(edit.row_set());
        if !self.fields.iter().any(|field| in_set(&field)) {
            return wrong(format!("the model has no row set {}", edit.row_set()));
        }
        if edit.row_set() == GAUSSIANS && edit.is_empty() {
            return wrong("no Gaussian would be left, and nothing could grow back".to_owned());
        }
        for field in self.fields.iter().filter(in_set) {
            let [rows, _] = shapes[&field.name];
            let other = |owned: &&OwnedRows| owned.gaussians() != rows;
            if let (GAUSSIANS, Some(owned)) = (edit.row_set(), owned.iter().find(other)) {
                return wrong(format!(
                    "rows of the set {} belong to {} Gaussians, there are {rows}",
                    owned.row_set(),
                    owned.gaussians()
                ));
            }
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

fn wrong(what: String) -> OpError {
    OpError::Argument {
        op: "Optimized::edit_rows",
        what,
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
