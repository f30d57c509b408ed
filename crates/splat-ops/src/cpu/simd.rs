//! Code for the processor at hand: chosen at run time, so that one binary runs everywhere.

/// Defines a function whose body is compiled twice, for the baseline and for AVX2 with FMA, and
/// which takes the one that the processor can run. What the body calls must be `#[inline(always)]`,
/// or it stays compiled for the baseline.
///
/// Rust never fuses a product and a sum by itself, so the numbers are the same either way.
macro_rules! vectorized {
    (
        $(#[$meta:meta])*
        fn $name:ident<T: Real>($($argument:ident: $type:ty),* $(,)?) $(-> $result:ty)? $body:block
    ) => {
        $(#[$meta])*
        fn $name<T: Real>($($argument: $type),*) $(-> $result)? {
            #[inline(always)]
            fn body<T: Real>($($argument: $type),*) $(-> $result)? $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                fn avx2<T: Real>($($argument: $type),*) $(-> $result)? {
                    body($($argument),*)
                }
                if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                    // SAFETY: the features that `avx2` is compiled for were just found.
                    return unsafe { avx2($($argument),*) };
                }
            }
            body($($argument),*)
        }
    };
}

pub(super) use vectorized;
