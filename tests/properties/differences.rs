//! The gradient of each op by itself against central differences in double precision.
//!
//! Along a direction v, with L the loss: `D(h) = (L(x + h v) - L(x - h v)) / 2 h`, and Richardson's
//! `(4 D(h) - D(2 h)) / 3`, whose error falls with h^4. At h = 5e-5 that is far below rounding
//! (1e-16 |L| / h, some 1e-10 of the derivative), which is far below the gate.
//!
//! The ops are smooth but where they decide: culled or not, clamped or not, below the cut of alpha,
//! at its cap, stopped. A case where some decision differs between the points of a difference is
//! thrown away and another drawn.

use burn::tensor::{DType, Tensor};
use burn_splat::ops::{
    ProjectSettings, Projected, RasterizeSettings, project, rasterize, spherical_harmonics,
};
use glam::DMat4;
use proptest::collection::vec;
use proptest::prelude::*;

use super::scene::{
    COEFFS, SIZE, Scene, Upload, host, rotations, rows, scenes, thresholds, vectors,
};
use super::support::{close, config, weights};

/// Gate on the relative L2 error of the derivatives along a tensor's directions. Measured: 3e-9.
const GATE: f64 = 1e-7;
const STEP: f64 = 5e-5;
/// Per tensor; together they find any error that is not orthogonal to all of them.
const DIRECTIONS: usize = 4;
/// Gaussians of a case. Fixed, so that directions can be drawn beside the scene.
const COUNT: usize = 8;
const CAMERAS: usize = 2;

const TO: Upload = Upload { dtype: DType::F64 };

/// One op on plain values, under one weighted sum of its outputs.
trait Op {
    /// Names of the inputs.
    const NAMES: &'static [&'static str];
    /// The sum, and its gradient by every input.
    fn loss(&self, inputs: &[Vec<f64>]) -> (f64, Vec<Vec<f64>>);
    /// Every decision on the way, in some fixed order.
    fn decisions(&self, inputs: &[Vec<f64>]) -> Vec<u8>;
}

/// Directions per input, of any length near 1 per entry.
fn directions(lengths: &[usize]) -> impl Strategy<Value = Vec<Vec<Vec<f64>>>> + use<> {
    lengths
        .iter()
        .map(|length| vec(vec(-1.0..1.0f64, *length), DIRECTIONS))
        .collect::<Vec<_>>()
}

fn check<O: Op>(
    op: &O,
    inputs: &[Vec<f64>],
    directions: &[Vec<Vec<f64>>],
) -> Result<(), TestCaseError> {
    let (_, gradients) = op.loss(inputs);
    let decisions = op.decisions(inputs);
    for (i, name) in O::NAMES.iter().enumerate() {
        let mut expected = Vec::new();
        let mut got = Vec::new();
        for direction in &directions[i] {
            let at = |step: f64| {
                let mut inputs = inputs.to_vec();
                for (x, v) in inputs[i].iter_mut().zip(direction) {
                    *x += step * v;
                }
                (op.decisions(&inputs) == decisions).then(|| op.loss(&inputs).0)
            };
            let difference = |step: f64| Some((at(step)? - at(-step)?) / (2.0 * step));
            let (Some(fine), Some(coarse)) = (difference(STEP), difference(2.0 * STEP)) else {
                return Err(TestCaseError::reject("a decision is near"));
            };
            expected.push((4.0 * fine - coarse) / 3.0);
            got.push(
                direction
                    .iter()
                    .zip(&gradients[i])
                    .map(|(v, g)| v * g)
                    .sum(),
            );
        }
        close(name, &got, &expected, GATE)?;
    }
    Ok(())
}

/// Inputs: means, quats, scales, viewmats, intrinsics.
struct Project {
    settings: ProjectSettings,
}

impl Project {
    fn run(&self, inputs: &[Tensor<1>]) -> Projected {
        project(
            inputs[0].clone().reshape([COUNT, 3]),
            inputs[1].clone().reshape([COUNT, 4]),
            inputs[2].clone().reshape([COUNT, 3]),
            inputs[3].clone().reshape([CAMERAS, 4, 4]),
            inputs[4].clone().reshape([CAMERAS, 4]),
            SIZE,
            &self.settings,
        )
        .expect("shapes fit")
    }
}

