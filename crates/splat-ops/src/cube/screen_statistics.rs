//! Sums of screen gradients and of views on CubeCL devices.

use burn_cubecl::CubeBackend;
use splat_kernels::screen_statistics::screen_statistics;

use super::{buffer, prepare, taken};
use crate::backend::{
    OpInputs, ScreenProbeOps, ScreenStatisticsInputs, ScreenStatisticsOps, ScreenStatisticsOutputs,
    ScreenStatisticsTensors,
};
use crate::settings::RowGroups;

impl ScreenProbeOps for CubeBackend {}

impl ScreenStatisticsOps for CubeBackend {
    fn add_screen_statistics(
        OpInputs(inputs): ScreenStatisticsInputs<Self>,
        half: [f64; 2],
        rows: Option<RowGroups>,
    ) -> ScreenStatisticsOutputs<Self> {
        let ScreenStatisticsTensors {
            gradient,
            packed,
            gradients,
            views,
        } = inputs.map(prepare);
        let (gradients, gradients_tensor) = taken(gradients);
        let (views, views_tensor) = taken(views);
        let [gradients, views] = screen_statistics(
            &gradient.client,
            [&buffer(&gradient), &buffer(&packed)],
            [gradients, views],
            half.map(|half| half as f32),
            rows.as_ref(),
        );
        ScreenStatisticsOutputs {
            gradients: gradients_tensor(gradients),
            views: views_tensor(views),
        }
    }
}
