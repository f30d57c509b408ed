//! `splat compact`: a scene in as few bytes as a given loss allows.

mod encoding;

use std::fmt::Write;
use std::path::{Path, PathBuf};

use clap::Args;
use splat_data::{SplatData, View, scene as files};
use splat_model::ops::OpError;
use splat_trainer::compact::{CompactSettings, Compacted, Judge, compact};

use super::convert::size_of;
use super::photos::PhotoArgs;
use super::{Failure, GlobalArgs, device, print, scene};
use crate::report::progress::Progress;
use crate::report::{probe_file, refuse_inputs};
use encoding::{Encoded, Encoder};

/// Make a scene smaller: fewer Gaussians, lower degrees of spherical harmonics, fewer bits
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat compact out/fox/scene.ply --capture fox --out fox.spz
  splat compact scene.ply --capture photos/ --max-loss 0.3 --out scene.sog

Renders the views that were trained on after every change, and takes from the scene what costs no more
than DB of their mean PSNR: Gaussians with little weight in the pictures, harmonics where colours hardly
depend on the direction, and bits of the file. The file is read again and judged as it is. Nothing is
trained.")]
pub struct CompactArgs {
    /// Scene: PLY, SPZ or SOG
    pub scene: PathBuf,
    /// Capture that the scene was trained on
    #[arg(long, value_name = "DIR")]
    pub capture: PathBuf,
    /// Largest loss of the mean PSNR, in dB
    #[arg(long, value_name = "DB", default_value_t = 0.1, value_parser = decibels)]
    pub max_loss: f64,
    /// File to write; its extension is its format: .spz or .sog, or .ply, which has no fewer bits
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    #[command(flatten)]
    pub photos: PhotoArgs,
}

/// A loss in dB.
fn decibels(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    match (0.0..=100.0).contains(&value) {
        true => Ok(value),
        false => Err("must lie in 0 to 100 dB".to_owned()),
    }
}

/// Runs the command.
pub(super) fn run(args: &CompactArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let encoder = Encoder::of(files::format_to_write(&args.out)?);
    let capture = args.photos.open(&args.capture, global)?;
    let train: Vec<&View> = capture.train_views().collect();
    let held_out: Vec<&View> = capture.test_views().collect();
    if train.is_empty() {
        return Err(Failure::BadInput(format!(
            "{}: no view is trained on; leave some with --hold-out",
            args.capture.display()
        )));
    }
    let device = device::open(global)?.device;
    let mut splats = scene::read(&args.scene, global)?;
    args.photos
        .warn_of_refined(&args.capture, &args.scene, global);
    probe_file(&args.out)?;
    refuse_inputs([args.out.clone()], [args.scene.as_path()])?;
    for loss in encoder.losses(&splats) {
        global.say(format_args!("warning: {}: {loss}", args.out.display()));
    }
    splats.settings.complete_from(&capture);

    let judge = Judge::new(&train, &device);
    let whole = judge.psnr(&splats)?;
    if !whole.is_finite() {
        return Err(Failure::BadInput(format!(
            "{}: the scene has no PSNR to lose, it is {whole}; check the photos and their masks",
            args.capture.display()
        )));
    }
    // What the format costs in any case is not there for anything else.
    let own = (whole - encoder.most_precise(&splats, &judge)?).max(0.0);
    if !(own <= args.max_loss) {
        return Err(Failure::Check(format!(
            "{}: this format alone costs {own:.3} dB, more than --max-loss {}; allow more, or write .ply",
            args.out.display(),
            args.max_loss
        )));
    }
    let settings = CompactSettings::new().with_max_loss(args.max_loss - own);
    let compacted = smaller(&splats, &train, &settings, &device, global)?;
    let limit = whole - args.max_loss;
    let Some(encoded) = fewer_bits(&encoder, &compacted.splats, &judge, limit, global)? else {
        return Err(Failure::Check(format!(
            "{}: the smaller scene cannot be written within the {} dB; allow more with --max-loss",
            args.out.display(),
            args.max_loss
        )));
    };
    splat_data::write_durably(&args.out, &encoded.bytes).map_err(|source| {
        splat_data::WriteError {
            path: args.out.clone(),
            source,
        }
    })?;
    let before = size_of(&args.scene);
    print(&report(&compacted, &encoded, &args.out, before))?;
    if !held_out.is_empty() {
        // Of the file as it was written.
        let judge = Judge::new(&held_out, &device);
        let read = as_original(files::read(&args.out)?, &splats);
        let (was, is) = (judge.psnr(&splats)?, judge.psnr(&read)?);
        print(&format!(
            "held-out views: {was:.2} dB before, {is:.2} dB from the file\n"
        ))?;
    }
    Ok(())
}

