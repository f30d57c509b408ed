//! The photometric loss on CubeCL devices. The photo is read as it is stored. Windows whose tiles
//! do not fit into shared memory fall back to tensor ops.

use burn::backend::TensorMetadata;
use burn::tensor::{DType, Shape};
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::{cast, into_contiguous};
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::Buffer;
use splat_kernels::photometric::{
    Images, PhotometricShape, TargetKind, photometric, photometric_tracked, photometric_vjp,
};

use super::{buffer, prepare, tensor};
use crate::backend::{PhotometricBackend, PhotometricOps, Target};
use crate::composed;
use crate::settings::SsimArgs;

fn shape(rendered: &CubeTensor, target: &Target<CubeBackend>, args: &SsimArgs) -> PhotometricShape {
    let target = match target {
        Target::Values(values) => values.shape(),
        Target::Levels(levels) => levels.shape(),
    };
    PhotometricShape {
        images: target[0],
        height: target[1],
        width: target[2],
        channels: target[3],
        pixel: rendered.shape()[3],
        c1: args.c1 as f32,
        c2: args.c2 as f32,
        window: args.window.iter().map(|weight| *weight as f32).collect(),
    }
}

/// Both images, in the memory layout of the kernels.
struct Pictures {
    rendered: CubeTensor,
    values: Buffer,
    target: Buffer,
    kind: TargetKind,
}

impl Pictures {
    fn new(rendered: CubeTensor, target: Target<CubeBackend>) -> Self {
        let rendered = prepare(rendered);
        let (target, kind) = words(target);
        Self {
            values: buffer(&rendered),
            rendered,
            target,
            kind,
        }
    }

    fn images(&self) -> Images<'_> {
        Images {
            rendered: &self.values,
            target: &self.target,
            kind: self.kind,
        }
    }
}

/// The memory of the photo, in words of 32 bits.
fn words(target: Target<CubeBackend>) -> (Buffer, TargetKind) {
    let levels = match target {
        Target::Values(values) => return (buffer(&prepare(values)), TargetKind::Values),
        Target::Levels(levels) => levels,
    };
    let count = levels.shape().num_elements();
    let (levels, words, kind) = match levels.dtype {
        DType::U8 if count.is_multiple_of(4) => (levels, count / 4, TargetKind::Bytes),
        DType::I32 | DType::U32 => (levels, count, TargetKind::Words),
        _ => (cast(levels, DType::I32), count, TargetKind::Words),
    };
    let levels = into_contiguous(levels);
    // As in `buffer`: a tensor that does not hold its elements would be read as empty.
    let memory = Buffer::new(levels.handle.clone(), words);
    let memory = memory.unwrap_or_else(|_| Buffer::empty(&levels.client, 0));
    (memory, kind)
}

impl PhotometricOps for CubeBackend {
    fn photometric(rendered: CubeTensor, target: Target<Self>, args: SsimArgs) -> CubeTensor {
        let shape = shape(&rendered, &target, &args);
        if !shape.fits(&rendered.client) {
            return composed::photometric::<Self>(rendered, target, &args);
        }
        let pictures = Pictures::new(rendered, target);
        let rendered = &pictures.rendered;
        let losses = photometric(&rendered.client, pictures.images(), &shape);
        tensor(rendered, losses, Shape::from([2]))
    }
}

impl PhotometricBackend for CubeBackend {
    fn photometric_tracked(
        rendered: CubeTensor,
        target: Target<Self>,
        args: &SsimArgs,
    ) -> (CubeTensor, CubeTensor) {
        let shape = shape(&rendered, &target, args);
        if !shape.fits(&rendered.client) {
            return composed::photometric_tracked::<Self>(rendered, target, args);
        }
        let pictures = Pictures::new(rendered, target);
        let rendered = &pictures.rendered;
        let (losses, kept) = photometric_tracked(&rendered.client, pictures.images(), &shape);
        let sizes = [3, shape.images, shape.channels, shape.height, shape.width];
        (
            tensor(rendered, losses, Shape::from([2])),
            tensor(rendered, kept, Shape::from(sizes)),
        )
    }

    fn photometric_backward(
        rendered: CubeTensor,
        target: Target<Self>,
        kept: CubeTensor,
        grad_losses: CubeTensor,
        args: &SsimArgs,
    ) -> CubeTensor {
        let shape = shape(&rendered, &target, args);
        if !shape.fits(&rendered.client) {
            return composed::photometric_backward::<Self>(rendered, target, kept, grad_losses);
        }
        let pictures = Pictures::new(rendered, target);
        let rendered = &pictures.rendered;
        let gradient = photometric_vjp(
            &rendered.client,
            pictures.images(),
            &buffer(&kept),
            &buffer(&prepare(grad_losses)),
            &shape,
        );
        tensor(rendered, gradient, rendered.shape())
    }
}
