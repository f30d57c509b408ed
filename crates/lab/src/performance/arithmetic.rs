//! Upper limit of the blending speed on this machine at this time: tiles full of splats, with
//! everything in cache.

use std::panic::resume_unwind;
use std::thread;
use std::time::Duration;

use burn::tensor::{Device, Tensor, TensorData};
use serde::Serialize;
use splat_ops::{ImageSize, Projected, RasterizeSettings, rasterize};

use super::stages::Recording;
use super::{PerformanceError, Spread, on_threads};

/// Side of a tile in pixels.
const TILE: u32 = 16;
/// Splats, all blended by every pixel of the tile.
const SPLATS: usize = 256;
/// Tiles per pass, each its own image.
const TILES: usize = 64;
/// Measured passes, after one that is not measured.
const PASSES: usize = 30;

/// 1e9 pairs per second and thread, forward and backward, of the rasteriser's own loops without
/// lists to walk, spans to find, or memory to wait for.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Arithmetic {
    /// Blending.
    pub forward: f64,
    /// Its gradient.
    pub backward: f64,
}

/// Mean of the given number of threads measuring at once, each on its own.
pub(super) fn measure(threads: usize) -> Result<Arithmetic, PerformanceError> {
    let rates: Result<Vec<Arithmetic>, PerformanceError> = thread::scope(|scope| {
        let threads: Vec<_> = (0..threads).map(|_| scope.spawn(alone)).collect();
        threads
            .into_iter()
            .map(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)))
            .collect()
    });
    let rates = rates?;
    let mean =
        |rate: fn(&Arithmetic) -> f64| rates.iter().map(rate).sum::<f64>() / rates.len() as f64;
    Ok(Arithmetic {
        forward: mean(|rate| rate.forward),
        backward: mean(|rate| rate.backward),
    })
}

/// Measures on one thread.
fn alone() -> Result<Arithmetic, PerformanceError> {
    let [forward, backward] = on_threads(1, || {
        let device = Device::flex().autodiff();
        let [packed, colors, opacities] = splats(&device);
        Recording::of(|recording| {
            let mut times = [vec![], vec![]];
            for pass in 0..=PASSES {
                let size = ImageSize {
                    width: TILE,
                    height: TILE,
                };
                let projected = Projected::from_packed(packed.clone(), size)?;
                let opacities = opacities.clone().squeeze_dim::<2>(2);
                let settings = RasterizeSettings::default();
                let rendered = rasterize(&projected, colors.clone(), opacities, None, &settings)?;
                rendered.packed().mean().backward();
                let stages = recording.take();
                let own = |name| {
                    let stages = stages.iter().filter(|stage| stage.name == name);
                    stages
                        .map(|stage| stage.own)
                        .sum::<Duration>()
                        .as_secs_f64()
                };
                if pass > 0 {
                    times[0].push(own("rasterize"));
                    times[1].push(own("rasterize gradient"));
                }
            }
            Ok::<_, PerformanceError>(times)
        })
    })?;
    let pairs = (TILES * SPLATS) as f64 * f64::from(TILE * TILE);
    let rate = |seconds| 1e-9 * pairs / Spread::of(seconds).median;
    Ok(Arithmetic {
        forward: rate(forward),
        backward: rate(backward),
    })
}

/// Tracked packed splats, colours and opacities of every tile: wide enough that every pixel passes
/// every test, and faint enough that light remains behind the last one.
fn splats(device: &Device) -> [Tensor<3>; 3] {
    let (deviation, middle) = (20.0, TILE as f32 / 2.0);
    let tensor = |width: usize, row: &dyn Fn(usize) -> Vec<f32>| {
        let values: Vec<f32> = (0..TILES * SPLATS).flat_map(|i| row(i % SPLATS)).collect();
        Tensor::<3>::from_data(TensorData::new(values, [TILES, SPLATS, width]), device)
            .require_grad()
    };
    let (w, extent) = (1.0 / deviation, 3.0 * deviation);
    let packed = tensor(9, &|i| {
        vec![
            middle,
            middle,
            1.0 + i as f32,
            w,
            0.0,
            w,
            1.0,
            extent,
            extent,
        ]
    });
    let colors = tensor(3, &|i| vec![0.2, 0.5, i as f32 / SPLATS as f32]);
    [packed, colors, tensor(1, &|_| vec![0.02])]
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_ops::rasterize_work;

    #[test]
    fn every_pixel_blends_every_splat() {
        let [packed, colors, opacities] = splats(&Device::flex().autodiff());
        let size = ImageSize {
            width: TILE,
            height: TILE,
        };
        let projected = Projected::from_packed(packed, size).unwrap();
        let opacities = opacities.squeeze_dim::<2>(2);
        let settings = RasterizeSettings::default();
        let work = rasterize_work(&projected, colors, opacities, &settings).unwrap();
        let pairs = TILES * SPLATS * (TILE * TILE) as usize;
        assert_eq!(work.tested as usize, pairs);
        assert_eq!(work.blended as usize, pairs);
    }
}
