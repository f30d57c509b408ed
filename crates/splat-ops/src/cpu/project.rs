//! Projection of Gaussians to screen splats, and its gradient.
//!
//! With p = W mean + t = (x, y, z) in the camera and u = x/z, v = y/z clamped near the view:
//!
//! ```text
//! J = | fx/z   0    -fx u/z |      V = (J W R) diag(s), rows V1, V2
//!     |  0    fy/z  -fy v/z |      m = V1 x V2 (the minors of V)
//!
//! covariance + e I = | a  b |      a = |V1|^2 + e,  b = V1.V2,
//!                    | b  c |      det = |m|^2 + e (|V1|^2 + |V2|^2) + e^2, every term >= 0
//!
//! inverse Cholesky factor: w11 = 1/sqrt(a),  w22 = sqrt(a/det),  w21 = -(b/a) w22
//! ```
//!
//! `a c - b b` would lose the determinant of a needle in single precision; the minors keep it.
//! V and e are taken in units of the splat's own size (`k` pixels), so that nothing over- or underflows, be the splat
//! a millionth of a pixel or a million pictures wide.

use core::marker::PhantomData;

use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::buffer::{Buffer, overwritten, tensor};
use super::math::*;
use super::real::Real;
use crate::backend::PROJECTED_WIDTH;
use crate::settings::ProjectArgs;

/// Splats larger than this many pixels are all alike: constant over any picture.
const SIZE_MAX: f64 = 1e12;

/// Gaussians per unit of parallel work. Fixed, so that sums over Gaussians have a fixed order.
const CHUNK: usize = 512;

/// One camera, in the precision of the op.
struct Camera<T> {
    /// World to camera, 3x3 block.
    w: Mat3<T>,
    t: Vec3<T>,
    fx: T,
    fy: T,
    cx: T,
    cy: T,
    /// Bounds of u and v for the Jacobian.
    u: (T, T),
    v: (T, T),
    width: T,
    height: T,
    near: T,
    far: T,
    /// Square root of `eps2d`.
    blur: T,
    /// Standard deviations to where alpha has fallen from 1 to `alpha_min`.
    reach: T,
}

impl<T: Real> Camera<T> {
    fn new(viewmat: &[T], intrinsics: &[T], args: &ProjectArgs) -> Self {
        let row = |i: usize| [viewmat[4 * i], viewmat[4 * i + 1], viewmat[4 * i + 2]];
        let [fx, fy, cx, cy] = [0, 1, 2, 3].map(|i| intrinsics[i]);
        let (width, height) = (
            T::of(args.size.width.into()),
            T::of(args.size.height.into()),
        );
        let margin = T::of(args.settings.clamp_margin);
        let bounds =
            |f: T, c: T, side: T| (-(c + margin * side) / f, (side - c + margin * side) / f);
        Self {
            w: [row(0), row(1), row(2)],
            t: [viewmat[3], viewmat[7], viewmat[11]],
            fx,
            fy,
            cx,
            cy,
            u: bounds(fx, cx, width),
            v: bounds(fy, cy, height),
            width,
            height,
            near: T::of(args.settings.near),
            far: T::of(args.settings.far),
            blur: T::of(args.settings.eps2d.sqrt()),
            reach: T::of((-2.0 * args.settings.alpha_min.ln()).max(0.0).sqrt()),
        }
    }
}

/// One Gaussian.
#[derive(Clone, Copy)]
struct Gaussian<T> {
    mean: Vec3<T>,
    quat: [T; 4],
    scale: Vec3<T>,
}

