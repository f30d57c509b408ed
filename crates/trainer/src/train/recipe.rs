//! Settings under a name.

use super::TrainSettings;

/// A recipe: a `config.toml` under a name, and nothing else.
///
/// ```
/// use splat_trainer::{RECIPES, Recipe};
///
/// let settings = Recipe::of_name("mcmc").unwrap().settings();
/// assert_eq!(settings.steps, 30_000);
/// assert!(RECIPES.iter().any(|recipe| recipe.name == "3dgs"));
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Recipe {
    /// The name, as `splat train --recipe` takes it.
    pub name: &'static str,
    /// The settings that are not the defaults, as TOML, with comments that say why.
    pub toml: &'static str,
}

/// All recipes. docs/RECIPES.md compares them.
pub const RECIPES: &[Recipe] = &[
    Recipe {
        name: "default",
        toml: include_str!("../recipes/default.toml"),
    },
    Recipe {
        name: "3dgs",
        toml: include_str!("../recipes/3dgs.toml"),
    },
    Recipe {
        name: "gsplat",
        toml: include_str!("../recipes/gsplat.toml"),
    },
    Recipe {
        name: "mcmc",
        toml: include_str!("../recipes/mcmc.toml"),
    },
    Recipe {
        name: "compact",
        toml: include_str!("../recipes/compact.toml"),
    },
    Recipe {
        name: "fast",
        toml: include_str!("../recipes/fast.toml"),
    },
    Recipe {
        name: "best",
        toml: include_str!("../recipes/best.toml"),
    },
];

impl Recipe {
    /// The recipe of a name.
    pub fn of_name(name: &str) -> Option<Self> {
        RECIPES.iter().copied().find(|recipe| recipe.name == name)
    }

    /// Its settings.
    ///
    /// # Panics
    /// Never: each is parsed by a test.
    pub fn settings(&self) -> TrainSettings {
        TrainSettings::parse(self.toml.as_bytes())
            .unwrap_or_else(|error| panic!("recipe {}: {error}", self.name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_recipe_can_be_used() {
        for recipe in RECIPES {
            let settings = recipe.settings();
            assert_eq!(settings.validate(), Ok(()), "{}", recipe.name);
            assert_eq!(Recipe::of_name(recipe.name), Some(*recipe));
            assert!(recipe.toml.starts_with("# "), "{}", recipe.name);
        }
        assert_eq!(
            Recipe::of_name("default").unwrap().settings(),
            TrainSettings::default()
        );
        assert_eq!(Recipe::of_name("no such"), None);
    }
}
