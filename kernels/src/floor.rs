//! The bytes of device memory that a training step cannot do without: every stage reads each of its inputs and writes
//! each of its results once, with a perfect cache within a stage and none between stages.
//!
//! Each stage states its own beside its kernels (`floor`); here they are put together for one camera. Counted are the
//! kernels of this crate alone, not the tensor ops between them. Two estimates are in it: the lists of all tiles count
//! to their ends, also where all pixels stop earlier; and what is said per Gaussian counts all of them, also those out
//! of view. Neither is a bound that a kernel could not go below by knowing more than its input.

use crate::{adam, intersect, project, rasterize, sh, sort, ssim};

/// Bytes read and written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bytes {
    /// From device memory.
    pub read: u64,
    /// To device memory.
    pub written: u64,
}

impl Bytes {
    /// Both ways together.
    pub fn total(self) -> u64 {
        self.read + self.written
    }
}

impl core::ops::Add for Bytes {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            read: self.read + other.read,
            written: self.written + other.written,
        }
    }
}

/// How large a training step is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sizes {
    /// Gaussians.
    pub gaussians: u64,
    /// Those that reach into the view.
    pub visible: u64,
    /// (Splat, tile) pairs.
    pub instances: u64,
    /// Width of the view.
    pub width: u64,
    /// Height of the view.
    pub height: u64,
    /// Colour channels.
    pub channels: u64,
    /// Degree of spherical harmonics.
    pub degree: usize,
    /// Floats of one Gaussian that are trained.
    pub parameters: u64,
    /// Bits of a digit of the sort on this device: [`sort::digit_bits`].
    pub digit_bits: u32,
}

impl Sizes {
    pub(crate) fn pixels(&self) -> u64 {
        self.width * self.height
    }
}

/// The stages of a step by name, in order, and the floor of each.
pub fn step(sizes: &Sizes) -> Vec<(&'static str, Bytes)> {
    let [project, project_gradient] = project::floor(sizes);
    let [sh, sh_gradient] = sh::floor(sizes);
    let [blend, blend_gradient] = rasterize::floor(sizes);
    let [ssim, ssim_gradient] = ssim::floor(sizes);
    vec![
        ("project", project),
        ("spherical harmonics", sh),
        (
            "rasterize",
            intersect::floor(sizes) + sort::floor(sizes) + blend,
        ),
        ("ssim", ssim),
        ("ssim gradient", ssim_gradient),
        ("rasterize gradient", blend_gradient),
        ("project gradient", project_gradient),
        ("spherical harmonics gradient", sh_gradient),
        ("adam", adam::floor(sizes)),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZES: Sizes = Sizes {
        gaussians: 1000,
        visible: 700,
        instances: 3000,
        width: 160,
        height: 128,
        channels: 3,
        degree: 3,
        parameters: 59,
        digit_bits: 5,
    };

    fn total(sizes: &Sizes) -> u64 {
        step(sizes).iter().map(|(_, bytes)| bytes.total()).sum()
    }

    /// From the shapes of the tensors: what a stage is given and what it leaves.
    #[test]
    fn floors_are_the_bytes_of_inputs_and_results() {
        let (n, i, pixels) = (1000, 3000, 160 * 128);
        let floors: std::collections::BTreeMap<_, _> = step(&SIZES).into_iter().collect();
        // Means, quaternions, scales; packed splats.
        let splats = Bytes {
            read: n * 4 * (3 + 4 + 3),
            written: n * 4 * 9,
        };
        assert_eq!(floors["project"], splats);
        // Coefficients of degree 3 and directions; colours.
        let colours = Bytes {
            read: n * 4 * (16 * 3 + 3),
            written: n * 4 * 3,
        };
        assert_eq!(floors["spherical harmonics"], colours);
        // Two images; their map and four means.
        let ssim = Bytes {
            read: pixels * 3 * 8,
            written: pixels * 3 * 4 * (1 + 4),
        };
        assert_eq!(floors["ssim"], ssim);
        // Of an instance: its number, its slot, six of shape, colour; then its nine sums and again; of a pixel the
        // gradient of colour and alpha, what is left, what was walked; of a Gaussian all of its gradients.
        let backward = Bytes {
            read: i * 4 * (2 + 6 + 3) + i * 4 * 9 + pixels * 4 * (4 + 2),
            written: i * 4 * 9 + n * 4 * (9 + 3 + 1),
        };
        assert_eq!(floors["rasterize gradient"], backward);
        let adam = Bytes {
            read: n * 59 * 16,
            written: n * 59 * 12,
        };
        assert_eq!(floors["adam"], adam);
    }

    #[test]
    fn more_work_is_more_bytes() {
        let more = [
            Sizes {
                gaussians: 2000,
                ..SIZES
            },
            Sizes {
                visible: 800,
                ..SIZES
            },
            Sizes {
                instances: 4000,
                ..SIZES
            },
            Sizes {
                width: 320,
                ..SIZES
            },
            Sizes {
                channels: 4,
                ..SIZES
            },
            Sizes {
                parameters: 60,
                ..SIZES
            },
            // Shorter digits are more passes.
            Sizes {
                digit_bits: 4,
                ..SIZES
            },
        ];
        for sizes in more {
            assert!(total(&sizes) > total(&SIZES), "{sizes:?}");
        }
        assert!(total(&Sizes { degree: 2, ..SIZES }) < total(&SIZES));
    }
}
