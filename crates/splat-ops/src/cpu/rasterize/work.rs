//! How much work an image takes on the CPU.

use burn::tensor::Tensor;
use macerator::Simd;
use rayon::prelude::*;

use super::blend::BlendTile;
use super::inputs::Camera;
use super::splat::LANES;
use super::tally::Tally;
use super::trace::Trace;
use super::view::{Listed, View};
use crate::backend::PROJECTED_WIDTH;
use crate::rasterize::{check_settings, per_camera};
use crate::settings::RasterizeArgs;
use crate::{ErrorSlot, OpError, Projected, RasterizeSettings};

/// Work of [`rasterize`](crate::rasterize), in numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RasterizeWork {
    /// Listed intersections of splats and tiles.
    pub intersections: u64,
    /// Pairs of a pixel and a splat whose alpha the forward pass evaluates. The backward pass
    /// evaluates about as many.
    pub tested: u64,
    /// Those of them whose alpha reaches `alpha_min`; on the CPU beyond the image's edges too, in
    /// the tiles that lie across.
    pub seen: u64,
    /// Those of them that are blended: the pixel exists and had not stopped.
    pub blended: u64,
}

/// Counts the work of [`rasterize`](crate::rasterize) with the same arguments, by doing it on the
/// CPU, wherever they are.
///
/// # Errors
/// As [`rasterize`](crate::rasterize).
pub fn rasterize_work<const DC: usize, const DO: usize>(
    projected: &Projected,
    colors: Tensor<DC>,
    opacities: Tensor<DO>,
    settings: &RasterizeSettings,
) -> Result<RasterizeWork, OpError> {
    check_settings(settings)?;
    let (colors, opacities) = per_camera(projected, colors, opacities)?;
    let [c, n, d] = colors.dims();
    let to_host = |tensor: Tensor<3>| {
        tensor
            .into_data()
            .convert::<f32>()
            .try_into_vec::<f32>()
            .unwrap_or_default()
    };
    let (packed, colors) = (to_host(projected.packed()), to_host(colors));
    let opacities = to_host(opacities.reshape([c as i32, -1, 1]));
    let args = RasterizeArgs {
        size: projected.image_size(),
        settings: *settings,
        backward: false,
        errors: ErrorSlot::default(),
    };
    let mut work = RasterizeWork::default();
    for index in 0..c {
        let camera = Camera {
            packed: &packed[index * n * PROJECTED_WIDTH..(index + 1) * n * PROJECTED_WIDTH],
            colors: &colors[index * n * d..(index + 1) * n * d],
            opacities: &opacities[index * n..(index + 1) * n],
            background: None,
            channels: d,
            absolute: false,
        };
        work.add(&of_camera(&camera, &args)?);
    }
    Ok(work)
}

fn of_camera(camera: &Camera<f32>, args: &RasterizeArgs) -> Result<RasterizeWork, OpError> {
    let listed = Listed::new(camera, args)?;
    let view = View::new(&listed, None, args);
    let tiles = (0..view.grid.columns * view.grid.rows).into_par_iter();
    let blended = tiles.map(|tile| {
        let mut work = RasterizeWork::default();
        let tile = [tile % view.grid.columns, tile / view.grid.columns];
        count_tile(&view, tile, &mut work);
        work
    });
    let mut work = blended.reduce(RasterizeWork::default, |mut sum, tile| {
        sum.add(&tile);
        sum
    });
    work.intersections = view.lists.intersections() as u64;
    Ok(work)
}

#[macerator::with_simd]
fn count_tile<'a, S: Simd>(view: &View<'a, f32>, tile: [usize; 2], work: &mut RasterizeWork) {
    BlendTile::new(view.channels).blend::<S>(
        view,
        tile,
        &mut Trace::with_capacity(1, view.list(tile).len()),
        work,
    );
}

impl RasterizeWork {
    fn add(&mut self, other: &Self) {
        self.intersections += other.intersections;
        self.tested += other.tested;
        self.seen += other.seen;
        self.blended += other.blended;
    }
}

impl Tally for RasterizeWork {
    fn tested(&mut self, seen: impl FnOnce() -> [bool; LANES]) {
        self.tested += LANES as u64;
        self.seen += count(seen());
    }

    fn blended(&mut self, blended: impl FnOnce() -> [bool; LANES]) {
        self.blended += count(blended());
    }
}

fn count(pixels: [bool; LANES]) -> u64 {
    pixels.iter().map(|pixel| u64::from(*pixel)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ImageSize;
    use burn::tensor::{Device, TensorData};
    use rand::{RngExt, SeedableRng};

    /// Against brute force over every pixel in double precision: no pair that is seen goes
    /// untested, and most pairs that are tested are seen. Behind an opaque wall nothing is blended.
    #[test]
    fn the_counts_are_those_of_brute_force() {
        let (n, size) = (
            200,
            ImageSize {
                width: 61,
                height: 45,
            },
        );
        let mut rng = rand_pcg::Pcg64::seed_from_u64(11);
        let (mut packed, mut opacities) = (Vec::new(), Vec::new());
        for i in 0..n {
            let mut w = || rng.random_range(0.1..0.6f32);
            let (w11, w22) = (w(), w());
            let w21 = rng.random_range(-0.3..0.3f32);
            let (x, y) = (rng.random_range(-5.0..66.0), rng.random_range(-5.0..50.0));
            packed.extend([x, y, 1.0 + i as f32, w11, w21, w22, 1.0, 50.0, 50.0]);
            opacities.push(rng.random_range(0.0..0.05f32));
        }
        let mut seen = 0;
        for (row, opacity) in packed.chunks_exact(9).zip(&opacities) {
            let row: Vec<f64> = row.iter().map(|v| f64::from(*v)).collect();
            for pixel in 0..61 * 45 {
                let (dx, dy) = (
                    (pixel % 61) as f64 + 0.5 - row[0],
                    (pixel / 61) as f64 + 0.5 - row[1],
                );
                let (z1, z2) = (row[3] * dx, row[4] * dx + row[5] * dy);
                let alpha = f64::from(*opacity) * (-(z1 * z1 + z2 * z2) / 2.0).exp();
                seen += u64::from(alpha >= splat_core::ALPHA_MIN);
            }
        }
        let count = |packed: Vec<f32>, opacities: Vec<f32>| {
            let (device, n) = (Device::flex(), opacities.len());
            let packed = Tensor::from_data(TensorData::new(packed, [1, n, 9]), &device);
            let projected = Projected::from_packed(packed, size).unwrap();
            let colors = Tensor::<2>::ones([n, 3], &device);
            let opacities = Tensor::<1>::from_data(TensorData::new(opacities, [n]), &device);
            rasterize_work(&projected, colors, opacities, &Default::default()).unwrap()
        };
        let work = count(packed.clone(), opacities.clone());
        let missed = work.blended.abs_diff(seen);
        assert!(missed <= 2, "{work:?}, brute force {seen}");
        assert!(work.seen >= work.blended);
        assert!(work.tested < 2 * work.seen, "{work:?}");
        assert!(work.intersections < 12 * n as u64, "{work:?}");

        // Two walls at the cap in front leave less than the rest may take away.
        let wall = [30.0, 22.0, 0.1, 1e-4, 0.0, 1e-4, 1.0, 1e5, 1e5f32];
        let walls = [wall, wall, wall].concat();
        let work = count([walls, packed].concat(), [vec![1.0; 3], opacities].concat());
        assert_eq!(work.blended, 2 * 61 * 45);
    }
}
