//! Row edits of a model, in terms of its old rows.

use std::collections::BTreeMap;

use crate::field::GAUSSIANS;

/// Treatment of the moments of a new row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moments {
    /// Moments of the source row.
    Keep,
    /// Zero moments, as for a parameter that was never stepped.
    Restart,
    /// Moments of another old row, for example for a row that keeps its moments while its values
    /// are replaced by those of a second one.
    Of(usize),
}

/// Rows of a row set after an edit, in terms of the old rows. All fields of the set are edited
/// alike, with their moments; [`offset`](Self::offset) and [`set`](Self::set) give differences
/// between fields.
///
/// ```
/// use splat_model::{Moments, RowEdit};
///
/// // Row 0 stays, row 1 becomes two, row 2 goes.
/// let mut edit = RowEdit::default();
/// edit.push(0, Moments::Keep);
/// for shift in [-0.1, 0.1] {
///     let half = edit.push(1, Moments::Restart);
///     edit.offset(half, "means", &[shift, 0.0, 0.0]);
///     edit.offset(half, "log_scales", &[-0.47; 3]);
/// }
/// assert_eq!(edit.len(), 3);
/// assert_eq!(edit.sources(), [0, 1, 1]);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct RowEdit {
    row_set: usize,
    rows: Vec<NewRow>,
}

#[derive(Debug, Clone, PartialEq)]
struct NewRow {
    source: u32,
    moments: Moments,
    changes: Vec<Change>,
}

#[derive(Debug, Clone, PartialEq)]
struct Change {
    field: String,
    kind: ChangeKind,
    values: Vec<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ChangeKind {
    Offset,
    Set,
}

/// Changes of one field: values `[N_new, width]`, and the rows they apply to.
#[derive(Debug, Default)]
pub(crate) struct FieldChanges {
    /// Added to the gathered rows; zero for rows without an offset.
    pub offsets: Option<Vec<f64>>,
    /// Rows that are then replaced, and their new values in sequence.
    pub set_rows: Vec<usize>,
    pub set_values: Vec<f64>,
}

impl Default for RowEdit {
    /// No rows, in the set of all Gaussians.
    fn default() -> Self {
        Self::of_row_set(GAUSSIANS)
    }
}

impl RowEdit {
    /// No rows, in one row set of the model.
    pub fn of_row_set(row_set: usize) -> Self {
        Self {
            row_set,
            rows: Vec::new(),
        }
    }

    /// All of `count` rows unchanged, as the start of an edit in place, such as a relocation.
    pub fn identity(count: usize) -> Self {
        let mut edit = Self::default();
        (0..count).for_each(|row| {
            edit.push(row, Moments::Keep);
        });
        edit
    }

    /// Adds a row made from an old one; returns its index.
    pub fn push(&mut self, source: usize, moments: Moments) -> usize {
        self.rows.push(NewRow {
            source: source as u32,
            moments,
            changes: Vec::new(),
        });
        self.rows.len() - 1
    }

    /// Changes the source of a new row, for example to move a dead Gaussian to where one is needed.
    pub fn relocate(&mut self, row: usize, source: usize, moments: Moments) {
        let row = &mut self.rows[row];
        (row.source, row.moments) = (source as u32, moments);
    }

    /// Sets what happens to the moments of a new row.
    pub fn set_moments(&mut self, row: usize, moments: Moments) {
        self.rows[row].moments = moments;
    }

    /// Adds to a new row's values in a field; `values` has the width of the field.
    pub fn offset(&mut self, row: usize, field: &str, values: &[f64]) {
        self.change(row, field, ChangeKind::Offset, values);
    }

    /// Replaces a new row's values in a field; `values` has the width of the field. Offsets of the
    /// same field then have no effect.
    pub fn set(&mut self, row: usize, field: &str, values: &[f64]) {
        self.change(row, field, ChangeKind::Set, values);
    }

    fn change(&mut self, row: usize, field: &str, kind: ChangeKind, values: &[f64]) {
        self.rows[row].changes.push(Change {
            field: field.to_owned(),
            kind,
            values: values.to_vec(),
        });
    }

    /// Number of new rows.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// True if no row is left.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The row set that is edited.
    pub fn row_set(&self) -> usize {
        self.row_set
    }

    /// Source row of each new row.
    pub fn sources(&self) -> Vec<u32> {
        self.rows.iter().map(|row| row.source).collect()
    }

    /// Old row whose moments each new row continues, unless it restarts.
    pub(crate) fn moment_sources(&self) -> Vec<u32> {
        let source = |row: &NewRow| match row.moments {
            Moments::Keep | Moments::Restart => row.source,
            Moments::Of(other) => other as u32,
        };
        self.rows.iter().map(source).collect()
    }

