//! Which splats touch which tiles, in depth order (3DGS section 6).
//!
//! The splats that a camera sees are numbered in the order of their Gaussians, so that memory is read and written one
//! after the other. Each emits its tiles; a counting sort brings these together tile by tile, and each tile sorts its own
//! few by (depth, index).

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rayon::prelude::*;

use super::buffer::overwritten;
use super::real::Real;
use crate::OpError;
use crate::backend::PROJECTED_WIDTH;
use crate::settings::RasterizeArgs;

/// Side of a tile in pixels.
pub(super) const TILE: usize = 16;

/// Splats per unit of parallel work.
pub(super) const CHUNK: usize = 256;

/// Pairs of a tile and a splat of one camera that can be listed: they are counted in 32 bits.
const MAX_PAIRS: u64 = u32::MAX as u64;

/// The one place that decides how many pairs are too many. Asked before any list is allocated.
fn check_pairs(pairs: u64, limit: u64) -> Result<(), OpError> {
    if pairs <= limit {
        return Ok(());
    }
    Err(OpError::TooManyPairs {
        op: "rasterize",
        pairs,
        limit,
    })
}

#[cfg(not(test))]
fn max_pairs() -> u64 {
    MAX_PAIRS
}

#[cfg(test)]
use tests::max_pairs;

/// Parts that the counting sort is done in, at most: each counts the tiles for itself.
const PARTS: usize = 16;

/// The lists of one camera. An instance is one (splat, tile) pair.
#[derive(Debug, Clone)]
pub(super) struct TileLists {
    /// The Gaussian of each listed splat, ascending.
    pub(super) listed: Vec<u32>,
    /// `emitted[i]..emitted[i + 1]`: the emitted instances of the i-th listed splat.
    pub(super) emitted: Vec<u32>,
    /// Where each emitted instance went when they were sorted by tile and depth.
    pub(super) position: Vec<u32>,
    /// The listed splat of each instance, sorted by tile, front to back in each tile.
    splats: Vec<u32>,
    /// `tiles[t]..tiles[t + 1]`: the sorted instances of tile t, tiles in rows.
    tiles: Vec<u32>,
}

/// The part of a splat that can pass the `alpha_min` test: the ellipse `sigma <= cut`, cut being `ln(opacity / alpha_min)`,
/// widened by a little so that rounding never drops a pixel.
#[derive(Clone, Copy)]
pub(super) struct Footprint<T> {
    pub(super) mean: [T; 2],
    pub(super) w11: T,
    pub(super) w21: T,
    pub(super) w22: T,
    pub(super) opacity: T,
    /// Half size of the ellipse's bounding box.
    pub(super) half: [T; 2],
    /// Along a row at dy the ellipse is `|dx - slope dy| <= sqrt(reach - shrink dy^2) inverse_a`.
    pub(super) slope: T,
    pub(super) reach: T,
    pub(super) shrink: T,
    pub(super) inverse_a: T,
}

/// Whether a packed splat can be seen anywhere: not culled, not too faint. NaN is not seen.
#[inline(always)]
fn is_visible<T: Real>(row: &[T], opacity: T, args: &RasterizeArgs) -> bool {
    row[7] > T::ZERO && opacity >= T::of(args.settings.alpha_min) && opacity.is_finite()
}

impl<T: Real> Footprint<T> {
    /// Of a splat that [`is_visible`].
    fn new(row: &[T], opacity: T, args: &RasterizeArgs) -> Self {
        let (w11, w21, w22) = (row[3], row[4], row[5]);
        let cut = (opacity / T::of(args.settings.alpha_min)).ln();
        let cut = cut + T::of(1e-4) * (cut + T::ONE);
        // L = W^-1 has l11 = 1/w11, l21 = -w21/(w11 w22), l22 = 1/w22; covariance = L L^T.
        let (radius, a) = ((cut + cut).sqrt(), w11 * w11 + w21 * w21);
        Self {
            mean: [row[0], row[1]],
            w11,
            w21,
            w22,
            opacity,
            half: [radius / w11, radius * a.sqrt() / (w11 * w22)],
            slope: -w21 * w22 / a,
            reach: (cut + cut) * a,
            shrink: w11 * w22 * w11 * w22,
            inverse_a: T::ONE / a,
        }
    }

    /// The dy of the ellipse's right end, where z2 = 0; the left one lies opposite.
    pub(super) fn end(&self) -> T {
        -self.w21 / self.w22 * self.half[0]
    }

