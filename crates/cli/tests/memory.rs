//! Work that does not fit into memory is refused in one line; a failed allocation would end the
//! process without a message.
#![cfg(all(feature = "cpu", target_os = "linux"))]

use std::path::Path;
use std::process::{Command, Output};

use splat_data::SplatData;
use splat_data::scene::ply;

/// Limit of the address space in kB, for `ulimit -v`: 1.5 GB.
const LIMIT: &str = "1500000";

/// Gaussians that each fill the whole picture, barely visible, so that no pixel stops.
fn haze(count: usize) -> SplatData {
    SplatData {
        means: (0..count)
            .map(|i| [(i % 17) as f32 * 0.1, (i % 5) as f32 * 0.1, 0.0])
            .collect(),
        log_scales: vec![[2.5; 3]; count],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![-4.0; count],
        sh0: vec![[0.3; 3]; count],
        sh_rest: Vec::new(),
        sh_degree: 0,
        ..SplatData::default()
    }
}

fn render_with_little_memory(folder: &Path, count: usize) -> Output {
    let scene = folder.join("scene.ply");
    ply::write(&scene, &haze(count)).unwrap();
    Command::new("sh")
        .args(["-c", "ulimit -v $0 && exec \"$@\"", LIMIT])
        .arg(env!("CARGO_BIN_EXE_splat"))
        .args(["--device", "cpu", "render", "--orbit", "1", "--out"])
        .arg(folder.join("pictures"))
        .arg(&scene)
        .output()
        .unwrap()
}

#[test]
fn more_splats_per_tile_than_memory_holds_are_refused_in_one_line() {
    let folder = tempfile::TempDir::new().unwrap();
    let output = render_with_little_memory(folder.path(), 60_000);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    let line = message
        .lines()
        .find(|line| line.starts_with("error: rasterize:"));
    let line = line.unwrap_or_else(|| panic!("{message}"));
    // 60,000 splats in each of 40 x 30 tiles.
    assert!(line.contains("72000000 intersections"), "{line}");
    assert!(
        line.contains("1.7 GB of memory") && line.contains("can be had"),
        "{line}"
    );
}

#[test]
fn what_fits_is_rendered_under_the_same_limit() {
    let folder = tempfile::TempDir::new().unwrap();
    let output = render_with_little_memory(folder.path(), 6_000);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{message}");
    assert!(folder.path().join("pictures/orbit_0000.png").is_file());
}