/// What the forward computes on its way; the backward computes it again.
struct Splat<T> {
    p: Vec3<T>,
    /// x/z and y/z, clamped.
    u: T,
    v: T,
    u_inside: bool,
    v_inside: bool,
    unit: [T; 4],
    length: T,
    rotation: Mat3<T>,
    /// J W.
    jw: Mat23<T>,
    /// J W R.
    jwr: Mat23<T>,
    /// Unit of length of everything below but `packed`, in pixels.
    k: T,
    /// Larger than `SIZE_MAX`: its shape has no influence.
    flat: bool,
    v1: Vec3<T>,
    v2: Vec3<T>,
    /// Direction of the minors, not normalised, and its length.
    minors: Vec3<T>,
    minors_norm: T,
    /// Length of the minors.
    minors_length: T,
    e: T,
    a: T,
    b: T,
    det: T,
    w11: T,
    w21: T,
    w22: T,
    packed: [T; PROJECTED_WIDTH],
}

impl<T: Real> Splat<T> {
    /// `None`: culled. Comparisons are written so that NaN culls.
    #[inline(always)]
    fn new(g: Gaussian<T>, camera: &Camera<T>) -> Option<Self> {
        let p = add(apply(&camera.w, g.mean), camera.t);
        let [x, y, z] = p;
        if !(z >= camera.near && z <= camera.far) {
            return None;
        }
        let (unit, length) = normalize_quat(g.quat)?;
        let rotation = rotation(unit);

        let (u_free, v_free) = (x / z, y / z);
        let u = u_free.greatest(camera.u.0).least(camera.u.1);
        let v = v_free.greatest(camera.v.0).least(camera.v.1);
        let jw: Mat23<T> = [
            add(
                scale(camera.w[0], camera.fx / z),
                scale(camera.w[2], -camera.fx * u / z),
            ),
            add(
                scale(camera.w[1], camera.fy / z),
                scale(camera.w[2], -camera.fy * v / z),
            ),
        ];
        let jwr = jw.map(|row| apply_transposed(&rotation, row));
        // V over its largest entry, `size` pixels.
        let largest_scale = largest(g.scale);
        let rows = jwr.map(|row| hadamard(row, over(g.scale, largest_scale)));
        let largest_entry = largest(rows[0]).greatest(largest(rows[1]));
        let rows = rows.map(|row| over(row, largest_entry));
        let size = largest_entry * largest_scale;
        let flat = size > T::of(SIZE_MAX);
        let size = size.least(T::of(SIZE_MAX));

        let k = size.greatest(camera.blur);
        let (share, blur) = (size / k, camera.blur / k);
        let [v1, v2] = rows.map(|row| scale(row, share));
        let minors = cross(rows[0], rows[1]);
        let minors_norm = dot(minors, minors).sqrt();
        let minors_length = share * share * minors_norm;
        let (n1, n2) = (dot(v1, v1), dot(v2, v2));
        let e = blur * blur;
        let (a, b) = (n1 + e, dot(v1, v2));
        let det = minors_length * minors_length + e * (n1 + n2) + e * e;

        let mean = [
            camera.fx * u_free + camera.cx,
            camera.fy * v_free + camera.cy,
        ];
        let reach = camera.reach * k;
        let extent = [reach * a.sqrt(), reach * (n2 + e).sqrt()];
        let reaches = mean[0] + extent[0] > T::ZERO
            && mean[0] - extent[0] < camera.width
            && mean[1] + extent[1] > T::ZERO
            && mean[1] - extent[1] < camera.height;
        if !reaches {
            return None;
        }
        let w11 = T::ONE / a.sqrt();
        let w22 = (a / det).sqrt();
        let w21 = -(b / a) * w22;
        let packed = [
            mean[0],
            mean[1],
            z,
            w11 / k,
            w21 / k,
            w22 / k,
            minors_length / det.sqrt(),
            extent[0],
            extent[1],
        ];
        packed.iter().all(|x| x.is_finite()).then_some(Self {
            p,
            u,
            v,
            u_inside: u_free >= camera.u.0 && u_free <= camera.u.1,
            v_inside: v_free >= camera.v.0 && v_free <= camera.v.1,
            unit,
            length,
            rotation,
            jw,
            jwr,
            k,
            flat,
            v1,
            v2,
            minors,
            minors_norm,
            minors_length,
            e,
            a,
            b,
            det,
            w11,
            w21,
            w22,
            packed,
        })
    }
}

