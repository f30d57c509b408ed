//! Lists the splats that touch each tile, in depth order (3DGS section 6).
//!
//! The splats that a camera sees are numbered in the order of their Gaussians, so that memory is
//! accessed sequentially. Each splat emits its tiles; a counting sort groups these by tile, and
//! each tile sorts its own few splats by (depth, index).

mod by_tile;
mod emit;

use core::ops::Range;
use core::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rayon::prelude::*;

use super::real::Real;
use super::splat::Splat;
use super::tiles::{CHUNK, Grid};
use super::uninit::Uncleared;
use crate::OpError;
use crate::backend::{PROJECTED_EXTENT, PROJECTED_WIDTH};
use crate::settings::RasterizeArgs;
use by_tile::ByTile;
use emit::{Emission, Emitted, emit};
use splat_core::memory::{in_units, lacking};

/// Gaussians per unit of parallel work in the visibility search.
const SEARCHED: usize = 2048;

/// Most intersections per camera, since they are counted in 32 bits.
const MAX_INTERSECTIONS: u64 = u32::MAX as u64;

/// Refuses too many intersections, before any list is allocated. No other place decides this.
fn check_intersections(intersections: u64, limit: u64) -> Result<(), OpError> {
    if intersections <= limit {
        return Ok(());
    }
    Err(OpError::TooManyIntersections {
        op: "rasterize",
        intersections,
        limit,
    })
}

/// Refuses intersections that would not fit into memory; a failed allocation would end the process.
fn check_memory(intersections: u64, bytes_per_intersection: u64) -> Result<(), OpError> {
    let needed = intersections.saturating_mul(bytes_per_intersection);
    match lacking(needed) {
        None => Ok(()),
        Some(left) => Err(OpError::OutOfMemory {
            op: "rasterize",
            intersections,
            needed: in_units(needed),
            left: in_units(left),
        }),
    }
}

/// Peak bytes per intersection: while the lists are made, or afterwards with the `kept` bytes.
fn bytes_per_intersection(kept: usize) -> u64 {
    // Emitted tiles, whose vectors grow by doubling; then owners, intersections, splats and places.
    let while_listed = (2 + 4) * size_of::<u32>();
    let listed = 2 * size_of::<u32>();
    while_listed.max(listed + kept) as u64
}

#[cfg(not(test))]
fn max_intersections() -> u64 {
    MAX_INTERSECTIONS
}

#[cfg(test)]
use tests::max_intersections;

/// Gaussians that may be visible: not culled, not too faint, without NaN in the fields that decide
/// it. Excludes Gaussians whose colour is not finite, which would spoil every pixel they touch.
fn visible<T: Real>(
    gaussians: Range<usize>,
    [packed, colors, opacities]: [&[T]; 3],
    args: &RasterizeArgs,
) -> Vec<u32> {
    let channels = colors.len() / opacities.len().max(1);
    let are_finite = |gaussians: Range<usize>| {
        let colors = &colors[gaussians.start * channels..gaussians.end * channels];
        colors.iter().fold(true, |all, c| all & c.is_finite())
    };
    let all_are = are_finite(gaussians.clone());
    let alpha_min = T::of(args.settings.alpha_min);
    let (mut visible, mut count) = (vec![0; gaussians.len()], 0);
    for n in gaussians {
        let (extent, opacity) = (packed[n * PROJECTED_WIDTH + PROJECTED_EXTENT], opacities[n]);
        let is_seen = (extent > T::ZERO) & (opacity >= alpha_min) & opacity.is_finite();
        // Written unconditionally: the branch would be mispredicted about half of the time.
        visible[count] = n as u32;
        count += usize::from(is_seen & (all_are || are_finite(n..n + 1)));
    }
    visible.truncate(count);
    visible
}

/// The lists of one camera. An intersection is a splat and a tile that it touches.
#[derive(Debug)]
pub(super) struct TileLists {
    /// The Gaussian of each listed splat, ascending.
    pub(super) listed: Vec<u32>,
    /// End of the emitted intersections of each listed splat.
    ends: Vec<u32>,
    /// Sorted position of each emitted intersection, by tile and depth.
    places: Vec<AtomicU32>,
    /// Listed splat of each intersection, sorted by tile, and front to back within a tile.
    splats: Vec<u32>,
    /// `tiles[t]..tiles[t + 1]`: the sorted intersections of tile t; tiles are in row-major order.
    tiles: Vec<u32>,
}

