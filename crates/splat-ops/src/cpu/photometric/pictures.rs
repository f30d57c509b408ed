//! The two images in memory: the rendered one, which may have more channels than count, and the
//! target, in 8 bits or as values.

use core::ops::Range;

use burn::backend::flex::FlexTensor;
use burn::backend::ops::{FloatTensorOps, IntTensorOps};
use burn::backend::{Flex, TensorMetadata};
use burn::tensor::DType;

use super::rows::values_of_levels;
use crate::backend::Target;
use crate::cpu::buffer::Buffer;
use crate::cpu::real::Real;

/// Memory of both images.
pub(super) struct Pictures {
    /// `[B, H, W, E]`.
    rendered: Buffer,
    /// `[B, H, W, D]`.
    target: Buffer,
    /// True if the target is in 8 bits.
    levels: bool,
    /// `[B, H, W, D]`.
    pub(super) shape: [usize; 4],
    /// E.
    pixel: usize,
}

impl Pictures {
    pub(super) fn new(rendered: FlexTensor, target: Target<Flex>) -> Self {
        let (target, levels) = match target {
            Target::Values(values) => (values, false),
            Target::Levels(levels) if levels.dtype() == DType::U8 => (levels, true),
            Target::Levels(levels) => {
                let values = Flex::int_into_float(levels, rendered.dtype().into());
                (Flex::float_div_scalar(values, 255.0.into()), false)
            }
        };
        let [.., pixel] = rendered.shape().dims::<4>();
        Self {
            shape: target.shape().dims(),
            rendered: Buffer::new(rendered),
            target: Buffer::new(target),
            levels,
            pixel,
        }
    }

    pub(super) fn rows<T: Real>(&self) -> Rows<'_, T> {
        let [.., width, channels] = self.shape;
        Rows {
            rendered: self.rendered.slice(),
            target: if self.levels {
                Values::Levels(self.target.slice())
            } else {
                Values::Real(self.target.slice())
            },
            width,
            channels,
            pixel: self.pixel,
        }
    }
}

/// Both images by row; rows are numbered through all images of the batch.
pub(super) struct Rows<'a, T> {
    rendered: &'a [T],
    target: Values<'a, T>,
    /// W.
    pub(super) width: usize,
    /// D.
    pub(super) channels: usize,
    /// E.
    pixel: usize,
}

enum Values<'a, T> {
    Levels(&'a [u8]),
    Real(&'a [T]),
}

impl<T: Real> Rows<'_, T> {
    /// The D channels of some pixels of a row: `x` from the rendered image, `y` from the target.
    pub(super) fn load(&self, row: usize, columns: Range<usize>, x: &mut [T], y: &mut [T]) {
        let pixels = row * self.width + columns.start..row * self.width + columns.end;
        let values = |channels: usize| pixels.start * channels..pixels.end * channels;
        let rendered = &self.rendered[values(self.pixel)];
        gather([self.channels, self.pixel], rendered, x);
        match self.target {
            Values::Levels(levels) => values_of_levels(&levels[values(self.channels)], y),
            Values::Real(real) => y.copy_from_slice(&real[values(self.channels)]),
        }
    }
}

/// First D of the E channels of each pixel.
fn gather<T: Real>([d, e]: [usize; 2], pixels: &[T], out: &mut [T]) {
    match [d, e] {
        // The common case of colour and alpha: copies of a known length.
        [3, 4] => {
            for (out, pixel) in out.chunks_exact_mut(3).zip(pixels.chunks_exact(4)) {
                out.copy_from_slice(&pixel[..3]);
            }
        }
        _ if d == e => out.copy_from_slice(pixels),
        _ => {
            for (out, pixel) in out.chunks_exact_mut(d).zip(pixels.chunks_exact(e)) {
                out.copy_from_slice(&pixel[..d]);
            }
        }
    }
}

/// Expands pixels from D channels to E; the others are zero.
pub(super) fn spread<T: Real>([d, e]: [usize; 2], pixels: &[T], out: &mut [T]) {
    match [d, e] {
        [3, 4] => {
            for (out, pixel) in out.chunks_exact_mut(4).zip(pixels.chunks_exact(3)) {
                out.copy_from_slice(&[pixel[0], pixel[1], pixel[2], T::ZERO]);
            }
        }
        _ if d == e => out.copy_from_slice(pixels),
        _ => {
            for (out, pixel) in out.chunks_exact_mut(e).zip(pixels.chunks_exact(d)) {
                out[..d].copy_from_slice(pixel);
                out[d..].fill(T::ZERO);
            }
        }
    }
}
