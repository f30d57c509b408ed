//! The runs to make, in turns, and which of them are missing.

use std::path::{Path, PathBuf};

use super::pictures;
use super::row::{Key, Row, digest};
use crate::photos::{self, PhotoArgs};
use crate::report::refuse_inputs;
use crate::text::read_config;
use crate::{Failure, GlobalArgs};
use splat_data::{Capture, CaptureSettings, View};
use splat_trainer::{RECIPES, Recipe, TrainSettings};

/// A recipe, or the settings of a file.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Named {
    pub name: String,
    pub settings: TrainSettings,
}

impl Named {
    /// All recipes.
    pub(super) fn recipes() -> Vec<Self> {
        RECIPES.iter().map(Self::from).collect()
    }

    /// The recipe of this name, or else the settings of the file at this path, under its name
    /// without `.toml`.
    pub(super) fn of_text(text: &str) -> Result<Self, Failure> {
        if let Some(recipe) = Recipe::of_name(text) {
            return Ok(Self::from(&recipe));
        }
        let path = Path::new(text);
        if !path.exists() {
            let names: Vec<&str> = RECIPES.iter().map(|recipe| recipe.name).collect();
            return Err(Failure::BadInput(format!(
                "--recipes: {text} is neither a file nor a recipe; recipes are {}",
                names.join(", ")
            )));
        }
        let settings = read_config(path)?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        Ok(Self {
            name: name.into_owned(),
            settings,
        })
    }
}

impl From<&Recipe> for Named {
    fn from(recipe: &Recipe) -> Self {
        Self {
            name: recipe.name.to_owned(),
            settings: recipe.settings(),
        }
    }
}

/// Recipes, captures and seeds.
pub(super) struct Plan {
    pub captures: Vec<Subject>,
    /// The first is the one that the others are compared with.
    pub recipes: Vec<Named>,
    /// Number of seeds, from 0 on.
    pub seeds: u64,
    /// Steps of a run, if they are not the recipe's.
    pub steps: Option<usize>,
    /// How photos are read.
    pub photos: PhotoArgs,
    /// Factor by which they are area-averaged.
    pub downscale: u32,
    /// Name of the device.
    pub device: String,
}

/// A capture to train on.
pub(super) struct Subject {
    pub name: String,
    pub folder: PathBuf,
    /// Digest of what it has beside its pixels, see [`contents`].
    pub contents: String,
}

/// Digest of the photos' folder and of the views: names, cameras, and which are held out.
fn contents(capture: &Capture) -> String {
    let view = |view: &View| format!("{} {:?}", view.name, view.camera());
    let views: Vec<String> = capture.views.iter().map(view).collect();
    let photos = capture.photos.canonicalize();
    digest(&format!("{photos:?} {views:?} {:?}", capture.split.test))
}

/// A run to make.
pub(super) struct Run {
    /// Index of its capture in [`Plan::captures`].
    pub capture: usize,
    pub recipe: Named,
    pub key: Key,
    /// Digest of the program's version, the capture's folder and contents, and all settings: a
    /// result is of this run only if it has the same.
    digest: String,
}

impl Plan {
    /// A plan without captures. Settings that cannot be used are refused.
    pub(super) fn new(
        recipes: Vec<Named>,
        seeds: u64,
        steps: Option<usize>,
        photos: PhotoArgs,
    ) -> Result<Self, Failure> {
        let downscale = photos.options().downscale;
        for (index, recipe) in recipes.iter().enumerate() {
            let same = |other: &Named| other.name.to_lowercase() == recipe.name.to_lowercase();
            if recipes[..index].iter().any(same) {
                return Err(Failure::BadInput(format!(
                    "--recipes: two are called {}, and results go by that name",
                    recipe.name
                )));
            }
            let settings = settings(recipe, steps, downscale, 0);
            settings.validate().map_err(|problem| {
                Failure::BadInput(format!("settings of {}: {problem}", recipe.name))
            })?;
        }
        Ok(Self {
            captures: Vec::new(),
            recipes,
            seeds,
            steps,
            photos,
            downscale,
            device: String::new(),
        })
    }

    /// Takes the captures in these folders, and checks what can be checked without decoding their
    /// photos, so that the last of them is not found unusable after hours. Results go to `out`.
    pub(super) fn take_captures(&mut self, folders: &[PathBuf], out: &Path) -> Result<(), Failure> {
        for folder in folders {
            let capture = Capture::load(folder, &self.reading().with_memory(0))?;
            capture.check_trainable()?;
            if capture.split.test.is_empty() {
                return Err(Failure::BadInput(format!(
                    "{}: the capture holds out no view, so there is nothing to compare recipes on; name some with --hold-out",
                    folder.display()
                )));
            }
            let name = capture.name.clone();
            // Files of both would be the same where case is ignored.
            let same = |other: &&Subject| other.name.to_lowercase() == name.to_lowercase();
            if let Some(other) = self.captures.iter().find(same) {
                return Err(Failure::BadInput(format!(
                    "{} and {}: both captures are called {name}, and results go by that name; give each an --out of its own",
                    other.folder.display(),
                    folder.display()
                )));
            }
            let photos = capture.photo_files();
            let picture = pictures::of_capture(out, &name);
            refuse_inputs([picture], photos.iter().map(PathBuf::as_path))?;
            self.captures.push(Subject {
                name,
                folder: folder.clone(),
                contents: contents(&capture),
            });
        }
        Ok(())
    }

