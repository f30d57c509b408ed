//! Renders a scene with the ops and takes the gradients of its loss with Burn's autodiff.

use burn::tensor::{DType, Device, Gradients, Tensor, TensorData};
use splat_ops::{
    Distortion, Intrinsics, OpError, Projected, Rendered, project, rasterize, spherical_harmonics,
};

use super::scene::{Array, Inputs, Outputs, Scene};
use super::{GradcheckError, Precision};

/// A known bug, for negative controls: a suite that passes with one of them proves nothing.
///
/// Each is made by composing the ops wrongly; the ops themselves are unaware of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bug {
    /// The direction of the spherical harmonics passes no gradient to means and camera.
    DirectionDetached,
    /// The backward pass of the projection treats the quaternion as normalised: it does not divide
    /// by its length, and leaves a component along the quaternion.
    QuaternionNormalisationSkipped,
    /// Half of the gradient through the off-diagonal entry of the inverse covariance is lost.
    OffDiagonalHalved,
    /// The Jacobian of the projection is not clamped off-screen.
    ClampIgnored,
}

impl Bug {
    /// All bugs.
    pub const ALL: [Self; 4] = [
        Self::DirectionDetached,
        Self::QuaternionNormalisationSkipped,
        Self::OffDiagonalHalved,
        Self::ClampIgnored,
    ];
}

/// Results of the ops for a scene.
#[derive(Debug, Clone)]
pub struct Computed {
    /// Images, in the shapes of the scene's upstream gradients.
    pub outputs: Outputs,
    /// Gradients of the scene's loss, in the shapes of its inputs.
    pub gradients: Inputs,
    /// Absolute gradients of the screen means `[C, N, 2]`, if the scene requests them.
    pub absgrad: Option<Array>,
    /// Screen splats `[C, N, 9]`, in the layout of [`Projected::packed`].
    pub projected: Array,
    /// Opacities passed to the rasteriser `[C, N]`: compensated in anti-aliased mode.
    pub opacities: Array,
}

/// Renders a scene on a device and differentiates its loss.
///
/// # Errors
/// When the device lacks the precision, the ops refuse the scene, or results cannot be read back.
pub fn run(
    scene: &Scene,
    device: &Device,
    precision: Precision,
    bug: Option<Bug>,
) -> Result<Computed, GradcheckError> {
    let dtype = precision.dtype();
    if !device.supports_dtype(dtype) {
        return Err(GradcheckError::Device {
            file: scene.source.clone(),
            reason: format!("{device:?} does not compute in {precision}"),
        });
    }
    let upload = Upload {
        device: device.clone().autodiff(),
        dtype,
    };
    let leaves = Leaves::new(scene, &upload);
    let op = |source| GradcheckError::Op {
        file: scene.source.clone(),
        source,
    };
    let projected = leaves.project(scene, bug).map_err(op)?;
    let (projected, absgrad) = match scene.absgrad {
        true => {
            let (probed, leaf) = projected.with_absgrad();
            (probed, Some(leaf))
        }
        false => (projected, None),
    };
    let (rendered, blended) = leaves.render(scene, &projected, bug).map_err(op)?;
    let image = rendered.image().narrow(3, 0, 3);
    let depth = (scene.upstream.depth.as_ref())
        .map(|upstream| (rendered.image().narrow(3, 3, 1), upstream));
    let loss = loss(scene, &upload, (&image, &rendered.alpha()), depth.as_ref());
    let grads = loss.backward();

    let download = Download { scene };
    let (c, n) = (scene.cameras, scene.gaussians);
    Ok(Computed {
        outputs: Outputs {
            image: download.tensor(image, &scene.upstream.image.shape)?,
            alpha: download.tensor(rendered.alpha(), &scene.upstream.alpha.shape)?,
            depth: depth
                .map(|(depth, _)| download.tensor(depth, &scene.upstream.alpha.shape))
                .transpose()?,
        },
        gradients: leaves.gradients(scene, &grads, &download)?,
        absgrad: absgrad
            .map(|leaf| download.gradient(leaf.grad(&grads), &Array::zeros(&[c, n, 2])))
            .transpose()?,
        projected: download.tensor(projected.packed(), &[c, n, 9])?,
        opacities: download.tensor(blended, &[c, n])?,
    })
}

/// Sum of all outputs with the scene's weights.
fn loss(
    scene: &Scene,
    upload: &Upload,
    (image, alpha): (&Tensor<4>, &Tensor<4>),
    depth: Option<&(Tensor<4>, &Array)>,
) -> Tensor<1> {
    let (w, h) = (scene.size.width as usize, scene.size.height as usize);
    let weighted = |output: &Tensor<4>, upstream: &Array, channels| {
        let upstream = upload.constant::<4>(upstream, [scene.cameras, h, w, channels]);
        (output.clone() * upstream).sum()
    };
    let loss =
        weighted(image, &scene.upstream.image, 3) + weighted(alpha, &scene.upstream.alpha, 1);
    match depth {
        Some((depth, upstream)) => loss + weighted(depth, upstream, 1),
        None => loss,
    }
}

