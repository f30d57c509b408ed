//! Functions with correct gradients pass, including our own ops.

use burn::tensor::{Tensor, activation};
use splat_lab::central::{Kind, Report, Settings, gradcheck, gradcheck_with, tensor};
use splat_ops::{
    ImageSize, ProjectSettings, Projected, RasterizeSettings, SsimArgs, gaussian_blur, project,
    rasterize, sh_colors, ssim_map,
};

use super::{numbers, random};

/// Asserts that there are no findings, kinks included, and derivatives to eight digits.
fn assert_clean(name: &str, report: &Report) {
    println!("{name}\n{report}");
    report.expect();
    assert!(
        report.rows.iter().all(|row| row.findings.is_empty()),
        "{report}"
    );
    assert!(report.worst_relative() < 1e-7, "{report}");
}

#[test]
fn formulas() {
    let x = || ("x", random(20, [4, 5]));
    let positive = || ("x", random(21, [4, 5]).abs() + 0.1);
    let functions: [(&str, &dyn Fn(Tensor<2>) -> Tensor<2>); 9] = [
        ("softmax", &|x| activation::softmax(x, 1)),
        ("log softmax", &|x| activation::log_softmax(x, 0)),
        ("norm", &|x| x.square().sum_dim(1).sqrt()),
        ("mean", &|x| x.mean().unsqueeze()),
        ("transpose", &|x| x.clone().transpose().matmul(x)),
        ("sigmoid", &|x| activation::sigmoid(x * 3.0)),
        ("exp of sin", &|x| (x.sin() * 2.0).exp()),
        ("cut and joined", &|x| {
            Tensor::cat(vec![x.clone().narrow(1, 1, 2).tanh(), x], 1)
        }),
        ("an input that does not matter", &|x| x.clone() - x),
    ];
    for (name, function) in functions {
        let report = gradcheck(function, x()).unwrap();
        println!("{name}\n{report}");
        report.expect();
    }
    let functions: [(&str, &dyn Fn(Tensor<2>) -> Tensor<2>); 5] = [
        ("log", &|x| x.log()),
        ("square root", &|x| x.sqrt()),
        ("reciprocal", &|x| x.recip()),
        ("power", &|x| x.powf_scalar(2.7)),
        ("product so far", &|x| {
            (-(x.clone() * 0.5)).log1p().cumsum(1).exp() * x
        }),
    ];
    for (name, function) in functions {
        assert_clean(name, &gradcheck(function, positive()).unwrap());
    }
}

/// Numbers from 1e-6 to 1e6 in one input.
#[test]
fn elements_of_very_different_size() {
    let values: Vec<f64> = (-6..=6).map(|e| 1.7 * 10f64.powi(e)).collect();
    let report = gradcheck(|x| x.log(), ("x", tensor(values, [13]))).unwrap();
    assert_clean("log", &report);
}

/// Rounding inside the function, a million times that of its output, is not a wrong gradient.
#[test]
fn noise_is_noticed() {
    let report = gradcheck(|x| (x.sin() + 1e6) - 1e6, ("x", random(22, [40]))).unwrap();
    report.expect();
}

#[test]
fn many_seeds() {
    for seed in 0..40 {
        let settings = Settings::new()
            .with_seed(seed)
            .with_each_up_to(8 * (seed as usize % 2));
        let report = gradcheck_with(
            |(x, w, b)| (x.matmul(w) + b.unsqueeze()).tanh().sum_dim(0).exp(),
            (
                ("x", random(seed, [5, 6])),
                ("w", random(seed + 100, [6, 3])),
                ("b", random(seed + 200, [3])),
            ),
            &settings,
        )
        .unwrap();
        report.expect();
    }
}

/// Inputs of all sizes, some of which leave a vanishing gradient and only rounding.
#[test]
fn no_false_alarms() {
    let functions: [(&str, &dyn Fn(Tensor<2>) -> Tensor<2>); 7] = [
        ("softmax", &|x| activation::softmax(x, 1)),
        ("relu", &activation::relu),
        ("norm", &|x| x.square().sum_dim(1).sqrt()),
        ("gram", &|x| x.clone().transpose().matmul(x)),
        ("log of length", &|x| x.abs().log()),
        ("peak", &|x| (x.square() + 1e-4).recip()),
        ("noisy", &|x| (x.sin() + 1e5) - 1e5),
    ];
    for (name, function) in functions {
        for seed in 0..120 {
            let scale = [1.0, 1e-3, 30.0][seed as usize % 3];
            if name == "noisy" && scale != 1.0 {
                continue;
            }
            let settings = Settings::new()
                .with_seed(seed)
                .with_each_up_to(1000 * (seed as usize % 2));
            let x = random(seed, [4, 6]) * scale;
            let report = gradcheck_with(function, ("x", x), &settings).unwrap();
            assert!(
                report.is_ok(),
                "{name}, seed {seed}, times {scale}\n{report}"
            );
        }
    }
}

const SIZE: ImageSize = ImageSize {
    width: 12,
    height: 10,
};
const N: usize = 4;