/// Gradients of one (camera, Gaussian) pair.
struct Gradient<T> {
    mean: Vec3<T>,
    quat: [T; 4],
    scale: Vec3<T>,
    camera: CameraGradient<T>,
}

/// Gradient of one camera: of W and t, and of fx, fy, cx, cy.
#[derive(Clone, Copy)]
struct CameraGradient<T> {
    w: Mat3<T>,
    t: Vec3<T>,
    intrinsics: [T; 4],
}

impl<T: Real> CameraGradient<T> {
    const ZERO: Self = Self {
        w: [[T::ZERO; 3]; 3],
        t: [T::ZERO; 3],
        intrinsics: [T::ZERO; 4],
    };

    fn add(&mut self, other: &Self) {
        self.w = add3(&self.w, &other.w);
        self.t = add(self.t, other.t);
        for (sum, value) in self.intrinsics.iter_mut().zip(other.intrinsics) {
            *sum += value;
        }
    }
}

/// The vector-Jacobian product of [`Splat::new`], `grad` being the gradient of `packed`.
#[inline(always)]
fn splat_backward<T: Real>(
    g: Gaussian<T>,
    camera: &Camera<T>,
    s: &Splat<T>,
    grad: &[T],
) -> Gradient<T> {
    let half = T::of(0.5);
    let two = T::of(2.0);
    let (e, w11, w22) = (s.e, s.w11, s.w22);
    let compensation = s.packed[6];

    // Inverse Cholesky factor (packed in 1 / pixels, here in 1 / k) and compensation -> a, b, det, |m|.
    let [g11, g21, g22] = [3, 4, 5].map(|i| grad[i] / s.k);
    let g22 = g22 - g21 * s.b / s.a;
    let db = -g21 * w22 / s.a;
    let da = (half * g22 * w22 - g21 * s.w21) / s.a - half * g11 * w11 * w11 * w11;
    let ddet = -half * (g22 * w22 + grad[6] * compensation) / s.det;
    let dlength = two * ddet * s.minors_length + grad[6] / s.det.sqrt();

    // a, b, det, |m| -> V. |m| has no derivative at zero; zero is its least subgradient.
    let dm = if s.minors_norm > T::ZERO {
        scale(s.minors, dlength / s.minors_norm)
    } else {
        [T::ZERO; 3]
    };
    // V in units of k -> V in pixels.
    let pixels = if s.flat { T::ZERO } else { T::ONE / s.k };
    let dv1 = add(
        add(scale(s.v1, two * (da + e * ddet)), scale(s.v2, db)),
        cross(s.v2, dm),
    );
    let dv2 = add(
        add(scale(s.v2, two * e * ddet), scale(s.v1, db)),
        cross(dm, s.v1),
    );
    let (dv1, dv2) = (scale(dv1, pixels), scale(dv2, pixels));

    // V = (J W R) diag(s) -> scales, R, J W.
    let dscale = add(hadamard(dv1, s.jwr[0]), hadamard(dv2, s.jwr[1]));
    let djwr = [hadamard(dv1, g.scale), hadamard(dv2, g.scale)];
    let drotation = add3(&outer(s.jw[0], djwr[0]), &outer(s.jw[1], djwr[1]));
    let djw = djwr.map(|row| apply(&s.rotation, row));

    // J W -> J, W.
    let [_, _, z] = s.p;
    let (fx, fy) = (camera.fx, camera.fy);
    let dj11 = dot(djw[0], camera.w[0]);
    let dj13 = dot(djw[0], camera.w[2]);
    let dj22 = dot(djw[1], camera.w[1]);
    let dj23 = dot(djw[1], camera.w[2]);
    let mut dw = [
        scale(djw[0], fx / z),
        scale(djw[1], fy / z),
        add(scale(djw[0], -fx * s.u / z), scale(djw[1], -fy * s.v / z)),
    ];

    // J -> fx, fy, u, v, z.
    let mut dfx = (dj11 - dj13 * s.u) / z;
    let mut dfy = (dj22 - dj23 * s.v) / z;
    let (mut dcx, mut dcy) = (grad[0], grad[1]);
    let du = -dj13 * fx / z;
    let dv = -dj23 * fy / z;
    let mut dz = grad[2] - (fx * (dj11 - dj13 * s.u) + fy * (dj22 - dj23 * s.v)) / (z * z);

    // Screen mean (not clamped) -> x/z, y/z.
    let (x_z, y_z) = (s.p[0] / z, s.p[1] / z);
    dfx += grad[0] * x_z;
    dfy += grad[1] * y_z;
    let (mut dx_z, mut dy_z) = (grad[0] * fx, grad[1] * fy);

    // Clamp: inside it passes on; outside u = const / fx - cx / fx is the camera's.
    if s.u_inside {
        dx_z += du;
    } else {
        dcx -= du / fx;
        dfx -= du * s.u / fx;
    }
    if s.v_inside {
        dy_z += dv;
    } else {
        dcy -= dv / fy;
        dfy -= dv * s.v / fy;
    }
    dz -= (dx_z * x_z + dy_z * y_z) / z;

    // p = W mean + t.
    let dp = [dx_z / z, dy_z / z, dz];
    dw = add3(&dw, &outer(dp, g.mean));
    Gradient {
        mean: apply_transposed(&camera.w, dp),
        quat: rotation_backward(s.unit, s.length, &drotation),
        scale: dscale,
        camera: CameraGradient {
            w: dw,
            t: dp,
            intrinsics: [dfx, dfy, dcx, dcy],
        },
    }
}

