//! Projection on CubeCL devices.

use burn::backend::TensorMetadata;
use burn::tensor::Shape;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::project::{project, project_backward};

use super::{buffer, gradients, prepare, tensor};
use crate::backend::{
    OpInputs, PROJECTED_WIDTH, ProjectBackend, ProjectGradients, ProjectInputs, ProjectOps,
    ProjectTensors,
};
use crate::settings::ProjectArgs;

impl ProjectOps for CubeBackend {
    fn project(OpInputs(inputs): ProjectInputs<Self>, args: ProjectArgs) -> CubeTensor {
        let inputs = inputs.map_inputs(prepare);
        let means = &inputs.means;
        let shape = [
            inputs.viewmats.shape()[0],
            means.shape()[0],
            PROJECTED_WIDTH,
        ];
        let buffers = inputs.clone().map_inputs(|input| buffer(&input));
        let client = &means.client;
        let packed = project(client, &buffers, args.size, args.model, &args.settings);
        tensor(means, packed, Shape::from(shape))
    }
}

impl ProjectBackend for CubeBackend {
    fn project_backward(
        OpInputs(inputs): ProjectInputs<Self>,
        grad_packed: CubeTensor,
        args: &ProjectArgs,
        needs_grad: ProjectTensors<bool>,
    ) -> ProjectGradients<Self> {
        let inputs = inputs.map_inputs(prepare);
        let grad_packed = prepare(grad_packed);
        let grads = project_backward(
            &grad_packed.client,
            &inputs.clone().map_inputs(|input| buffer(&input)),
            &buffer(&grad_packed),
            args.size,
            args.model,
            &args.settings,
            needs_grad,
        );
        gradients(grads.into(), inputs.inputs().into()).into()
    }
}
