//! Gradients of each op against central differences in double precision, by `splat_lab::central`,
//! along random directions over each input.
//!
//! The ops are smooth except at decisions: culled or not, clamped or not, below the cut of alpha,
//! at its cap, stopped. Steps shrink until no decision changes within them. The last test counts
//! the decisions.

use burn::tensor::Tensor;
use burn_splat::ops::{
    ProjectSettings, Projected, RasterizeSettings, project, rasterize, spherical_harmonics,
};
use glam::DMat4;
use proptest::collection::vec;
use proptest::prelude::*;
use splat_lab::central::{CheckError, Coverage, Report, Settings, gradcheck_with, tensor};

use super::scene::{COEFFS, SIZE, Scene, host, rotations, rows, scenes, thresholds, vectors};
use super::support::{config, weights};

/// Gate on the difference of derivatives along a direction, relative to the root of the sum of the
/// squared derivatives of its elements.
const GATE: f64 = 1e-7;
/// Largest error at a single element that may go unseen, in units of the root mean square
/// derivative. Measured: 3e-6.
const UNSEEN: f64 = 1e-5;
/// Directions per tensor; together they detect any error that is not orthogonal to all of them.
const DIRECTIONS: usize = 4;
/// Gaussians per case.
const COUNT: usize = 8;
const CAMERAS: usize = 2;

/// Directions over all elements of all inputs, different for every seed.
fn along_directions(seed: u64) -> Settings {
    Settings::new()
        .with_tolerance(GATE)
        .with_each_up_to(0)
        .with_directions(DIRECTIONS)
        .with_seed(seed)
}

/// Checks that all gradients agree, and that an error would have been seen.
fn judge(report: Result<Report, CheckError>) -> Result<(), TestCaseError> {
    let report = report.map_err(|error| TestCaseError::fail(error.to_string()))?;
    prop_assert!(report.is_ok(), "{report}");
    for row in &report.rows {
        if let Coverage::Directions { limit, .. } = row.coverage {
            prop_assert!(limit < UNSEEN, "{report}");
        }
    }
    Ok(())
}

type ProjectInputs = (Tensor<2>, Tensor<2>, Tensor<2>, Tensor<3>, Tensor<2>);

/// Means, quats, scales, viewmats and intrinsics as tensors.
fn project_inputs(scene: &Scene, viewmats: &[f64], intrinsics: &[f64]) -> ProjectInputs {
    (
        tensor(&scene.means[..], [COUNT, 3]),
        tensor(&scene.quats[..], [COUNT, 4]),
        tensor(&scene.scales[..], [COUNT, 3]),
        tensor(viewmats, [CAMERAS, 4, 4]),
        tensor(intrinsics, [CAMERAS, 4]),
    )
}

fn run_project(inputs: ProjectInputs, settings: &ProjectSettings) -> Projected {
    let (means, quats, scales, viewmats, intrinsics) = inputs;
    project(means, quats, scales, viewmats, intrinsics, SIZE, settings).expect("shapes fit")
}

/// A second camera near the first, so that both see the scene.
fn cameras() -> impl Strategy<Value = (Scene, Vec<f64>, Vec<f64>)> {
    (
        scenes(COUNT..=COUNT),
        rotations(),
        vectors(0.2),
        0.9..1.1f64,
    )
        .prop_map(|(scene, turn, shift, zoom)| {
            let turn = glam::DQuat::IDENTITY.slerp(turn, 0.05);
            let second = DMat4::from_rotation_translation(turn, shift) * scene.viewmat;
            let viewmats = [rows(scene.viewmat), rows(second)].concat();
            let intrinsics = [scene.intrinsics, scene.intrinsics.map(|x| x * zoom)].concat();
            (scene, viewmats, intrinsics)
        })
}

/// Screen splats of both cameras `[C, N, 9]`.
fn screen(scene: &Scene, viewmats: &[f64], intrinsics: &[f64]) -> Tensor<3> {
    let inputs = project_inputs(scene, viewmats, intrinsics);
    run_project(inputs, &scene.project_settings()).packed()
}

/// Colours and a background for both cameras.
fn paint() -> impl Strategy<Value = (Tensor<3>, Tensor<2>)> {
    (
        vec(-1.0..1.0, CAMERAS * COUNT * CHANNELS),
        vec(-1.0..1.0, CAMERAS * CHANNELS),
    )
        .prop_map(|(colors, background): (Vec<f64>, Vec<f64>)| {
            (
                tensor(colors, [CAMERAS, COUNT, CHANNELS]),
                tensor(background, [CAMERAS, CHANNELS]),
            )
        })
}

