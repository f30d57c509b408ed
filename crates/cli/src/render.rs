//! `splat render`: pictures of a scene.

mod cameras;

use std::path::PathBuf;

use burn::tensor::Tensor;
use clap::{Args, ValueEnum};
use splat_model::ops::device::to_host;
use splat_model::ops::{OpError, Projected, rasterize};
use splat_model::{CameraTensors, Gaussians, RenderSettings, project_gaussians, render_projected};

use super::photos::PhotoArgs;
use super::{Failure, GlobalArgs, device, scene};
use crate::report::png::Picture;
use crate::report::progress::Progress;
use crate::report::view_names::ViewNames;
use crate::report::{probe_folder, refuse_inputs};

/// Render pictures of a scene
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat render scene.ply --capture examples/data/saharov --out pictures
  splat render scene.ply --orbit 60 --out pictures --channels rgb,alpha,depth
  splat render scene.ply --camera camera.json --out pictures

A camera file holds one camera or a list of them:
  {\"name\": \"front\", \"width\": 640, \"height\": 480, \"intrinsics\": [fx, fy, cx, cy],
   \"viewmat\": [[r, r, r, t], [r, r, r, t], [r, r, r, t], [0, 0, 0, 1]]}
A lens: \"camera_model\": \"opencv\", \"distortion\": [k1, k2, p1, p2, k3, k4, k5, k6]
     or \"camera_model\": \"opencv_fisheye\", \"distortion\": [k1, k2, k3, k4]
viewmat maps world to camera (+x right, +y down, +z forward); the first pixel's centre is at (0.5, 0.5).")]
pub struct RenderArgs {
    /// Scene: a PLY file in the 3DGS layout, SPZ or SOG
    pub scene: PathBuf,
    /// Precision of the higher degrees of spherical harmonics
    #[arg(long, value_enum, default_value_t)]
    pub sh_precision: scene::PrecisionChoice,
    #[command(flatten)]
    cameras: CameraArgs,
    #[command(flatten)]
    photos: PhotoArgs,
    /// Folder to write the pictures to
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Channels to render; depth is the mean visible depth, nearest white, farthest black
    #[arg(long, value_enum, value_delimiter = ',', default_value = "rgb")]
    channels: Vec<Channel>,
}

/// Source of the cameras: one of three.
#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct CameraArgs {
    /// Render every view of this capture
    #[arg(long, value_name = "CAPTURE")]
    capture: Option<PathBuf>,
    /// Render the cameras of this file
    #[arg(long, value_name = "FILE.json")]
    camera: Option<PathBuf>,
    /// Render from N places on a circle about the scene's middle (up is -y)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    orbit: Option<u32>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Channel {
    Rgb,
    Alpha,
    Depth,
}

impl Channel {
    /// Suffix of the file name before `.png`.
    fn suffix(self) -> &'static str {
        match self {
            Self::Rgb => "",
            Self::Alpha => ".alpha",
            Self::Depth => ".depth",
        }
    }
}

