//! Rows of other row sets that belong to the Gaussians, and follow them through every edit.

use std::collections::BTreeMap;
use std::sync::Arc;

use burn::module::Module;
use burn::tensor::{Int, Tensor, TensorData};
use splat_ops::OpError;

use super::Optimized;
use crate::field::{Field, GAUSSIANS};
use crate::optimizer::{MomentEdit, StateRecord};
use crate::rows::{Moments, RowEdit};
use crate::{LearningRates, SplatModel};

/// Rows of a row set that belong to the Gaussians, in their order: those of Gaussian i are the rows
/// `starts[i]..starts[i + 1]`. Where Gaussians go, are copied or change places, their rows and
/// moments do too.
///
/// [`Gaussians`](crate::Gaussians) of different degrees of spherical harmonics have such a set, of
/// their coefficients.
///
/// ```
/// use splat_model::OwnedRows;
///
/// let rows = OwnedRows::of_counts(1, [3, 0, 8]);
/// assert_eq!(rows.starts(), [0, 3, 3, 11]);
/// assert_eq!(rows.counts().collect::<Vec<_>>(), [3, 0, 8]);
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnedRows {
    row_set: usize,
    /// `[N + 1]`, ascending from 0.
    starts: Arc<[u32]>,
}

impl OwnedRows {
    /// So many rows of a set for each Gaussian, in order. What is beyond 2^32 - 1 rows in all is
    /// left out.
    pub fn of_counts(row_set: usize, counts: impl IntoIterator<Item = u32>) -> Self {
        let mut end = 0u32;
        let ends = counts.into_iter().map(|count| {
            end = end.saturating_add(count);
            end
        });
        Self {
            row_set,
            starts: core::iter::once(0).chain(ends).collect(),
        }
    }

    /// The row set, which is not that of the Gaussians.
    pub fn row_set(&self) -> usize {
        self.row_set
    }

    /// First row of each of N Gaussians, and the number of rows, `[N + 1]`.
    pub fn starts(&self) -> &[u32] {
        &self.starts
    }

    /// Number of rows of each Gaussian.
    pub fn counts(&self) -> impl Iterator<Item = u32> + '_ {
        self.starts.windows(2).map(|pair| pair[1] - pair[0])
    }

    /// Number of Gaussians.
    pub fn gaussians(&self) -> usize {
        self.starts.len() - 1
    }

    /// Number of rows of all Gaussians.
    pub fn rows(&self) -> usize {
        self.starts.last().map_or(0, |end| *end as usize)
    }

    /// Rows of a Gaussian.
    fn of(&self, gaussian: u32) -> core::ops::Range<u32> {
        let at = gaussian as usize;
        self.starts[at]..self.starts[at + 1]
    }

    /// What an edit of the Gaussians, whose rows exist, does to the rows that belong to them.
    pub(super) fn follow(&self, edit: &RowEdit) -> (Gather, Self) {
        let mut gather = Gather::default();
        let sources = edit.sources();
        let kinds = edit.moments();
        let moment_sources = edit.moment_sources();
        for ((source, kind), moments) in sources.iter().zip(&kinds).zip(&moment_sources) {
            let moments = self.of(*moments);
            for (place, row) in self.of(*source).enumerate() {
                let of_moments = moments.start + place as u32;
                // Where the moments are those of a Gaussian with fewer rows, the last have none.
                let has = *kind != Moments::Restart && of_moments < moments.end;
                gather.sources.push(row as i32);
                gather
                    .moments
                    .push(if has { of_moments as i32 } else { row as i32 });
                gather.restarts.push(!has);
            }
        }
        let counts = sources.iter().map(|source| self.of(*source).len() as u32);
        let after = Self::of_counts(self.row_set, counts);
        (gather, after)
    }
}

/// New rows of a row set, in terms of the old ones.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Gather {
    pub(super) sources: Vec<i32>,
    pub(super) moments: Vec<i32>,
    pub(super) restarts: Vec<bool>,
}

impl Gather {
    pub(super) fn of(edit: &RowEdit) -> Self {
        let indices = |rows: Vec<u32>| rows.into_iter().map(|row| row as i32).collect();
        let kinds = edit.moments().into_iter();
        Self {
            sources: indices(edit.sources()),
            moments: indices(edit.moment_sources()),
            restarts: kinds.map(|moments| moments == Moments::Restart).collect(),
        }
    }
}

/// What a model says of the rows that its Gaussians own.
pub(super) struct Owner<M> {
    pub(super) rows: fn(&M) -> Vec<OwnedRows>,
    pub(super) set: fn(&mut M, &OwnedRows) -> Result<(), OpError>,
    keep: fn(&mut M, &OwnedRows) -> Result<(), OpError>,
    fields: fn(&M, &LearningRates) -> Vec<Field>,
}