/// The five inputs as slices.
struct Inputs<'a, T> {
    means: &'a [T],
    quats: &'a [T],
    scales: &'a [T],
    cameras: Vec<Camera<T>>,
}

impl<'a, T: Real> Inputs<'a, T> {
    fn new(buffers: &'a [Buffer; 5], args: &ProjectArgs) -> Self {
        let [means, quats, scales, viewmats, intrinsics] =
            buffers.each_ref().map(|buffer| buffer.slice::<T>());
        Self {
            means,
            quats,
            scales,
            cameras: viewmats
                .chunks_exact(16)
                .zip(intrinsics.chunks_exact(4))
                .map(|(viewmat, intrinsics)| Camera::new(viewmat, intrinsics, args))
                .collect(),
        }
    }

    fn count(&self) -> usize {
        self.means.len() / 3
    }

    fn gaussian(&self, n: usize) -> Gaussian<T> {
        Gaussian {
            mean: core::array::from_fn(|i| self.means[3 * n + i]),
            quat: core::array::from_fn(|i| self.quats[4 * n + i]),
            scale: core::array::from_fn(|i| self.scales[3 * n + i]),
        }
    }
}

pub(super) fn forward<T: Real>(
    _: PhantomData<T>,
    inputs: [FlexTensor; 5],
    args: &ProjectArgs,
) -> FlexTensor {
    let buffers = inputs.map(Buffer::new);
    let inputs = Inputs::<T>::new(&buffers, args);
    let (c, n) = (inputs.cameras.len(), inputs.count());
    let mut packed = overwritten::<T>(c * n * PROJECTED_WIDTH);
    if n > 0 {
        for (camera, packed) in inputs
            .cameras
            .iter()
            .zip(packed.chunks_exact_mut(n * PROJECTED_WIDTH))
        {
            packed
                .par_chunks_mut(PROJECTED_WIDTH)
                .with_min_len(CHUNK)
                .enumerate()
                .for_each(|(n, row)| match Splat::new(inputs.gaussian(n), camera) {
                    Some(splat) => row.copy_from_slice(&splat.packed),
                    None => row.fill(T::ZERO),
                });
        }
    }
    tensor(packed, [c, n, PROJECTED_WIDTH])
}

