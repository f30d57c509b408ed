//! Some rows of a tensor, as groups of consecutive ones.

use core::ops::Range;

/// Rows of a tensor, chosen in groups of consecutive rows: group g holds the rows from `g * size`
/// on, and the last group what is left.
///
/// ```
/// use splat_core::RowGroups;
///
/// let rows = RowGroups::new(4, 10, vec![0, 2]).unwrap();
/// assert_eq!(rows.indices().collect::<Vec<_>>(), [0, 1, 2, 3, 8, 9]);
/// assert_eq!((rows.len(), rows.count(), rows.groups()), (6, 10, 3));
/// assert!(RowGroups::new(4, 10, vec![2, 0]).is_none());
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RowGroups {
    size: usize,
    count: usize,
    chosen: Vec<u32>,
}

impl RowGroups {
    /// The groups `chosen`, in ascending order, of a tensor of `count` rows in groups of `size`.
    /// `None` if they are not in order, if one does not exist, or if `size` is zero.
    pub fn new(size: usize, count: usize, chosen: Vec<u32>) -> Option<Self> {
        if size == 0 {
            return None;
        }
        let groups = count.div_ceil(size);
        let exist = chosen.last().is_none_or(|last| (*last as usize) < groups);
        let ordered = chosen.windows(2).all(|pair| pair[0] < pair[1]);
        (exist && ordered).then_some(Self {
            size,
            count,
            chosen,
        })
    }

    /// All rows.
    pub fn all(size: usize, count: usize) -> Self {
        let size = size.max(1);
        let groups = count.div_ceil(size) as u32;
        Self {
            size,
            count,
            chosen: (0..groups).collect(),
        }
    }

    /// Rows of a group, but for the last.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Rows of the tensor.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Groups of the tensor.
    pub fn groups(&self) -> usize {
        self.count.div_ceil(self.size)
    }

    /// The groups chosen, in ascending order.
    pub fn chosen(&self) -> &[u32] {
        &self.chosen
    }

    /// Number of rows chosen.
    pub fn len(&self) -> usize {
        self.chosen
            .iter()
            .map(|group| self.range(*group).len())
            .sum()
    }

    /// True if no row is chosen.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The rows of a group.
    pub fn range(&self, group: u32) -> Range<usize> {
        let start = group as usize * self.size;
        start..self.count.min(start + self.size)
    }

    /// The rows chosen, in ascending order.
    pub fn indices(&self) -> impl Iterator<Item = usize> {
        self.chosen.iter().flat_map(|group| self.range(*group))
    }
}
