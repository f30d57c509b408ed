//! State as named tensors and numbers, for checkpoints.

use std::collections::BTreeMap;

use burn::tensor::TensorData;
use burn_pack::Scalar;

/// Saved state of an optimiser, a strategy or a module.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StateRecord {
    /// Tensors by name.
    pub tensors: BTreeMap<String, TensorData>,
    /// Numbers by name.
    pub scalars: BTreeMap<String, Scalar>,
}

impl StateRecord {
    /// Splits the entries by the part of the name before the first dot: the tensor of that name
    /// alone, and the entries under it.
    pub(crate) fn by_field(self) -> BTreeMap<String, (Option<TensorData>, StateRecord)> {
        let mut fields: BTreeMap<String, (Option<TensorData>, Self)> = BTreeMap::new();
        for (name, data) in self.tensors {
            match name.split_once('.') {
                Some((field, leaf)) => {
                    let (_, state) = fields.entry(field.to_owned()).or_default();
                    state.tensors.insert(leaf.to_owned(), data);
                }
                None => fields.entry(name).or_default().0 = Some(data),
            }
        }
        for (name, value) in self.scalars {
            let (field, leaf) = name.split_once('.').unwrap_or((&name, ""));
            let (_, state) = fields.entry(field.to_owned()).or_default();
            state.scalars.insert(leaf.to_owned(), value);
        }
        fields
    }

    /// Takes out everything under a name and strips the name: `model.means` under `model` becomes
    /// `means`.
    pub fn take_under(&mut self, name: &str) -> Self {
        let is_under = |key: &str| {
            key.strip_prefix(name)
                .is_some_and(|rest| rest.starts_with('.'))
        };
        let cut = |key: String| key[name.len() + 1..].to_owned();
        let (tensors, scalars) = (
            core::mem::take(&mut self.tensors),
            core::mem::take(&mut self.scalars),
        );
        let mut under = Self::default();
        for (key, data) in tensors {
            match is_under(&key) {
                true => under.tensors.insert(cut(key), data),
                false => self.tensors.insert(key, data),
            };
        }
        for (key, value) in scalars {
            match is_under(&key) {
                true => under.scalars.insert(cut(key), value),
                false => self.scalars.insert(key, value),
            };
        }
        under
    }

    /// Puts everything of another record under a name, for [`take_under`](Self::take_under).
    pub fn put_under(&mut self, name: &str, other: Self) {
        let under = |key: String| format!("{name}.{key}");
        self.tensors.extend(
            other
                .tensors
                .into_iter()
                .map(|(key, data)| (under(key), data)),
        );
        self.scalars.extend(
            other
                .scalars
                .into_iter()
                .map(|(key, value)| (under(key), value)),
        );
    }
}
