//! Projection of Gaussians to screen splats, and its gradient.
//!
//! With the Jacobian J of the camera at the mean, for a pinhole with p = W mean + t = (x, y, z) in
//! camera space and u = x/z, v = y/z clamped near the view:
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
//! `a c - b b` would lose the determinant of a needle in single precision; the minors keep it. V
//! and e are in units of the splat's own size (`k` pixels), so that nothing overflows or
//! underflows, whether the splat is a millionth of a pixel or a million images wide. Camera models
//! differ in the screen mean, J, depth and domain only: each is a `Lens`, in a file of its own.

mod camera;
mod distorted;
mod fisheye;
mod gradient;
mod opencv;
mod pinhole;
mod splat;
#[cfg(test)]
mod tests;

use core::marker::PhantomData;
use core::ops::Range;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use self::camera::{COEFFICIENTS, Camera, Lens};
use self::distorted::Distorted;
use self::fisheye::OpenCvFisheye;
use self::gradient::splat_backward;
use self::opencv::OpenCv;
use self::pinhole::Pinhole;
use self::splat::{Gaussian, Splat};
use super::buffer::{Buffer, tensor};
use super::real::Real;
use super::simd::{LANES, Lanes, for_each_block, vectorized};
use super::uninit::Uncleared;
use crate::backend::{
    OpInputs, PROJECTED_WIDTH, ProjectBackend, ProjectGradients, ProjectInputs, ProjectOps,
    ProjectTensors,
};
use crate::settings::{CameraModel, ProjectArgs};

/// Gaussians per unit of parallel work. Fixed, so that sums over Gaussians have a fixed order.
const CHUNK: usize = 512;
/// Columns of a Gaussian: mean, quaternion, scales.
const GAUSSIAN: usize = 10;
/// Columns of a splat that carry a gradient: all but the extents.
const GRADED: usize = 7;
/// Columns of a camera's gradient: W, t, then fx, fy, cx, cy, then the coefficients.
const CAMERA: usize = 16 + COEFFICIENTS;

type Tensors<X> = ProjectTensors<X, Option<X>>;

/// The inputs.
struct Inputs<'a, T, L> {
    means: &'a [T],
    quats: &'a [T],
    scales: &'a [T],
    cameras: Vec<Camera<T, L>>,
}

impl<'a, T: Real, L: Lens<T>> Inputs<'a, T, L> {
    fn new(buffers: &'a Tensors<Buffer>, args: &ProjectArgs) -> Self {
        let viewmats = buffers.viewmats.slice::<T>();
        let intrinsics = buffers.intrinsics.slice::<T>();
        // A pinhole has neither.
        let lens = |buffer: &'a Option<Buffer>, width: usize, camera: usize| {
            let values = buffer.as_ref().map_or(&[][..], Buffer::slice::<T>);
            values
                .get(width * camera..width * (camera + 1))
                .unwrap_or(&[])
        };
        let cameras = viewmats.chunks_exact(16).zip(intrinsics.chunks_exact(4));
        Self {
            means: buffers.means.slice(),
            quats: buffers.quats.slice(),
            scales: buffers.scales.slice(),
            cameras: cameras
                .enumerate()
                .map(|(index, (viewmat, intrinsics))| {
                    let coefficients = lens(&buffers.distortion, L::COEFFICIENTS, index);
                    let domain = lens(&buffers.domain, 2, index);
                    Camera::new(viewmat, intrinsics, coefficients, domain, args)
                })
                .collect(),
        }
    }

    fn count(&self) -> usize {
        self.means.len() / 3
    }

    /// Loads up to [`LANES`] Gaussians as columns. Unused lanes hold a quaternion of length zero,
    /// which is culled.
    fn load(&self, rows: impl Iterator<Item = usize>) -> [Lanes<T>; GAUSSIAN] {
        let mut columns = [[T::ZERO; LANES]; GAUSSIAN];
        for (lane, n) in rows.enumerate() {
            let mean = &self.means[3 * n..3 * n + 3];
            let quat = &self.quats[4 * n..4 * n + 4];
            let scale = &self.scales[3 * n..3 * n + 3];
            // One part after the other; a loop over chained parts is slower.
            for (column, value) in columns[..3].iter_mut().zip(mean) {
                column[lane % LANES] = *value;
            }
            for (column, value) in columns[3..7].iter_mut().zip(quat) {
                column[lane % LANES] = *value;
            }
            for (column, value) in columns[7..].iter_mut().zip(scale) {
                column[lane % LANES] = *value;
            }
        }
        columns
    }
}

