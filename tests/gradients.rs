//! Every gradient agrees with PyTorch, on every device and in every precision.
//!
//! The fixtures in `tests/fixtures` are scenes with the images and gradients of a brute-force
//! float64 renderer (`generate.py`). The gates on the relative L2 error of every parameter group
//! and image are 1e-9 in double precision, 1e-5 in single precision, and 1e-3 for scenes marked
//! hard. The negative controls switch on known bugs, which the same gates must catch.

#[cfg(feature = "wgpu")]
mod adapter;

use std::path::PathBuf;

use burn::tensor::Device;
use splat_lab::gradcheck::{Bug, FileReport, Fixture, Precision, check, check_file, run, table};

/// All fixtures, sorted by name.
fn fixtures() -> Vec<PathBuf> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures");
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .expect("the fixtures are part of the repository")
        .map(|entry| entry.expect("a readable folder").path())
        .filter(|path| path.extension().is_some_and(|e| e == "safetensors"))
        .collect();
    files.sort();
    assert!(
        files.len() >= 20,
        "only {} fixtures in {folder}",
        files.len()
    );
    files
}

fn fixture(name: &str) -> Fixture {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("tests/fixtures")
        .join(name)
        .with_extension("safetensors");
    Fixture::read(&path).unwrap_or_else(|error| panic!("{error}"))
}

/// Checks every fixture, prints one line for each, and fails with the full table of the failures.
fn check_all(device: &Device, precision: Precision) {
    let reports: Vec<FileReport> = fixtures()
        .iter()
        .map(|path| {
            check_file(path, device, precision, None).unwrap_or_else(|error| panic!("{error}"))
        })
        .collect();
    for report in &reports {
        let (group, rel_l2) = report.worst_group();
        let pictures: Vec<_> = report
            .outputs
            .iter()
            .map(|o| format!("{} {:.1e}", o.name, o.rel_l2))
            .collect();
        println!(
            "{} {:<36} gate {:.0e}  worst {rel_l2:.1e} ({group})  {}  {} of {} pixels near a threshold",
            if report.pass { "pass" } else { "FAIL" },
            report.file.file_stem().unwrap_or_default().display(),
            report.gate,
            pictures.join("  "),
            report.near_threshold,
            report.pixels,
        );
    }
    let failed: Vec<_> = reports.into_iter().filter(|r| !r.pass).collect();
    assert!(
        failed.is_empty(),
        "{} fixtures fail on {device:?} in {precision}:\n{}",
        failed.len(),
        table(&failed)
    );
}

#[cfg(feature = "cpu")]
mod cpu {
    use super::*;

    #[test]
    fn double_precision_agrees_with_pytorch() {
        check_all(&Device::flex(), Precision::F64);
    }

    #[test]
    fn single_precision_agrees_with_pytorch() {
        check_all(&Device::flex(), Precision::F32);
    }

    /// The image does not depend on a quaternion's length or sign, and no gradient is along it.
    #[test]
    fn quaternion_length_and_sign_change_nothing() {
        let computed = |name| {
            let fixture = fixture(name);
            let computed = run(&fixture.scene, &Device::flex(), Precision::F64, None)
                .unwrap_or_else(|error| panic!("{error}"));
            (fixture, computed)
        };
        let (_, plain) = computed("quaternion");
        for name in ["quaternion", "quaternion_negated", "quaternion_times_5"] {
            let (fixture, other) = computed(name);
            for (a, b) in plain
                .outputs
                .image
                .values
                .iter()
                .zip(&other.outputs.image.values)
            {
                assert!((a - b).abs() <= 1e-13, "{name}: {a} and {b}");
            }
            let quats = fixture.scene.inputs.quats.values.chunks_exact(4);
            for (q, g) in quats.zip(other.gradients.quats.values.chunks_exact(4)) {
                let radial: f64 = q.iter().zip(g).map(|(q, g)| q * g).sum();
                assert!(
                    radial.abs() <= 1e-12,
                    "{name}: {radial} along the quaternion"
                );
            }
        }
    }

    /// Runs every fixture with a bug; returns the names of the failing ones with their failing
    /// groups.
    fn caught(bug: Bug, precision: Precision) -> Vec<(String, Vec<&'static str>, bool)> {
        fixtures()
            .iter()
            .map(|path| Fixture::read(path).unwrap_or_else(|error| panic!("{error}")))
            .map(|fixture| {
                check(&fixture, &Device::flex(), precision, Some(bug))
                    .unwrap_or_else(|error| panic!("{error}"))
            })
            .filter(|report| !report.pass)
            .map(|report| {
                let name = report.file.file_stem().unwrap_or_default();
                let groups = report.groups.iter().filter(|g| !g.pass);
                (
                    name.display().to_string(),
                    groups.map(|g| g.name).collect(),
                    report.outputs.iter().all(|o| o.pass),
                )
            })
            .collect()
    }

    /// The bug must make `fixture` fail in all of `groups`, in both precisions. A bug in the
    /// backward pass alone must leave the images correct: only the gradients reveal it.
    fn must_be_caught(bug: Bug, fixture: &str, groups: &[&str], pictures_right: bool) {
        for precision in [Precision::F64, Precision::F32] {
            let caught = caught(bug, precision);
            println!("{bug:?} in {precision}: {} fixtures fail", caught.len());
            let found = caught.iter().find(|(name, ..)| name == fixture);
            let Some((_, failed, pictures)) = found else {
                panic!("{bug:?} in {precision}: `{fixture}` passes; caught: {caught:?}");
            };
            for group in groups {
                assert!(
                    failed.contains(group),
                    "{bug:?} in {precision}: {group} of `{fixture}` passes, only {failed:?} fail"
                );
            }
            assert_eq!(
                *pictures, pictures_right,
                "{bug:?} in {precision}: pictures of `{fixture}`"
            );
        }
    }

    #[test]
    fn a_detached_direction_is_caught() {
        must_be_caught(
            Bug::DirectionDetached,
            "sh_degree_3",
            &["means", "viewmat"],
            true,
        );
    }

    #[test]
    fn a_skipped_quaternion_normalisation_is_caught() {
        must_be_caught(
            Bug::QuaternionNormalisationSkipped,
            "quaternion_times_5",
            &["quats"],
            true,
        );
    }

    #[test]
    fn a_halved_off_diagonal_gradient_is_caught() {
        must_be_caught(
            Bug::OffDiagonalHalved,
            "three_gaussians",
            &["means", "quats", "scales"],
            true,
        );
    }

    #[test]
    fn an_ignored_clamp_is_caught() {
        for fixture in [
            "clamped_left",
            "clamped_right",
            "clamped_top",
            "clamped_bottom",
            "clamped_corner_off_centre",
        ] {
            must_be_caught(Bug::ClampIgnored, fixture, &["means", "intrinsics"], false);
        }
    }
}

#[cfg(feature = "wgpu")]
mod wgpu {
    use super::*;

    #[test]
    fn single_precision_agrees_with_pytorch() {
        if let Some(device) = adapter::adapter() {
            check_all(&device, Precision::F32);
        }
    }
}