    /// Left and right end of the part of the ellipse between two rows, from the mean: at one of them, or where the whole
    /// ellipse has its end.
    #[inline(always)]
    fn between(&self, dy: [T; 2]) -> [T; 2] {
        let half_width = |dy: T| {
            let discriminant = self.reach - self.shrink * dy * dy;
            discriminant.greatest(T::ZERO).sqrt() * self.inverse_a
        };
        let (middle, half) = (dy.map(|dy| self.slope * dy), dy.map(half_width));
        let left = (middle[0] - half[0]).least(middle[1] - half[1]);
        let right = (middle[0] + half[0]).greatest(middle[1] + half[1]);
        let end = self.end();
        let inside = |y: T| y >= dy[0] && y <= dy[1];
        [
            if inside(-end) { -self.half[0] } else { left },
            if inside(end) { self.half[0] } else { right },
        ]
    }

    /// Tiles of the bounding box: at least as many as [`tiles`](Self::tiles) emits.
    fn tiles_at_most(&self, grid: Grid) -> u64 {
        let columns = tile_range(self.mean[0], self.half[0], grid.columns).len();
        let rows = tile_range(self.mean[1], self.half[1], grid.rows).len();
        columns as u64 * rows as u64
    }

    fn count_tiles(&self, grid: Grid) -> u64 {
        let mut count = 0;
        self.tiles(grid, |_| count += 1);
        count
    }

    /// Calls `emit` with every tile whose box of pixel centres the ellipse touches, row by row.
    #[inline(always)]
    fn tiles(&self, grid: Grid, mut emit: impl FnMut(u32)) {
        let (slack, last) = (T::of(1e-3), T::of((TILE - 1) as f64));
        for ty in tile_range(self.mean[1], self.half[1], grid.rows) {
            let top = T::of((ty * TILE) as f64 + 0.5) - self.mean[1];
            let dy = [
                top.greatest(-self.half[1]),
                (top + last).least(self.half[1]),
            ];
            if dy[0] > dy[1] + slack {
                continue;
            }
            // Most splats lie in one row of tiles, and reach as far as their bounding box does.
            let is_whole = dy[0] == -self.half[1] && dy[1] == self.half[1];
            let [left, right] = if is_whole {
                [-self.half[0], self.half[0]]
            } else {
                self.between(dy)
            };
            let columns = tiles_between(
                self.mean[0] + left - slack - last,
                self.mean[0] + right + slack,
                grid.columns,
            );
            for tx in columns {
                emit((ty * grid.columns + tx) as u32);
            }
        }
    }
}

/// The tiles whose first pixel centre is not left of `low` nor right of `high`, of `count` in a row or column.
// In this precision and without a branch: in f64, and with casts that saturate, it takes most of the time of the lists. The
// nearest integer to a half more is the next one; a ten-thousandth stands for ties.
#[inline(always)]
fn tiles_between<T: Real>(low: T, high: T, count: usize) -> core::ops::Range<usize> {
    let (half, tie, count) = (T::of(0.5), T::of(1e-4), T::of(count as f64));
    let next = |x: T, tie: T| {
        let at = (x - half) * T::of(1.0 / TILE as f64) + half + tie;
        at.greatest(T::ZERO).least(count).nearest() as usize
    };
    next(low, -tie)..next(high, tie)
}

/// The tiles that the interval `mean +- half` reaches, of `count` in a row or column, with half a pixel of slack.
#[inline(always)]
fn tile_range<T: Real>(mean: T, half: T, count: usize) -> core::ops::Range<usize> {
    let (slack, last) = (T::of(0.5), T::of((TILE - 1) as f64));
    tiles_between(mean - half - slack - last, mean + half + slack, count)
}

/// Tiles of an image.
#[derive(Clone, Copy)]
pub(super) struct Grid {
    pub(super) columns: usize,
    pub(super) rows: usize,
}

impl Grid {
    pub(super) fn new(args: &RasterizeArgs) -> Self {
        Self {
            columns: (args.size.width as usize).div_ceil(TILE),
            rows: (args.size.height as usize).div_ceil(TILE),
        }
    }
}

