//! View-dependent colours, and the vector-Jacobian product (3DGS section 4).
//!
//! ```text
//! colour = max(Σ_k Y_k(d / |d|) coefficient_k + 1/2, 0),   d = mean - centre
//! ```
//! A channel below zero gets no gradient; one that is exactly zero does. Directions are computed
//! where they are used. Gradients of Gaussians are summed over cameras inside one unit; those of
//! the centres over blocks of Gaussians and then over the blocks, in order and without atomics.
//!
//! Where Gaussians have different degrees, the rows of their coefficients are given by starts. The
//! loops are those of the highest degree; what a Gaussian does not have is neither read nor
//! written, and counts as zero, bit for bit.
//!
//! If the packed splats are given, Gaussians culled by a camera are not evaluated: they are black
//! and pass no gradient.
//!
//! Floor, with K = `(degree + 1)²`. Forward: per Gaussian that a camera sees, 12 bytes of mean and
//! 12 K of coefficients read; per camera and Gaussian, 4 read and 12 written; about 9 K + 25
//! operations per camera and seen Gaussian. Gradients: 12 + 12 K read per seen Gaussian; per
//! camera, 12 for each Gaussian and 4 more for each seen one; 12 + 12 K written; about 24 K + 40
//! operations per camera and seen Gaussian. Gradients of centres, if wanted, read and compute that
//! once more.

mod backward;

use cubecl::ir::ElemType;
use cubecl::prelude::*;
use splat_core::{
    PROJECTED_EXTENT, PROJECTED_WIDTH, SH_DEGREE_MAX, ShColorSettings, sh_coefficient_count,
};

pub use self::backward::sh_colors_backward;
use crate::bytes::{Bytes, Sizes};
use crate::launch::{Buffer, F16, F32, HalfBuffer, per_element};
use crate::math::{Vec3, is_below_zero};
use crate::sh::{basis, inverse_length, usable_degree};

/// Floors of the forward pass and of the gradient, for one camera.
pub(crate) fn floor(sizes: &Sizes) -> [Bytes; 2] {
    let (n, seen) = (sizes.gaussians, sizes.visible);
    let coefficients = 12 * sh_coefficient_count(sizes.degree) as u64;
    [
        Bytes {
            read: (12 + coefficients) * seen + 4 * n,
            written: 12 * n,
        },
        Bytes {
            read: (16 + coefficients) * seen + 12 * n,
            written: (12 + coefficients) * n,
        },
    ]
}

/// Coefficients of the higher degrees [N, R, 3], or [K, 1, 3] with starts, as stored. Sums are in
/// single precision.
#[derive(Clone, Debug)]
pub enum ShRest {
    /// In single precision.
    Exact(Buffer),
    /// In half precision: half of the bytes, with a relative error of up to 2^-11 each.
    Half(HalfBuffer),
}

impl ShRest {
    fn len(&self) -> usize {
        match self {
            Self::Exact(values) => values.len(),
            Self::Half(values) => values.len(),
        }
    }
}

/// Inputs of the colours.
#[derive(Clone, Debug)]
pub struct ShColorInputs {
    /// Coefficients of degree 0 [N, 1, 3].
    pub sh0: Buffer,
    /// Coefficients of the higher degrees [N, R, 3], or [K, 1, 3] with starts, if any.
    pub sh_rest: Option<ShRest>,
    /// R; not read with starts.
    pub stored: usize,
    /// First row of the coefficients of each Gaussian, and the end K, [N + 1], if each has those of
    /// its own degree. Whoever gives them has checked that they ascend by 0, 3, 8 or 15 from 0 to
    /// K.
    pub starts: Option<Buffer>,
    /// World positions [N, 3].
    pub means: Buffer,
    /// Camera centres [C, 3].
    pub centers: Buffer,
    /// Packed splats [C, N, 9], to skip culled ones.
    pub seen: Option<Buffer>,
}

impl ShColorInputs {
    fn gaussians(&self) -> usize {
        let count = (self.means.len() / 3).min(self.sh0.len() / 3);
        match (&self.sh_rest, &self.starts) {
            (Some(_), Some(starts)) => count.min(starts.len().saturating_sub(1)),
            (Some(rest), None) if self.stored > 0 => count.min(rest.len() / (3 * self.stored)),
            _ => count,
        }
    }

    /// The starts, if there are any.
    fn starts(&self) -> Option<BufferArg> {
        let starts = self.starts.as_ref().filter(|_| self.sh_rest.is_some());
        starts.map(Buffer::arg)
    }

    fn cameras(&self) -> usize {
        self.centers.len() / 3
    }

    fn degree(&self, degree: usize) -> usize {
        let stored = match (&self.sh_rest, &self.starts) {
            (None, _) => 0,
            (Some(_), None) => self.stored,
            // Each Gaussian has its own.
            (Some(_), Some(_)) => sh_coefficient_count(SH_DEGREE_MAX) - 1,
        };
        usable_degree(degree, 1 + stored)
    }

    /// The packed splats, or a buffer in their place; and whether they are read.
    fn seen(&self) -> (BufferArg, bool) {
        match &self.seen {
            Some(packed) => (packed.arg(), true),
            None => (self.sh0.arg(), false),
        }
    }

    /// A buffer in place of coefficients that are not read.
    fn rest(&self) -> (BufferArg, ElemType) {
        match &self.sh_rest {
            Some(ShRest::Exact(values)) => (values.arg(), F32),
            Some(ShRest::Half(values)) => (values.arg(), F16),
            None => (self.sh0.arg(), F32),
        }
    }
}

/// A Gaussian relative to a camera: d / |d| and 1 / |d|.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Sight {
    unit: Vec3,
    inverse: f32,
}