/// Channels of the rasterised case.
const CHANNELS: usize = 2;

/// The opacities of a scene for both cameras.
fn opacities(scene: &Scene) -> Tensor<2> {
    tensor(scene.opacities.repeat(CAMERAS), [CAMERAS, COUNT])
}

fn run_rasterize(
    (packed, colors, opacities, background): (Tensor<3>, Tensor<3>, Tensor<2>, Tensor<2>),
    settings: &RasterizeSettings,
) -> Tensor<4> {
    let projected = Projected::from_packed(packed, SIZE).expect("shapes fit");
    rasterize(&projected, colors, opacities, Some(background), settings)
        .expect("shapes fit")
        .packed()
}

/// Differentiable columns of the screen splats: mean and inverse Cholesky factor. Depth and extents
/// only order and cull; the compensation is not read.
fn differentiated(packed: &Tensor<3>) -> Tensor<3> {
    let columns = |start, length| packed.clone().narrow(2, start, length);
    Tensor::cat(vec![columns(0, 2), columns(3, 3)], 2)
}

/// `packed` with other values in the differentiable columns.
fn with_differentiated(packed: &Tensor<3>, values: Tensor<3>) -> Tensor<3> {
    let kept = |start, length| packed.clone().narrow(2, start, length);
    let new = |start, length| values.clone().narrow(2, start, length);
    Tensor::cat(vec![new(0, 2), kept(2, 1), new(2, 3), kept(6, 3)], 2)
}

proptest! {
    #![proptest_config(config(48))]

    #[test]
    fn project_agrees_with_central_differences(
        (scene, viewmats, intrinsics) in cameras(),
        seed in any::<u64>(),
    ) {
        let settings = scene.project_settings();
        let (means, quats, scales, viewmats, intrinsics) =
            project_inputs(&scene, &viewmats, &intrinsics);
        judge(gradcheck_with(
            // The extents, the last two of nine columns, carry no gradient by design.
            |inputs| run_project(inputs, &settings).packed().narrow(2, 0, 7),
            (
                ("means", means),
                ("quats", quats),
                ("scales", scales),
                ("viewmats", viewmats),
                ("intrinsics", intrinsics),
            ),
            &along_directions(seed),
        ))?;
    }

    #[test]
    fn spherical_harmonics_agree_with_central_differences(
        coeffs in vec(-1.0..1.0, COUNT * COEFFS),
        dirs in vec(
            vectors(2.0).prop_filter("too short", |v| v.length() > 0.3).prop_map(|v| v.to_array()),
            CAMERAS * COUNT,
        ),
        degree in 0..=3usize,
        seed in any::<u64>(),
    ) {
        judge(gradcheck_with(
            |(coeffs, dirs)| spherical_harmonics(coeffs, dirs, degree),
            (
                ("coeffs", tensor(coeffs, [COUNT, 16, 3])),
                ("dirs", tensor(dirs.concat(), [CAMERAS, COUNT, 3])),
            ),
            &along_directions(seed),
        ))?;
    }

    #[test]
    fn rasterize_agrees_with_central_differences(
        (scene, viewmats, intrinsics) in cameras(),
        (colors, background) in paint(),
        settings in thresholds(),
        seed in any::<u64>(),
    ) {
        let packed = screen(&scene, &viewmats, &intrinsics);
        let leaf = packed.clone().require_grad();
        let inputs = (leaf.clone(), colors.clone(), opacities(&scene), background.clone());
        let output = run_rasterize(inputs, &settings);
        let shape = output.dims();
        let weights = tensor(weights(shape.iter().product()), shape);
        let gradient = leaf.grad(&(output * weights).sum().backward());
        for row in host(gradient.expect("tracked")).chunks_exact(9) {
            prop_assert_eq!([row[2], row[6], row[7], row[8]], [0.0; 4]);
        }
        judge(gradcheck_with(
            |(splats, colors, opacities, background)| {
                let packed = with_differentiated(&packed, splats);
                run_rasterize((packed, colors, opacities, background), &settings)
            },
            (
                ("splats", differentiated(&packed)),
                ("colors", colors),
                ("opacities", opacities(&scene)),
                ("background", background),
            ),
            &along_directions(seed),
        ))?;
    }
}