/// Inputs of a scene on a device, with a camera dimension in front.
struct Leaves {
    means: Tensor<2>,
    quats: Tensor<2>,
    scales: Tensor<2>,
    opacities: Tensor<1>,
    sh_coeffs: Tensor<3>,
    viewmats: Tensor<3>,
    intrinsics: Tensor<2>,
    background: Tensor<1>,
    distortion: Option<Distortion>,
}

impl Leaves {
    fn new(scene: &Scene, upload: &Upload) -> Self {
        let (c, n) = (scene.cameras, scene.gaussians);
        let inputs = &scene.inputs;
        let rows = inputs.sh_coeffs.shape[1];
        let domain = Array {
            shape: vec![c, 2],
            values: scene.domain.clone(),
        };
        let distortion = inputs.distortion.as_ref().map(|coefficients| Distortion {
            model: scene.model,
            coefficients: upload.leaf(coefficients, [c, scene.model.coefficients()]),
            domain: upload.constant(&domain, [c, 2]),
        });
        Self {
            distortion,
            means: upload.leaf(&inputs.means, [n, 3]),
            quats: upload.leaf(&inputs.quats, [n, 4]),
            scales: upload.leaf(&inputs.scales, [n, 3]),
            opacities: upload.leaf(&inputs.opacities, [n]),
            sh_coeffs: upload.leaf(&inputs.sh_coeffs, [n, rows, 3]),
            viewmats: upload.leaf(&inputs.viewmat, [c, 4, 4]),
            intrinsics: upload.leaf(&inputs.intrinsics, [c, 4]),
            background: upload.leaf(&inputs.background, [3]),
        }
    }

    /// Screen splats.
    fn project(&self, scene: &Scene, bug: Option<Bug>) -> Result<Projected, OpError> {
        let mut settings = scene.project;
        if bug == Some(Bug::ClampIgnored) {
            settings.clamp_margin = 1e6;
        }
        let (quats, scales) = (self.quats.clone(), self.scales.clone());
        let (quats, scales) = match bug {
            Some(Bug::QuaternionNormalisationSkipped) => {
                quaternion_normalisation_skipped(quats, scales)
            }
            _ => (quats, scales),
        };
        let projected = project(
            self.means.clone(),
            quats,
            scales,
            self.viewmats.clone(),
            Intrinsics {
                pinhole: self.intrinsics.clone(),
                distortion: self.distortion.clone(),
            },
            scene.size,
            &settings,
        )?;
        match bug {
            Some(Bug::OffDiagonalHalved) => off_diagonal_halved(&projected),
            _ => Ok(projected),
        }
    }

    /// Colours `[C, N, 3]` for the camera centre -W^T t.
    fn colors(&self, scene: &Scene, bug: Option<Bug>) -> Result<Tensor<3>, OpError> {
        let (c, n) = (scene.cameras, scene.gaussians);
        let rotation = self.viewmats.clone().narrow(1, 0, 3).narrow(2, 0, 3); // [C, 3, 3]
        let translation = self.viewmats.clone().narrow(1, 0, 3).narrow(2, 3, 1); // [C, 3, 1]
        let centre = (rotation * translation).sum_dim(1).neg(); // [C, 1, 3]
        // Repeated rather than broadcast, and `-1` rather than N: with N = 0, `expand` panics and
        // `reshape` reads the 0 as "keep this dimension".
        let mut directions = self.means.clone().reshape([1, -1, 3]).repeat_dim(0, c) // [C, N, 3]
            - centre.repeat_dim(1, n);
        if bug == Some(Bug::DirectionDetached) {
            directions = directions.detach();
        }
        let colors = spherical_harmonics(self.sh_coeffs.clone(), directions, scene.sh_degree)?;
        Ok(colors.add_scalar(0.5).clamp_min(0.0))
    }

