//! The floor of a step equals the sum over the shapes of its tensors.

use splat_kernels::floor::{Bytes, Sizes, step};

const SIZES: Sizes = Sizes {
    gaussians: 1000,
    visible: 700,
    intersections: 3000,
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

/// Computed from the shapes of each stage's inputs and results.
#[test]
fn floors_are_the_bytes_of_inputs_and_results() {
    let (n, seen, i, pixels) = (1000, 700, 3000, 160 * 128);
    let floors: std::collections::BTreeMap<_, _> = step(&SIZES).into_iter().collect();
    // Means, quaternions, scales; packed splats.
    let splats = Bytes {
        read: n * 4 * (3 + 4 + 3),
        written: n * 4 * 9,
    };
    assert_eq!(floors["project"], splats);
    // Coefficients of degree 3 and means of seen Gaussians, whose extents tell; colours of all.
    let colours = Bytes {
        read: seen * 4 * (16 * 3 + 3) + n * 4,
        written: n * 4 * 3,
    };
    assert_eq!(floors["colours"], colours);
    // The same and their gradients, after the gradients of the colours; gradients of all.
    let colours = Bytes {
        read: n * 4 * 3 + seen * 4 * (16 * 3 + 3 + 1),
        written: n * 4 * (16 * 3 + 3),
    };
    assert_eq!(floors["colours gradient"], colours);
    // The image and the 8-bit photo; three derivatives per value.
    let photometric = Bytes {
        read: pixels * 3 * (4 + 1),
        written: pixels * 3 * 12,
    };
    assert_eq!(floors["photometric"], photometric);
    // The derivatives and both images again; colour and alpha.
    let photometric = Bytes {
        read: pixels * 3 * (12 + 4 + 1),
        written: pixels * 4 * 4,
    };
    assert_eq!(floors["photometric gradient"], photometric);
    // Log-scales and the logit; then these or their values, and their gradients.
    let activations = Bytes {
        read: n * 4 * 2 * 4,
        written: n * 4 * 4,
    };
    assert_eq!(floors["activations gradient"], activations);
    // Gradient, extent along x, two sums; the updated sums.
    let density = Bytes {
        read: n * 4 * (2 + 1 + 2),
        written: n * 4 * 2,
    };
    assert_eq!(floors["density"], density);
    // Per intersection: its index, its slot, six values of shape, colour; then its nine sums
    // written and read again. Per pixel: the gradients of colour and alpha, the final
    // transmittance, the number of splats walked. Per Gaussian: all of its gradients.
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
            intersections: 4000,
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
        // Shorter digits take more passes.
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
