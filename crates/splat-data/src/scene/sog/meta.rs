//! `meta.json`.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::super::limits::{most_gaussians, too_many};
use super::super::values::{check_settings, is_scale};
use super::super::{SceneFileError, SceneSettings, SplatData};
use crate::text::{one_line, utf8};

/// The contents of `meta.json`, version 2.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Meta {
    version: u32,
    #[serde(default, skip_deserializing)]
    asset: Asset,
    count: u64,
    /// `default`, `antialiased` or `2dgs`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    model: Option<String>,
    /// What earlier writers had instead of `model`.
    #[serde(default, skip_serializing)]
    antialias: Option<bool>,
    pub means: Means,
    pub scales: Coded,
    pub quats: Files,
    pub sh0: Coded,
    #[serde(default, rename = "shN", skip_serializing_if = "Option::is_none")]
    pub sh_n: Option<Palette>,
    #[serde(default, skip_serializing_if = "Extras::is_empty")]
    extras: Extras,
}

#[derive(Debug, Default, Serialize)]
struct Asset {
    generator: String,
}

/// Positions: the ranges of their logarithms.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Means {
    pub mins: [f64; 3],
    pub maxs: [f64; 3],
    pub files: Vec<String>,
}

/// Images of something without a codebook.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Files {
    pub files: Vec<String>,
}

/// Images of entries of a codebook. Other programs write infinities as `null`.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Coded {
    pub codebook: Vec<Option<f32>>,
    pub files: Vec<String>,
}

impl Coded {
    pub fn new(codebook: Vec<f32>, file: &str) -> Self {
        Self {
            codebook: codebook.into_iter().map(Some).collect(),
            files: vec![file.to_owned()],
        }
    }
}

/// Spherical harmonics of degrees 1 to 3.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Palette {
    pub count: u32,
    /// Degree of the harmonics.
    pub bands: usize,
    pub codebook: Vec<Option<f32>>,
    pub files: Vec<String>,
}

/// Data of applications, as in glTF.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(from = "serde_json::Value")]
struct Extras {
    burn_splat: Ours,
    /// Why our part cannot be read.
    #[serde(skip)]
    bad: Option<String>,
}

impl Extras {
    fn is_empty(&self) -> bool {
        self.burn_splat == Ours::default()
    }
}

impl From<serde_json::Value> for Extras {
    fn from(value: serde_json::Value) -> Self {
        // Whatever other applications write there is theirs.
        match value.get("burn_splat").map(Ours::deserialize) {
            None => Self::default(),
            Some(Ok(burn_splat)) => Self {
                burn_splat,
                bad: None,
            },
            Some(Err(error)) => Self {
                bad: Some(one_line(&error.to_string())),
                ..Self::default()
            },
        }
    }
}

/// What the format has no place for.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
struct Ours {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    origin: Option<[f64; 3]>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    scene_scale: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    background: Option<[f32; 3]>,
}

impl Meta {
    /// Everything but the images.
    pub fn of_scene(scene: &SplatData) -> Self {
        let settings = &scene.settings;
        let model = settings.antialias.map(|antialias| match antialias {
            true => "antialiased".to_owned(),
            false => "default".to_owned(),
        });
        Self {
            version: 2,
            asset: Asset {
                generator: concat!("burn-splat ", env!("CARGO_PKG_VERSION")).to_owned(),
            },
            count: scene.len() as u64,
            model,
            antialias: None,
            means: Means::default(),
            scales: Coded::default(),
            quats: Files::default(),
            sh0: Coded::default(),
            sh_n: None,
            extras: Extras {
                burn_splat: Ours {
                    origin: (scene.origin != [0.0; 3]).then_some(scene.origin),
                    scene_scale: settings.scene_scale,
                    background: settings.background,
                },
                bad: None,
            },
        }
    }

    pub fn to_json(&self) -> Vec<u8> {
        // Strings and finite numbers always have a form.
        serde_json::to_vec(self).unwrap_or_default()
    }

