//! Functions agree with PyTorch, values and gradients, on every device and in every precision.
//!
//! The fixtures in `tests/fixtures/functions` come from `functions.py` beside them. Gates, on the
//! relative L2 error of every output and gradient: 1e-9 in double precision, 1e-5 in single
//! precision, 1e-3 for what is marked hard. The negative controls change what is expected, or
//! compute something else, and demand that the same gates notice.
#![cfg(feature = "cpu")]

mod adam;
#[cfg(feature = "wgpu")]
#[path = "../adapter/mod.rs"]
mod adapter;
mod fixture;
mod twins;

use burn::tensor::Device;
use fixture::{Fixture, Place, Row};
use splat_lab::gradcheck::Precision;
use twins::{BUGS, TWINS};

/// Prints the worst error of each fixture and fails with all rows beyond their gates.
fn check_all(device: &Device, precision: Precision) {
    let place = Place::new(device, precision);
    let mut failed = Vec::new();
    let mut judge = |name: &str, rows: Vec<Row>| {
        let worst = rows
            .iter()
            .max_by(|a, b| a.severity().total_cmp(&b.severity()));
        println!("{name:<34} {}", worst.expect("a fixture has outputs"));
        let beyond = rows.iter().filter(|row| !row.passes());
        failed.extend(beyond.map(|row| format!("{name}: {row}")));
    };
    for (name, twin) in TWINS {
        let fixture = Fixture::read(name);
        judge(name, fixture.compare(&fixture.run(&place, *twin), &place));
    }
    for name in adam::FILES {
        judge(name, adam::check(&Fixture::read(name), &place, None));
    }
    assert!(
        failed.is_empty(),
        "on {device:?} in {precision}:\n{}",
        failed.join("\n")
    );
}

/// Every file in the folder has a twin.
#[test]
fn no_file_is_left_out() {
    let mut files: Vec<String> = std::fs::read_dir(fixture::FOLDER)
        .expect("the fixtures are part of the repository")
        .map(|entry| entry.expect("a readable folder").path())
        .map(|path| path.file_stem().unwrap_or_default().display().to_string())
        .collect();
    let twins = TWINS.iter().map(|(name, _)| *name);
    let mut checked: Vec<&str> = twins.chain(adam::FILES).collect();
    files.sort();
    checked.sort_unstable();
    assert_eq!(files, checked);
}

#[test]
fn double_precision_agrees_with_pytorch() {
    check_all(&Device::flex(), Precision::F64);
}

#[test]
fn single_precision_agrees_with_pytorch() {
    check_all(&Device::flex(), Precision::F32);
}

#[cfg(feature = "wgpu")]
#[test]
fn single_precision_on_wgpu_agrees_with_pytorch() {
    if let Some(device) = adapter::adapter() {
        check_all(&device, Precision::F32);
    }
}

const PRECISIONS: [Precision; 2] = [Precision::F64, Precision::F32];

/// Every expected output and gradient is compared: where one of them is 20 gates off, it fails.
#[test]
fn another_expected_value_is_noticed() {
    for precision in PRECISIONS {
        let place = Place::new(&Device::flex(), precision);
        for (name, twin) in TWINS {
            let fixture = Fixture::read(name);
            let found = fixture.run(&place, *twin);
            for tensor in fixture.expected() {
                let changed = fixture.with_error(tensor, 20.0 * fixture.gate(&place));
                let rows = changed.compare(&found, &place);
                let failed: Vec<_> = rows.iter().filter(|row| !row.passes()).collect();
                let names: Vec<_> = failed.iter().map(|row| row.name.as_str()).collect();
                assert_eq!(names, [tensor], "{name} in {precision}");
            }
        }
    }
}

/// A wrong function fails, in the tensor that it is wrong in.
#[test]
fn a_wrong_function_is_noticed() {
    for precision in PRECISIONS {
        let place = Place::new(&Device::flex(), precision);
        for (name, tensor, wrong) in BUGS {
            let fixture = Fixture::read(name);
            let rows = fixture.compare(&fixture.run(&place, *wrong), &place);
            let row = rows.iter().find(|row| row.name == *tensor);
            let row = row.unwrap_or_else(|| panic!("{name} has no `{tensor}`"));
            println!("{name:<26} in {precision}: {row}");
            assert!(!row.passes(), "{name} in {precision}: {row}");
        }
        for (name, bug) in adam::BUGS {
            let rows = adam::check(&Fixture::read(name), &place, Some(*bug));
            let failed = rows.iter().find(|row| !row.passes());
            let row = failed.unwrap_or_else(|| panic!("{name} in {precision}: {bug:?} passes"));
            println!("{name:<26} in {precision}, {bug:?}: {row}");
        }
    }
}
