//! Edits of the rows of a model: what each new row is made from.

use std::collections::BTreeMap;

use crate::field::GAUSSIANS;

/// Whether the moments of a row go on or start anew.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moments {
    /// They are those of the row that it is made from.
    Keep,
    /// They are zero, as of a parameter that was never stepped.
    Restart,
}

/// The rows of a row set after an edit, in terms of those before. All fields of the set are edited
/// alike, and their moments with them; what differs between fields is said by
/// [`offset`](Self::offset) and [`set`](Self::set).
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
    values: Vec<f32>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ChangeKind {
    Offset,
    Set,
}

/// Changes of one field: values `[N_new, width]`, and which of them count.
#[derive(Debug, Default)]
pub(crate) struct FieldChanges {
    /// Added to the gathered rows; zero where a row has none.
    pub offsets: Option<Vec<f32>>,
    /// Rows that are replaced after that, and by what, one after the other.
    pub set_rows: Vec<usize>,
    pub set_values: Vec<f32>,
}

impl Default for RowEdit {
    /// No rows, of the set of all Gaussians.
    fn default() -> Self {
        Self::of_row_set(GAUSSIANS)
    }
}

impl RowEdit {
    /// No rows, of one row set of the model.
    pub fn of_row_set(row_set: usize) -> Self {
        Self {
            row_set,
            rows: Vec::new(),
        }
    }

    /// All of `count` rows as they are: the beginning of an edit in place, such as a relocation.
    pub fn identity(count: usize) -> Self {
        let mut edit = Self::default();
        (0..count).for_each(|row| {
            edit.push(row, Moments::Keep);
        });
        edit
    }

    /// Adds a row made from an old one, and returns its index.
    pub fn push(&mut self, source: usize, moments: Moments) -> usize {
        self.rows.push(NewRow {
            source: source as u32,
            moments,
            changes: Vec::new(),
        });
        self.rows.len() - 1
    }

    /// Makes a new row from another old one, as when a dead Gaussian is moved to where one is
    /// needed.
    pub fn relocate(&mut self, row: usize, source: usize, moments: Moments) {
        let row = &mut self.rows[row];
        (row.source, row.moments) = (source as u32, moments);
    }

    /// What becomes of the moments of a new row.
    pub fn set_moments(&mut self, row: usize, moments: Moments) {
        self.rows[row].moments = moments;
    }

    /// Adds to the values that a new row has in a field: as many as the field is wide.
    pub fn offset(&mut self, row: usize, field: &str, values: &[f32]) {
        self.change(row, field, ChangeKind::Offset, values);
    }

    /// Replaces the values that a new row has in a field, as many as the field is wide; what is
    /// offset beside is then without effect.
    pub fn set(&mut self, row: usize, field: &str, values: &[f32]) {
        self.change(row, field, ChangeKind::Set, values);
    }

    fn change(&mut self, row: usize, field: &str, kind: ChangeKind, values: &[f32]) {
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

    /// Whether no row is left.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The row set that is edited.
    pub fn row_set(&self) -> usize {
        self.row_set
    }

    /// The old row that each new one is made from.
    pub fn sources(&self) -> Vec<u32> {
        self.rows.iter().map(|row| row.source).collect()
    }

    /// Which moments go on, by new row.
    pub fn moments(&self) -> Vec<Moments> {
        self.rows.iter().map(|row| row.moments).collect()
    }

    /// What a new row's values in a field are shifted by, if they are.
    pub fn offset_of(&self, row: usize, field: &str) -> Option<&[f32]> {
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

    /// Orders the new rows so that neighbours in space are neighbours in memory, given the old
    /// means.
    pub fn arrange(&mut self, means: &[[f32; 3]]) {
        let means: Vec<[f32; 3]> = (0..self.len())
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

    /// The changes of all fields that have any, of widths that fit.
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
