//! One step of Adam (Kingma & Ba 2015) on one parameter, in one pass.
//!
//! ```text
//! m = beta_1 m + (1 - beta_1) g,   v = beta_2 v + (1 - beta_2) g²,   p = p - rate m / (√v + epsilon)
//! ```
//! A gradient whose square is not finite counts as zero. Parameter and moments are overwritten in
//! place if nothing else holds their memory.
//!
//! Floor per value: 16 bytes read, 12 written, about 12 operations; memory-bound. For a row that
//! takes no step, 4 bytes read.

use cubecl::prelude::*;
use splat_core::{AdamGap, AdamRows, AdamStep, RowGroups};

use crate::bytes::{Bytes, Sizes};
use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, cube_count, per_element};
use crate::math::is_finite;
use crate::row_groups::row_of;

/// Weights of the old moments and of the new values, in this order; rate; epsilon.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Numbers {
    keep_1: f32,
    take_1: f32,
    keep_2: f32,
    take_2: f32,
    rate: f32,
    epsilon: f32,
}

/// Parameter and both moments of one value after the step.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Stepped {
    param: f32,
    moment_1: f32,
    moment_2: f32,
}

#[cube]
fn stepped(param: f32, grad: f32, moment_1: f32, moment_2: f32, numbers: Numbers) -> Stepped {
    let g = select(is_finite(grad * grad), grad, 0.0f32);
    let m = moment_1 * numbers.keep_1 + g * numbers.take_1;
    let v = moment_2 * numbers.keep_2 + g * g * numbers.take_2;
    Stepped {
        param: param - m / (f32::sqrt(v) + numbers.epsilon) * numbers.rate,
        moment_1: m,
        moment_2: v,
    }
}

#[cube(launch)]
fn adam_values(
    param: &[f32],
    grad: &[f32],
    moment_1: &[f32],
    moment_2: &[f32],
    param_out: &mut [f32],
    moment_1_out: &mut [f32],
    moment_2_out: &mut [f32],
    numbers: Numbers,
    len: u32,
) {
    let i = ABSOLUTE_POS;
    if i < len as usize {
        let after = stepped(param[i], grad[i], moment_1[i], moment_2[i], numbers);
        param_out[i] = after.param;
        moment_1_out[i] = after.moment_1;
        moment_2_out[i] = after.moment_2;
    }
}

/// True for values other than zeros and NaN, tested on the bits: a device may flush the smallest
/// numbers to zero.
#[cube]
fn is_seen(grad: f32) -> bool {
    let magnitude = u32::reinterpret(grad) & 0x7fff_ffffu32;
    magnitude > 0u32 && magnitude <= 0x7f80_0000u32
}

/// Each workgroup processes `rows` whole rows, at most as many as it has units. `copied` names the
/// results that are not written in place, so that unchanged values must be copied.
#[cube(launch)]
fn adam_seen_rows(
    param: &[f32],
    grad: &[f32],
    moment_1: &[f32],
    moment_2: &[f32],
    param_out: &mut [f32],
    moment_1_out: &mut [f32],
    moment_2_out: &mut [f32],
    numbers: Numbers,
    len: u32,
    width: u32,
    rows: u32,
    #[comptime] copied: [bool; 3],
) {
    let seen = Shared::<[Atomic<u32>]>::new_slice(CUBE_UNITS_USIZE);
    let unit = UNIT_POS as usize;
    let width = width as usize;
    Atomic::store(&seen[unit], 0u32);
    sync_cube();
    let from = CUBE_POS * rows as usize * width;
    let to = min(from + rows as usize * width, len as usize);
    let mut i = from + unit;
    while i < to {
        if is_seen(grad[i]) {
            Atomic::store(&seen[(i - from) / width], 1u32);
        }
        i += CUBE_UNITS_USIZE;
    }
    sync_cube();
    let mut i = from + unit;
    while i < to {
        if Atomic::load(&seen[(i - from) / width]) != 0u32 {
            let after = stepped(param[i], grad[i], moment_1[i], moment_2[i], numbers);
            param_out[i] = after.param;
            moment_1_out[i] = after.moment_1;
            moment_2_out[i] = after.moment_2;
        } else {
            if comptime!(copied[0]) {
                param_out[i] = param[i];
            }
            if comptime!(copied[1]) {
                moment_1_out[i] = moment_1[i];
            }
            if comptime!(copied[2]) {
                moment_2_out[i] = moment_2[i];
            }
        }
        i += CUBE_UNITS_USIZE;
    }
}

