//! Smaller scenes: without the Gaussians and the spherical harmonics that photos do not need.
//!
//! [`compact`] removes as much as a given loss of PSNR allows, and measures the loss by rendering,
//! against the photos. It trains nothing. Files of fewer bits per number are the matter of
//! [`splat_data::scene`].

mod judge;
mod prune;
mod reduce;
#[cfg(all(test, feature = "cpu"))]
mod tests;

use burn::tensor::Device;
use derive_setters::Setters;
use splat_data::{SplatData, View};
use splat_model::ops::OpError;

pub use judge::Judge;
pub use prune::contributions;

/// How much of a scene may be lost, and how the loss is shared.
#[derive(Debug, Clone, PartialEq, Setters)]
#[setters(prefix = "with_")]
pub struct CompactSettings {
    /// Largest loss of the mean PSNR over the views, in dB. Default 0.1.
    pub max_loss: f64,
    /// The part of it that fewer Gaussians may take. Default 0.5.
    pub prune_share: f64,
    /// The part of it that lower degrees of spherical harmonics may take. Default 0.25.
    pub reduce_share: f64,
}

impl CompactSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }
}

impl Default for CompactSettings {
    fn default() -> Self {
        Self {
            max_loss: 0.1,
            prune_share: 0.5,
            reduce_share: 0.25,
        }
    }
}

/// A scene after a stage of [`compact`].
#[derive(Debug, Clone, PartialEq)]
pub struct Stage {
    /// What was done.
    pub name: &'static str,
    /// Gaussians left.
    pub gaussians: usize,
    /// Gaussians of each degree of spherical harmonics, 0 to 3.
    pub degrees: [usize; 4],
    /// Mean PSNR over the views, in dB.
    pub psnr: f64,
}

/// A scene that was made smaller.
#[derive(Debug, Clone, PartialEq)]
pub struct Compacted {
    /// The scene. Gaussians whose degree was lowered have zeros in the coefficients above it.
    pub splats: SplatData,
    /// The scene as it was, and after each stage.
    pub stages: Vec<Stage>,
}

/// Removes Gaussians and lowers degrees of spherical harmonics as far as the mean PSNR over the
/// views allows.
///
/// Gaussians go in the order of their weight in all pictures, `Σ_p w_i(p)`. Degrees are lowered
/// where the colour changes least over the views that see the Gaussian (Papantonakis et al. 2024,
/// *Reducing the Memory Footprint of 3D Gaussian Splatting*, section 4.2).
///
/// `progress` is told the stage, and how many renders of all views are done of about how many.
///
/// ```
/// use burn::tensor::Device;
/// use splat_data::{Capture, CaptureSettings};
/// use splat_trainer::compact::{CompactSettings, compact};
/// use splat_trainer::{TrainSettings, Trainer};
///
/// # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
/// let capture = Capture::load(folder, &CaptureSettings::new().with_downscale(16))?;
/// let settings = TrainSettings::new().with_steps(3);
/// let trained = Trainer::builder(capture.clone())
///     .settings(settings)
///     .device(Device::flex())
///     .build()?
///     .run()?;
/// let views: Vec<_> = capture.train_views().collect();
/// let settings = CompactSettings::new().with_max_loss(0.2);
/// let small = compact(&trained.to_data(), &views, &settings, &Device::flex(), |_, _, _| {})?;
/// assert!(small.splats.len() < trained.model.len());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// When there are no views, an op refuses its input, or the device fails.
pub fn compact(
    splats: &SplatData,
    views: &[&View],
    settings: &CompactSettings,
    device: &Device,
    mut progress: impl FnMut(&'static str, usize, usize),
) -> Result<Compacted, OpError> {
    if views.is_empty() {
        return Err(OpError::Argument {
            op: "compact",
            what: "there are no views to judge by".into(),
        });
    }
    let judge = Judge::new(views, device);
    let whole = judge.psnr(splats)?;
    let mut stages = vec![stage("as it was", splats, whole)];
    let floor = |share: f64| whole - settings.max_loss * share;

    let pruned = prune::prune(splats, &judge, floor(settings.prune_share), |done, of| {
        progress("removing Gaussians", done, of);
    })?;
    stages.push(stage("fewer Gaussians", &pruned.0, pruned.1));
    let share = settings.prune_share + settings.reduce_share;
    let reduced = reduce::reduce(pruned, &judge, floor(share), |done, of| {
        progress("lowering degrees", done, of);
    })?;
    stages.push(stage("lower degrees", &reduced.0, reduced.1));
    Ok(Compacted {
        splats: reduced.0,
        stages,
    })
}

fn stage(name: &'static str, splats: &SplatData, psnr: f64) -> Stage {
    Stage {
        name,
        gaussians: splats.len(),
        degrees: reduce::degrees(splats),
        psnr,
    }
}

/// The largest of `0..=most` that `holds`, by halving. 0 holds; what is above one that does not is
/// taken not to.
fn largest(
    most: usize,
    mut holds: impl FnMut(usize) -> Result<bool, OpError>,
) -> Result<usize, OpError> {
    let (mut low, mut high) = (0, most + 1);
    while high - low > 1 {
        let middle = low + (high - low) / 2;
        if holds(middle)? {
            low = middle;
        } else {
            high = middle;
        }
    }
    Ok(low)
}

/// About how many times [`largest`] asks.
fn questions(most: usize) -> usize {
    (most + 1).next_power_of_two().trailing_zeros() as usize
}