impl Op for Project {
    const NAMES: &'static [&'static str] = &["means", "quats", "scales", "viewmats", "intrinsics"];

    fn loss(&self, inputs: &[Vec<f64>]) -> (f64, Vec<Vec<f64>>) {
        differentiate(inputs, |leaves| {
            // The extents, the last two of nine columns, carry no gradient by design.
            self.run(leaves).packed().narrow(2, 0, 7)
        })
    }

    /// Culled; left of, within, right of (above, within, below) the clamp of the Jacobian.
    fn decisions(&self, inputs: &[Vec<f64>]) -> Vec<u8> {
        let leaves: Vec<_> = inputs
            .iter()
            .map(|x| TO.constant::<1>(x, [x.len()]))
            .collect();
        let extents = host(self.run(&leaves).extents());
        let mut decisions: Vec<u8> = extents.iter().map(|e| u8::from(*e > 0.0)).collect();
        let margin = self.settings.clamp_margin;
        for camera in 0..CAMERAS {
            let row = |i: usize| &inputs[3][16 * camera + 4 * i..];
            let intrinsics = &inputs[4][4 * camera..];
            for mean in inputs[0].chunks_exact(3) {
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
}

/// Inputs: coefficients, directions.
struct SphericalHarmonics {
    degree: usize,
}

impl Op for SphericalHarmonics {
    const NAMES: &'static [&'static str] = &["coeffs", "dirs"];

    fn loss(&self, inputs: &[Vec<f64>]) -> (f64, Vec<Vec<f64>>) {
        differentiate(inputs, |leaves| {
            spherical_harmonics(
                leaves[0].clone().reshape([COUNT, 16, 3]),
                leaves[1].clone().reshape([CAMERAS, COUNT, 3]),
                self.degree,
            )
            .expect("shapes fit")
        })
    }

    /// Smooth but at directions of no length, which are not drawn.
    fn decisions(&self, _: &[Vec<f64>]) -> Vec<u8> {
        Vec::new()
    }
}

/// Inputs: packed screen splats, colours, opacities, background.
struct Rasterize {
    settings: RasterizeSettings,
}

/// Channels of the rasterised case.
const CHANNELS: usize = 2;

impl Op for Rasterize {
    const NAMES: &'static [&'static str] = &["packed", "colors", "opacities", "background"];

    fn loss(&self, inputs: &[Vec<f64>]) -> (f64, Vec<Vec<f64>>) {
        differentiate(inputs, |leaves| {
            let packed = leaves[0].clone().reshape([CAMERAS, COUNT, 9]);
            let projected = Projected::from_packed(packed, SIZE).expect("shapes fit");
            rasterize(
                &projected,
                leaves[1].clone().reshape([CAMERAS, COUNT, CHANNELS]),
                leaves[2].clone().reshape([CAMERAS, COUNT]),
                Some(leaves[3].clone().reshape([CAMERAS, CHANNELS])),
                &self.settings,
            )
            .expect("shapes fit")
            .packed()
        })
    }

    /// What becomes of every splat at every pixel.
    fn decisions(&self, inputs: &[Vec<f64>]) -> Vec<u8> {
        let settings = &self.settings;
        let mut decisions = Vec::new();
        let cameras = inputs[0].chunks_exact(9 * COUNT);
        for (packed, opacities) in cameras.zip(inputs[2].chunks_exact(COUNT)) {
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
}

const SKIPPED: u8 = 0;
const BLENDED: u8 = 1;
const CAPPED: u8 = 2;
const STOPPED: u8 = 3;

/// The weighted sum of an op's output, and its gradient by every input.
fn differentiate<const D: usize>(
    inputs: &[Vec<f64>],
    op: impl FnOnce(&[Tensor<1>]) -> Tensor<D>,
) -> (f64, Vec<Vec<f64>>) {
    let leaves: Vec<_> = inputs.iter().map(|x| TO.leaf::<1>(x, [x.len()])).collect();
    let output = op(&leaves);
    let shape = output.dims();
    let loss = (output * TO.constant(&weights(shape.iter().product()), shape)).sum();
    let grads = loss.clone().backward();
    let gradients = leaves
        .iter()
        .map(|leaf| host(leaf.grad(&grads).expect("tracked")))
        .collect();
    (loss.into_scalar(), gradients)
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
fn screen(scene: &Scene, viewmats: &[f64], intrinsics: &[f64]) -> Vec<f64> {
    let inputs = [
        &scene.means,
        &scene.quats,
        &scene.scales,
        &viewmats.to_vec(),
        &intrinsics.to_vec(),
    ]
    .map(|x| TO.constant::<1>(x, [x.len()]));
    let op = Project {
        settings: scene.project_settings(),
    };
    host(op.run(&inputs).packed())
}

proptest! {
    #![proptest_config(config(48))]

    #[test]
    fn project_agrees_with_central_differences(
        (scene, viewmats, intrinsics) in cameras(),
        directions in directions(&[3 * COUNT, 4 * COUNT, 3 * COUNT, 16 * CAMERAS, 4 * CAMERAS]),
    ) {
        let op = Project { settings: scene.project_settings() };
        check(&op, &[scene.means, scene.quats, scene.scales, viewmats, intrinsics], &directions)?;
    }

    #[test]
    fn spherical_harmonics_agree_with_central_differences(
        coeffs in vec(-1.0..1.0, COUNT * COEFFS),
        dirs in vec(
            vectors(2.0).prop_filter("too short", |v| v.length() > 0.3).prop_map(|v| v.to_array()),
            CAMERAS * COUNT,
        ),
        degree in 0..=3usize,
        directions in directions(&[COUNT * COEFFS, 3 * CAMERAS * COUNT]),
    ) {
        check(&SphericalHarmonics { degree }, &[coeffs, dirs.concat()], &directions)?;
    }

    #[test]
    fn rasterize_agrees_with_central_differences(
        (scene, viewmats, intrinsics) in cameras(),
        colors in vec(-1.0..1.0, CAMERAS * COUNT * CHANNELS),
        background in vec(-1.0..1.0, CAMERAS * CHANNELS),
        settings in thresholds(),
        mut directions in directions(
            &[9 * CAMERAS * COUNT, CAMERAS * COUNT * CHANNELS, CAMERAS * COUNT, CAMERAS * CHANNELS],
        ),
    ) {
        let packed = screen(&scene, &viewmats, &intrinsics);
        let opacities = [&scene.opacities[..], &scene.opacities[..]].concat();
        let inputs = [packed, colors, opacities, background];
        // Depth and extents only order and cull, the compensation is not read: not differentiated.
        for direction in &mut directions[0] {
            for row in direction.chunks_exact_mut(9) {
                for column in [2, 6, 7, 8] {
                    row[column] = 0.0;
                }
            }
        }
        let op = Rasterize { settings };
        let (_, gradients) = op.loss(&inputs);
        for row in gradients[0].chunks_exact(9) {
            prop_assert_eq!([row[2], row[6], row[7], row[8]], [0.0; 4]);
        }
        check(&op, &inputs, &directions)?;
    }
}

/// The scenes above come by every decision, so that no branch goes unchecked.
#[test]
fn random_scenes_come_by_every_decision() {
    use proptest::test_runner::TestRunner;

    let found = std::cell::RefCell::new([0usize; 4]);
    let outside = std::cell::Cell::new(0);
    TestRunner::new(config(48))
        .run(
            &(cameras(), thresholds()),
            |((scene, viewmats, intrinsics), settings)| {
                let op = Project {
                    settings: scene.project_settings(),
                };
                let packed = screen(&scene, &viewmats, &intrinsics);
                let opacities = [&scene.opacities[..], &scene.opacities[..]].concat();
                for decision in (Rasterize { settings }).decisions(&[packed, Vec::new(), opacities])
                {
                    found.borrow_mut()[usize::from(decision)] += 1;
                }
                let inputs = [scene.means, scene.quats, scene.scales, viewmats, intrinsics];
                let decisions = op.decisions(&inputs);
                // Extents of visible splats first, then the places relative to the clamp.
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