/// Steps the rows of some groups; the gradient has rows for these alone. `group` is the number of
/// values of a whole group.
#[cube(launch)]
fn adam_groups(
    param: &[f32],
    grad: &[f32],
    moment_1: &[f32],
    moment_2: &[f32],
    groups: &[u32],
    param_out: &mut [f32],
    moment_1_out: &mut [f32],
    moment_2_out: &mut [f32],
    numbers: Numbers,
    len: u32,
    group: u32,
    width: u32,
    #[comptime] seen_rows: bool,
) {
    let i = ABSOLUTE_POS;
    if i < len as usize {
        let mut steps = true;
        if comptime!(seen_rows) {
            // Every unit looks through its row: groups are few, and their rows in cache.
            let first = i - i % width as usize;
            steps = false;
            for value in 0..width as usize {
                if is_seen(grad[first + value]) {
                    steps = true;
                }
            }
        }
        if steps {
            let at = row_of(groups, i, group as usize);
            let after = stepped(param[at], grad[i], moment_1[at], moment_2[at], numbers);
            param_out[at] = after.param;
            moment_1_out[at] = after.moment_1;
            moment_2_out[at] = after.moment_2;
        }
    }
}

/// Does to the rows of some groups what steps without a gradient do. `gaps` has four numbers for
/// each: what is kept of the first moment and of the second, step, epsilon.
#[cube(launch)]
fn adam_catch_up_groups(
    param: &[f32],
    moment_1: &[f32],
    moment_2: &[f32],
    groups: &[u32],
    gaps: &[f32],
    param_out: &mut [f32],
    moment_1_out: &mut [f32],
    moment_2_out: &mut [f32],
    len: u32,
    group: u32,
) {
    let i = ABSOLUTE_POS;
    if i < len as usize {
        let at = row_of(groups, i, group as usize);
        let gap = i / group as usize * 4;
        let m = moment_1[at];
        let v = moment_2[at];
        param_out[at] = param[at] - m / (f32::sqrt(v) + gaps[gap + 3]) * gaps[gap + 2];
        moment_1_out[at] = m * gaps[gap];
        moment_2_out[at] = v * gaps[gap + 1];
    }
}

/// Floor of a step of all parameters.
pub(crate) fn floor(sizes: &Sizes) -> Bytes {
    let values = sizes.gaussians * sizes.parameters;
    Bytes {
        read: 16 * values,
        written: 12 * values,
    }
}

/// Steps a parameter and its moments, given the gradient. All have one length, in rows of `width`.
pub fn adam(
    client: &Client,
    param: Buffer,
    grad: &Buffer,
    moments: [Buffer; 2],
    step: &AdamStep,
    width: usize,
) -> [Buffer; 3] {
    let [moment_1, moment_2] = moments;
    let buffers = [param, moment_1, moment_2];
    let lens = buffers.each_ref().map(Buffer::len);
    let len = lens.into_iter().fold(grad.len(), usize::min);
    let copied = buffers.each_ref().map(Buffer::is_held);
    let [param, moment_1, moment_2] = buffers;
    let (param, [param_in, param_out]) = param.overwritten(client, 0);
    let (moment_1, [moment_1_in, moment_1_out]) = moment_1.overwritten(client, 2);
    let (moment_2, [moment_2_in, moment_2_out]) = moment_2.overwritten(client, 3);
    let inputs = [param_in, grad.arg(), moment_1_in, moment_2_in];
    let outputs = [param_out, moment_1_out, moment_2_out];
    match step.rows {
        AdamRows::All => all_rows(client, inputs, outputs, step, len),
        AdamRows::Seen => {
            seen_rows(client, inputs, outputs, step, [len, width.max(1)], copied);
        }
    }
    [param, moment_1, moment_2]
}