#[inline(always)]
fn gaussian<T: Real>(columns: &[Lanes<T>; GAUSSIAN], lane: usize) -> Gaussian<T> {
    let at = |column: usize| columns[column][lane];
    Gaussian {
        mean: [at(0), at(1), at(2)],
        quat: [at(3), at(4), at(5), at(6)],
        scale: [at(7), at(8), at(9)],
    }
}

vectorized! {
    /// Packed columns of a block of splats; zero if culled.
    fn project_lanes<T: Real, with L: Lens<T>, const FMA: bool>(
        gaussians: &[Lanes<T>; GAUSSIAN],
        camera: &Camera<T, L>,
        packed: &mut [Lanes<T>; PROJECTED_WIDTH],
    ) {
        for lane in 0..LANES {
            let splat = Splat::new(gaussian(gaussians, lane), camera);
            for column in 0..PROJECTED_WIDTH {
                packed[column][lane] = if splat.visible { splat.packed[column] } else { T::ZERO };
            }
        }
    }
}

impl ProjectOps for Flex {
    fn project(OpInputs(inputs): ProjectInputs<Self>, args: ProjectArgs) -> FlexTensor {
        in_precision!(inputs.means, forward, inputs, &args)
    }
}

impl ProjectBackend for Flex {
    fn project_backward(
        OpInputs(inputs): ProjectInputs<Self>,
        grad_packed: FlexTensor,
        args: &ProjectArgs,
        needs_grad: ProjectTensors<bool>,
    ) -> ProjectGradients<Self> {
        in_precision!(
            inputs.means,
            backward,
            inputs,
            grad_packed,
            args,
            needs_grad
        )
    }
}

fn forward<T: Real>(
    _: PhantomData<T>,
    inputs: Tensors<FlexTensor>,
    args: &ProjectArgs,
) -> FlexTensor {
    match args.model {
        CameraModel::Pinhole => forward_with::<T, Pinhole<T>>(inputs, args),
        CameraModel::OpenCv => forward_with::<T, Distorted<OpenCv<T>>>(inputs, args),
        CameraModel::OpenCvFisheye => forward_with::<T, Distorted<OpenCvFisheye<T>>>(inputs, args),
    }
}

fn forward_with<T: Real, L: Lens<T>>(
    inputs: Tensors<FlexTensor>,
    args: &ProjectArgs,
) -> FlexTensor {
    let buffers = inputs.map_inputs(Buffer::new);
    let inputs = Inputs::<T, L>::new(&buffers, args);
    let (c, n) = (inputs.cameras.len(), inputs.count());
    let mut packed = Uncleared::<T>::new(c * n * PROJECTED_WIDTH);
    let parts = packed.chunks_of_each(c, CHUNK * PROJECTED_WIDTH);
    parts.into_par_iter().for_each(|(camera, first, part)| {
        let first = first / PROJECTED_WIDTH;
        let blocks = part.overwritten().chunks_mut(LANES * PROJECTED_WIDTH);
        for (first, packed) in (first..).step_by(LANES).zip(blocks) {
            let count = packed.len() / PROJECTED_WIDTH;
            let gaussians = inputs.load(first..first + count);
            let mut columns = [[T::ZERO; LANES]; PROJECTED_WIDTH];
            project_lanes(&gaussians, &inputs.cameras[camera], &mut columns);
            for (lane, row) in packed.chunks_exact_mut(PROJECTED_WIDTH).enumerate() {
                for (value, column) in row.iter_mut().zip(&columns) {
                    *value = column[lane];
                }
            }
        }
    });
    tensor(packed.written(), [c, n, PROJECTED_WIDTH])
}

vectorized! {
    /// Gradients of a block of Gaussians in one camera, and their contribution to the camera's
    /// gradient, if wanted; zero if culled.
    fn project_lanes_backward<T: Real, with L: Lens<T>, const FMA: bool>(
        gaussians: &[Lanes<T>; GAUSSIAN],
        camera: &Camera<T, L>,
        grad: &[Lanes<T>; GRADED],
        gradients: &mut [Lanes<T>; GAUSSIAN],
        of_camera: Option<&mut [Lanes<T>; CAMERA]>,
    ) {
        match of_camera {
            Some(of_camera) => lanes_backward::<T, L, true>(gaussians, camera, grad, gradients, of_camera),
            None => {
                let nowhere = &mut [[T::ZERO; LANES]; CAMERA];
                lanes_backward::<T, L, false>(gaussians, camera, grad, gradients, nowhere);
            }
        }
    }
}

