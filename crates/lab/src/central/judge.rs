//! Judges whether derivatives along one line agree, and classifies failures.

use super::Settings;
use super::ladder::{Enough, Slope};
use super::report::Kind;

/// Relative difference of the slopes on both sides that counts as a kink.
const KINK: f64 = 1e-6;
/// Relative error above which a derivative counts as unknown.
const UNKNOWN: f64 = 1e-2;
/// An unknown derivative is negligible if a change of the input by its own size changes the outputs
/// by less than this share.
const NEGLIGIBLE: f64 = 1e-6;

/// Known properties of a line before it is followed, per unit of the line.
#[derive(Debug, Clone, Copy)]
pub(super) struct Analytic {
    /// Derivative along the line; `None` if autodiff has none.
    pub value: Option<f64>,
    /// Root of the sum of the squared derivatives of its elements.
    pub scale: f64,
    /// Root mean square derivative of the whole input.
    pub rms: f64,
}

impl Analytic {
    /// Slope errors that are small enough not to matter.
    pub(super) fn enough(&self, settings: &Settings) -> Enough {
        let scale = self.scale / settings.safety / 10.0;
        Enough {
            central: settings.tolerance * scale,
            jump: KINK * scale,
        }
    }

    /// Largest allowed difference.
    pub(super) fn allowed(&self, slope: &Slope, settings: &Settings) -> f64 {
        settings.safety * slope.central.error + settings.tolerance * (self.scale + 1e-3 * self.rms)
    }

    /// `None` if everything is fine.
    pub(super) fn judge(&self, slope: Option<&Slope>, settings: &Settings) -> Option<Kind> {
        let Some(slope) = slope else {
            return Some(Kind::OutsideDomain);
        };
        let analytic = self.value.unwrap_or(0.0);
        let (central, jump) = (slope.central, slope.jump);
        let allowed = self.allowed(slope, settings);

        let surely = jump.value.abs() - settings.safety * jump.error;
        if surely > KINK * (self.scale + central.value.abs()) {
            let (left, right) = (
                central.value - jump.value / 2.0,
                central.value + jump.value / 2.0,
            );
            let margin = allowed + settings.safety * jump.error + KINK * jump.value.abs();
            let between =
                analytic >= left.min(right) - margin && analytic <= left.max(right) + margin;
            return Some(Kind::Kink {
                left,
                right,
                accepted: between && !settings.refuse_kinks,
            });
        }
        let uncertain = settings.safety * central.error;
        let matters = self.scale.max(central.value.abs()).max(self.rms);
        if uncertain > UNKNOWN * matters && uncertain > NEGLIGIBLE * slope.size {
            return Some(Kind::Unresolved);
        }
        // NaN fails.
        if (analytic - central.value).abs() <= allowed {
            return None;
        }
        match self.value {
            None => Some(Kind::NoGradient),
            Some(_) => Some(Kind::Wrong),
        }
    }
}