    /// The image, whose fourth channel is the depth if the loss uses it, and the opacities passed
    /// to the rasteriser.
    fn render(
        &self,
        scene: &Scene,
        projected: &Projected,
        bug: Option<Bug>,
    ) -> Result<(Rendered, Tensor<2>), OpError> {
        let c = scene.cameras;
        let colors = self.colors(scene, bug)?;
        let backdrop = self.background.clone().reshape([1, 3]).expand([c, 3]);
        // Depth is an additional colour on a background of zero.
        let (colors, backdrop) = match scene.upstream.depth {
            None => (colors, backdrop),
            Some(_) => {
                let depths = projected.depths().unsqueeze_dim::<3>(2);
                let zero = Tensor::zeros([c, 1], (&backdrop.device(), backdrop.dtype()));
                (
                    Tensor::cat(vec![colors, depths], 2),
                    Tensor::cat(vec![backdrop, zero], 1),
                )
            }
        };
        let mut blended = self.opacities.clone().reshape([1, -1]).repeat_dim(0, c); // [C, N]
        if scene.antialias {
            blended = blended * projected.compensations();
        }
        let opacities = blended.clone();
        let rendered = rasterize(
            projected,
            colors,
            opacities,
            Some(backdrop),
            &scene.rasterize,
        )?;
        Ok((rendered, blended))
    }

    fn gradients(
        &self,
        scene: &Scene,
        grads: &Gradients,
        download: &Download,
    ) -> Result<Inputs, GradcheckError> {
        let inputs = &scene.inputs;
        Ok(Inputs {
            means: download.gradient(self.means.grad(grads), &inputs.means)?,
            quats: download.gradient(self.quats.grad(grads), &inputs.quats)?,
            scales: download.gradient(self.scales.grad(grads), &inputs.scales)?,
            opacities: download.gradient(self.opacities.grad(grads), &inputs.opacities)?,
            sh_coeffs: download.gradient(self.sh_coeffs.grad(grads), &inputs.sh_coeffs)?,
            viewmat: download.gradient(self.viewmats.grad(grads), &inputs.viewmat)?,
            intrinsics: download.gradient(self.intrinsics.grad(grads), &inputs.intrinsics)?,
            background: download.gradient(self.background.grad(grads), &inputs.background)?,
            distortion: (inputs.distortion.as_ref().zip(self.distortion.as_ref()))
                .map(|(like, leaf)| download.gradient(leaf.coefficients.grad(grads), like))
                .transpose()?,
        })
    }
}

/// The same values, with the gradients of a backward pass that forgets to differentiate q / |q|.
///
/// The quaternion that reaches the op has the value q / |q| but passes its gradient to q unchanged.
/// The unnormalised rotation matrix grows with the square of the quaternion's length, so the
/// component along it is that of a scale of |q|^2.
fn quaternion_normalisation_skipped(quats: Tensor<2>, scales: Tensor<2>) -> (Tensor<2>, Tensor<2>) {
    let length = quats.clone().square().sum_dim(1).sqrt();
    let unit = (quats.clone() / length).detach();
    // The difference comes first: it is exactly zero in every precision.
    let quats = unit + (quats.clone() - quats.detach());
    let square = quats.clone().square().sum_dim(1);
    (quats, scales * square)
}

/// The same screen splats, with half the gradient of w21.
fn off_diagonal_halved(projected: &Projected) -> Result<Projected, OpError> {
    let packed = projected.packed();
    let w21 = packed.clone().narrow(2, 4, 1);
    let halved = w21.clone().mul_scalar(0.5) + w21.mul_scalar(0.5).detach();
    Projected::from_packed(
        Tensor::cat(
            vec![
                packed.clone().narrow(2, 0, 4),
                halved,
                packed.narrow(2, 5, 4),
            ],
            2,
        ),
        projected.image_size(),
    )
}

struct Upload {
    device: Device,
    dtype: DType,
}

impl Upload {
    fn constant<const D: usize>(&self, array: &Array, shape: [usize; D]) -> Tensor<D> {
        let data = TensorData::new(array.values.clone(), shape);
        Tensor::from_data(data, (&self.device, self.dtype))
    }

    fn leaf<const D: usize>(&self, array: &Array, shape: [usize; D]) -> Tensor<D> {
        self.constant(array, shape).require_grad()
    }
}

struct Download<'a> {
    scene: &'a Scene,
}

impl Download<'_> {
    fn tensor<const D: usize>(
        &self,
        tensor: Tensor<D>,
        shape: &[usize],
    ) -> Result<Array, GradcheckError> {
        let values = tensor
            .try_into_vec_as::<f64>()
            .map_err(|error| GradcheckError::Device {
                file: self.scene.source.clone(),
                reason: format!("results cannot be read back: {error}"),
            })?;
        Ok(Array {
            shape: shape.to_vec(),
            values,
        })
    }

    /// A missing gradient counts as zero; the judge decides whether that is right.
    fn gradient<const D: usize>(
        &self,
        gradient: Option<Tensor<D>>,
        like: &Array,
    ) -> Result<Array, GradcheckError> {
        match gradient {
            Some(tensor) => self.tensor(tensor, &like.shape),
            None => Ok(Array::zeros(&like.shape)),
        }
    }
}