    /// Reads the text of `meta.json`; `path` is used in messages.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, SceneFileError> {
        let bad = |reason: String| SceneFileError::Field {
            path: path.to_path_buf(),
            field: "meta.json",
            reason,
        };
        #[derive(Deserialize)]
        struct Version {
            version: Option<u32>,
        }
        let not_ours = |error: serde_json::Error| {
            bad(format!(
                "no metadata of a SOG scene: {}",
                one_line(&error.to_string())
            ))
        };
        let text = utf8(bytes).map_err(&bad)?;
        let Version { version } = serde_json::from_str(text).map_err(not_ours)?;
        if version != Some(2) {
            let version = version.map_or_else(|| "1".to_owned(), |version| version.to_string());
            return Err(bad(format!(
                "SOG version {version}; version 2 can be read, so write it again as that"
            )));
        }
        let meta: Self = serde_json::from_str(text).map_err(not_ours)?;
        let bands = meta.sh_n.as_ref().map_or(0, |palette| palette.bands);
        if bands > 3 {
            return Err(bad(format!("shN.bands is {bands}; it must be 0 to 3")));
        }
        Ok(meta)
    }

    /// Every image and the entry that names it.
    pub fn images(&self) -> Vec<(&'static str, &str)> {
        let mut lists = vec![
            ("means", &self.means.files, 2),
            ("quats", &self.quats.files, 1),
            ("scales", &self.scales.files, 1),
            ("sh0", &self.sh0.files, 1),
        ];
        let palette = self.sh_n.iter().filter(|palette| palette.bands > 0);
        lists.extend(palette.map(|palette| ("shN", &palette.files, 2)));
        let mut images = Vec::new();
        for (field, files, count) in lists {
            let names = files.iter().take(count);
            images.extend(names.map(|name| (field, name.as_str())));
        }
        images
    }

    /// Number of Gaussians, checked against the bytes of the files.
    pub fn gaussians(&self, path: &Path, bytes: u64) -> Result<usize, SceneFileError> {
        if self.count == 0 {
            return Err(SceneFileError::Empty {
                path: path.to_path_buf(),
            });
        }
        match usize::try_from(self.count) {
            Ok(count) if self.count <= most_gaussians(bytes) => Ok(count),
            _ => Err(SceneFileError::Field {
                path: path.to_path_buf(),
                field: "meta.json",
                reason: too_many(self.count, bytes),
            }),
        }
    }

    /// Origin and settings.
    pub fn settings(&self, path: &Path) -> Result<([f64; 3], SceneSettings), SceneFileError> {
        let ours = &self.extras.burn_splat;
        let scale = ours.scene_scale.filter(|scale| !is_scale(*scale));
        let bad = match (&self.extras.bad, scale) {
            (Some(bad), _) => Some(bad.clone()),
            (None, Some(scale)) => Some(format!("scene_scale is {scale}, not 1e-15 to 1e10")),
            (None, None) => None,
        };
        if let Some(bad) = bad {
            return Err(SceneFileError::Field {
                path: path.to_path_buf(),
                field: "meta.json",
                reason: format!("extras.burn_splat: {bad}"),
            });
        }
        let mut settings = SceneSettings {
            scene_scale: ours.scene_scale,
            background: ours.background,
            ..SceneSettings::default()
        };
        match self.model.as_deref() {
            None => settings.antialias = self.antialias,
            Some("default") => settings.antialias = Some(false),
            Some("antialiased") => settings.antialias = Some(true),
            Some(other) => {
                let text = one_line(&format!("SOG model {}", other.escape_debug()));
                settings.not_understood.push(text);
            }
        }
        let scene = SplatData {
            origin: ours.origin.unwrap_or_default(),
            settings,
            ..SplatData::default()
        };
        check_settings(path, &scene)?;
        Ok((scene.origin, scene.settings))
    }
}
