//! The photometric loss, compared with its definition in float64, for every photo layout.

use cubecl::client::Client;
use rand::RngExt;
use splat_kernels::Buffer;
use splat_kernels::photometric::{
    Images, PhotometricShape, TargetKind, photometric, photometric_tracked, photometric_vjp,
};

use crate::device::{
    assert_close, client, differences, download, relative_l2, rng, uniform, upload,
};

fn shape([images, height, width]: [usize; 3], channels: usize, pixel: usize) -> PhotometricShape {
    let weights = [0.1, 0.2, 0.4, 0.2, 0.1];
    PhotometricShape {
        images,
        height,
        width,
        channels,
        pixel,
        c1: 1e-4,
        c2: 9e-4,
        window: weights.to_vec(),
    }
}

/// The mean absolute difference and one minus the mean similarity, from the definition.
fn reference(rendered: &[f64], photo: &[f64], shape: &PhotometricShape) -> [f64; 2] {
    let (h, w) = (shape.height as isize, shape.width as isize);
    let margin = if h < 5 || w < 5 { 0 } else { 2 };
    let (mut l1, mut ssim, mut counted) = (0.0, 0.0, 0.0);
    for plane in 0..shape.images * shape.channels {
        let (image, channel) = (plane / shape.channels, plane % shape.channels);
        let at = |x: isize, y: isize| {
            if x < 0 || y < 0 || x >= w || y >= h {
                return [0.0, 0.0];
            }
            let pixel = image * (h * w) as usize + (y * w + x) as usize;
            [
                rendered[pixel * shape.pixel + channel],
                photo[pixel * shape.channels + channel],
            ]
        };
        for y in 0..h {
            for x in 0..w {
                let [a, b] = at(x, y);
                l1 += (a - b).abs();
                if x < margin || y < margin || x >= w - margin || y >= h - margin {
                    continue;
                }
                let mut m = [0.0; 4];
                for (i, wy) in shape.window.iter().enumerate() {
                    for (j, wx) in shape.window.iter().enumerate() {
                        let [a, b] = at(x + j as isize - 2, y + i as isize - 2);
                        let weight = f64::from(*wx) * f64::from(*wy);
                        for (m, value) in m.iter_mut().zip([a, b, a * a + b * b, a * b]) {
                            *m += weight * value;
                        }
                    }
                }
                let [mx, my, q, p] = m;
                let (c1, c2) = (f64::from(shape.c1), f64::from(shape.c2));
                let squares = mx * mx + my * my;
                ssim += (2.0 * mx * my + c1) * (2.0 * (p - mx * my) + c2)
                    / ((squares + c1) * (q - squares + c2));
                counted += 1.0;
            }
        }
    }
    [l1 / photo.len() as f64, 1.0 - ssim / counted]
}

/// Means and gradient.
fn run(
    client: &Client,
    rendered: &[f32],
    (target, kind): (&Buffer, TargetKind),
    shape: &PhotometricShape,
) -> (Vec<f32>, Vec<f32>) {
    let rendered = upload(client, rendered);
    let images = Images {
        rendered: &rendered,
        target,
        kind,
    };
    let (means, kept) = photometric_tracked(client, images, shape);
    let means = download(client, &means);
    assert_eq!(means, download(client, &photometric(client, images, shape)));
    let grad = upload(client, &[0.7, -1.3]);
    let gradient = photometric_vjp(client, images, &kept, &grad, shape);
    (means, download(client, &gradient))
}

#[test]
fn photos_of_any_kind_give_the_means_and_the_gradient_of_the_definition() {
    let Some(client) = client() else { return };
    let mut rng = rng(80);
    // Less than a tile, several tiles, and an image smaller than the window.
    for (size, channels, pixel) in [([1, 6, 7], 1, 1), ([2, 4, 9], 3, 4), ([1, 18, 34], 2, 4)] {
        let shape = shape(size, channels, pixel);
        let pixels: usize = size.iter().product();
        let levels: Vec<u8> = (0..pixels * channels).map(|_| rng.random()).collect();
        let mut rendered = uniform(&mut rng, pixels * pixel, 0.0, 1.0);
        for (x, level) in rendered
            .chunks_mut(pixel)
            .zip(levels.chunks(channels))
            .step_by(5)
        {
            x[0] = f32::from(level[0]) / 255.0;
        }

        let words: Vec<u32> = levels.iter().map(|level| u32::from(*level)).collect();
        let values: Vec<f32> = levels
            .iter()
            .map(|level| f32::from(*level) / 255.0)
            .collect();
        let bytes: Vec<u32> = levels
            .chunks(4)
            .map(|bytes| {
                bytes
                    .iter()
                    .rev()
                    .fold(0, |word, byte| word << 8 | u32::from(*byte))
            })
            .collect();
        let photos = [
            (Buffer::from_f32(&client, &values), TargetKind::Values),
            (Buffer::from_u32(&client, &words), TargetKind::Words),
            (Buffer::from_u32(&client, &bytes), TargetKind::Bytes),
        ];
        let [of_values, of_words, of_bytes] =
            photos.map(|(photo, kind)| run(&client, &rendered, (&photo, kind), &shape));
        assert_eq!(of_values, of_words);
        assert_eq!(of_values, of_bytes);

        let (means, gradient) = of_values;
        let photo: Vec<f64> = levels
            .iter()
            .map(|level| f64::from(*level) / 255.0)
            .collect();
        let wide: Vec<f64> = rendered.iter().map(|x| f64::from(*x)).collect();
        assert_close("means", &means, &reference(&wide, &photo, &shape), 2e-6);
        let d_ssim = |x: &[f64]| reference(x, &photo, &shape)[1];
        // The absolute value has no slope where both images are equal; elsewhere it is one over the
        // number of values.
        let mut expected = differences(&wide, 1e-5, |x| -1.3 * d_ssim(x));
        for (i, value) in expected.iter_mut().enumerate() {
            let (pixel, channel) = (i / shape.pixel, i % shape.pixel);
            if channel < channels {
                let photo = values[pixel * channels + channel];
                if rendered[i] != photo {
                    *value += 0.7 * f64::from((rendered[i] - photo).signum()) / photo_count(&shape);
                }
            } else {
                assert_eq!(gradient[i], 0.0);
            }
        }
        println!("{size:?}: {:.1e}", relative_l2(&gradient, &expected));
        assert_close("gradient", &gradient, &expected, 1e-5);
    }
}

fn photo_count(shape: &PhotometricShape) -> f64 {
    (shape.images * shape.height * shape.width * shape.channels) as f64
}

#[test]
fn a_window_that_shared_memory_cannot_hold_does_not_fit() {
    let Some(client) = client() else { return };
    let with = |taps: usize| PhotometricShape {
        window: vec![1.0 / taps as f32; taps],
        ..shape([1, 20, 20], 3, 4)
    };
    // A window of 11 must fit on every device: WebGPU guarantees 16 KiB.
    assert!(with(11).fits(&client));
    assert!(!with(100_001).fits(&client));
}
