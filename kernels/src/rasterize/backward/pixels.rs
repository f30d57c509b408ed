//! The pixels of a unit on the way from back to front, and their sums.

use cubecl::prelude::*;

use super::super::pair::{SHAPE, Shape, Thresholds, UNSEEN, sample};
use super::super::tile::{Place, Plan, pixel_index};
use super::SlotLayout;
use crate::intersect::Grid;

/// The pixels of a unit.
#[derive(CubeType)]
pub(super) struct Pixels {
    /// Transmittance behind the splats that are still to come.
    t: Array<f32>,
    /// Their light and the background's, times the gradient.
    behind: Array<f32>,
    /// How many splats of the list the pixel has walked.
    last: Array<u32>,
    /// Gradient of the pixel's colour, channel by channel.
    g: Array<f32>,
}

#[cube]
impl Pixels {
    /// The pixels, and what they have walked to the `ends` of the blocks and the `longest` of the
    /// tile.
    pub fn load(
        background: &ComptimeOption<&[f32]>,
        transmittance: &[f32],
        walked: &[u32],
        grad_output: &[f32],
        ends: &Shared<[Atomic<u32>]>,
        longest: &Shared<[Atomic<u32>]>,
        grid: Grid,
        place: Place,
        channels: u32,
        first_channel: u32,
        #[comptime] plan: Plan,
        #[comptime] layout: SlotLayout,
        #[comptime] first_launch: bool,
    ) -> Pixels {
        let width = comptime!(layout.width);
        let pixels = comptime!(plan.pixels());
        let mut t = Array::<f32>::new(pixels);
        let mut behind = Array::<f32>::new(pixels);
        let mut last = Array::<u32>::new(pixels);
        let mut g = Array::<f32>::new(comptime!(pixels * width));
        #[unroll]
        for q in 0..pixels {
            let (x, y) = place.pixel(q, plan);
            let (inside, pixel) = pixel_index(grid, place, x, y);
            t[q] = 1.0f32;
            behind[q] = 0.0f32;
            last[q] = 0u32;
            #[unroll]
            for channel in 0..width {
                g[q * width + channel] = 0.0f32;
            }
            if inside {
                let from = pixel * (channels as usize + 1) + first_channel as usize;
                let end = transmittance[pixel];
                t[q] = end;
                last[q] = walked[pixel];
                let mut seen = 0.0f32;
                #[unroll]
                for channel in 0..width {
                    let value = grad_output[from + channel];
                    g[q * width + channel] = value;
                    #[comptime]
                    if let ComptimeOption::Some(background) = background {
                        let at = (place.camera * channels + first_channel) as usize + channel;
                        seen += value * background[at];
                    }
                }
                if comptime!(layout.reads_all_channels()) {
                    #[comptime]
                    if let ComptimeOption::Some(background) = background {
                        // The first one is there already.
                        for channel in 1..channels as usize {
                            let at = place.camera as usize * channels as usize + channel;
                            seen += grad_output[from + channel] * background[at];
                        }
                    }
                }
                if comptime!(first_launch) {
                    seen -= grad_output[from + channels as usize];
                }
                behind[q] = end * seen;
                Atomic::fetch_max(&ends[place.block as usize], last[q]);
                Atomic::fetch_max(&longest[0], last[q]);
            }
        }
        Pixels { t, behind, last, g }
    }

