//! Gaussian splat models for Burn: module, cameras, losses, density control, optimiser. Everything
//! is an ordinary Burn module or a function on tensors.

mod camera;
mod field;
mod gaussians;
mod init;
pub mod losses;
mod model;
mod morton;
mod opacity;
mod optimized;
pub mod optimizer;
mod rates;
mod record;
mod render;
mod rows;
mod sh_degrees;
mod sh_reduction;
pub mod strategy;

pub use camera::CameraTensors;
pub use field::{Field, GAUSSIANS, SH_COEFFICIENTS};
pub use gaussians::{Gaussians, ShPrecision};
pub use init::{InitError, InitSettings, splats_from_points};
pub use model::SplatModel;
pub use optimized::{FieldGradients, FieldStep, Optimized, OwnedRows, Part, SparseOptimized};
pub use rates::LearningRates;
pub use record::RecordError;
pub use render::{
    RenderSettings, project_gaussians, render, render_projected, render_projected_on,
};
pub use rows::{Moments, RowEdit};
pub use sh_reduction::{ShReductionSettings, reduce_sh_degrees};
pub use splat_data::{Camera, CameraModel, Lens, SceneScale, SplatData};
pub use splat_ops as ops;

/// The adapter that all tests of this crate share.
#[cfg(all(test, feature = "wgpu"))]
mod test_adapter {
    use std::sync::OnceLock;

    use burn::tensor::Device;
    use splat_test_support::adapter_or_skip;

    /// wgpu's. A process can open it once.
    pub(crate) fn wgpu() -> Option<Device> {
        static ADAPTER: OnceLock<Option<Device>> = OnceLock::new();
        let opened = || adapter_or_skip(Device::wgpu_options().init());
        ADAPTER.get_or_init(opened).clone()
    }
}