/// Four Gaussians in front of two cameras.
fn scene() -> (Tensor<2>, Tensor<2>, Tensor<2>, Tensor<3>, Tensor<2>) {
    let means = numbers(30, 3 * N).into_iter().enumerate();
    let means = means.map(|(i, x)| match i % 3 {
        2 => 3.0 + 0.3 * (i as f64) + 0.1 * x,
        _ => 0.9 * x,
    });
    let view = |turn: f64, shift: f64| {
        let (s, c) = turn.sin_cos();
        [
            c, 0.0, s, shift, 0.0, 1.0, 0.0, 0.1, -s, 0.0, c, 0.2, 0.0, 0.0, 0.0, 1.0,
        ]
    };
    (
        tensor(means.collect::<Vec<_>>(), [N, 3]),
        random(31, [N, 4]) + 0.2,
        random(32, [N, 3]).exp() * 0.3,
        tensor([view(0.1, 0.0), view(-0.05, 0.2)].concat(), [2, 4, 4]),
        tensor([12.0, 11.0, 6.1, 5.2, 10.0, 12.0, 5.9, 4.8], [2, 4]),
    )
}

/// Differentiable columns of the screen splats, and the others.
fn columns(packed: Tensor<3>) -> (Tensor<3>, Tensor<3>) {
    let cut = |start, length| packed.clone().narrow(2, start, length);
    (
        Tensor::cat(vec![cut(0, 2), cut(3, 3)], 2),
        Tensor::cat(vec![cut(2, 1), cut(6, 3)], 2),
    )
}

#[test]
fn projection() {
    let (means, quats, scales, viewmats, intrinsics) = scene();
    let report = gradcheck(
        |(means, quats, scales, viewmats, intrinsics)| {
            let settings = ProjectSettings::default();
            project(means, quats, scales, viewmats, intrinsics, SIZE, &settings)
                // The extents, the last two columns, carry no gradient by design.
                .map(|projected| projected.packed().narrow(2, 0, 7))
        },
        (
            ("means", means),
            ("quats", quats),
            ("scales", scales),
            ("viewmats", viewmats),
            ("intrinsics", intrinsics),
        ),
    )
    .unwrap();
    assert_clean("project", &report);
}

#[test]
fn rasteriser() {
    let (means, quats, scales, viewmats, intrinsics) = scene();
    let settings = ProjectSettings::default();
    let projected = project(means, quats, scales, viewmats, intrinsics, SIZE, &settings).unwrap();
    let (splats, rest) = columns(projected.packed());
    let report = gradcheck(
        |(splats, colors, opacities, background)| {
            let cut = |start, length| Tensor::narrow(splats.clone(), 2, start, length);
            let kept = |start, length| rest.clone().narrow(2, start, length);
            let packed = Tensor::cat(vec![cut(0, 2), kept(0, 1), cut(2, 3), kept(1, 3)], 2);
            let projected = Projected::from_packed(packed, SIZE)?;
            let settings = RasterizeSettings::default();
            rasterize(&projected, colors, opacities, Some(background), &settings)
                .map(|rendered| rendered.packed())
        },
        (
            ("splats", splats),
            ("colors", random::<3>(33, [2, N, 3])),
            ("opacities", random::<2>(34, [2, N]) * 0.2 + 0.6),
            ("background", random::<2>(35, [2, 3])),
        ),
    )
    .unwrap();
    assert_clean("rasterize", &report);
}

#[test]
fn colours() {
    let (means, ..) = scene();
    let report = gradcheck(
        |(sh0, rest, means, centers)| sh_colors(sh0, Some(rest), means, centers, 3, None),
        (
            ("sh0", random::<3>(36, [N, 1, 3])),
            ("rest", random::<3>(37, [N, 15, 3]) * 0.3),
            ("means", means),
            ("centers", random::<2>(38, [2, 3]) * 0.1),
        ),
    )
    .unwrap();
    assert_clean("sh_colors", &report);
}

/// A colour exactly at its clamp is a kink, where the op's gradient is the slope on the right.
#[test]
fn a_colour_at_its_clamp_is_a_kink() {
    const SH0: f64 = 0.28209479177387814;
    let report = gradcheck(
        |(sh0, means, centers)| sh_colors(sh0, None, means, centers, 0, None),
        (
            ("sh0", tensor([-0.5 / SH0, 0.3, 0.2], [1, 1, 3])),
            ("means", tensor([0.1, 0.2, 3.0], [1, 3])),
            ("centers", tensor([0.0, 0.0, 0.0], [1, 3])),
        ),
    )
    .unwrap();
    report.expect();
    let findings = &report.row("sh0").unwrap().findings;
    assert_eq!(findings.len(), 1, "{report}");
    assert!(
        matches!(findings[0].kind, Kind::Kink { accepted: true, .. }),
        "{report}"
    );
    assert_eq!(findings[0].comparison.at, Some(vec![0, 0, 0]), "{report}");
}

#[test]
fn similarity_and_blur() {
    let window = vec![0.1, 0.2, 0.4, 0.2, 0.1];
    let args = SsimArgs {
        window: window.clone(),
        c1: 1e-4,
        c2: 9e-4,
    };
    let image = |seed| random::<4>(seed, [1, 6, 7, 2]) * 0.5 + 0.5;
    let report = gradcheck(
        |[x, y]| ssim_map(x, y, &args),
        [("x", image(40)), ("y", image(41))],
    )
    .unwrap();
    assert_clean("ssim_map", &report);
    let report = gradcheck(|x| gaussian_blur(x, &window), ("x", image(42))).unwrap();
    assert_clean("gaussian_blur", &report);
}
