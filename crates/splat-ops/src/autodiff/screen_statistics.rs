//! Statistics are no part of any graph.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, AutodiffBackend};

use crate::backend::{
    OpInputs, ScreenStatisticsInputs, ScreenStatisticsOps, ScreenStatisticsOutputs,
};
use crate::settings::RowGroups;

impl<B: ScreenStatisticsOps, C: CheckpointStrategy> ScreenStatisticsOps for Autodiff<B, C> {
    fn add_screen_statistics(
        OpInputs(inputs): ScreenStatisticsInputs<Self>,
        half: [f64; 2],
        rows: Option<RowGroups>,
    ) -> ScreenStatisticsOutputs<Self> {
        let inputs = OpInputs(inputs.map(|input| input.into_primitive()));
        let sums = B::add_screen_statistics(inputs, half, rows);
        ScreenStatisticsOutputs {
            gradients: Self::from_inner(sums.gradients),
            views: Self::from_inner(sums.views),
        }
    }
}