/// Steps some rows of a parameter and its moments, given the gradient of these rows alone, in rows
/// of `width`. The others keep their values.
pub fn adam_rows(
    client: &Client,
    param: Buffer,
    grad: &Buffer,
    moments: [Buffer; 2],
    step: &AdamStep,
    width: usize,
    rows: &RowGroups,
) -> [Buffer; 3] {
    let [moment_1, moment_2] = moments;
    let buffers = [param, moment_1, moment_2].map(|buffer| buffer.owned(client));
    let len = (rows.len() * width).min(grad.len());
    let fits = buffers
        .iter()
        .all(|buffer| buffer.len() >= rows.count() * width);
    let Some((count, dim)) = per_element(len).filter(|_| fits && width > 0) else {
        return buffers;
    };
    let groups = Buffer::from_u32(client, rows.chosen());
    let [param, moment_1, moment_2] = buffers;
    let (param, [param_in, param_out]) = param.overwritten(client, 0);
    let (moment_1, [moment_1_in, moment_1_out]) = moment_1.overwritten(client, 2);
    let (moment_2, [moment_2_in, moment_2_out]) = moment_2.overwritten(client, 3);
    adam_groups::launch(
        client,
        count,
        dim,
        param_in,
        grad.arg(),
        moment_1_in,
        moment_2_in,
        groups.arg(),
        param_out,
        moment_1_out,
        moment_2_out,
        numbers(step),
        len as u32,
        (rows.size() * width) as u32,
        width as u32,
        step.rows == AdamRows::Seen,
    );
    [param, moment_1, moment_2]
}

/// Does to some rows of a parameter and its moments what steps without a gradient do; a gap for
/// each group. The other rows keep their values.
pub fn adam_catch_up(
    client: &Client,
    param: Buffer,
    moments: [Buffer; 2],
    width: usize,
    rows: &RowGroups,
    gaps: &[AdamGap],
) -> [Buffer; 3] {
    let [moment_1, moment_2] = moments;
    let buffers = [param, moment_1, moment_2].map(|buffer| buffer.owned(client));
    let len = rows.len() * width;
    let fits = gaps.len() == rows.chosen().len()
        && buffers
            .iter()
            .all(|buffer| buffer.len() >= rows.count() * width);
    let Some((count, dim)) = per_element(len).filter(|_| fits) else {
        return buffers;
    };
    let groups = Buffer::from_u32(client, rows.chosen());
    let gaps: Vec<f32> = (gaps.iter())
        .flat_map(|gap| [gap.keep_1, gap.keep_2, gap.step, gap.epsilon].map(|value| value as f32))
        .collect();
    let gaps = Buffer::from_f32(client, &gaps);
    let [param, moment_1, moment_2] = buffers;
    let (param, [param_in, param_out]) = param.overwritten(client, 0);
    let (moment_1, [moment_1_in, moment_1_out]) = moment_1.overwritten(client, 1);
    let (moment_2, [moment_2_in, moment_2_out]) = moment_2.overwritten(client, 2);
    adam_catch_up_groups::launch(
        client,
        count,
        dim,
        param_in,
        moment_1_in,
        moment_2_in,
        groups.arg(),
        gaps.arg(),
        param_out,
        moment_1_out,
        moment_2_out,
        len as u32,
        (rows.size() * width) as u32,
    );
    [param, moment_1, moment_2]
}

fn numbers(step: &AdamStep) -> NumbersLaunch {
    NumbersLaunch::new(
        step.beta_1 as f32,
        (1.0 - step.beta_1) as f32,
        step.beta_2 as f32,
        (1.0 - step.beta_2) as f32,
        step.rate as f32,
        step.epsilon as f32,
    )
}

fn all_rows(
    client: &Client,
    [param, grad, moment_1, moment_2]: [BufferArg; 4],
    [param_out, moment_1_out, moment_2_out]: [BufferArg; 3],
    step: &AdamStep,
    len: usize,
) {
    if let Some((count, dim)) = per_element(len) {
        adam_values::launch(
            client,
            count,
            dim,
            param,
            grad,
            moment_1,
            moment_2,
            param_out,
            moment_1_out,
            moment_2_out,
            numbers(step),
            len as u32,
        );
    }
}

fn seen_rows(
    client: &Client,
    [param, grad, moment_1, moment_2]: [BufferArg; 4],
    [param_out, moment_1_out, moment_2_out]: [BufferArg; 3],
    step: &AdamStep,
    [len, width]: [usize; 2],
    copied: [bool; 3],
) {
    if len == 0 {
        return;
    }
    let rows = (CUBE_UNITS_USIZE / width).max(1);
    adam_seen_rows::launch(
        client,
        cube_count(len.div_ceil(rows * width)),
        CubeDim::new_1d(CUBE_UNITS),
        param,
        grad,
        moment_1,
        moment_2,
        param_out,
        moment_1_out,
        moment_2_out,
        numbers(step),
        len as u32,
        width as u32,
        rows as u32,
        copied,
    );
}