    /// Sums over the pixels of the gradients of the splat that begins at `at`, whose place in the
    /// list is `entry`; the pixels then stand before it. Where the layout
    /// reads all channels, it takes them from `colors` and `grad_output`.
    pub fn gradients(
        &mut self,
        splats: &Shared<[f32]>,
        at: usize,
        entry: u32,
        colors: &[f32],
        grad_output: &[f32],
        splat: usize,
        channels: usize,
        grid: Grid,
        place: Place,
        thresholds: Thresholds,
        #[comptime] plan: Plan,
        #[comptime] layout: SlotLayout,
    ) -> Array<f32> {
        let width = comptime!(layout.width);
        let shape = Shape::load(splats, at);
        let mut color = Array::<f32>::new(width);
        #[unroll]
        for channel in 0..width {
            color[channel] = splats[at + SHAPE + channel];
        }
        let mut color_sums = Array::<f32>::new(width);
        #[unroll]
        for channel in 0..width {
            color_sums[channel] = 0.0f32;
        }
        let mut sum = 0.0f32;
        let mut sum_z1 = 0.0f32;
        let mut sum_z2 = 0.0f32;
        let mut sum_z1_dx = 0.0f32;
        let mut sum_z2_dx = 0.0f32;
        let mut sum_z2_dy = 0.0f32;
        let mut absolute_x = 0.0f32;
        let mut absolute_y = 0.0f32;
        #[unroll]
        for q in 0..comptime!(plan.pixels()) {
            let (x, y) = place.pixel(q, plan);
            let s = sample(shape, x as f32 + 0.5f32, y as f32 + 0.5f32);
            let raw = select(entry < self.last[q], s.raw, UNSEEN);
            let seen = thresholds.seen(raw);
            let alpha = select(seen, thresholds.alpha(raw), 0.0f32);
            let clear = 1.0f32 - alpha;
            let before = self.t[q] / clear;
            let weight = alpha * before;
            let mut dot = 0.0f32;
            if comptime!(layout.reads_all_channels()) {
                let (_, pixel) = pixel_index(grid, place, x, y);
                for channel in 0..channels {
                    let value = grad_output[pixel * (channels + 1) + channel];
                    dot += colors[splat * channels + channel] * value;
                }
            } else {
                #[unroll]
                for channel in 0..width {
                    let value = self.g[q * width + channel];
                    dot += color[channel] * value;
                    if comptime!(layout.colors) {
                        color_sums[channel] += weight * value;
                    }
                }
            }
            if comptime!(layout.shape || layout.absolute) {
                let g_alpha = before * dot - self.behind[q] / clear;
                let g_sigma = select(thresholds.capped(raw), 0.0f32, -g_alpha * raw);
                let g_sigma = select(seen, g_sigma, 0.0f32);
                // Far from the splat a broken one may overflow.
                let g_z1 = g_sigma * select(seen, s.z1, 0.0f32);
                let g_z2 = g_sigma * select(seen, s.z2, 0.0f32);
                if comptime!(layout.absolute) {
                    absolute_x += f32::abs(shape.w11 * g_z1 + shape.w21 * g_z2);
                    absolute_y += f32::abs(shape.w22 * g_z2);
                }
                sum += g_sigma;
                sum_z1 += g_z1;
                sum_z2 += g_z2;
                sum_z1_dx += g_z1 * s.dx;
                sum_z2_dx += g_z2 * s.dx;
                sum_z2_dy += g_z2 * s.dy;
            }
            self.behind[q] += weight * dot;
            self.t[q] = before;
        }

        let mut parts = Array::<f32>::new(comptime!(layout.values()));
        if comptime!(layout.shape) {
            // d = pixel - mean
            parts[0] = -(shape.w11 * sum_z1 + shape.w21 * sum_z2);
            parts[1] = -(shape.w22 * sum_z2);
            parts[2] = sum_z1_dx;
            parts[3] = sum_z2_dx;
            parts[4] = sum_z2_dy;
            parts[5] = -sum / shape.opacity;
        }
        if comptime!(layout.absolute) {
            parts[comptime!(layout.first_absolute())] = absolute_x;
            parts[comptime!(layout.first_absolute() + 1)] = absolute_y;
        }
        if comptime!(layout.colors) {
            #[unroll]
            for channel in 0..width {
                parts[comptime!(layout.first_color()) + channel] = color_sums[channel];
            }
        }
        parts
    }
}