/// The scenes above meet every decision, so that no branch is unchecked.
#[test]
fn random_scenes_come_by_every_decision() {
    use proptest::test_runner::TestRunner;

    let found = std::cell::RefCell::new([0usize; 4]);
    let outside = std::cell::Cell::new(0);
    TestRunner::new(config(48))
        .run(
            &(cameras(), thresholds()),
            |((scene, viewmats, intrinsics), settings)| {
                let packed = host(screen(&scene, &viewmats, &intrinsics));
                let opacities = host(opacities(&scene));
                for decision in rasterize_decisions(&packed, &opacities, &settings) {
                    found.borrow_mut()[usize::from(decision)] += 1;
                }
                let decisions = project_decisions(&scene, &viewmats, &intrinsics);
                // Extents of visible splats first, then the positions relative to the clamp.
                let (extents, clamps) = decisions.split_at(2 * CAMERAS * COUNT);
                let visible = extents.chunks_exact(2).map(|e| e[0] > 0);
                let clamped = clamps.chunks_exact(2).map(|c| c != [1, 1]);
                outside.set(outside.get() + visible.zip(clamped).filter(|(v, c)| *v && *c).count());
                Ok(())
            },
        )
        .expect("nothing is asserted inside");
    let found = found.into_inner();
    println!(
        "skipped, blended, capped, stopped: {found:?}; clamped: {}",
        outside.get()
    );
    assert!(found.iter().all(|count| *count > 100), "{found:?}");
    assert!(
        outside.get() > 10,
        "{} visible splats beyond the clamp",
        outside.get()
    );
}

/// Culled; left of, within, right of (above, within, below) the clamp of the Jacobian.
fn project_decisions(scene: &Scene, viewmats: &[f64], intrinsics: &[f64]) -> Vec<u8> {
    let settings = scene.project_settings();
    let projected = run_project(project_inputs(scene, viewmats, intrinsics), &settings);
    let extents = host(projected.extents());
    let mut decisions: Vec<u8> = extents.iter().map(|e| u8::from(*e > 0.0)).collect();
    let margin = settings.clamp_margin;
    for camera in 0..CAMERAS {
        let row = |i: usize| &viewmats[16 * camera + 4 * i..];
        let intrinsics = &intrinsics[4 * camera..];
        for mean in scene.means.chunks_exact(3) {
            let seen = |i: usize| {
                let row = row(i);
                row[0] * mean[0] + row[1] * mean[1] + row[2] * mean[2] + row[3]
            };
            for (axis, side) in [(0, f64::from(SIZE.width)), (1, f64::from(SIZE.height))] {
                let pixel = intrinsics[axis] * seen(axis) / seen(2) + intrinsics[2 + axis];
                let (low, high) = (-margin * side, (1.0 + margin) * side);
                decisions.push(u8::from(pixel >= low) + u8::from(pixel > high));
            }
        }
    }
    decisions
}

const SKIPPED: u8 = 0;
const BLENDED: u8 = 1;
const CAPPED: u8 = 2;
const STOPPED: u8 = 3;

/// The decision for every splat at every pixel.
fn rasterize_decisions(packed: &[f64], opacities: &[f64], settings: &RasterizeSettings) -> Vec<u8> {
    let mut decisions = Vec::new();
    let cameras = packed.chunks_exact(9 * COUNT);
    for (packed, opacities) in cameras.zip(opacities.chunks_exact(COUNT)) {
        let mut splats: Vec<_> = packed.chunks_exact(9).zip(opacities).collect();
        splats.retain(|(row, _)| row[7] > 0.0);
        splats.sort_by(|(a, _), (b, _)| a[2].total_cmp(&b[2]));
        for (y, x) in (0..SIZE.height).flat_map(|y| (0..SIZE.width).map(move |x| (y, x))) {
            let (x, y) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
            let mut transmittance = 1.0;
            for (row, opacity) in &splats {
                let (dx, dy) = (x - row[0], y - row[1]);
                let (z1, z2) = (row[3] * dx, row[4] * dx + row[5] * dy);
                let raw = *opacity * (-(z1 * z1 + z2 * z2) / 2.0).exp();
                if raw < settings.alpha_min {
                    decisions.push(SKIPPED);
                    continue;
                }
                let after = transmittance * (1.0 - raw.min(settings.alpha_max));
                if after < settings.transmittance_min {
                    decisions.push(STOPPED);
                    break;
                }
                transmittance = after;
                decisions.push(if raw >= settings.alpha_max {
                    CAPPED
                } else {
                    BLENDED
                });
            }
        }
    }
    decisions
}
