//! A copy, for buffers of which a kernel overwrites a part, and to measure the device's memory
//! bandwidth.
//!
//! Floor per value: 4 bytes read, 4 written, no operation. Any memory-bound stage can reach the
//! bandwidth of this kernel.

use std::time::Instant;

use cubecl::future::block_on;
use cubecl::prelude::*;

use crate::launch::{Buffer, per_element};

#[cube(launch)]
fn copy_values(from: &[f32], to: &mut [f32], len: u32) {
    let i = ABSOLUTE_POS;
    if i < len as usize {
        to[i] = from[i];
    }
}

/// The same elements in memory of their own.
pub(crate) fn copied(client: &Client, from: &Buffer) -> Buffer {
    let to = Buffer::empty(client, from.len());
    if let Some((cubes, dim)) = per_element(from.len()) {
        copy_values::launch(client, cubes, dim, from.arg(), to.arg(), from.len() as u32);
    }
    to
}

/// Bytes read and written per second by a kernel that copies `len` floats, one per unit: the best
/// of several runs, each long enough to hide the final wait. Choose `len` larger than the device's
/// caches.
///
/// # Errors
/// The device's error, in words; or that `len` is zero.
pub fn bandwidth(client: &Client, len: usize) -> Result<f64, String> {
    let wait = || block_on(client.sync()).map_err(|error| format!("{error:?}"));
    let from = Buffer::from_f32(client, &vec![1.0; len]);
    let to = Buffer::empty(client, len);
    let copies = |count: usize| {
        wait()?;
        let start = Instant::now();
        for _ in 0..count {
            let (cubes, dim) = per_element(len).ok_or("nothing to copy")?;
            copy_values::launch(client, cubes, dim, from.arg(), to.arg(), len as u32);
        }
        wait()?;
        Ok::<f64, String>(start.elapsed().as_secs_f64())
    };
    // The first run compiles the kernel.
    copies(1)?;
    let count = (LEAST_SECONDS / copies(1)?.max(1e-6))
        .ceil()
        .clamp(1.0, MOST_COPIES) as usize;
    let mut best = f64::INFINITY;
    for _ in 0..RUNS {
        best = best.min(copies(count)? / count as f64);
    }
    Ok(8.0 * len as f64 / best)
}

/// Number of runs, of which the best counts.
const RUNS: usize = 5;
/// Approximate duration of a run, unless it would take more copies than this.
const LEAST_SECONDS: f64 = 0.05;
const MOST_COPIES: f64 = 1000.0;