impl<M: SplatModel> Owner<M> {
    pub(super) fn new() -> Self {
        Self {
            rows: M::owned_rows,
            set: M::set_owned_rows,
            keep: M::keep_owned_rows,
            fields: M::fields,
        }
    }
}

impl<M> Clone for Owner<M> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<M> Copy for Owner<M> {}

impl<M> core::fmt::Debug for Owner<M> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Owner")
    }
}

impl<M: Module> Optimized<M> {
    /// Rows of other row sets that belong to the Gaussians.
    pub(super) fn owned_rows(&self) -> Vec<OwnedRows> {
        let owner = self.owner.as_ref();
        owner.map_or_else(Vec::new, |owner| (owner.rows)(self.model()))
    }

    /// Lets each Gaussian keep at most so many of its rows in a row set, the first ones, with their
    /// moments. Where the model has them as one row per Gaussian so far, they become rows of the
    /// set, see [`SplatModel::keep_owned_rows`].
    ///
    /// # Errors
    /// When the model has no such rows, or `most` is not for its number of Gaussians. The model is
    /// then unchanged.
    pub fn keep_owned_rows(&mut self, most: &OwnedRows) -> Result<(), OpError> {
        let Some(owner) = self.owner else {
            return Err(wrong(
                "rows belong to the Gaussians of a model; make it with `Optimized::of_model`"
                    .into(),
            ));
        };
        let (old_shapes, old_fields) = (self.shapes(), self.fields.clone());
        let old_rows = self.owned_rows();
        let mut model = self.model().clone();
        (owner.keep)(&mut model, most)?;
        let Some(new) = (owner.rows)(&model)
            .into_iter()
            .find(|rows| rows.row_set == most.row_set)
        else {
            return Err(wrong(format!("the model has no row set {}", most.row_set)));
        };
        let mut fields = (owner.fields)(&model, &LearningRates::default());
        for field in &mut fields {
            // Rates are those of the run.
            let Some(old) = old_fields.iter().find(|old| old.name == field.name) else {
                return Err(wrong(format!("`{}` was no field before", field.name)));
            };
            *field = Field {
                row_set: field.row_set,
                ..old.clone()
            };
        }
        let before = (
            self.model.replace(model),
            core::mem::replace(&mut self.fields, fields),
        );
        let edits = self.kept(&old_rows, &new, &old_shapes);
        let edits = match self.check_fields().and(edits) {
            Ok(edits) => edits,
            Err(error) => {
                (self.model, self.fields) = before;
                return Err(error);
            }
        };
        drop(before);
        for (field, edit) in edits {
            if let Some(optimizer) = self.optimizers.get_mut(&field) {
                optimizer.edit_rows(&edit);
            }
            if let Some(waiting) = self.waiting.remove(&field) {
                self.waiting.insert(field, edit.apply(waiting));
            }
        }
        self.edits += 1;
        self.version += 1;
        Ok(())
    }

    /// The edits of the moments of each field of the set `new`, of fields that had other shapes.
    fn kept(
        &self,
        old_rows: &[OwnedRows],
        new: &OwnedRows,
        old_shapes: &BTreeMap<String, [usize; 2]>,
    ) -> Result<Vec<(String, MomentEdit)>, OpError> {
        let shapes = self.shapes();
        let in_set = |field: &&Field| field.row_set == Some(new.row_set);
        let mut edits = Vec::new();
        for field in self.fields.iter().filter(in_set) {
            let ([rows, width], [old_count, old_width]) =
                (shapes[&field.name], old_shapes[&field.name]);
            let parts = old_width / width.max(1);
            let old = match old_rows.iter().find(|old| old.row_set == new.row_set) {
                Some(old) => old.clone(),
                // A row of a Gaussian is so many rows of the set.
                None => OwnedRows::of_counts(new.row_set, vec![parts as u32; old_count]),
            };
            let fits = parts * width == old_width
                && old.rows() == old_count * parts
                && new.rows() == rows
                && old.gaussians() == new.gaussians()
                && old.counts().zip(new.counts()).all(|(old, new)| new <= old);
            if !fits {
                return Err(wrong(format!(
                    "`{}` of shape [{old_count}, {old_width}] has become one of [{rows}, {width}]; each Gaussian keeps some of its rows",
                    field.name
                )));
            }
            let source: Vec<i32> = (old.starts.iter().zip(new.counts()))
                .flat_map(|(start, count)| (*start..start + count).map(|row| row as i32))
                .collect();
            let device = match self.field(&field.name) {
                Some(value) => value.device(),
                None => continue,
            };
            let source = Tensor::<1, Int>::from_data(TensorData::new(source, [rows]), &device);
            edits.push((field.name.clone(), MomentEdit::Cut { parts, source }));
        }
        Ok(edits)
    }
}

