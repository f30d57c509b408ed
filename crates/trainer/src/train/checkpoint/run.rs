//! Identity of a checkpoint's run: its settings and its capture. Another run cannot resume from it.

use serde::{Deserialize, Serialize};

use super::super::TrainSettings;
use super::super::fingerprint::Fingerprint;
use super::{Checkpoint, CheckpointError};

/// Settings that a resumed run may change: its length, and the limits of growth.
const CHANGEABLE: [&str; 4] = [
    "steps",
    "density.max_gaussians",
    "mcmc.max_gaussians",
    "improved.max_gaussians",
];

/// A run without its state: its settings and its capture.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(in super::super) struct RunRecord {
    pub(in super::super) capture: Fingerprint,
    /// As TOML, which preserves every digit.
    #[serde(with = "as_toml")]
    pub(in super::super) config: TrainSettings,
    /// Changes made on resuming, see [`Checkpoint::changes_with`].
    pub(in super::super) changes: Vec<String>,
}

impl Checkpoint {
    /// Settings of the run.
    pub fn settings(&self) -> &TrainSettings {
        &self.meta.run.config
    }

    /// Checks that a run with these settings is the run of this checkpoint, and has steps left.
    /// Only `steps` and the strategies' `max_gaussians` may differ. Any other change, including the
    /// seed and the initial Gaussians, would make a run that nobody could repeat, and would partly
    /// have no effect.
    ///
    /// # Errors
    /// [`CheckpointError::OtherSettings`] and [`CheckpointError::NothingLeft`].
    pub fn check_settings(&self, config: &TrainSettings) -> Result<(), CheckpointError> {
        let mut same = config.clone();
        same.steps = self.settings().steps;
        same.density.max_gaussians = self.settings().density.max_gaussians;
        same.mcmc.max_gaussians = self.settings().mcmc.max_gaussians;
        same.improved.max_gaussians = self.settings().improved.max_gaussians;
        if let Some(difference) = self.settings().difference_in_words(&same) {
            return Err(CheckpointError::OtherSettings {
                path: self.path.clone(),
                difference,
            });
        }
        let (done, steps, wanted) = (self.step(), self.settings().steps, config.steps);
        // A run that has completed its steps may still have results to write.
        if wanted < done || (wanted == done && wanted != steps) {
            return Err(CheckpointError::NothingLeft {
                path: self.path.clone(),
                done,
                steps,
                wanted,
            });
        }
        Ok(())
    }

    /// Changes to the run made by resuming with these settings, and earlier ones, one per line.
    pub fn changes_with(&self, config: &TrainSettings) -> Vec<String> {
        let mut changes = self.meta.run.changes.clone();
        for (name, was, is) in self.settings().differences(config) {
            if CHANGEABLE.contains(&name.as_str()) {
                let step = self.step();
                changes.push(format!(
                    "from step {step} on {name} = {is}, before it was {was}"
                ));
            }
        }
        changes
    }

    /// Checks capture, settings, strategy and names of loss terms. Returns the photos whose pixels
    /// have changed.
    pub(in super::super) fn check_run(
        &self,
        run: &RunRecord,
        terms: &[String],
        strategy: &str,
        hooks: &[&str],
    ) -> Result<Vec<String>, CheckpointError> {
        self.check_settings(&run.config)?;
        let was = &self.meta.run.capture;
        if let Some(difference) = was.difference(&run.capture) {
            return Err(CheckpointError::OtherCapture {
                path: self.path.clone(),
                name: was.name().to_owned(),
                difference,
            });
        }
        if self.meta.strategy != strategy {
            return Err(CheckpointError::OtherSettings {
                path: self.path.clone(),
                difference: format!("the strategy {}, not {strategy}", self.meta.strategy),
            });
        }
        if self.meta.hooks != hooks {
            return Err(CheckpointError::OtherSettings {
                path: self.path.clone(),
                difference: format!("the hooks {:?}, not {hooks:?}", self.meta.hooks),
            });
        }
        if self.meta.history.terms != terms {
            let [was, is] = [&self.meta.history.terms[..], terms].map(|terms| terms.join(", "));
            return Err(CheckpointError::OtherSettings {
                path: self.path.clone(),
                difference: format!("a loss of the terms {was}, not {is}"),
            });
        }
        Ok(was.changed_photos(&run.capture))
    }
}

/// A [`TrainSettings`] as the text of a `config.toml`.
mod as_toml {
    use serde::{Deserialize, Deserializer, Serializer, de, ser};

    use super::TrainSettings;

    pub(super) fn serialize<S: Serializer>(
        config: &TrainSettings,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&toml::to_string(config).map_err(ser::Error::custom)?)
    }

    pub(super) fn deserialize<'a, D: Deserializer<'a>>(
        deserializer: D,
    ) -> Result<TrainSettings, D::Error> {
        let text = String::deserialize(deserializer)?;
        TrainSettings::parse(text.as_bytes()).map_err(de::Error::custom)
    }
}