#[inline(always)]
fn lanes_backward<T: Real, L: Lens<T>, const OF_CAMERA: bool>(
    gaussians: &[Lanes<T>; GAUSSIAN],
    camera: &Camera<T, L>,
    grad: &[Lanes<T>; GRADED],
    gradients: &mut [Lanes<T>; GAUSSIAN],
    of_camera: &mut [Lanes<T>; CAMERA],
) {
    for lane in 0..LANES {
        let gaussian = gaussian(gaussians, lane);
        let splat = Splat::new(gaussian, camera);
        let g = splat_backward(
            gaussian,
            camera,
            &splat,
            core::array::from_fn(|i| grad[i][lane]),
        );
        let kept = |value: T| if splat.visible { value } else { T::ZERO };
        for i in 0..3 {
            gradients[i][lane] = kept(g.camera.mean[i]);
            gradients[7 + i][lane] = kept(g.scale[i]);
        }
        for i in 0..4 {
            gradients[3 + i][lane] = kept(g.quat[i]);
        }
        if OF_CAMERA {
            for i in 0..3 {
                for j in 0..3 {
                    of_camera[3 * i + j][lane] += kept(g.camera.w[i][j]);
                }
                of_camera[9 + i][lane] += kept(g.camera.t[i]);
            }
            for i in 0..4 {
                of_camera[12 + i][lane] += kept(g.camera.intrinsics[i]);
            }
            for i in 0..L::COEFFICIENTS {
                of_camera[16 + i][lane] += kept(g.camera.coefficients[i]);
            }
        }
    }
}

/// Gradients of one chunk of Gaussians, in the output.
struct Chunk<'a, T> {
    rows: Range<usize>,
    means: &'a mut [T],
    quats: &'a mut [T],
    scales: &'a mut [T],
    /// True if gradients of the cameras are wanted too.
    of_cameras: bool,
}

impl<T: Real> Chunk<'_, T> {
    /// Adds the gradients through one camera; returns the camera's gradient.
    fn add<L: Lens<T>>(
        &mut self,
        inputs: &Inputs<T, L>,
        camera: &Camera<T, L>,
        grad: &[T],
    ) -> [T; CAMERA] {
        let mut of_camera = [[T::ZERO; LANES]; CAMERA];
        // Most splats of most views have no gradient: culled, covered or too faint.
        let is_graded = |row: usize| {
            let graded = &grad[row * PROJECTED_WIDTH..][..GRADED];
            graded.iter().fold(false, |any, g| any | (*g != T::ZERO))
        };
        for_each_block(self.rows.clone(), is_graded, |rows| {
            self.add_block(rows, inputs, camera, grad, &mut of_camera);
        });
        of_camera.map(|lanes| lanes.into_iter().fold(T::ZERO, |sum, value| sum + value))
    }

    fn add_block<L: Lens<T>>(
        &mut self,
        rows: &[usize],
        inputs: &Inputs<T, L>,
        camera: &Camera<T, L>,
        grad: &[T],
        of_camera: &mut [Lanes<T>; CAMERA],
    ) {
        let gaussians = inputs.load(rows.iter().copied());
        let mut graded = [[T::ZERO; LANES]; GRADED];
        for (lane, row) in rows.iter().enumerate() {
            for (column, value) in graded.iter_mut().zip(&grad[row * PROJECTED_WIDTH..]) {
                column[lane] = *value;
            }
        }
        let mut gradients = [[T::ZERO; LANES]; GAUSSIAN];
        let of_camera = self.of_cameras.then_some(of_camera);
        project_lanes_backward(&gaussians, camera, &graded, &mut gradients, of_camera);
        for (lane, row) in rows.iter().enumerate() {
            let i = row - self.rows.start;
            for (sums, columns) in [
                (&mut self.means[3 * i..3 * i + 3], &gradients[..3]),
                (&mut self.quats[4 * i..4 * i + 4], &gradients[3..7]),
                (&mut self.scales[3 * i..3 * i + 3], &gradients[7..]),
            ] {
                for (sum, column) in sums.iter_mut().zip(columns) {
                    *sum += column[lane % LANES];
                }
            }
        }
    }
}

