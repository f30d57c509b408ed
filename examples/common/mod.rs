//! What the examples share: their arguments, and the picture that each leaves.
#![allow(dead_code, reason = "not every example uses everything")]

use std::error::Error;
use std::path::PathBuf;

use burn_splat::ops::device::to_host;
use burn_splat::prelude::*;
use image::{Rgb, RgbImage, imageops};

/// Pixels of white between two images.
const GAP: u32 = 8;
/// Smaller images are enlarged, up to this height.
const HEIGHT: u32 = 480;

/// Arguments of an example: `[SIZE [FOLDER [INPUT]]]`.
pub struct Arguments {
    /// How much to do, usually the number of training steps.
    pub size: usize,
    /// Where the picture goes.
    folder: PathBuf,
    /// What to work on, a capture or a photo.
    pub input: String,
}

impl Arguments {
    /// Reads the command line, with these defaults.
    pub fn read(size: usize, input: &str) -> Result<Self, Box<dyn Error>> {
        let mut given = std::env::args().skip(1);
        Ok(Self {
            size: given.next().map_or(Ok(size), |size| size.parse())?,
            folder: given.next().unwrap_or("out/examples".into()).into(),
            input: given.next().unwrap_or(input.into()),
        })
    }

    /// Writes images side by side to `FOLDER/NAME.png`. They have one size, `[1, H, W, 3]` or `[1,
    /// H, W, 1]`, and values in [0, 1].
    pub fn save(&self, name: &str, images: &[Tensor<4>]) -> Result<(), Box<dyn Error>> {
        let [_, height, width, _] = images[0].dims().map(|side| side as u32);
        let scale = (HEIGHT / height).max(1);
        let step = width * scale + GAP;
        let page_width = step * images.len() as u32 - GAP;
        let mut page = RgbImage::from_pixel(page_width, height * scale, Rgb([255; 3]));
        for (i, image) in images.iter().enumerate() {
            let rgb = image.clone().repeat_dim(3, 3 / image.dims()[3]);
            let bytes = to_host(rgb)?.into_iter().map(|x| (x * 255.0).round() as u8);
            let image = RgbImage::from_raw(width, height, bytes.collect());
            let image = image.ok_or("images side by side must have one size")?;
            let filter = imageops::FilterType::Nearest;
            let image = imageops::resize(&image, width * scale, height * scale, filter);
            imageops::replace(&mut page, &image, i64::from(step) * i as i64, 0);
        }
        std::fs::create_dir_all(&self.folder)?;
        let file = self.folder.join(name).with_extension("png");
        page.save(&file)?;
        println!("{}", file.display());
        Ok(())
    }
}

/// The first held-out view: its photo, and what the trained model renders of it, `[1, H, W, D]`.
pub fn held_out<M: SplatModel>(
    capture: &Capture,
    trained: &Trained<M>,
) -> Result<[Tensor<4>; 2], Box<dyn Error>> {
    let view = capture.test_views().next().ok_or("no view is held out")?;
    let device = trained.model.means().device();
    let camera = view.camera().relative_to(trained.model.origin());
    let camera = CameraTensors::from_camera(&camera, &device);
    let image = render(&trained.model, &camera, &trained.render_settings)?.image();
    Ok([burn_splat::train::photo(view, &device)?, image])
}

/// Peak signal-to-noise ratio of two images in dB.
pub fn psnr(image: &Tensor<4>, target: &Tensor<4>) -> f32 {
    losses::psnr(image.clone(), target.clone()).into_scalar()
}
