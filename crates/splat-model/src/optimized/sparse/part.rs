//! Some rows of a model, as a model of their own.

use burn::tensor::{Gradients, Int, Tensor, TensorData};
use splat_ops::RowGroups;

use super::bounds::GroupBox;
use super::{BOXED, SparseOptimized, gradients_of};
use crate::SplatModel;
use crate::field::GAUSSIANS;
use crate::optimized::fields::{FieldVisitor, ValuesOf, change};
use crate::optimized::{FieldGradients, Optimized, WHOLE};

/// Some rows of a [`SparseOptimized`], as a model of their own.
#[derive(Debug)]
pub struct Part<M> {
    model: M,
    rows: RowGroups,
    boxes: Vec<(u32, GroupBox)>,
}

impl<M: SplatModel> Part<M> {
    /// Copies the rows out of a model.
    pub(super) fn gather(whole: &Optimized<M>, rows: RowGroups) -> Self {
        let in_rows = |name: &str| {
            let field = whole.fields.iter().find(|field| field.name == name);
            field.is_some_and(|field| field.row_set == Some(GAUSSIANS))
        };
        let device = whole.model().means().device().without_autodiff();
        let indices: Vec<i32> = rows.indices().map(|row| row as i32).collect();
        let count = indices.len();
        let indices = Tensor::<1, Int>::from_data(TensorData::new(indices, [count]), &device);
        let mut model = Some(whole.model().clone());
        change(&mut model, whole.names(), |name, value| {
            match in_rows(name) {
                true => value.select(0, indices.clone()),
                false => value,
            }
        });
        let mut part = Self {
            model: model.expect(WHOLE),
            rows,
            boxes: Vec::new(),
        };
        part.boxes = part.measured(whole);
        part
    }

    /// The model of the rows alone.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// Which rows they are.
    pub fn rows(&self) -> &RowGroups {
        &self.rows
    }

    pub(super) fn into_rows(self) -> RowGroups {
        self.rows
    }

    /// Boxes around its groups.
    pub(super) fn boxes(&self) -> impl Iterator<Item = (u32, GroupBox)> {
        self.boxes.iter().copied()
    }

    /// Takes the gradients of the part's fields, by name, from those of a backward pass: rows as
    /// the part has them.
    pub fn gradients(
        &self,
        whole: &SparseOptimized<M>,
        gradients: &mut Gradients,
    ) -> FieldGradients {
        gradients_of(&whole.behind, &self.model, gradients)
    }

    fn measured(&self, whole: &Optimized<M>) -> Vec<(u32, GroupBox)> {
        let mut values: [Vec<f32>; 2] = Default::default();
        let read = ValuesOf(|name: &str, value: Tensor<2>| {
            if let Some(place) = BOXED.iter().position(|boxed| *boxed == name) {
                // Without values the groups' boxes stay as they were.
                values[place] = value.try_into_vec_as::<f32>().unwrap_or_default();
            }
        });
        self.model
            .visit(&mut FieldVisitor::new(whole.names(), read));
        let [means, log_scales] = values;
        let size = 3 * self.rows.size();
        let boxes = means.chunks(size).zip(log_scales.chunks(size));
        let boxes = boxes.map(|(means, log_scales)| GroupBox::around(means, log_scales));
        self.rows.chosen().iter().copied().zip(boxes).collect()
    }
}