/// Gradients of one chunk of Gaussians, summed over the cameras, and of the cameras, summed over
/// the chunk.
struct ChunkGradient<T> {
    means: Vec<T>,
    quats: Vec<T>,
    scales: Vec<T>,
    cameras: Vec<CameraGradient<T>>,
}

pub(super) fn backward<T: Real>(
    _: PhantomData<T>,
    inputs: [FlexTensor; 5],
    grad_packed: FlexTensor,
    args: &ProjectArgs,
    wanted: [bool; 5],
) -> [Option<FlexTensor>; 5] {
    let buffers = inputs.map(Buffer::new);
    let inputs = Inputs::<T>::new(&buffers, args);
    let grad = Buffer::new(grad_packed);
    let grad = grad.slice::<T>();
    let (c, n) = (inputs.cameras.len(), inputs.count());

    let chunks: Vec<ChunkGradient<T>> = (0..n.div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            let range = chunk * CHUNK..n.min((chunk + 1) * CHUNK);
            let mut sums = ChunkGradient {
                means: vec![T::ZERO; range.len() * 3],
                quats: vec![T::ZERO; range.len() * 4],
                scales: vec![T::ZERO; range.len() * 3],
                cameras: vec![CameraGradient::ZERO; c],
            };
            for (i, index) in range.enumerate() {
                let gaussian = inputs.gaussian(index);
                for (k, camera) in inputs.cameras.iter().enumerate() {
                    let row = (k * n + index) * PROJECTED_WIDTH;
                    let grad = &grad[row..row + PROJECTED_WIDTH];
                    let Some(splat) = Splat::new(gaussian, camera) else {
                        continue;
                    };
                    let gradient = splat_backward(gaussian, camera, &splat, grad);
                    accumulate(&mut sums.means[3 * i..], &gradient.mean);
                    accumulate(&mut sums.quats[4 * i..], &gradient.quat);
                    accumulate(&mut sums.scales[3 * i..], &gradient.scale);
                    sums.cameras[k].add(&gradient.camera);
                }
            }
            sums
        })
        .collect();

    let gather = |field: fn(&ChunkGradient<T>) -> &Vec<T>, width: usize| {
        let mut values = Vec::with_capacity(n * width);
        for chunk in &chunks {
            values.extend_from_slice(field(chunk));
        }
        tensor(values, [n, width])
    };
    let mut cameras = vec![CameraGradient::ZERO; c];
    for chunk in &chunks {
        for (sum, camera) in cameras.iter_mut().zip(&chunk.cameras) {
            sum.add(camera);
        }
    }
    [
        wanted[0].then(|| gather(|chunk| &chunk.means, 3)),
        wanted[1].then(|| gather(|chunk| &chunk.quats, 4)),
        wanted[2].then(|| gather(|chunk| &chunk.scales, 3)),
        wanted[3].then(|| tensor(viewmat_gradients(&cameras), [c, 4, 4])),
        wanted[4].then(|| {
            let values = cameras.iter().flat_map(|camera| camera.intrinsics);
            tensor(values.collect(), [c, 4])
        }),
    ]
}

fn viewmat_gradients<T: Real>(cameras: &[CameraGradient<T>]) -> Vec<T> {
    let mut values = Vec::with_capacity(cameras.len() * 16);
    for camera in cameras {
        for (row, t) in camera.w.iter().zip(camera.t) {
            values.extend_from_slice(row);
            values.push(t);
        }
        values.extend([T::ZERO; 4]);
    }
    values
}

fn accumulate<T: Real>(sums: &mut [T], values: &[T]) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += *value;
    }
}
