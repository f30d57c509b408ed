//! How much work an image takes.

use burn::tensor::Tensor;
use rayon::prelude::*;

use super::blend::BlendTile;
use super::blocks::Blocks;
use super::{Camera, Frame, View};
use crate::rasterize::per_camera;
use crate::settings::RasterizeArgs;
use crate::{ErrorSlot, OpError, Projected, RasterizeSettings};

/// What [`rasterize`](crate::rasterize) does on the CPU, in numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RasterizeWork {
    /// Pairs of a tile and a splat that is listed in it.
    pub instances: u64,
    /// Pairs of a pixel and a splat whose alpha the forward pass evaluates. The backward pass evaluates about as many.
    pub tested: u64,
    /// Those of them whose alpha reaches `alpha_min`.
    pub seen: u64,
    /// Those of them that are blended: the pixel had not stopped.
    pub blended: u64,
}

/// Counts the work of [`rasterize`](crate::rasterize) with the same arguments, by doing it.
///
/// # Errors
/// As [`rasterize`](crate::rasterize).
pub fn rasterize_work<const DC: usize, const DO: usize>(
    projected: &Projected,
    colors: Tensor<DC>,
    opacities: Tensor<DO>,
    settings: &RasterizeSettings,
) -> Result<RasterizeWork, OpError> {
    let (colors, opacities) = per_camera(projected, colors, opacities)?;
    let [c, n, d] = colors.dims();
    let host = |tensor: Tensor<3>| {
        tensor
            .into_data()
            .convert::<f32>()
            .try_into_vec::<f32>()
            .unwrap_or_default()
    };
    let (packed, colors) = (host(projected.packed()), host(colors));
    let opacities = host(opacities.reshape([c as i32, -1, 1]));
    let args = RasterizeArgs {
        size: projected.image_size(),
        settings: *settings,
        errors: ErrorSlot::default(),
    };
    let mut work = RasterizeWork::default();
    for index in 0..c {
        let camera = Camera {
            packed: &packed[index * n * 9..(index + 1) * n * 9],
            colors: &colors[index * n * d..(index + 1) * n * d],
            opacities: &opacities[index * n..(index + 1) * n],
            background: None,
            channels: d,
        };
        work.add(&of_camera(&camera, &args)?);
    }
    Ok(work)
}

fn of_camera(camera: &Camera<f32>, args: &RasterizeArgs) -> Result<RasterizeWork, OpError> {
    let frame = Frame::new(camera, args)?;
    let view = View::new(&frame.lists, &frame.splats, &frame.colors, camera, args);
    let tiles = (0..view.grid.columns * view.grid.rows).into_par_iter();
    let blended = tiles.map(|tile| {
        let d = camera.channels;
        let mut work = RasterizeWork::default();
        let ranks = frame.lists.tile(tile);
        let tile = [tile % view.grid.columns, tile / view.grid.columns];
        // Without FMA a few pairs at a threshold may fall to its other side; for a count that is nothing.
        let blocks = &mut Blocks::new(ranks.len());
        BlendTile::new(d).blend::<false>(&view, ranks, tile, d, blocks, &mut work);
        work
    });
    let mut work = blended.reduce(RasterizeWork::default, |mut sum, tile| {
        sum.add(&tile);
        sum
    });
    work.instances = frame.lists.instances() as u64;
    Ok(work)
}

impl RasterizeWork {
    fn add(&mut self, other: &Self) {
        self.instances += other.instances;
        self.tested += other.tested;
        self.seen += other.seen;
        self.blended += other.blended;
    }
}

/// Told about every evaluated (pixel, splat) pair.
pub(super) trait Tally {
    fn pair(&mut self, seen: bool, blended: bool);
}

/// Nobody counts, and it costs nothing.
impl Tally for () {
    #[inline(always)]
    fn pair(&mut self, _: bool, _: bool) {}
}

impl Tally for RasterizeWork {
    fn pair(&mut self, seen: bool, blended: bool) {
        self.tested += 1;
        self.seen += u64::from(seen);
        self.blended += u64::from(blended);
    }
}