/// Runs the command.
pub(super) fn run(args: &RenderArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let device = device::open(global)?.device;
    let mut data = scene::read(&args.scene, global)?;
    let capture = match &args.cameras.capture {
        Some(path) => {
            args.photos.warn_of_refined(path, &args.scene, global);
            let capture = args.photos.open(path, global)?;
            data.settings.complete_from(&capture);
            Some(capture)
        }
        None => {
            args.photos.refuse("of use with --capture only")?;
            None
        }
    };
    let (gaussians, settings) = scene::on_device(&data, &device, args.sh_precision, global);
    let mut inputs = vec![args.scene.clone()];
    let cameras = match (&capture, &args.cameras.camera) {
        (Some(capture), _) => {
            inputs.extend(capture.photo_files());
            cameras::of_capture(capture)
        }
        (None, Some(path)) => cameras::of_file(path)?,
        (None, None) => cameras::orbit(&data, args.cameras.orbit.unwrap_or(1)),
    };
    probe_folder(&args.out)?;
    let mut progress = Progress::new(cameras.len() as u64, 0, global.quiet);
    let suffixes: Vec<&str> = args
        .channels
        .iter()
        .map(|channel| channel.suffix())
        .collect();
    let names = ViewNames::new(cameras.iter().map(|(name, _)| name.as_str()), &suffixes);
    if let Some(note) = names.note() {
        global.say(note);
    }
    let pictures_of = |stem: &str| {
        let names = suffixes
            .iter()
            .map(move |suffix| format!("{stem}{suffix}.png"));
        names.map(|name| args.out.join(name)).collect::<Vec<_>>()
    };
    let outputs = names.stems.iter().flat_map(|stem| pictures_of(stem));
    refuse_inputs(outputs, inputs.iter().map(PathBuf::as_path))?;
    for (done, ((name, camera), stem)) in cameras.iter().zip(&names.stems).enumerate() {
        let camera = CameraTensors::from_camera(&camera.relative_to(gaussians.origin), &device);
        for (channel, picture) in pictures(&gaussians, &camera, &settings, &args.channels)? {
            let suffix = channel.suffix();
            picture.write(&args.out.join(format!("{stem}{suffix}.png")))?;
        }
        progress.update(done as u64 + 1, || name.clone());
    }
    progress.finish();
    global.say(format_args!(
        "{} camera(s) rendered to {}",
        cameras.len(),
        args.out.display()
    ));
    Ok(())
}

/// Picture of each requested channel, from one camera.
fn pictures(
    gaussians: &Gaussians,
    camera: &CameraTensors,
    settings: &RenderSettings,
    channels: &[Channel],
) -> Result<Vec<(Channel, Picture)>, Failure> {
    let (width, height) = (camera.size.width, camera.size.height);
    let projected = project_gaussians(gaussians, camera, settings)?;
    let rendered = render_projected(gaussians, &projected, camera, settings)?;
    let mut pictures = Vec::with_capacity(channels.len());
    for &channel in channels {
        let picture = match channel {
            Channel::Rgb => Picture::from_rgb_f32(width, height, &to_host(rendered.image())?),
            Channel::Alpha => Picture::from_gray_f32(width, height, &to_host(rendered.alpha())?),
            Channel::Depth => {
                let depth = accumulated_depth(gaussians, &projected, settings)?;
                let shades = depth_shades(&to_host(depth)?, &to_host(rendered.alpha())?);
                Picture::from_gray_f32(width, height, &shades)
            }
        };
        pictures.push((channel, picture?));
    }
    Ok(pictures)
}

/// Accumulated depth `sum(z alpha T)`, `[1, H, W, 1]`: depths rasterised like a colour.
fn accumulated_depth(
    gaussians: &Gaussians,
    projected: &Projected,
    settings: &RenderSettings,
) -> Result<Tensor<4>, OpError> {
    let depths: Tensor<3> = projected.depths().unsqueeze_dim(2);
    let opacities = gaussians.opacities().unsqueeze::<2>();
    let opacities = if settings.antialias {
        opacities * projected.compensations()
    } else {
        opacities
    };
    let rendered = rasterize(projected, depths, opacities, None, &settings.rasterize)?;
    Ok(rendered.image())
}

/// Mean depth of each pixel as a shade: nearest 1, farthest 0; 0 where little is visible.
fn depth_shades(depth: &[f32], alpha: &[f32]) -> Vec<f32> {
    const SEEN: f32 = 0.5;
    let mean = |(&depth, &alpha): (&f32, &f32)| (alpha >= SEEN).then(|| depth / alpha);
    let means = || depth.iter().zip(alpha).map(mean);
    let range = (f32::INFINITY, f32::NEG_INFINITY);
    let (near, far) = means()
        .flatten()
        .fold(range, |(near, far), z| (near.min(z), far.max(z)));
    let span = (far - near).max(f32::MIN_POSITIVE);
    means()
        .map(|mean| mean.map_or(0.0, |z| (far - z) / span))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_is_bright_and_nothing_is_black() {
        // Depths 2 and 4, and a pixel where little is visible.
        let shades = depth_shades(&[1.0, 4.0, 9.0, 3.0], &[0.5, 1.0, 0.1, 1.0]);
        assert_eq!(shades, [1.0, 0.0, 0.0, 0.5]);
        assert_eq!(depth_shades(&[1.0], &[0.0]), [0.0]);
    }
}