/// [`compact`] with its progress shown.
fn smaller(
    splats: &SplatData,
    views: &[&View],
    settings: &CompactSettings,
    device: &burn::tensor::Device,
    global: &GlobalArgs,
) -> Result<Compacted, OpError> {
    let mut bar: Option<(&'static str, Progress)> = None;
    let compacted = compact(splats, views, settings, device, |stage, done, of| {
        if bar.as_ref().is_none_or(|(shown, _)| *shown != stage) {
            bar = Some((stage, Progress::new(of as u64, 0, global.quiet)));
        }
        if let Some((_, bar)) = &mut bar {
            bar.update(done as u64, || stage.to_owned());
            if done == of {
                bar.finish();
            }
        }
    })?;
    Ok(compacted)
}

/// [`Encoder::encode`] with its progress shown.
fn fewer_bits(
    encoder: &Encoder,
    splats: &SplatData,
    judge: &Judge,
    limit: f64,
    global: &GlobalArgs,
) -> Result<Option<Encoded>, Failure> {
    let mut bar: Option<Progress> = None;
    let encoded = encoder.encode(splats, judge, limit, |done, of| {
        let bar = bar.get_or_insert_with(|| Progress::new(of as u64, 0, global.quiet));
        bar.update(done as u64, || "fewer bits".to_owned());
    });
    if let Some(bar) = &bar {
        bar.finish();
    }
    encoded
}

/// A scene from a file, with what is known beside it where the file cannot hold it, as
/// `splat eval` knows it from the capture.
fn as_original(mut read: SplatData, original: &SplatData) -> SplatData {
    let (settings, before) = (&mut read.settings, &original.settings);
    settings.background = settings.background.or(before.background);
    settings.antialias = settings.antialias.or(before.antialias);
    settings.scene_scale = settings.scene_scale.or(before.scene_scale);
    read
}

/// The stages as a table.
fn report(compacted: &Compacted, encoded: &Encoded, out: &Path, before: Option<u64>) -> String {
    let mut text = format!(
        "{:16} {:>9} {:>31}  {:>8}\n",
        "", "Gaussians", "of degree 0, 1, 2, 3", "PSNR dB"
    );
    for stage in &compacted.stages {
        let [a, b, c, d] = stage.degrees;
        let degrees = format!("{a}, {b}, {c}, {d}");
        let _ = writeln!(
            text,
            "{:16} {:>9} {degrees:>31}  {:8.3}",
            stage.name, stage.gaussians, stage.psnr
        );
    }
    let _ = writeln!(
        text,
        "{:16} {:>9} {:>31}  {:8.3}",
        "from the file",
        compacted.splats.len(),
        encoded.settings,
        encoded.psnr
    );
    let bytes = encoded.bytes.len() as u64;
    let _ = write!(text, "{}  {bytes} bytes", out.display());
    if let Some(before) = before {
        let percent = 100.0 * bytes as f64 / before.max(1) as f64;
        let _ = write!(text, ", {percent:.1} % of {before}");
    }
    text.push('\n');
    text
}