impl TileLists {
    /// Lists for one camera, and the footprints of its listed splats: packed splats `[N, 9]`, colours `[N, D]` and
    /// opacities `[N]`. A splat with a colour that is not finite is in no list: it would be in every pixel it touches.
    pub(super) fn new<T: Real>(
        packed: &[T],
        colors: &[T],
        opacities: &[T],
        args: &RasterizeArgs,
    ) -> Result<(Self, Vec<Footprint<T>>), OpError> {
        let channels = (colors.len() / opacities.len().max(1)).max(1);
        let row = |n: u32| &packed[n as usize * PROJECTED_WIDTH..][..PROJECTED_WIDTH];
        let is_listed = |n: &u32| {
            let color = &colors[*n as usize * channels..][..channels];
            is_visible(row(*n), opacities[*n as usize], args) && color.iter().all(|c| c.is_finite())
        };
        let listed: Vec<u32> = (0..opacities.len() as u32)
            .into_par_iter()
            .with_min_len(CHUNK)
            .filter(is_listed)
            .collect();
        let (footprints, depths): (Vec<Footprint<T>>, Vec<T>) = listed
            .par_iter()
            .with_min_len(CHUNK)
            .map(|n| {
                let row = row(*n);
                (Footprint::new(row, opacities[*n as usize], args), row[2])
            })
            .unzip();

        let limit = max_pairs();
        let grid = Grid::new(args);
        // The exact count costs as much as the lists do: only where the bounding boxes are too many.
        let sum = |count: fn(&Footprint<T>, Grid) -> u64| -> u64 {
            let counts = footprints.par_iter().with_min_len(CHUNK);
            counts.map(|footprint| count(footprint, grid)).sum()
        };
        if check_pairs(sum(Footprint::tiles_at_most), limit).is_err() {
            check_pairs(sum(Footprint::count_tiles), limit)?;
        }

        let emission = Emission::new(&footprints, grid);
        let (mut instances, tiles) = emission.by_tile();
        let position: Vec<AtomicU32> = unset(instances.len());
        let mut rest = &mut instances[..];
        let lists: Vec<(u32, &mut [u32])> = tiles
            .windows(2)
            .map(|ends| {
                let (list, after) =
                    core::mem::take(&mut rest).split_at_mut((ends[1] - ends[0]) as usize);
                rest = after;
                (ends[0], list)
            })
            .collect();
        lists
            .into_par_iter()
            .for_each_init(Vec::new, |keys, (first, list)| {
                keys.clear();
                // Instances are numbered as the splats are: equal depths are in the order of the Gaussians.
                let depth = |instance: u32| depths[emission.owners[instance as usize] as usize];
                keys.extend(
                    list.iter()
                        .map(|instance| depth(*instance).sort_key(*instance)),
                );
                keys.sort_unstable();
                for ((place, splat), key) in (first..).zip(list).zip(&*keys) {
                    let instance = T::index_of(*key) as usize;
                    position[instance].store(place, Relaxed);
                    *splat = emission.owners[instance];
                }
            });
        let lists = Self {
            listed,
            emitted: emission.ends,
            position: position.into_iter().map(AtomicU32::into_inner).collect(),
            splats: instances,
            tiles,
        };
        Ok((lists, footprints))
    }

    /// Number of (splat, tile) pairs.
    pub(super) fn instances(&self) -> usize {
        self.splats.len()
    }

    /// The splats of a tile, front to back.
    pub(super) fn tile(&self, tile: usize) -> &[u32] {
        &self.splats[self.tiles[tile] as usize..self.tiles[tile + 1] as usize]
    }

    /// The sorted instances of a row of tiles.
    pub(super) fn row_of_tiles(&self, ty: usize, grid: Grid) -> core::ops::Range<usize> {
        let [first, last] = [ty, ty + 1].map(|row| self.tiles[row * grid.columns] as usize);
        first..last
    }
}

/// The tiles of all splats, in the order of the splats.
struct Emission {
    /// By instance.
    tiles: Vec<u32>,
    /// By instance: its splat.
    owners: Vec<u32>,
    /// `ends[i]..ends[i + 1]`: the instances of splat i.
    ends: Vec<u32>,
    grid: Grid,
}

impl Emission {
    fn new<T: Real>(footprints: &[Footprint<T>], grid: Grid) -> Self {
        let chunks: Vec<(Vec<u32>, Vec<u32>)> = footprints
            .par_chunks(CHUNK)
            .map(|chunk| {
                let mut tiles = Vec::with_capacity(4 * chunk.len());
                let ends = chunk.iter().map(|footprint| {
                    footprint.tiles(grid, |tile| tiles.push(tile));
                    tiles.len() as u32
                });
                let ends = ends.collect();
                (tiles, ends)
            })
            .collect();
        let total = chunks.iter().map(|(tiles, _)| tiles.len()).sum();
        let mut ends = overwritten::<u32>(footprints.len() + 1);
        let [mut tiles, mut owners] = [(); 2].map(|()| overwritten::<u32>(total));
        ends[0] = 0;
        let (mut of_tiles, mut of_owners) = (&mut tiles[..], &mut owners[..]);
        let mut first = 0;
        let parts: Vec<_> = chunks
            .iter()
            .zip(ends[1..].chunks_mut(CHUNK))
            .enumerate()
            .map(|(chunk, (emitted, ends))| {
                let [tiles, owners] = [&mut of_tiles, &mut of_owners].map(|all| {
                    let (part, rest) = core::mem::take(all).split_at_mut(emitted.0.len());
                    *all = rest;
                    part
                });
                let start = first;
                first += emitted.0.len() as u32;
                (chunk * CHUNK, start, emitted, tiles, owners, ends)
            })
            .collect();
        parts
            .into_par_iter()
            .for_each(|(splat, start, emitted, tiles, owners, ends)| {
                tiles.copy_from_slice(&emitted.0);
                let mut done = 0;
                for ((end, own), splat) in ends.iter_mut().zip(&emitted.1).zip(splat as u32..) {
                    owners[done..*own as usize].fill(splat);
                    done = *own as usize;
                    *end = start + own;
                }
            });
        Self {
            tiles,
            owners,
            ends,
            grid,
        }
    }