    /// How captures are read.
    fn reading(&self) -> CaptureSettings {
        self.photos.options()
    }

    /// Reads the capture of a run, with its photos.
    pub(super) fn load(&self, run: &Run, global: &GlobalArgs) -> Result<Capture, Failure> {
        let folder = &self.captures[run.capture].folder;
        Ok(photos::load(folder, &self.reading(), global)?)
    }

    /// All runs, in turns: with each seed, each recipe once on each capture.
    pub(super) fn runs(&self) -> Vec<Run> {
        let mut runs = Vec::new();
        for seed in 0..self.seeds {
            for (capture, subject) in self.captures.iter().enumerate() {
                for recipe in &self.recipes {
                    let settings = settings(recipe, self.steps, self.downscale, seed);
                    let folder = subject.folder.canonicalize();
                    let folder = folder.unwrap_or_else(|_| subject.folder.clone());
                    let (version, folder) = (env!("CARGO_PKG_VERSION"), folder.display());
                    let contents = &subject.contents;
                    runs.push(Run {
                        digest: digest(&format!("{version} {folder} {settings:?} {contents}")),
                        capture,
                        recipe: recipe.clone(),
                        key: Key {
                            capture: subject.name.clone(),
                            recipe: recipe.name.clone(),
                            seed,
                            steps: settings.steps,
                            downscale: self.downscale,
                            device: self.device.clone(),
                        },
                    });
                }
            }
        }
        runs
    }

    /// The runs without a row.
    pub(super) fn missing(&self, rows: &[Row]) -> Vec<Run> {
        let runs = self.runs().into_iter();
        runs.filter(|run| run.row(rows).is_none()).collect()
    }

    /// The rows of the plan's runs: by capture, then by recipe, then by seed.
    pub(super) fn measured<'a>(&self, rows: &'a [Row]) -> Vec<&'a Row> {
        let mut runs = self.runs();
        let place = |recipe: &Named| self.recipes.iter().position(|known| known == recipe);
        runs.sort_by_key(|run| (run.capture, place(&run.recipe), run.key.seed));
        runs.iter().filter_map(|run| run.row(rows)).collect()
    }
}

impl Run {
    /// The settings of the run.
    pub(super) fn settings(&self) -> TrainSettings {
        let Key {
            seed,
            steps,
            downscale,
            ..
        } = self.key;
        settings(&self.recipe, Some(steps), downscale, seed)
    }

    /// What tells its results from those of other runs with the same names.
    pub(super) fn digest(&self) -> String {
        self.digest.clone()
    }

    /// The row of the run, unless the recipe was another one then.
    fn row<'a>(&self, rows: &'a [Row]) -> Option<&'a Row> {
        let own = |row: &&Row| row.key == self.key && row.digest == self.digest();
        rows.iter().find(own)
    }
}

impl std::fmt::Display for Run {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Key {
            capture,
            recipe,
            seed,
            ..
        } = &self.key;
        write!(f, "{capture}, {recipe}, seed {seed}")
    }
}

/// The settings of a recipe for a run.
fn settings(recipe: &Named, steps: Option<usize>, downscale: u32, seed: u64) -> TrainSettings {
    let own = &recipe.settings;
    TrainSettings {
        steps: steps.unwrap_or(own.steps),
        seed,
        downscale,
        ..own.clone()
    }
}

#[cfg(test)]
mod tests {
    use splat_data::SplitRule;

    use super::super::row::example;
    use super::*;

    /// Two captures, two recipes and two seeds.
    fn plan() -> Plan {
        let recipes = ["default", "mcmc"].map(|name| Named::of_text(name).unwrap());
        let subject = |name: &str| Subject {
            name: name.to_owned(),
            folder: name.into(),
            contents: String::new(),
        };
        let photos = PhotoArgs {
            downscale: Some(4),
            ..PhotoArgs::default()
        };
        Plan {
            captures: ["a", "b"].map(subject).into(),
            device: "cpu".to_owned(),
            ..Plan::new(recipes.into(), 2, Some(100), photos).unwrap()
        }
    }

    /// A row of the plan's run.
    fn row(capture: &str, recipe: &str, seed: u64) -> Row {
        let row = example(capture, recipe, seed, 20.0);
        let run = plan().runs().into_iter().find(|run| run.key == row.key);
        Row {
            digest: run.map_or_else(String::new, |run| run.digest()),
            ..row
        }
    }