impl TileLists {
    /// Builds the lists of one camera and its listed splats from packed splats `[N, 9]`, colours
    /// `[N, D]` and opacities `[N]`. The caller keeps `kept` bytes per intersection.
    pub(super) fn new<T: Real>(
        [packed, colors, opacities]: [&[T]; 3],
        args: &RasterizeArgs,
        kept: usize,
    ) -> Result<(Self, Vec<Splat<T>>), OpError> {
        let count = opacities.len();
        let visible: Vec<Vec<u32>> = (0..count.div_ceil(SEARCHED))
            .into_par_iter()
            .map(|unit| {
                let gaussians = unit * SEARCHED..count.min((unit + 1) * SEARCHED);
                visible(gaussians, [packed, colors, opacities], args)
            })
            .collect();
        let listed = visible.concat();

        let grid = Grid::new(args);
        let mut splats = Uncleared::<Splat<T>>::new(listed.len());
        let mut depths = Uncleared::<T>::new(listed.len());
        let mut emitted = |keeps| -> Vec<Emitted> {
            let emission = Emission::new([packed, colors, opacities], args, keeps);
            splats
                .chunks(CHUNK)
                .into_par_iter()
                .zip(depths.chunks(CHUNK))
                .zip(listed.par_chunks(CHUNK))
                .map(|((splats, depths), listed)| {
                    let (splats, depths) = (splats.overwritten(), depths.overwritten());
                    emit(&emission, listed, splats, depths)
                })
                .collect()
        };
        // If there may be too many, count them before keeping any.
        let limit = max_intersections();
        let each = bytes_per_intersection(kept);
        let most = listed.len() as u64 * grid.tiles() as u64;
        if most > limit || lacking(most.saturating_mul(each)).is_some() {
            let intersections = emitted(false).iter().map(|part| part.intersections).sum();
            check_intersections(intersections, limit)?;
            check_memory(intersections, each)?;
        }
        let emitted = emitted(true);

        let lists = ByTile::new(&emitted, listed.len(), grid).sorted(listed, &depths.written());
        Ok((lists, splats.written()))
    }

    /// Number of intersections.
    pub(super) fn intersections(&self) -> usize {
        self.splats.len()
    }

    /// Splats of a tile, front to back.
    pub(super) fn tile(&self, tile: usize) -> &[u32] {
        &self.splats[self.tiles[tile] as usize..self.tiles[tile + 1] as usize]
    }

    /// Sorted intersections of a row of tiles.
    pub(super) fn row_of_tiles(&self, ty: usize, grid: Grid) -> Range<usize> {
        let [first, last] = [ty, ty + 1].map(|row| self.tiles[row * grid.columns] as usize);
        first..last
    }

    /// Emitted intersections of a listed splat.
    #[inline(always)]
    pub(super) fn emitted(&self, splat: usize) -> Range<usize> {
        let first = splat.checked_sub(1).map_or(0, |before| self.ends[before]);
        first as usize..self.ends[splat] as usize
    }

    /// Sorted position of an emitted intersection, if it exists.
    #[inline(always)]
    pub(super) fn place(&self, emitted: usize) -> Option<usize> {
        let place = self.places.get(emitted)?;
        Some(place.load(Relaxed) as usize)
    }
}

#[cfg(test)]
mod tests {
    use core::cell::Cell;

    use super::*;
    use crate::backend::{OpInputs, RasterizeBackend, RasterizeTensors};
    use crate::cpu::buffer::tensor;
    use crate::{ImageSize, ProjectSettings, Projected, RasterizeSettings, project, rasterize};
    use burn::backend::Flex;
    use burn::tensor::{Device, Tensor, TensorData};

    thread_local! {
        /// Lets a test lower the limit on its thread; no test can list 2^32 intersections.
        static LIMIT: Cell<u64> = const { Cell::new(MAX_INTERSECTIONS) };
    }

    pub(super) fn max_intersections() -> u64 {
        LIMIT.get()
    }

    fn small_picture() -> RasterizeArgs {
        RasterizeArgs {
            size: ImageSize {
                width: 3,
                height: 2,
            },
            settings: Default::default(),
            backward: false,
            errors: Default::default(),
        }
    }

    #[test]
    fn intersections_are_refused_from_the_first_one_that_cannot_be_indexed() {
        for intersections in [0, 1, 1 << 31, MAX_INTERSECTIONS] {
            assert_eq!(
                check_intersections(intersections, MAX_INTERSECTIONS),
                Ok(())
            );
        }
        for intersections in [1 << 32, (1 << 32) + 5, 1 << 40, u64::MAX] {
            let error = check_intersections(intersections, MAX_INTERSECTIONS).unwrap_err();
            let message = error.to_string();
            assert!(message.contains(&intersections.to_string()), "{message}");
            assert!(message.contains("4294967295"), "{message}");
        }
    }

