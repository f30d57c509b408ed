//! The order of training views.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64Mcg;

/// Order of `count` views: every epoch is a permutation drawn from (seed, epoch) alone, so that a
/// resumed run continues with the same views.
pub(super) struct ViewOrder {
    seed: u64,
    epoch: Option<(usize, Vec<usize>)>,
    count: usize,
}

impl ViewOrder {
    pub(super) fn new(seed: u64, count: usize) -> Self {
        Self {
            seed,
            epoch: None,
            count,
        }
    }

    pub(super) fn at(&mut self, step: usize) -> usize {
        let epoch = step / self.count;
        if self
            .epoch
            .as_ref()
            .is_none_or(|(current, _)| *current != epoch)
        {
            let mut order: Vec<usize> = (0..self.count).collect();
            let seed = self.seed ^ (epoch as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            order.shuffle(&mut Pcg64Mcg::seed_from_u64(seed));
            self.epoch = Some((epoch, order));
        }
        self.epoch
            .as_ref()
            .map_or(0, |(_, order)| order[step % self.count])
    }
}

#[cfg(test)]
mod tests {
    use super::ViewOrder;

    #[test]
    fn every_epoch_sees_every_view_once_in_its_own_order() {
        let mut order = ViewOrder::new(7, 13);
        let epochs: Vec<Vec<usize>> = (0..4)
            .map(|e| (0..13).map(|i| order.at(13 * e + i)).collect())
            .collect();
        for epoch in &epochs {
            let mut sorted = epoch.clone();
            sorted.sort_unstable();
            assert_eq!(sorted, (0..13).collect::<Vec<_>>());
        }
        assert_ne!(epochs[0], epochs[1]);
        // Resuming in the middle of an epoch gives the same views.
        assert_eq!(ViewOrder::new(7, 13).at(20), epochs[1][7]);
    }
}