fn wrong(what: String) -> OpError {
    OpError::Argument {
        op: "Optimized::keep_owned_rows",
        what,
    }
}

/// Prefix under which the rows that Gaussians own are saved, as numbers of rows.
const OWNED: &str = "owned";

/// Name in a record of the numbers of rows in a set.
fn name(row_set: usize) -> String {
    format!("{OWNED}/{row_set}")
}

impl OwnedRows {
    /// Puts the numbers of rows into a record: floats, which a number of rows of one Gaussian fits.
    pub(super) fn save(&self, record: &mut StateRecord) {
        let counts: Vec<f32> = self.counts().map(|count| count as f32).collect();
        let counts = TensorData::new(counts, [self.gaussians(), 1]);
        record.tensors.insert(name(self.row_set), counts);
    }

    /// Takes what [`save`](Self::save) put into a record.
    pub(super) fn restore(
        fields: &mut BTreeMap<String, (Option<TensorData>, StateRecord)>,
    ) -> Result<Vec<Self>, String> {
        let names: Vec<String> = fields.keys().cloned().collect();
        let mut found = Vec::new();
        for name in names {
            let Some(set) = name
                .strip_prefix(OWNED)
                .and_then(|set| set.strip_prefix('/'))
            else {
                continue;
            };
            let data = fields.remove(&name).and_then(|(data, _)| data);
            let counts = data.and_then(|data| data.convert::<f32>().try_into_vec::<f32>().ok());
            let (Ok(row_set), Some(counts)) = (set.parse::<usize>(), counts) else {
                return Err(format!("`{name}` is no list of numbers of rows"));
            };
            let is_count = |count: &f32| count.fract() == 0.0 && (0.0..65_536.0).contains(count);
            if row_set == GAUSSIANS || !counts.iter().all(is_count) {
                return Err(format!("`{name}` has a value that is no number of rows"));
            }
            found.push(Self::of_counts(
                row_set,
                counts.iter().map(|count| *count as u32),
            ));
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gaussians of 3, 0, 1 and 2 rows.
    fn rows() -> OwnedRows {
        OwnedRows::of_counts(1, [3, 0, 1, 2])
    }

    #[test]
    fn rows_go_where_their_gaussians_go() {
        let mut edit = RowEdit::default();
        edit.push(3, Moments::Keep);
        edit.push(1, Moments::Keep);
        edit.push(0, Moments::Restart);
        edit.push(2, Moments::Keep);
        let (gather, after) = rows().follow(&edit);
        assert_eq!(after, OwnedRows::of_counts(1, [2, 0, 3, 1]));
        assert_eq!(gather.sources, [4, 5, 0, 1, 2, 3]);
        assert_eq!(gather.moments, gather.sources);
        let (keep, restart) = (false, true);
        assert_eq!(
            gather.restarts,
            [keep, keep, restart, restart, restart, keep]
        );
    }

    /// Values of a Gaussian with three rows, moments of one with two, and the other way round.
    #[test]
    fn moments_of_another_gaussian_reach_as_far_as_its_rows() {
        let mut edit = RowEdit::default();
        edit.push(0, Moments::Of(3));
        edit.push(3, Moments::Of(0));
        edit.push(2, Moments::Of(1));
        let (gather, after) = rows().follow(&edit);
        assert_eq!(after.starts(), [0, 3, 5, 6]);
        assert_eq!(gather.sources, [0, 1, 2, 4, 5, 3]);
        assert_eq!(gather.moments, [4, 5, 2, 0, 1, 3]);
        assert_eq!(gather.restarts, [false, false, true, false, false, true]);
    }

    #[test]
    fn numbers_of_rows_are_saved_and_damaged_ones_refused() {
        let mut record = StateRecord::default();
        rows().save(&mut record);
        let mut fields = record.clone().by_field();
        assert_eq!(OwnedRows::restore(&mut fields), Ok(vec![rows()]));
        assert!(fields.is_empty());
        for counts in [vec![0.5f32], vec![-1.0], vec![f32::NAN], vec![1e9]] {
            let mut record = record.clone();
            let data = TensorData::new(counts, [1, 1]);
            record.tensors.insert("owned/65535".into(), data);
            let refused = OwnedRows::restore(&mut record.by_field()).unwrap_err();
            assert!(refused.contains("`owned/65535`"), "{refused}");
        }
        let mut record = StateRecord::default();
        record
            .tensors
            .insert("owned/0".into(), TensorData::new(vec![0.0f32], [1, 1]));
        assert!(OwnedRows::restore(&mut record.by_field()).is_err());
    }
}
