//! What a file cannot hold of a scene.

use super::super::SplatData;

/// What is lost beyond precision, one line each.
pub(super) fn losses(scene: &SplatData) -> Vec<String> {
    let mut losses = Vec::new();
    if scene.origin != [0.0; 3] {
        let [x, y, z] = scene.origin;
        losses.push(format!(
            "other programs see the scene without the offset {x} {y} {z} of its origin"
        ));
    }
    losses
}
