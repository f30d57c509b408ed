//! The floor of a step is what the shapes of its tensors say.

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

/// From the shapes of the tensors: what a stage is given and what it leaves.
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
    // Coefficients of degree 3 and means of what is seen, as its extent says; colours of all.
    let colours = Bytes {
        read: seen * 4 * (16 * 3 + 3) + n * 4,
        written: n * 4 * 3,
    };
    assert_eq!(floors["colours"], colours);
    // The same and their gradients, after those of the colours; gradients of all.
    let colours = Bytes {
        read: n * 4 * 3 + seen * 4 * (16 * 3 + 3 + 1),
        written: n * 4 * (16 * 3 + 3),
    };
    assert_eq!(floors["colours gradient"], colours);
    // The image and the photo of 8 bits; three derivatives of each value.
    let photometric = Bytes {
        read: pixels * 3 * (4 + 1),
        written: pixels * 3 * 12,
    };
    assert_eq!(floors["photometric"], photometric);
    // The derivatives and both again; colour and alpha.
    let photometric = Bytes {
        read: pixels * 3 * (12 + 4 + 1),
        written: pixels * 4 * 4,
    };
    assert_eq!(floors["photometric gradient"], photometric);
    // Log-scales and the logit; then these or their values and what comes back.
    let activations = Bytes {
        read: n * 4 * 2 * 4,
        written: n * 4 * 4,
    };
    assert_eq!(floors["activations gradient"], activations);
    // Gradient, extent along x, two sums; the sums.
    let density = Bytes {
        read: n * 4 * (2 + 1 + 2),
        written: n * 4 * 2,
    };
    assert_eq!(floors["density"], density);
    // Of an intersection: its number, its slot, six of shape, colour; then its nine sums and again;
    // of a pixel the gradient of colour and alpha, what is left, what was walked; of a Gaussian all
    // of its gradients.
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
