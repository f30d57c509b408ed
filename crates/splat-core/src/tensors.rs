//! The tensors of each op by name, the same from the public op to the kernel.
//!
//! One struct serves for the inputs of an op (of tensors), for their gradients (of options), and
//! for which of these are needed (of `bool`). Inputs that may be absent have a type of their own,
//! `O`.

/// A struct of tensors, and what is done to all of them at once.
macro_rules! tensors {
    (
        $(#[$meta:meta])* $name:ident {
            $($(#[$doc:meta])* $field:ident),+ $(,)?
        }
    ) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
        pub struct $name<T> {
            $($(#[$doc])* pub $field: T,)+
        }

        impl<T> $name<T> {
            /// Applies a function to each tensor.
            pub fn map<U>(self, mut f: impl FnMut(T) -> U) -> $name<U> {
                $name { $($field: f(self.$field)),+ }
            }

            /// Pairs each tensor with that of the same name.
            pub fn zip<U>(self, other: $name<U>) -> $name<(T, U)> {
                $name { $($field: (self.$field, other.$field)),+ }
            }

            /// Applies a function to each tensor that is there.
            pub fn map_inputs<U>(self, f: impl FnMut(T) -> U) -> $name<U> {
                self.map(f)
            }

            /// References to the tensors that are there.
            pub fn inputs(&self) -> $name<Option<&T>> {
                $name { $($field: Some(&self.$field)),+ }
            }
        }

        tensors!(@array $name<T> { $($field),+ });
    };
    (
        $(#[$meta:meta])* $name:ident {
            $($(#[$doc:meta])* $field:ident),+ $(,)?
        } optional {
            $($(#[$optional_doc:meta])* $optional:ident),+ $(,)?
        }
    ) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
        pub struct $name<T, O = T> {
            $($(#[$doc])* pub $field: T,)+
            $($(#[$optional_doc])* pub $optional: O,)+
        }

        impl<T> $name<T> {
            /// Applies a function to each tensor.
            pub fn map<U>(self, mut f: impl FnMut(T) -> U) -> $name<U> {
                $name { $($field: f(self.$field),)+ $($optional: f(self.$optional)),+ }
            }

            /// Pairs each tensor with that of the same name.
            pub fn zip<U>(self, other: $name<U>) -> $name<(T, U)> {
                $name {
                    $($field: (self.$field, other.$field),)+
                    $($optional: (self.$optional, other.$optional)),+
                }
            }
        }

        impl<T> $name<T, Option<T>> {
            /// Applies a function to each tensor that is there.
            pub fn map_inputs<U>(self, mut f: impl FnMut(T) -> U) -> $name<U, Option<U>> {
                $name {
                    $($field: f(self.$field),)+
                    $($optional: self.$optional.map(&mut f)),+
                }
            }

            /// References to the tensors that are there.
            pub fn inputs(&self) -> $name<Option<&T>> {
                $name {
                    $($field: Some(&self.$field),)+
                    $($optional: self.$optional.as_ref()),+
                }
            }
        }

        tensors!(@array $name<T> { $($field,)+ $($optional),+ });
    };
    (@array $name:ident<T> { $($field:ident),+ }) => {
        impl<T> From<$name<T>> for [T; [$(stringify!($field)),+].len()] {
            fn from(tensors: $name<T>) -> Self {
                [$(tensors.$field),+]
            }
        }

        impl<T> From<[T; [$(stringify!($field)),+].len()]> for $name<T> {
            fn from([$($field),+]: [T; [$(stringify!($field)),+].len()]) -> Self {
                Self { $($field),+ }
            }
        }
    };
}

tensors! {
    /// Tensors of `project`.
    ProjectTensors {
        /// World positions `[N, 3]`.
        means,
        /// Quaternions (w, x, y, z) of any non-zero length `[N, 4]`.
        quats,
        /// Linear scales `[N, 3]`.
        scales,
        /// World-to-camera matrices, row-major `[C, 4, 4]`.
        viewmats,
        /// fx, fy, cx, cy in pixels `[C, 4]`.
        intrinsics,
    } optional {
        /// Distortion coefficients `[C, K]`; absent for a pinhole.
        distortion,
        /// Domains of the lenses `[C, 2]`, see `LensDomain`; absent for a pinhole. Never has a
        /// gradient.
        domain,
    }
}

tensors! {
    /// Tensors of `spherical_harmonics`.
    SphericalHarmonicsTensors {
        /// Coefficients `[N, K, 3]`, K >= (degree + 1)^2.
        coeffs,
        /// Directions of any length `[C, N, 3]`.
        dirs,
    }
}

tensors! {
    /// Tensors of `sh_colors`.
    ShColorTensors {
        /// Coefficients of degree 0 `[N, 1, 3]`.
        sh0,
        /// World positions `[N, 3]`.
        means,
        /// Positions of the cameras `[C, 3]`.
        centers,
    } optional {
        /// Coefficients of the higher degrees `[N, R, 3]`, or `[K, 1, 3]` where Gaussians have
        /// different degrees; absent at degree 0.
        sh_rest,
        /// Packed splats `[C, N, 9]`, of which those without an extent have no colour. Never has a
        /// gradient.
        seen,
    }
}

tensors! {
    /// Tensors of `rasterize`.
    RasterizeTensors {
        /// Packed splats `[C, N, 9]`.
        packed,
        /// Colours, any number D of channels `[C, N, D]`.
        colors,
        /// Opacities `[C, N]`.
        opacities,
    } optional {
        /// Colour behind all splats `[C, D]`; zero if there is none.
        background,
        /// Leaf `[C, N, 2]` whose gradient is the sum over pixels of the absolute gradients of the
        /// screen means. Its values are not read.
        absgrad,
    }
}

tensors! {
    /// Tensors of `ssim_map`.
    SsimTensors {
        /// One image `[B, H, W, D]`.
        x,
        /// The other.
        y,
    }
}

tensors! {
    /// Tensors of `adam_step`, all of one shape.
    AdamTensors {
        /// Parameter.
        param,
        /// Its gradient.
        grad,
        /// Its first moment.
        moment_1,
        /// Its second moment.
        moment_2,
    }
}

tensors! {
    /// Tensors of `perturb_means`.
    PerturbTensors {
        /// World positions `[N, 3]`.
        means,
        /// Quaternions (w, x, y, z) of any length `[N, 4]`.
        quats,
        /// Logarithms of the scales `[N, 3]`.
        log_scales,
        /// Logits of the opacities `[N]`.
        opacity_logits,
    }
}

tensors! {
    /// Tensors of `ScreenStatistics::add`.
    ScreenStatisticsTensors {
        /// Gradient of the packed splats `[C, N, 9]`, or of their screen means `[C, N, 2]`.
        gradient,
        /// Packed splats `[C, N, 9]`.
        packed,
        /// Sums of the lengths of screen gradients `[N]`.
        gradients,
        /// Sums of views `[N]`.
        views,
    }
}
