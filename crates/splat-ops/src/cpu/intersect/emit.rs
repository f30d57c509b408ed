//! Splats of a view, and the tiles that each reaches.
//!
//! Works on several splats at once, as SIMD code. Data-dependent counts (rows of tiles, tiles per
//! row) avoid branches where possible, as those would be mispredicted about half of the time.

use super::super::real::Real;
use super::super::simd::{LANES, Lanes, vectorized};
use super::super::splat::{GROUP, NUMBERS, Splat};
use super::super::tiles::{Grid, TILE};
use crate::backend::PROJECTED_WIDTH;
use crate::settings::RasterizeArgs;

/// Rows of tiles examined at once for all splats. Few splats reach more.
const ROWS: usize = 4;

/// Tiles of a row written at once, even if a splat reaches fewer.
const RUN: usize = 4;

/// Inputs and settings that all splats of a view share.
pub(super) struct Emission<'a, T> {
    packed: &'a [T],
    colors: &'a [T],
    opacities: &'a [T],
    alpha_min: T,
    grid: Grid,
    keeps: bool,
}

/// Tiles of some splats.
pub(super) struct Emitted {
    /// Tiles splat by splat, row by row, if kept.
    pub(super) tiles: Vec<u32>,
    /// End of the tiles of each splat.
    pub(super) ends: Vec<u32>,
    /// Number of intersections, kept or not.
    pub(super) intersections: u64,
}

impl<'a, T: Real> Emission<'a, T> {
    /// Counts tiles, and keeps them if asked to.
    pub(super) fn new(
        [packed, colors, opacities]: [&'a [T]; 3],
        args: &RasterizeArgs,
        keeps: bool,
    ) -> Self {
        Self {
            packed,
            colors,
            opacities,
            alpha_min: T::of(args.settings.alpha_min),
            grid: Grid::new(args),
            keeps,
        }
    }
}

vectorized! {
    /// Splats of some Gaussians with their depths, and their tiles.
    pub(super) fn emit<T: Real, const FMA: bool>(
        emission: &Emission<T>,
        listed: &[u32],
        splats: &mut [Splat<T>],
        depths: &mut [T],
    ) -> Emitted {
        let mut emitted = Emitted {
            tiles: Vec::with_capacity(4 * listed.len()),
            ends: Vec::with_capacity(listed.len()),
            intersections: 0,
        };
        let mut block = Block::new();
        let outputs = splats.chunks_mut(LANES).zip(depths.chunks_mut(LANES));
        for (listed, (splats, depths)) in listed.chunks(LANES).zip(outputs) {
            block.load(emission, listed, depths);
            block.prepare(emission.alpha_min);
            for (lane, splat) in splats.iter_mut().enumerate() {
                *splat = block.splat(lane % LANES);
            }
            let before = emitted.tiles.len();
            block.emit(emission.grid, splats, &mut emitted);
            emitted.intersections += (emitted.tiles.len() - before) as u64;
            if !emission.keeps {
                emitted.tiles.clear();
            }
        }
        emitted
    }
}

/// Several splats, one per lane.
struct Block<T> {
    /// Mean and inverse Cholesky factor of a packed splat, and the opacity.
    given: [Lanes<T>; 6],
    /// The splats, one row per number.
    splats: [Lanes<T>; NUMBERS],
    /// First channels of the colours.
    colors: [[T; GROUP]; LANES],
    /// Half heights of the ellipses.
    heights: Lanes<T>,
}

impl<T: Real> Block<T> {
    fn new() -> Self {
        Self {
            given: [[T::ZERO; LANES]; 6],
            splats: [[T::ZERO; LANES]; NUMBERS],
            colors: [[T::ZERO; GROUP]; LANES],
            heights: [T::ZERO; LANES],
        }
    }

    /// Loads up to [`LANES`] Gaussians. Further lanes keep their old contents.
    #[inline(always)]
    fn load(&mut self, emission: &Emission<T>, listed: &[u32], depths: &mut [T]) {
        let channels = emission.colors.len() / emission.opacities.len().max(1);
        for (lane, (n, depth)) in listed.iter().zip(depths).enumerate() {
            let n = *n as usize;
            let row = &emission.packed[n * PROJECTED_WIDTH..][..PROJECTED_WIDTH];
            *depth = row[2];
            let opacity = emission.opacities[n];
            let given = [row[0], row[1], row[3], row[4], row[5], opacity];
            for (column, value) in self.given.iter_mut().zip(given) {
                column[lane % LANES] = value;
            }
            let color = &emission.colors[n * channels..(n + 1) * channels];
            for (channel, value) in self.colors[lane % LANES].iter_mut().zip(color) {
                *channel = *value;
            }
        }
    }