    /// The instances, brought together tile by tile in the order in which they were emitted, and where each tile's begin
    /// and the last one's end.
    fn by_tile(&self) -> (Vec<u32>, Vec<u32>) {
        let length = self.tiles.len().div_ceil(PARTS).max(CHUNK);
        let count = self.grid.columns * self.grid.rows;
        let mut counts: Vec<Vec<u32>> = self
            .tiles
            .par_chunks(length)
            .map(|tiles| {
                let mut counts = vec![0; count];
                for tile in tiles {
                    counts[*tile as usize] += 1;
                }
                counts
            })
            .collect();
        // From how many there are to where they go: tile by tile, and in a tile part by part.
        let mut starts = Vec::with_capacity(count + 1);
        let mut next = 0;
        for tile in 0..count {
            starts.push(next);
            for counts in &mut counts {
                let own = core::mem::replace(&mut counts[tile], next);
                next += own;
            }
        }
        starts.push(next);
        // The places of a part are anywhere, but no two parts have one in common.
        let sorted: Vec<AtomicU32> = unset(self.tiles.len());
        self.tiles
            .par_chunks(length)
            .zip(counts)
            .enumerate()
            .for_each(|(part, (tiles, mut next))| {
                for (tile, instance) in tiles.iter().zip((part * length) as u32..) {
                    let place = &mut next[*tile as usize];
                    sorted[*place as usize].store(instance, Relaxed);
                    *place += 1;
                }
            });
        let sorted = sorted.into_iter().map(AtomicU32::into_inner).collect();
        (sorted, starts)
    }
}

/// Memory that several threads write, each its own places. Every place is written before any is read.
fn unset(len: usize) -> Vec<AtomicU32> {
    let values = overwritten::<u32>(len).into_iter();
    values.map(AtomicU32::new).collect()
}

#[cfg(test)]
mod tests {
    use core::cell::Cell;

    use super::*;
    use crate::backend::SplatBackend;
    use crate::cpu::buffer::tensor;
    use crate::{ImageSize, ProjectSettings, Projected, RasterizeSettings, project, rasterize};
    use burn::backend::Flex;
    use burn::tensor::{Device, Tensor, TensorData};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    thread_local! {
        /// A test on this thread may lower the limit: no test can list 2^32 pairs.
        static LIMIT: Cell<u64> = const { Cell::new(MAX_PAIRS) };
    }

    pub(super) fn max_pairs() -> u64 {
        LIMIT.get()
    }

