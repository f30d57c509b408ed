//! Description of a capture.

use std::fmt::Write;

use super::scene::middle;
use super::{bounds, bounds_text};
use splat_data::{Capture, Lens};

/// Describes the capture.
pub(super) fn describe(capture: &Capture) -> String {
    let mut text = format!("capture {}\n", capture.root.display());
    let _ = writeln!(
        text,
        "photos  {} ({} to train on, {} held out)",
        capture.views.len(),
        capture.split.train.len(),
        capture.split.test.len()
    );
    for (width, height, count) in capture.image_sizes() {
        let _ = writeln!(text, "  {width} x {height} px: {count}");
    }
    let mut cameras: Vec<([f64; 4], Lens)> = Vec::new();
    for view in &capture.views {
        let camera = (view.intrinsics, view.lens);
        if !cameras.contains(&camera) {
            cameras.push(camera);
        }
    }
    let _ = writeln!(text, "cameras  {}", cameras.len());
    for ([fx, fy, cx, cy], lens) in cameras.iter().take(8) {
        let model = lens.model();
        let _ = write!(
            text,
            "  {}  fx {fx:.3}  fy {fy:.3}  cx {cx:.3}  cy {cy:.3}",
            model.name()
        );
        for (name, value) in model.coefficient_names().iter().zip(lens.coefficients()) {
            let _ = write!(text, "  {name} {value:.5}");
        }
        text.push('\n');
    }
    let masks = capture
        .views
        .iter()
        .filter(|view| view.mask.is_some())
        .count();
    if masks > 0 {
        let _ = writeln!(text, "masks  {masks}");
    }
    if cameras.len() > 8 {
        let _ = writeln!(text, "  and {} more", cameras.len() - 8);
    }
    let centers = capture
        .views
        .iter()
        .map(|view| view.camera().position().to_array());
    let _ = write!(text, "camera centres\n{}", bounds_text(bounds(centers)));
    let positions = || capture.points.iter().map(|point| point.position);
    let _ = writeln!(text, "points  {}", capture.points.len());
    text += &bounds_text(bounds(positions()));
    let _ = write!(
        text,
        "points, the middle 98 % of each axis\n{}",
        bounds_text(middle(positions().collect()))
    );
    let held_out: Vec<&str> = capture
        .test_views()
        .map(|view| view.name.as_str())
        .collect();
    let _ = writeln!(text, "held out  {}", held_out.join(" "));
    for warning in &capture.warnings {
        let _ = writeln!(text, "warning: {warning}");
    }
    if let Err(error) = capture.check_trainable() {
        let _ = writeln!(text, "warning: {error}");
    }
    text
}