    fn names(runs: &[Run]) -> Vec<String> {
        runs.iter().map(Run::to_string).collect()
    }

    #[test]
    fn runs_take_turns() {
        assert_eq!(
            names(&plan().runs()),
            [
                "a, default, seed 0",
                "a, mcmc, seed 0",
                "b, default, seed 0",
                "b, mcmc, seed 0",
                "a, default, seed 1",
                "a, mcmc, seed 1",
                "b, default, seed 1",
                "b, mcmc, seed 1",
            ]
        );
        let settings = plan().runs()[5].settings();
        assert_eq!(
            (settings.steps, settings.downscale, settings.seed),
            (100, 4, 1)
        );
    }

    #[test]
    fn what_was_measured_is_not_missing() {
        let mut plan = plan();
        let mut rows = vec![
            row("b", "mcmc", 1),
            row("a", "mcmc", 1),
            row("a", "mcmc", 0),
            row("a", "default", 1),
            row("a", "default", 0),
            row("c", "default", 0),
        ];
        let missing = [
            "b, default, seed 0",
            "b, mcmc, seed 0",
            "b, default, seed 1",
        ];
        assert_eq!(names(&plan.missing(&rows)), missing);
        let measured = plan.measured(&rows).into_iter();
        let measured: Vec<_> = measured
            .map(|row| (&*row.key.capture, &*row.key.recipe, row.key.seed))
            .collect();
        assert_eq!(
            measured,
            [
                ("a", "default", 0),
                ("a", "default", 1),
                ("a", "mcmc", 0),
                ("a", "mcmc", 1),
                ("b", "mcmc", 1),
            ]
        );

        // Another recipe of that name, number of steps, size or device is another run.
        let changes: [fn(&mut Row); 4] = [
            |row| row.digest = "other".to_owned(),
            |row| row.key.steps += 1,
            |row| row.key.downscale += 1,
            |row| row.key.device = "wgpu".to_owned(),
        ];
        for (row, change) in rows.iter_mut().zip(changes) {
            change(row);
        }
        assert_eq!(plan.missing(&rows).len(), 7);
        plan.seeds = 3;
        assert_eq!(plan.missing(&rows).len(), 11);
        // A capture of the same name in another folder.
        plan.captures[0].folder = "elsewhere".into();
        plan.captures[1].folder = "elsewhere".into();
        assert_eq!(plan.missing(&rows).len(), 12);
    }

    #[test]
    fn runs_with_other_views_are_others() {
        let rows = vec![row("a", "mcmc", 0), row("b", "mcmc", 0)];
        let mut plan = plan();
        assert_eq!(plan.missing(&rows).len(), 6);
        plan.captures[0].contents = "other views".to_owned();
        assert_eq!(plan.missing(&rows).len(), 7);

        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
        let read = |settings: CaptureSettings| {
            let settings = settings.with_downscale(16).with_memory(0);
            Capture::load(folder, &settings).unwrap()
        };
        let usual = read(CaptureSettings::new());
        let split = read(CaptureSettings::new().with_split(SplitRule::Every(5)));
        let mut moved = usual.clone();
        moved.views[3].viewmat[0][3] += 1e-3;
        let mut elsewhere = usual.clone();
        elsewhere.photos = folder.into();
        for other in [split, moved, elsewhere] {
            assert_ne!(contents(&other), contents(&usual));
        }
        assert_eq!(contents(&usual), contents(&usual.clone()));
    }

    #[test]
    fn unusable_settings_are_refused() {
        let recipe = Named::of_text("default").unwrap();
        let refused = |recipes, steps| {
            let planned = Plan::new(recipes, 1, steps, PhotoArgs::default());
            planned.err().unwrap().to_string()
        };
        let words = refused(vec![recipe.clone(), recipe.clone()], None);
        assert!(words.contains("two are called default"), "{words}");
        let words = refused(vec![recipe], Some(0));
        assert!(
            words.contains("default") && words.contains("`steps`"),
            "{words}"
        );
    }

    #[test]
    fn a_file_is_a_recipe_under_its_own_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.toml");
        std::fs::write(&path, "steps = 7\n").unwrap();
        let named = Named::of_text(path.to_str().unwrap()).unwrap();
        assert_eq!((&*named.name, named.settings.steps), ("mine", 7));
        std::fs::write(&path, "stepps = 7\n").unwrap();
        let words = Named::of_text(path.to_str().unwrap())
            .unwrap_err()
            .to_string();
        assert!(
            words.contains("mine.toml") && words.contains("stepps"),
            "{words}"
        );
        let words = Named::of_text("no such").unwrap_err().to_string();
        assert!(words.contains("default, 3dgs"), "{words}");
    }
}