    #[test]
    fn pairs_are_refused_from_the_first_one_that_cannot_be_indexed() {
        for pairs in [0, 1, 1 << 31, MAX_PAIRS] {
            assert_eq!(check_pairs(pairs, MAX_PAIRS), Ok(()));
        }
        for pairs in [1 << 32, (1 << 32) + 5, 1 << 40, u64::MAX] {
            let error = check_pairs(pairs, MAX_PAIRS).unwrap_err();
            let message = error.to_string();
            assert!(message.contains(&pairs.to_string()), "{message}");
            assert!(message.contains("4294967295"), "{message}");
        }
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
    fn too_many_pairs_are_an_error_of_the_op_and_not_a_panic() {
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
                LIMIT.set(MAX_PAIRS);
                rendered
            };
            let pairs = match render(0) {
                Err(OpError::TooManyPairs {
                    pairs, limit: 0, ..
                }) => pairs,
                other => panic!("{other:?}"),
            };
            // Fewer than the nine tiles of the bounding box: what counts is what would be listed.
            assert!((3..9).contains(&pairs), "{pairs} pairs");
            assert!(render(pairs).is_ok());
            assert_eq!(
                render(pairs - 1).unwrap_err(),
                OpError::TooManyPairs {
                    op: "rasterize",
                    pairs,
                    limit: pairs - 1
                }
            );
        }
    }

    #[test]
    fn an_image_that_was_not_rendered_is_zero_and_so_are_its_gradients() {
        let args = RasterizeArgs {
            size: ImageSize {
                width: 3,
                height: 2,
            },
            settings: Default::default(),
            errors: Default::default(),
        };
        let row = vec![1.0f32, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 3.0, 3.0];
        let inputs = || {
            (
                tensor(row.clone(), [1, 1, PROJECTED_WIDTH]),
                tensor(vec![1.0f32], [1, 1, 1]),
                tensor(vec![0.5f32], [1, 1]),
                Some(tensor(vec![1.0f32], [1, 1])),
            )
        };
        LIMIT.set(0);
        let (packed, colors, opacities, background) = inputs();
        let (image, state) = Flex::rasterize_forward(packed, colors, opacities, background, &args);
        LIMIT.set(MAX_PAIRS);
        assert!(args.errors.error().is_some());
        assert_eq!(image.as_slice::<f32>(), Some(&[0.0; 12][..]));

        let (packed, colors, opacities, background) = inputs();
        let grad = tensor(vec![1.0f32; 12], [1, 2, 3, 2]);
        let grads = Flex::rasterize_backward(
            packed, colors, opacities, background, image, state, grad, &args, [true; 4],
        );
        for (grad, length) in grads.iter().zip([PROJECTED_WIDTH, 1, 1, 1]) {
            let grad = grad.as_ref().and_then(|grad| grad.as_slice::<f32>());
            assert_eq!(grad, Some(&vec![0.0; length][..]));
        }
    }

    /// The tile test against brute force over every pixel: no tile that holds a visible pixel may be
    /// missing, and a tile without one may only be listed if its box of pixel centres is touched
    /// between the centres.
    #[test]
    fn tile_test_agrees_with_brute_force_over_pixels() {
        let args = RasterizeArgs {
            size: ImageSize {
                width: 83,
                height: 61,
            },
            settings: Default::default(),
            errors: Default::default(),
        };
        let grid = Grid::new(&args);
        let mut rng = Pcg64::seed_from_u64(3);
        let (mut kept, mut needed) = (0, 0);
        for _ in 0..3_000 {
            let long: f64 = 10f64.powf(rng.random_range(-0.3..2.5));
            let short = (long * 10f64.powf(rng.random_range(-3.0..0.0))).max(0.55);
            let (sin, cos) = rng.random_range(0.0..core::f64::consts::TAU).sin_cos();
            let a = (long * cos).powi(2) + (short * sin).powi(2);
            let b = (long * long - short * short) * sin * cos;
            let det = (long * short).powi(2);
            let w22 = (a / det).sqrt();
            let opacity = rng.random_range(0.002..1.0f64) as f32;
            let row = [
                rng.random_range(-40.0..123.0),
                rng.random_range(-40.0..100.0),
                1.0,
                1.0 / a.sqrt(),
                -b / a * w22,
                w22,
                1.0,
                1.0,
                1.0,
            ]
            .map(|v: f64| v as f32);
            if !is_visible(&row, opacity, &args) {
                assert!(opacity < 1.0 / 255.0);
                continue;
            }
            let footprint = Footprint::new(&row, opacity, &args);
            let mut listed = vec![false; grid.columns * grid.rows];
            footprint.tiles(grid, |tile| listed[tile as usize] = true);
            kept += listed.iter().filter(|l| **l).count();

            let mut visible = vec![false; listed.len()];
            let wide = row.map(f64::from);
            for y in 0..61usize {
                for x in 0..83usize {
                    let (dx, dy) = (x as f64 + 0.5 - wide[0], y as f64 + 0.5 - wide[1]);
                    let (z1, z2) = (wide[3] * dx, wide[4] * dx + wide[5] * dy);
                    let alpha = f64::from(opacity) * (-(z1 * z1 + z2 * z2) / 2.0).exp();
                    if alpha >= 1.0 / 255.0 {
                        visible[y / TILE * grid.columns + x / TILE] = true;
                    }
                }
            }
            needed += visible.iter().filter(|v| **v).count();
            for (tile, (visible, listed)) in visible.iter().zip(&listed).enumerate() {
                assert!(
                    !visible || *listed,
                    "tile {tile} dropped: {row:?} {opacity}"
                );
            }
        }
        // Needles pass between pixel centres, and the last tiles reach beyond the image.
        assert!(
            kept as f64 <= 1.10 * needed as f64,
            "{kept} tiles for {needed}"
        );
    }
}
