//! The ellipse of a splat, and the tiles that it may touch.

use cubecl::prelude::*;
use splat_core::{PROJECTED_EXTENT, PROJECTED_WIDTH};

use super::{Grid, TILE};
use crate::math::is_finite;

/// The visible part of a splat: the ellipse sigma <= `cut`.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Footprint {
    /// True if the ellipse exists and is of finite size.
    seen: bool,
    mean_x: f32,
    mean_y: f32,
    w11: f32,
    w21: f32,
    w22: f32,
    /// ln(opacity / alpha_min), slightly widened so that rounding never drops a pixel.
    cut: f32,
    /// Half size of the ellipse's bounding box.
    half_x: f32,
    half_y: f32,
}

#[cube]
impl Footprint {
    pub fn new(
        mean_x: f32,
        mean_y: f32,
        w11: f32,
        w21: f32,
        w22: f32,
        opacity: f32,
        alpha_min: f32,
    ) -> Footprint {
        let ratio = opacity / alpha_min;
        let cut = f32::ln(ratio) * 1.0001f32 + 1e-4f32;
        // Standard deviations along x and y: L = W⁻¹ has l11 = 1/w11, l21 = -w21/(w11 w22), l22 =
        // 1/w22.
        let reach = f32::sqrt(2.0f32 * cut);
        let half_x = reach / w11;
        let slope = w21 / w11;
        let half_y = reach * f32::sqrt(1.0f32 + slope * slope) / w22;
        let finite = is_finite(ratio)
            && is_finite(mean_x)
            && is_finite(mean_y)
            && is_finite(half_x)
            && is_finite(half_y);
        Footprint {
            seen: finite && opacity >= alpha_min,
            mean_x,
            mean_y,
            w11,
            w21,
            w22,
            cut,
            half_x,
            half_y,
        }
    }

    /// True if the ellipse meets the rectangle of the centres of pixels `x..end_x`, `y..end_y`.
    pub fn touches(self, x: u32, end_x: u32, y: u32, end_y: u32) -> bool {
        let dx0 = x as f32 + 0.5f32 - self.mean_x;
        let dy0 = y as f32 + 0.5f32 - self.mean_y;
        let dx1 = end_x as f32 - 0.5f32 - self.mean_x;
        let dy1 = end_y as f32 - 0.5f32 - self.mean_y;
        let beside = dx0 > 0.0f32 || dx1 < 0.0f32;
        let above = dy0 > 0.0f32 || dy1 < 0.0f32;
        // Lowest point of the facing vertical edge: dσ/ddy = 0 at dy = -w21 dx / w22.
        let edge_x = select(dx0 > 0.0f32, dx0, dx1);
        let on_x = min(max(-self.w21 * edge_x / self.w22, dy0), dy1);
        // Lowest point of the facing horizontal edge: dσ/ddx = 0 at dx = -w21 w22 dy / (w11² +
        // w21²).
        let edge_y = select(dy0 > 0.0f32, dy0, dy1);
        let on_y = min(
            max(
                -self.w21 * self.w22 * edge_y / (self.w11 * self.w11 + self.w21 * self.w21),
                dx0,
            ),
            dx1,
        );
        let hit_x = beside && self.sigma_below(edge_x, on_x) <= self.cut;
        let hit_y = above && self.sigma_below(on_y, edge_y) <= self.cut;
        (!beside && !above) || hit_x || hit_y
    }

    /// Lower bound of sigma at (dx, dy) from the mean, lower by its rounding error for long and
    /// thin splats.
    fn sigma_below(self, dx: f32, dy: f32) -> f32 {
        let z1 = self.w11 * dx;
        let along = self.w21 * dx;
        let across = self.w22 * dy;
        let rounding = 1e-6f32 * (f32::abs(along) + f32::abs(across));
        let z2 = max(f32::abs(along + across) - rounding, 0.0f32);
        0.5f32 * (z1 * z1 + z2 * z2)
    }
}

/// Loads the footprint of a splat.
#[cube]
pub(super) fn footprint(
    packed: &[f32],
    opacities: &[f32],
    splat: usize,
    alpha_min: f32,
) -> Footprint {
    let at = splat * PROJECTED_WIDTH;
    let mut f = Footprint::new(
        packed[at],
        packed[at + 1],
        packed[at + 3],
        packed[at + 4],
        packed[at + 5],
        opacities[splat],
        alpha_min,
    );
    f.seen = f.seen && packed[at + PROJECTED_EXTENT] > 0.0f32;
    f
}

/// Range of tiles that the interval mean +- half reaches, of `count` in a row or column, with a
/// slack of half a pixel and one part in 10,000.
#[cube]
fn tile_range(mean: f32, half: f32, count: u32) -> (u32, u32) {
    let reach = half * 1.0001f32 + 0.5f32;
    let tile = TILE as f32;
    let low = (mean - reach - 0.5f32) / tile;
    let high = (mean + reach - 0.5f32) / tile + 1.0f32;
    let limit = count as f32;
    (
        min(max(low, 0.0f32), limit) as u32,
        min(max(high, 0.0f32), limit) as u32,
    )
}

/// Tiles that a splat may touch: a rectangle.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Reach {
    x: u32,
    y: u32,
    columns: u32,
    /// Number of tiles of the box; zero if the splat is not visible.
    pub tiles: u32,
}

#[cube]
impl Reach {
    pub fn new(f: Footprint, grid: Grid) -> Reach {
        let (x, end_x) = tile_range(f.mean_x, f.half_x, grid.columns);
        let (y, end_y) = tile_range(f.mean_y, f.half_y, grid.rows);
        let columns = select(end_x > x, end_x - x, 0u32);
        let rows = select(end_y > y, end_y - y, 0u32);
        Reach {
            x,
            y,
            columns,
            tiles: select(f.seen, columns * rows, 0u32),
        }
    }

    /// The i-th tile of the box in its image, and whether the splat touches it.
    pub fn tile(self, f: Footprint, i: u32, grid: Grid) -> (u32, bool) {
        let columns = max(self.columns, 1u32);
        let column = self.x + i % columns;
        let row = self.y + i / columns;
        let (x, y) = (column * TILE, row * TILE);
        let end_x = min(x + TILE, grid.width);
        let end_y = min(y + TILE, grid.height);
        (
            row * grid.columns + column,
            i < self.tiles && f.touches(x, end_x, y, end_y),
        )
    }
}