    #[inline(always)]
    fn splat(&self, lane: usize) -> Splat<T> {
        let numbers = core::array::from_fn(|i| self.splats[i][lane]);
        Splat::from_numbers(numbers, self.colors[lane])
    }

    #[inline(always)]
    fn prepare(&mut self, alpha_min: T) {
        for lane in 0..LANES {
            let given = core::array::from_fn(|i| self.given[i][lane]);
            let (splat, height) = Splat::new(given, alpha_min);
            let numbers = splat.into_numbers();
            for i in 0..numbers.len() {
                self.splats[i][lane] = numbers[i];
            }
            self.heights[lane] = height;
        }
    }

    /// Adds the tiles of the splats.
    #[inline(always)]
    fn emit(&self, grid: Grid, splats: &[Splat<T>], emitted: &mut Emitted) {
        let (mut first, mut after) = ([0; LANES], [0; LANES]);
        for lane in 0..LANES {
            let (mean, half) = (self.splats[1][lane], self.heights[lane]);
            [first[lane], after[lane]] = rows_of_tiles(mean, half, grid);
        }
        let highest = (0..splats.len()).map(|lane| after[lane] - first[lane]);
        let rows = highest.max().unwrap_or(0).clamp(0, ROWS as i32) as usize;
        let (mut starts, mut lengths) = ([[0; LANES]; ROWS], [[0; LANES]; ROWS]);
        for k in 0..rows {
            for lane in 0..LANES {
                let row = first[lane] + k as i32;
                let [start, end] = tiles_of_row(&self.splat(lane), row, grid);
                let length = if row < after[lane] { end - start } else { 0 };
                starts[k][lane] = start;
                lengths[k][lane] = length;
            }
        }
        let tiles = &mut emitted.tiles;
        for (lane, splat) in splats.iter().enumerate() {
            let lane = lane % LANES;
            for k in 0..rows {
                write_run(starts[k][lane], lengths[k][lane], tiles);
            }
            for row in first[lane] + ROWS as i32..after[lane] {
                let [start, end] = tiles_of_row(splat, row, grid);
                write_run(start, end - start, tiles);
            }
            emitted.ends.push(tiles.len() as u32);
        }
    }
}

/// Adds a run of adjacent tiles.
#[inline(always)]
fn write_run(start: i32, length: i32, tiles: &mut Vec<u32>) {
    let (start, length) = (start as u32, length.max(0) as usize);
    let before = tiles.len();
    let run: [u32; RUN] = core::array::from_fn(|i| start + i as u32);
    tiles.extend_from_slice(&run);
    if length <= RUN {
        tiles.truncate(before + length);
    } else {
        tiles.extend(start + RUN as u32..start + length as u32);
    }
}

/// Range of tile rows that an ellipse of this height reaches, with half a pixel of slack.
#[inline(always)]
fn rows_of_tiles<T: Real>(mean: T, half: T, grid: Grid) -> [i32; 2] {
    tiles_between([mean - half, mean + half], T::of(0.5), grid.rows)
}

/// Range of tiles in a row whose box of pixel centres touches the ellipse.
#[inline(always)]
fn tiles_of_row<T: Real>(splat: &Splat<T>, row: i32, grid: Grid) -> [i32; 2] {
    let top = T::of_index(row * TILE as i32) + T::of(0.5) - splat.mean[1];
    let rows = [top, top + T::of((TILE - 1) as f64)];
    let (left, is_left) = splat.farthest(-T::ONE, rows);
    let (right, is_right) = splat.farthest(T::ONE, rows);
    let ends = [splat.mean[0] + left, splat.mean[0] + right];
    let [first, after] = tiles_between(ends, T::of(1e-3), grid.columns);
    let start = row * grid.columns as i32;
    let after = if is_left & is_right { after } else { first };
    [start + first, start + after]
}

/// Range of tiles, out of `count` in a row or column, that an interval reaches, with some slack.
// Branch-free and in the precision of the op: in f64 with saturating casts it would dominate the
// time of the lists. Rounding to nearest after adding a half gives the next integer; the extra
// ten-thousandth breaks ties.
#[inline(always)]
fn tiles_between<T: Real>([low, high]: [T; 2], slack: T, count: usize) -> [i32; 2] {
    let (half, tie, count) = (T::of(0.5), T::of(1e-4), T::of(count as f64));
    let next = |x: T, tie: T| {
        let at = (x - half) * T::of(1.0 / TILE as f64) + half + tie;
        at.greatest(T::ZERO).least(count).nearest()
    };
    // Distance from a tile's first pixel centre to its last.
    let last = T::of((TILE - 1) as f64);
    [next(low - slack - last, -tie), next(high + slack, tie)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ImageSize;
    use rand::{RngExt, SeedableRng};

    /// Compared with brute force over every pixel: no tile with a visible pixel may be missing, and
    /// a tile without one may be listed only if the ellipse passes between its pixel centres.
    #[test]
    fn the_tiles_agree_with_brute_force_over_pixels() {
        const SIZE: [usize; 2] = [83, 141];
        let args = RasterizeArgs {
            size: ImageSize {
                width: SIZE[0] as u32,
                height: SIZE[1] as u32,
            },
            settings: Default::default(),
            backward: false,
            errors: Default::default(),
        };
        let grid = Grid::new(&args);
        assert!(
            grid.rows > 2 * ROWS,
            "some splats have to be higher than the lanes' rows"
        );
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        let (mut packed, mut opacities) = (Vec::new(), Vec::new());
        for _ in 0..3_000 {
            let long: f64 = 10f64.powf(rng.random_range(-0.3..2.5));
            let short = (long * 10f64.powf(rng.random_range(-3.0..0.0))).max(0.55);
            let (sin, cos) = rng.random_range(0.0..core::f64::consts::TAU).sin_cos();
            let a = (long * cos).powi(2) + (short * sin).powi(2);
            let b = (long * long - short * short) * sin * cos;
            let w22 = (a / (long * short).powi(2)).sqrt();
            let (x, y) = (
                rng.random_range(-40.0..123.0),
                rng.random_range(-40.0..180.0),
            );
            let row = [x, y, 1.0, 1.0 / a.sqrt(), -b / a * w22, w22, 1.0, 1.0, 1.0];
            packed.extend(row.map(|v: f64| v as f32));
            opacities.push(rng.random_range(1.0 / 254.0..1.0f64) as f32);
        }
        let listed: Vec<u32> = (0..opacities.len() as u32).collect();
        let colors: Vec<f32> = (0..2 * listed.len()).map(|i| i as f32).collect();
        let mut splats = vec![Splat::default(); listed.len()];
        let mut depths = vec![0.0; listed.len()];
        let mut emitted = |keeps| {
            let emission = Emission::new([&packed, &colors, &opacities], &args, keeps);
            emit(&emission, &listed, &mut splats, &mut depths)
        };
        let counted = emitted(false);
        let Emitted {
            tiles,
            ends,
            intersections,
        } = emitted(true);
        assert_eq!(
            (counted.intersections, counted.tiles.len()),
            (intersections, 0)
        );
        assert_eq!(intersections, tiles.len() as u64);
        assert_eq!(ends.len(), listed.len());
        assert!(depths.iter().all(|depth| *depth == 1.0));
        for (splat, color) in splats.iter().zip(colors.as_chunks::<2>().0) {
            assert_eq!(splat.color, [color[0], color[1], 0.0, 0.0]);
        }

        let (mut kept, mut needed, mut first) = (0, 0, 0);
        for ((row, opacity), end) in packed.chunks_exact(9).zip(&opacities).zip(ends) {
            let own = &tiles[first..end as usize];
            first = end as usize;
            let mut is_listed = vec![false; grid.tiles()];
            for tile in own {
                assert!(!is_listed[*tile as usize], "tile {tile} twice: {row:?}");
                is_listed[*tile as usize] = true;
            }
            kept += own.len();

            let mut visible = vec![false; grid.tiles()];
            let wide: Vec<f64> = row.iter().map(|v| f64::from(*v)).collect();
            for y in 0..SIZE[1] {
                for x in 0..SIZE[0] {
                    let (dx, dy) = (x as f64 + 0.5 - wide[0], y as f64 + 0.5 - wide[1]);
                    let (z1, z2) = (wide[3] * dx, wide[4] * dx + wide[5] * dy);
                    let alpha = f64::from(*opacity) * (-(z1 * z1 + z2 * z2) / 2.0).exp();
                    if alpha >= splat_core::ALPHA_MIN {
                        visible[y / TILE * grid.columns + x / TILE] = true;
                    }
                }
            }
            needed += visible.iter().filter(|v| **v).count();
            for (tile, (visible, is_listed)) in visible.iter().zip(&is_listed).enumerate() {
                assert!(
                    !visible || *is_listed,
                    "tile {tile} dropped: {row:?} {opacity}"
                );
            }
        }
        // Needles pass between pixel centres, and the last tiles extend beyond the image.
        assert!(
            kept as f64 <= 1.10 * needed as f64,
            "{kept} tiles for {needed}"
        );
    }
}
