//! The chosen ones of all groups of rows.

use crate::settings::RowGroups;

/// Of something for every group of rows, in order, that of the chosen ones.
pub(super) fn chosen<X>(rows: &RowGroups, of_groups: impl Iterator<Item = X>) -> Vec<X> {
    let mut chosen = rows.chosen().iter().copied().peekable();
    let mut parts = Vec::with_capacity(rows.chosen().len());
    for (group, part) in (0..).zip(of_groups) {
        if chosen.next_if_eq(&group).is_some() {
            parts.push(part);
        }
    }
    parts
}
