//! How few bits a file needs: fields are made coarser, one after another, as long as the pictures
//! of the file that is read back allow it.

use std::path::Path;

use splat_data::SplatData;
use splat_data::scene::sog::{self, SogSettings};
use splat_data::scene::spz::{self, SpzSettings};
use splat_data::scene::{self, SceneFileError, SceneFormat};
use splat_trainer::compact::Judge;

use super::as_original;
use crate::Failure;

/// Bits behind the binary point of positions that are tried, after as many as fit.
const POSITION_BITS: [u8; 12] = [20, 18, 16, 15, 14, 13, 12, 11, 10, 9, 8, 7];

/// A file in memory.
pub(super) struct Encoded {
    pub(super) bytes: Vec<u8>,
    /// Mean PSNR of the file that is read back, in dB.
    pub(super) psnr: f64,
    /// What was chosen, in words.
    pub(super) settings: String,
}

/// Writes a format as coarsely as pictures allow.
pub(super) struct Encoder(&'static SceneFormat);

/// The settings of a file.
#[derive(Debug, Clone)]
enum Choice {
    Default,
    Spz(SpzSettings),
    Sog(SogSettings),
}

impl Encoder {
    pub(super) fn of(format: &'static SceneFormat) -> Self {
        Self(format)
    }

    /// What the format cannot hold of a scene.
    pub(super) fn losses(&self, scene: &SplatData) -> Vec<String> {
        (self.0.losses)(scene)
    }

    /// Mean PSNR of a scene in the most precise file, in dB; below any if it cannot hold the scene.
    pub(super) fn most_precise(&self, scene: &SplatData, judge: &Judge) -> Result<f64, Failure> {
        let (start, _) = self.choices();
        let written = self.write(scene, judge, &start)?;
        Ok(written.map_or(f64::NEG_INFINITY, |file| file.psnr))
    }

    /// The smallest file found with at least this PSNR; none if the most precise one has less.
    pub(super) fn encode(
        &self,
        scene: &SplatData,
        judge: &Judge,
        limit: f64,
        mut progress: impl FnMut(usize, usize),
    ) -> Result<Option<Encoded>, Failure> {
        let (start, fields) = self.choices();
        let most = fields.iter().map(Vec::len).sum::<usize>() + 1;
        let Some(mut best) = self.write(scene, judge, &start)? else {
            return Ok(None);
        };
        if !(best.psnr >= limit) {
            return Ok(None);
        }
        let (mut choice, mut done) = (start, 1);
        let whole = best.psnr;
        for (index, field) in fields.iter().enumerate() {
            // Each field may take its share of what is left, and what those before it did not.
            let share = (index + 1) as f64 / fields.len() as f64;
            let floor = whole - share * (whole - limit);
            for coarser in field {
                progress(done, most);
                done += 1;
                let next = coarser(choice.clone());
                match self.write(scene, judge, &next)? {
                    // Positions that need more bits than there are.
                    None => continue,
                    Some(tried) if !(tried.psnr >= floor) => break,
                    Some(tried) => {
                        choice = next;
                        if tried.bytes.len() <= best.bytes.len() {
                            best = tried;
                        }
                    }
                }
            }
        }
        Ok(Some(best))
    }

    /// The most precise choice, and for each field the coarser ones.
    fn choices(&self) -> (Choice, Vec<Vec<Coarser>>) {
        match self.0.name {
            "SPZ" => {
                let start = SpzSettings::new().with_sh1_bits(8).with_sh_rest_bits(8);
                let rest = (1..8u8)
                    .rev()
                    .map(|bits| spz_with(move |s| s.with_sh_rest_bits(bits)));
                let first = (1..8u8)
                    .rev()
                    .map(|bits| spz_with(move |s| s.with_sh1_bits(bits)));
                let positions = POSITION_BITS
                    .into_iter()
                    .map(|bits| spz_with(move |s| s.with_fractional_bits(bits)));
                let fields = vec![rest.collect(), first.collect(), positions.collect()];
                (Choice::Spz(start), fields)
            }
            "SOG" => {
                let palettes = (4..16u32).rev().map(|power| -> Coarser {
                    Box::new(move |_| {
                        Choice::Sog(SogSettings {
                            palette: 1 << power,
                        })
                    })
                });
                (Choice::Sog(SogSettings::new()), vec![palettes.collect()])
            }
            _ => (Choice::Default, Vec::new()),
        }
    }

    /// Writes a file, reads it back and judges it; nothing if the choice cannot hold the scene.
    fn write(
        &self,
        scene: &SplatData,
        judge: &Judge,
        choice: &Choice,
    ) -> Result<Option<Encoded>, Failure> {
        let folder = tempfile::tempdir()?;
        let path = folder
            .path()
            .join("scene")
            .with_extension(self.0.endings[0]);
        let path: &Path = &path;
        match choice {
            Choice::Default => scene::write(path, scene)?,
            Choice::Sog(settings) => sog::write_with(path, scene, settings)?,
            Choice::Spz(settings) => match spz::write_with(path, scene, settings) {
                Err(SceneFileError::Field { .. }) if settings.fractional_bits.is_some() => {
                    return Ok(None);
                }
                written => written?,
            },
        }
        let bytes = std::fs::read(path)?;
        let psnr = judge.psnr(&as_original(scene::read(path)?, scene))?;
        Ok(Some(Encoded {
            bytes,
            psnr,
            settings: choice.words(),
        }))
    }
}

/// Makes one field coarser.
type Coarser = Box<dyn Fn(Choice) -> Choice>;

fn spz_with(change: impl Fn(SpzSettings) -> SpzSettings + 'static) -> Coarser {
    Box::new(move |choice| match choice {
        Choice::Spz(settings) => Choice::Spz(change(settings)),
        other => other,
    })
}

impl Choice {
    fn words(&self) -> String {
        match self {
            Self::Default => String::new(),
            Self::Sog(settings) => format!("palette of at most {}", settings.palette),
            Self::Spz(settings) => {
                let positions = (settings.fractional_bits)
                    .map_or_else(|| "finest".to_owned(), |bits| format!("2^-{bits}"));
                let (first, rest) = (settings.sh1_bits, settings.sh_rest_bits);
                format!("grid {positions}, SH {first}, {rest} bits")
            }
        }
    }
}
