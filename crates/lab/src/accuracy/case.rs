//! Definition of a hard case.

use burn::tensor::Device;

use super::measure::{AccuracyError, Outcome, against_double};
use crate::gradcheck::Scene;

/// A scene, or another task, that breaks naive splatting code.
#[derive(Clone, Copy)]
pub struct Case {
    /// 1 to 44.
    pub number: u8,
    /// Short description.
    pub name: &'static str,
    /// The failure of a naive kernel.
    pub naive: &'static str,
    /// Additional demand, besides the relative L2 error of 1e-3.
    pub demand: &'static str,
    pub(super) check: Check,
}

/// How a case is checked.
#[derive(Clone, Copy)]
pub(super) enum Check {
    /// Compares image, alpha and every gradient of these scenes with double precision. The named
    /// groups have a gradient of zero by symmetry.
    Scenes(fn() -> Vec<Scene>, &'static [&'static str]),
    /// Checked by its own function.
    Own(fn(&Device) -> Result<Outcome, AccuracyError>),
}

impl Case {
    /// A case of scenes, each with errors below 1e-3.
    pub(super) const fn scenes(
        number: u8,
        name: &'static str,
        naive: &'static str,
        scenes: fn() -> Vec<Scene>,
    ) -> Self {
        Self {
            number,
            name,
            naive,
            demand: "",
            check: Check::Scenes(scenes, &[]),
        }
    }

    /// A case with a demand of its own.
    pub(super) const fn own(
        number: u8,
        name: &'static str,
        naive: &'static str,
        demand: &'static str,
        check: fn(&Device) -> Result<Outcome, AccuracyError>,
    ) -> Self {
        Self {
            number,
            name,
            naive,
            demand,
            check: Check::Own(check),
        }
    }

    /// Measures the case on `device` in single precision.
    ///
    /// # Errors
    /// When the device or an op refuses valid input. An inaccurate result is not an error.
    pub fn measure(&self, device: &Device) -> Result<Outcome, AccuracyError> {
        match self.check {
            Check::Own(check) => check(device),
            Check::Scenes(scenes, zero) => {
                scenes().iter().try_fold(Outcome::new(), |outcome, scene| {
                    Ok(outcome.and(against_double(scene, device, zero)?))
                })
            }
        }
    }

    /// Scenes for timing; empty if the case renders nothing.
    pub fn timed_scenes(&self) -> Vec<Scene> {
        match self.check {
            Check::Scenes(scenes, _) => scenes(),
            Check::Own(_) => vec![],
        }
    }
}