#[cube]
fn sight(means: &[f32], centers: &[f32], gaussian: usize, camera: usize) -> Sight {
    let d = Vec3::load(means, gaussian * 3).sub(Vec3::load(centers, camera * 3));
    let inverse = inverse_length(d);
    Sight {
        unit: d.scale(inverse),
        inverse,
    }
}

/// Coefficients of a Gaussian beyond degree 0: where the first number is, and how many there are.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Own {
    from: usize,
    count: usize,
}

/// The coefficients of a Gaussian: `stored` of each, or those that the starts give it.
#[cube]
fn own(starts: &ComptimeOption<&[u32]>, gaussian: usize, stored: usize) -> Own {
    let mut from = gaussian * stored;
    let mut count = stored;
    #[comptime]
    if let ComptimeOption::Some(starts) = starts {
        from = starts[gaussian] as usize;
        count = starts[gaussian + 1] as usize - from;
    }
    Own {
        from: from * 3,
        count,
    }
}

#[cube]
fn coefficient<R: Float>(rest: &[R], at: usize) -> Vec3 {
    Vec3::new(
        f32::cast_from(rest[at]),
        f32::cast_from(rest[at + 1]),
        f32::cast_from(rest[at + 2]),
    )
}

/// The coefficient of function k > 0; zero, and not read, if it is beyond those that a Gaussian has
/// of its own.
#[cube]
fn own_coefficient<R: Float>(rest: &[R], own: Own, k: usize, #[comptime] ragged: bool) -> Vec3 {
    if comptime!(ragged) {
        let mut red = 0.0f32;
        let mut green = 0.0f32;
        let mut blue = 0.0f32;
        if k <= own.count {
            let found = coefficient::<R>(rest, own.from + (k - 1) * 3);
            red = found.x;
            green = found.y;
            blue = found.z;
        }
        Vec3::new(red, green, blue)
    } else {
        coefficient::<R>(rest, own.from + (k - 1) * 3)
    }
}

/// True if a camera sees a Gaussian, or if visibility is not asked for.
#[cube]
fn is_seen(packed: &[f32], index: usize, #[comptime] asked: bool) -> bool {
    if comptime!(asked) {
        packed[index * PROJECTED_WIDTH + PROJECTED_EXTENT] > 0.0f32
    } else {
        true.runtime()
    }
}

/// The colour before the clamp. Fused multiply-adds are spelled out, so that the gradient finds the
/// same sign.
#[cube]
fn unclamped<R: Float>(
    sh0: &[f32],
    rest: &[R],
    y: &Array<f32>,
    gaussian: usize,
    own: Own,
    #[comptime] degree: usize,
    #[comptime] ragged: bool,
) -> Vec3 {
    let first = Vec3::load(sh0, gaussian * 3).scale(y[0]);
    let mut red = first.x;
    let mut green = first.y;
    let mut blue = first.z;
    #[unroll]
    for k in 1..comptime!(sh_coefficient_count(degree)) {
        let coefficient = own_coefficient::<R>(rest, own, k, ragged);
        red = fma(y[k], coefficient.x, red);
        green = fma(y[k], coefficient.y, green);
        blue = fma(y[k], coefficient.z, blue);
    }
    Vec3::new(red + 0.5f32, green + 0.5f32, blue + 0.5f32)
}

/// Clamps at zero; keeps NaN.
#[cube]
fn clamped(value: f32) -> f32 {
    select(is_below_zero(value), 0.0f32, value)
}

#[cube(launch)]
fn sh_colors_forward<R: Float>(
    sh0: &[f32],
    rest: &[R],
    means: &[f32],
    centers: &[f32],
    packed: &[f32],
    starts: ComptimeOption<&[u32]>,
    colors: &mut [f32],
    gaussians: u32,
    cameras: u32,
    stored: u32,
    #[comptime] degree: usize,
    #[comptime] asked: bool,
    #[comptime] ragged: bool,
    #[define(R)] _stored_as: ElemType,
) {
    let gaussians = gaussians as usize;
    let index = ABSOLUTE_POS;
    if index < gaussians * cameras as usize {
        if is_seen(packed, index, asked) {
            let gaussian = index % gaussians;
            let sight = sight(means, centers, gaussian, index / gaussians);
            let mut y = Array::<f32>::new(comptime!(sh_coefficient_count(degree)));
            basis(sight.unit, &mut y, degree);
            let own = own(&starts, gaussian, stored as usize);
            let color = unclamped::<R>(sh0, rest, &y, gaussian, own, degree, ragged);
            Vec3::new(clamped(color.x), clamped(color.y), clamped(color.z))
                .store(colors, index * 3);
        } else {
            Vec3::new(0.0f32, 0.0f32, 0.0f32).store(colors, index * 3);
        }
    }
}

/// Colours [C, N, 3]. The degree is limited to [`SH_DEGREE_MAX`] and to
/// the stored coefficients.
pub fn sh_colors(client: &Client, inputs: &ShColorInputs, settings: ShColorSettings) -> Buffer {
    let (gaussians, cameras) = (inputs.gaussians(), inputs.cameras());
    let colors = Buffer::empty(client, cameras * gaussians * 3);
    let (rest, stored_as) = inputs.rest();
    let (packed, asked) = inputs.seen();
    let starts = inputs.starts();
    let ragged = starts.is_some();
    if let Some((count, dim)) = per_element(cameras * gaussians) {
        sh_colors_forward::launch(
            client,
            count,
            dim,
            inputs.sh0.arg(),
            rest,
            inputs.means.arg(),
            inputs.centers.arg(),
            packed,
            starts.into(),
            colors.arg(),
            gaussians as u32,
            cameras as u32,
            inputs.stored as u32,
            inputs.degree(settings.degree),
            asked,
            ragged,
            stored_as,
        );
    }
    colors
}