    /// Moments of each new row.
    pub fn moments(&self) -> Vec<Moments> {
        self.rows.iter().map(|row| row.moments).collect()
    }

    /// Offset of a new row's values in a field, if any.
    pub fn offset_of(&self, row: usize, field: &str) -> Option<&[f64]> {
        let changes = self.rows[row].changes.iter();
        let mut offsets =
            changes.filter(|change| change.kind == ChangeKind::Offset && change.field == field);
        offsets.next().map(|change| change.values.as_slice())
    }

    /// Drops the new rows for which `keep` is false.
    pub fn retain(&mut self, mut keep: impl FnMut(usize) -> bool) {
        let mut index = 0;
        self.rows.retain(|_| {
            index += 1;
            keep(index - 1)
        });
    }

    /// Orders the new rows so that neighbours in space are neighbours in memory, from the old
    /// means.
    pub fn arrange(&mut self, means: &[[f64; 3]]) {
        let means: Vec<[f64; 3]> = (0..self.len())
            .map(|row| {
                let mean = means[self.rows[row].source as usize];
                match self.offset_of(row, "means") {
                    Some(offset) => [0, 1, 2].map(|axis| mean[axis] + offset[axis]),
                    None => mean,
                }
            })
            .collect();
        let order = crate::morton::order(&means);
        let mut rows: Vec<Option<NewRow>> = core::mem::take(&mut self.rows)
            .into_iter()
            .map(Some)
            .collect();
        self.rows = order
            .into_iter()
            .filter_map(|row| rows[row].take())
            .collect();
    }

    /// Row, field and number of values of every change.
    pub(crate) fn widths(&self) -> impl Iterator<Item = (usize, &str, usize)> {
        let rows = self.rows.iter().enumerate();
        rows.flat_map(|(row, new)| {
            let changes = new.changes.iter();
            changes.map(move |change| (row, change.field.as_str(), change.values.len()))
        })
    }

    /// Changes of all fields that have any; their widths must fit.
    pub(crate) fn changes(&self) -> BTreeMap<&str, FieldChanges> {
        let mut fields: BTreeMap<&str, FieldChanges> = BTreeMap::new();
        for (index, row) in self.rows.iter().enumerate() {
            for Change {
                field,
                kind,
                values,
            } in &row.changes
            {
                let changes = fields.entry(field).or_default();
                match kind {
                    ChangeKind::Set => {
                        changes.set_rows.push(index);
                        changes.set_values.extend(values);
                    }
                    ChangeKind::Offset => {
                        let width = values.len();
                        let offsets = changes
                            .offsets
                            .get_or_insert_with(|| vec![0.0; width * self.rows.len()]);
                        for (offset, value) in offsets[index * width..].iter_mut().zip(values) {
                            *offset += value;
                        }
                    }
                }
            }
        }
        fields
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arranged_rows_are_neighbours_in_memory_and_keep_what_belongs_to_them() {
        let mut edit = RowEdit::identity(3);
        let means = [[3.0, 3.0, 3.0], [0.0, 0.0, 0.0], [2.9, 3.0, 3.0]];
        let new = edit.push(1, Moments::Restart);
        edit.offset(new, "means", &[0.1, 0.0, 0.0]);
        edit.offset(new, "log_scales", &[-0.5; 3]);
        edit.arrange(&means);
        assert_eq!(edit.sources(), [1, 1, 2, 0]);
        let (keep, restart) = (Moments::Keep, Moments::Restart);
        assert_eq!(edit.moments(), [keep, restart, keep, keep]);
        assert_eq!(edit.offset_of(1, "means"), Some(&[0.1, 0.0, 0.0][..]));
        let changes = edit.changes();
        let offsets = changes["log_scales"].offsets.clone().unwrap();
        assert_eq!(offsets[..6], [0.0, 0.0, 0.0, -0.5, -0.5, -0.5]);
        assert_eq!(offsets.len(), 12);
    }

    #[test]
    fn a_row_may_have_the_values_of_one_and_the_moments_of_another() {
        let mut edit = RowEdit::identity(3);
        edit.relocate(2, 0, Moments::Of(2));
        edit.set_moments(0, Moments::Restart);
        assert_eq!(edit.sources(), [0, 1, 0]);
        assert_eq!(edit.moment_sources(), [0, 1, 2]);
    }

    #[test]
    fn rows_are_dropped_with_their_changes() {
        let mut edit = RowEdit::identity(4);
        edit.set(2, "opacity_logits", &[0.5]);
        edit.relocate(3, 0, Moments::Restart);
        edit.retain(|row| row != 1);
        assert_eq!(edit.sources(), [0, 2, 0]);
        let changes = edit.changes();
        assert_eq!(changes["opacity_logits"].set_rows, [1]);
        assert_eq!(changes["opacity_logits"].set_values, [0.5]);
    }
}
