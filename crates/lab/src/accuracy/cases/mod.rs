//! The hard cases of splatting, by number.

mod blending;
mod camera;
mod colour;
mod lens;
mod model;
mod shape;

use super::case::Case;

/// All 44 cases, by number.
pub fn cases() -> Vec<Case> {
    let mut cases: Vec<Case> = [
        blending::CASES.as_slice(),
        camera::CASES.as_slice(),
        colour::CASES.as_slice(),
        lens::CASES.as_slice(),
        model::CASES.as_slice(),
        shape::CASES.as_slice(),
    ]
    .concat();
    cases.sort_by_key(|case| case.number);
    cases
}