fn backward<T: Real>(
    _: PhantomData<T>,
    inputs: Tensors<FlexTensor>,
    grad: FlexTensor,
    args: &ProjectArgs,
    needed: ProjectTensors<bool>,
) -> ProjectGradients<Flex> {
    match args.model {
        CameraModel::Pinhole => backward_with::<T, Pinhole<T>>(inputs, grad, args, needed),
        CameraModel::OpenCv => backward_with::<T, Distorted<OpenCv<T>>>(inputs, grad, args, needed),
        CameraModel::OpenCvFisheye => {
            backward_with::<T, Distorted<OpenCvFisheye<T>>>(inputs, grad, args, needed)
        }
    }
}

fn backward_with<T: Real, L: Lens<T>>(
    inputs: Tensors<FlexTensor>,
    grad_packed: FlexTensor,
    args: &ProjectArgs,
    needs_grad: ProjectTensors<bool>,
) -> ProjectGradients<Flex> {
    let buffers = inputs.map_inputs(Buffer::new);
    let inputs = Inputs::<T, L>::new(&buffers, args);
    let grad = Buffer::new(grad_packed);
    let grad = grad.slice::<T>();
    let (c, n) = (inputs.cameras.len(), inputs.count());

    let [mut means, mut quats, mut scales] = [3, 4, 3].map(|width| Uncleared::<T>::new(n * width));
    let of_cameras: Vec<Vec<[T; CAMERA]>> = means
        .chunks(3 * CHUNK)
        .into_par_iter()
        .zip(quats.chunks(4 * CHUNK))
        .zip(scales.chunks(3 * CHUNK))
        .enumerate()
        .map(|(chunk, ((means, quats), scales))| {
            let mut chunk = Chunk {
                rows: chunk * CHUNK..n.min((chunk + 1) * CHUNK),
                means: means.cleared(),
                quats: quats.cleared(),
                scales: scales.cleared(),
                of_cameras: needs_grad.viewmats || needs_grad.intrinsics || needs_grad.distortion,
            };
            let views = inputs
                .cameras
                .iter()
                .zip(grad.chunks_exact(n * PROJECTED_WIDTH));
            views
                .map(|(camera, grad)| chunk.add(&inputs, camera, grad))
                .collect()
        })
        .collect();

    let mut cameras = vec![[T::ZERO; CAMERA]; c];
    for chunk in &of_cameras {
        for (sum, camera) in cameras.iter_mut().zip(chunk) {
            for (sum, value) in sum.iter_mut().zip(camera) {
                *sum += *value;
            }
        }
    }
    let [means, quats, scales] = [means, quats, scales].map(Uncleared::written);
    ProjectTensors {
        means: needs_grad.means.then(|| tensor(means, [n, 3])),
        quats: needs_grad.quats.then(|| tensor(quats, [n, 4])),
        scales: needs_grad.scales.then(|| tensor(scales, [n, 3])),
        viewmats: needs_grad
            .viewmats
            .then(|| tensor(viewmat_gradients(&cameras), [c, 4, 4])),
        intrinsics: (needs_grad.intrinsics).then(|| tensor(columns(&cameras, 12, 4), [c, 4])),
        distortion: needs_grad.distortion.then(|| {
            let k = L::COEFFICIENTS;
            tensor(columns(&cameras, 16, k), [c, k])
        }),
        domain: None,
    }
}

fn columns<T: Real>(cameras: &[[T; CAMERA]], first: usize, width: usize) -> Vec<T> {
    let of_camera = |camera: &[T; CAMERA]| camera[first..first + width].to_vec();
    cameras.iter().flat_map(of_camera).collect()
}

fn viewmat_gradients<T: Real>(cameras: &[[T; CAMERA]]) -> Vec<T> {
    let mut values = Vec::with_capacity(cameras.len() * 16);
    for camera in cameras {
        for (row, t) in camera[..9].chunks_exact(3).zip(&camera[9..12]) {
            values.extend_from_slice(row);
            values.push(*t);
        }
        values.extend([T::ZERO; 4]);
    }
    values
}
