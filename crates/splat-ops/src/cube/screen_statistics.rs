//! Sums of screen gradients and of views on CubeCL devices.

use burn_cubecl::tensor::CubeTensor;
use splat_kernels::screen_statistics::screen_statistics;

use super::{buffer, prepare, taken};

/// Gradient and splats `[C, N, 9]` and both sums `[N]` to the sums with this step added.
pub(super) fn add(tensors: [CubeTensor; 4], half: [f64; 2]) -> [CubeTensor; 2] {
    let [gradient, packed, lengths, views] = tensors.map(prepare);
    let (lengths, lengths_tensor) = taken(lengths);
    let (views, views_tensor) = taken(views);
    let [lengths, views] = screen_statistics(
        &gradient.client,
        [&buffer(&gradient), &buffer(&packed)],
        [lengths, views],
        half.map(|half| half as f32),
    );
    [lengths_tensor(lengths), views_tensor(views)]
}