    #[test]
    fn what_is_culled_faint_or_not_finite_is_not_visible() {
        let args = small_picture();
        let count = 12;
        let row = [1.0f32, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 3.0, 3.0];
        let mut packed = vec![row; count];
        let (mut colors, mut opacities) = (vec![[0.5f32; 2]; count], vec![0.5f32; count]);
        let all = |packed: &[[f32; 9]], colors: &[[f32; 2]], opacities: &[f32], from: usize| {
            let inputs = [packed.as_flattened(), colors.as_flattened(), opacities];
            visible(from..count, inputs, &args)
        };
        let expected: Vec<u32> = (0..count as u32).collect();
        assert_eq!(all(&packed, &colors, &opacities, 0), expected);

        packed[1][PROJECTED_EXTENT] = 0.0;
        packed[2][PROJECTED_EXTENT] = f32::NAN;
        opacities[4] = 0.003;
        opacities[5] = f32::NAN;
        opacities[6] = f32::INFINITY;
        assert_eq!(all(&packed, &colors, &opacities, 1), [3, 7, 8, 9, 10, 11]);
        colors[8][1] = f32::NAN;
        colors[10][0] = f32::NEG_INFINITY;
        assert_eq!(all(&packed, &colors, &opacities, 0), [0, 3, 7, 9, 11]);
    }

    /// One long splat across a 48 x 48 image, whose bounding box touches all nine tiles.
    fn diagonal(device: &Device) -> (Projected, Tensor<2>, Tensor<1>) {
        let tensor = |values: Vec<f32>, shape: Vec<usize>| TensorData::new(values, shape);
        let at = |values: Vec<f32>, shape: Vec<usize>| {
            Tensor::<2>::from_data(tensor(values, shape), device)
        };
        let angle = core::f32::consts::FRAC_PI_8;
        let viewmat = [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ];
        let projected = project(
            at(vec![0.0, 0.0, 1.0], vec![1, 3]),
            at(vec![angle.cos(), 0.0, 0.0, angle.sin()], vec![1, 4]),
            at(vec![0.12, 0.005, 0.01], vec![1, 3]),
            Tensor::<3>::from_data([viewmat], device),
            at(vec![60.0, 60.0, 24.0, 24.0], vec![1, 4]),
            ImageSize {
                width: 48,
                height: 48,
            },
            &ProjectSettings::default(),
        );
        let colors = at(vec![1.0], vec![1, 1]);
        let opacities = Tensor::from_data(tensor(vec![0.9], vec![1]), device);
        (projected.unwrap(), colors, opacities)
    }

    #[test]
    fn too_many_intersections_are_an_error_of_the_op_and_not_a_panic() {
        for tracked in [false, true] {
            let device = Device::flex();
            let device = if tracked { device.autodiff() } else { device };
            let (projected, mut colors, opacities) = diagonal(&device);
            if tracked {
                colors = colors.require_grad();
            }
            let render = |limit: u64| {
                LIMIT.set(limit);
                let settings = RasterizeSettings::default();
                let rendered = rasterize(
                    &projected,
                    colors.clone(),
                    opacities.clone(),
                    None,
                    &settings,
                );
                LIMIT.set(MAX_INTERSECTIONS);
                rendered
            };
            let intersections = match render(0) {
                Err(OpError::TooManyIntersections {
                    intersections,
                    limit: 0,
                    ..
                }) => intersections,
                other => panic!("{other:?}"),
            };
            // Fewer than the nine tiles of the bounding box, as only listed tiles count.
            assert!(
                (3..9).contains(&intersections),
                "{intersections} intersections"
            );
            assert!(render(intersections).is_ok());
            assert_eq!(
                render(intersections - 1).unwrap_err(),
                OpError::TooManyIntersections {
                    op: "rasterize",
                    intersections,
                    limit: intersections - 1
                }
            );
        }
    }

    #[test]
    fn an_image_that_was_not_rendered_is_zero_and_so_are_its_gradients() {
        let args = small_picture();
        let row = vec![1.0f32, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 3.0, 3.0];
        let inputs = OpInputs(RasterizeTensors {
            packed: tensor(row, [1, 1, PROJECTED_WIDTH]),
            colors: tensor(vec![1.0f32], [1, 1, 1]),
            opacities: tensor(vec![0.5f32], [1, 1]),
            background: Some(tensor(vec![1.0f32], [1, 1])),
            absgrad: Some(tensor(vec![0.0f32; 2], [1, 1, 2])),
        });
        LIMIT.set(0);
        let (image, state) = Flex::rasterize_tracked(inputs.clone(), &args);
        LIMIT.set(MAX_INTERSECTIONS);
        assert!(args.errors.error().is_some());
        assert_eq!(image.as_slice::<f32>(), Some(&[0.0; 12][..]));

        let grad = tensor(vec![1.0f32; 12], [1, 2, 3, 2]);
        let grads = Flex::rasterize_backward(inputs, state, grad, &args, [true; 5].into());
        let grads: [_; 5] = grads.into();
        for (grad, length) in grads.iter().zip([PROJECTED_WIDTH, 1, 1, 1, 2]) {
            let grad = grad.as_ref().and_then(|grad| grad.as_slice::<f32>());
            assert_eq!(grad, Some(&vec![0.0; length][..]));
        }
    }
}
