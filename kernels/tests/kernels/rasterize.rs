//! Tests of blending and its gradients.

use cubecl::client::Client;
use splat_kernels::Buffer;
use splat_kernels::intersect::Frames;
use splat_kernels::rasterize::{
    RasterizeInputs, RasterizeSettings, RasterizeState, Sums, count_evaluations, rasterize,
    rasterize_vjp,
};

use crate::device::{
    assert_close, client, differences, download, download_u32, rng, uniform, upload, wide,
};
use crate::reference::{self, View};

const SETTINGS: RasterizeSettings = RasterizeSettings {
    alpha_max: 0.99,
    transmittance_min: 9.999e-5,
    sums: Sums::Ordered,
};

const ALL_SUMS: [Sums; 3] = [Sums::Ordered, Sums::Atomic, Sums::Exchange];

/// Gradients of packed splats, colours, opacities and background, without absolute ones.
fn gradients(
    client: &Client,
    inputs: &RasterizeInputs,
    state: &RasterizeState,
    grad_output: &Buffer,
    frames: &Frames,
    settings: &RasterizeSettings,
    [packed, colors, opacities, background]: [bool; 4],
) -> [Option<Buffer>; 4] {
    let needs_grad = [packed, colors, opacities, background, false].into();
    let gradients = rasterize_vjp(
        client,
        inputs,
        state,
        grad_output,
        frames,
        settings,
        needs_grad,
    );
    let [packed, colors, opacities, background, absgrad] = gradients.into();
    assert!(absgrad.is_none(), "nobody asked for absolute gradients");
    [packed, colors, opacities, background]
}

struct Scene {
    frames: Frames,
    channels: usize,
    packed: Vec<f32>,
    colors: Vec<f32>,
    opacities: Vec<f32>,
    background: Option<Vec<f32>>,
}

impl Scene {
    /// Overlapping splats of a few pixels, with opacities within `opacity`.
    fn new(
        cameras: usize,
        gaussians: usize,
        width: u32,
        height: u32,
        channels: usize,
        opacity: [f32; 2],
        seed: u64,
    ) -> Self {
        let mut rng = rng(seed);
        let splats = cameras * gaussians;
        let mut packed = Vec::new();
        for _ in 0..splats {
            let v = uniform(&mut rng, 6, 0.0, 1.0);
            packed.extend([
                v[0] * (width as f32 + 8.0) - 4.0,
                v[1] * (height as f32 + 8.0) - 4.0,
                1.0 + v[2] * 5.0,
                0.1 + 0.4 * v[3],
                0.6 * v[4] - 0.3,
                0.1 + 0.4 * v[5],
                1.0,
                40.0,
                40.0,
            ]);
        }
        Self {
            frames: Frames {
                cameras,
                gaussians,
                width,
                height,
                alpha_min: splat_core::ALPHA_MIN as f32,
            },
            channels,
            packed,
            colors: uniform(&mut rng, splats * channels, -0.5, 1.0),
            opacities: uniform(&mut rng, splats, opacity[0], opacity[1]),
            background: Some(uniform(&mut rng, cameras * channels, 0.0, 1.0)),
        }
    }

    fn inputs(&self, client: &cubecl::client::Client) -> RasterizeInputs {
        RasterizeInputs {
            packed: upload(client, &self.packed),
            colors: upload(client, &self.colors),
            opacities: upload(client, &self.opacities),
            background: self.background.as_ref().map(|b| upload(client, b)),
            channels: self.channels,
        }
    }

    /// Packed splats, colours, opacities, background in float64.
    fn wide(&self) -> [Vec<f64>; 4] {
        let background = self.background.clone();
        let background =
            background.unwrap_or_else(|| vec![0.0; self.frames.cameras * self.channels]);
        [
            wide(&self.packed),
            wide(&self.colors),
            wide(&self.opacities),
            wide(&background),
        ]
    }

    fn reference(&self, p: &[Vec<f64>; 4]) -> Vec<f64> {
        let (n, d) = (self.frames.gaussians, self.channels);
        let view = View::new(self.frames.width as usize, self.frames.height as usize);
        (0..self.frames.cameras)
            .flat_map(|c| {
                reference::rasterize(
                    &p[0][c * n * 9..(c + 1) * n * 9],
                    &p[1][c * n * d..(c + 1) * n * d],
                    &p[2][c * n..(c + 1) * n],
                    &p[3][c * d..(c + 1) * d],
                    &view,
                )
            })
            .collect()
    }
}

/// Compares the forward pass and all gradients, in every summation mode, with float64 within
/// `limit`.
fn check(name: &str, scene: &Scene, limit: f64) {
    let Some(client) = client() else { return };
    let inputs = scene.inputs(&client);
    let wide_scene = scene.wide();
    let image = scene.reference(&wide_scene);
    let weights = uniform(&mut rng(30), image.len(), -1.0, 1.0);
    let grad_output = upload(&client, &weights);
    let weights = wide(&weights);
    let expected = [0, 1, 2, 3].map(|which| {
        differences(&wide_scene[which], 1e-7, |x| {
            let mut moved = wide_scene.clone();
            moved[which] = x.to_vec();
            let image = scene.reference(&moved);
            image.iter().zip(&weights).map(|(a, b)| a * b).sum()
        })
    });
    for sums in ALL_SUMS {
        let settings = RasterizeSettings { sums, ..SETTINGS };
        let (output, state) = rasterize(&client, &inputs, &scene.frames, &settings).unwrap();
        assert_close(
            &format!("{name}: image"),
            &download(&client, &output),
            &image,
            1e-6,
        );
        let grads = gradients(
            &client,
            &inputs,
            &state,
            &grad_output,
            &scene.frames,
            &settings,
            [true; 4],
        );
        for (which, part) in ["packed", "colors", "opacities", "background"]
            .iter()
            .enumerate()
        {
            let Some(grad) = &grads[which] else {
                assert!(*part == "background" && scene.background.is_none());
                continue;
            };
            assert_close(
                &format!("{name}: {part}, {sums:?}"),
                &download(&client, grad),
                &expected[which],
                limit,
            );
        }
    }
}

#[test]
fn images_and_gradients_agree_with_float64() {
    check(
        "soft splats",
        &Scene::new(1, 40, 37, 21, 3, [0.1, 0.8], 31),
        1e-5,
    );
}

#[test]
fn opaque_splats_stop_pixels_early_and_gradients_follow() {
    check(
        "opaque splats",
        &Scene::new(1, 80, 20, 20, 3, [0.7, 0.98], 32),
        1e-5,
    );
}

#[test]
fn two_cameras_and_no_background() {
    let mut scene = Scene::new(2, 20, 18, 33, 2, [0.1, 0.9], 33);
    scene.background = None;
    check("two cameras", &scene, 1e-5);
}

#[test]
fn any_number_of_channels() {
    for channels in [1, 16, 17, 35] {
        check(
            &format!("{channels} channels"),
            &Scene::new(1, 12, 17, 9, channels, [0.2, 0.9], 34),
            1e-5,
        );
    }
}

#[test]
fn an_image_of_one_pixel() {
    check(
        "one pixel",
        &Scene::new(1, 5, 1, 1, 3, [0.2, 0.9], 35),
        1e-5,
    );
}

#[test]
fn the_cap_of_alpha_stops_the_gradient_through_it() {
    let Some(client) = client() else { return };
    let mut scene = Scene::new(1, 1, 1, 1, 1, [0.999, 1.0], 36);
    scene.packed[..2].copy_from_slice(&[0.5, 0.5]);
    let inputs = scene.inputs(&client);
    let (output, state) = rasterize(&client, &inputs, &scene.frames, &SETTINGS).unwrap();
    let grad = upload(&client, &[1.0, 1.0]);
    let [packed, colors, opacities, background] = gradients(
        &client,
        &inputs,
        &state,
        &grad,
        &scene.frames,
        &SETTINGS,
        [true; 4],
    );
    assert_close("alpha", &download(&client, &output)[1..], &[0.99], 1e-6);
    assert_eq!(download(&client, &packed.unwrap()), [0.0; 9]);
    assert_eq!(download(&client, &opacities.unwrap()), [0.0]);
    assert_close(
        "colour",
        &download(&client, &colors.unwrap()),
        &[0.99],
        1e-6,
    );
    assert_close(
        "background",
        &download(&client, &background.unwrap()),
        &[0.01],
        1e-5,
    );
}

#[test]
fn many_faint_layers_keep_their_transmittance() {
    let Some(client) = client() else { return };
    let mut scene = Scene::new(1, 2000, 16, 16, 1, [0.00393, 0.005], 37);
    for (i, row) in scene.packed.chunks_mut(9).enumerate() {
        row.copy_from_slice(&[8.0, 8.0, 1.0 + i as f32, 1e-4, 0.0, 1e-4, 1.0, 4e4, 4e4]);
    }
    let inputs = scene.inputs(&client);
    let (output, state) = rasterize(&client, &inputs, &scene.frames, &SETTINGS).unwrap();
    let wide_scene = scene.wide();
    assert_close(
        "image",
        &download(&client, &output),
        &scene.reference(&wide_scene),
        1e-5,
    );
    let weights = uniform(&mut rng(38), output.len(), 0.0, 1.0);
    let [_, colors, ..] = gradients(
        &client,
        &inputs,
        &state,
        &upload(&client, &weights),
        &scene.frames,
        &SETTINGS,
        [false, true, false, false],
    );
    // dL/dcolour_i = Σ over pixels of T_i alpha_i g: the image is linear in the colours.
    let (packed, opacities) = (&wide_scene[0], &wide_scene[2]);
    let mut expected = vec![0.0; 2000];
    for y in 0..16 {
        for x in 0..16 {
            let mut t = 1.0;
            for i in 0..2000 {
                let raw = reference::raw_alpha(
                    &packed[i * 9..i * 9 + 9],
                    opacities[i],
                    x as f64 + 0.5,
                    y as f64 + 0.5,
                );
                expected[i] += t * raw * f64::from(weights[(y * 16 + x) * 2]);
                t *= 1.0 - raw;
            }
        }
    }
    assert_close(
        "colours",
        &download(&client, &colors.unwrap()),
        &expected,
        2e-5,
    );
}

#[test]
fn nothing_to_see_gives_the_background() {
    let Some(client) = client() else { return };
    let mut scene = Scene::new(2, 0, 19, 5, 2, [0.1, 0.2], 39);
    scene.background = Some(vec![0.25, 0.5, 0.75, 1.0]);
    let inputs = scene.inputs(&client);
    let (output, state) = rasterize(&client, &inputs, &scene.frames, &SETTINGS).unwrap();
    assert_eq!(
        wide(&download(&client, &output)),
        scene.reference(&scene.wide())
    );
    let grad = upload(&client, &vec![1.0; output.len()]);
    let grads = gradients(
        &client,
        &inputs,
        &state,
        &grad,
        &scene.frames,
        &SETTINGS,
        [true; 4],
    );
    let [packed, colors, opacities, background] = grads.map(|g| download(&client, &g.unwrap()));
    assert!(packed.is_empty() && colors.is_empty() && opacities.is_empty());
    assert_eq!(background, [95.0; 4]);
}

#[test]
fn only_the_wanted_gradients_and_the_same_bits_every_time() {
    let Some(client) = client() else { return };
    let scene = Scene::new(1, 60, 40, 40, 3, [0.1, 0.9], 40);
    let inputs = scene.inputs(&client);
    let weights = uniform(&mut rng(41), 40 * 40 * 4, -1.0, 1.0);
    let run = |sums, needs_grad: [bool; 4]| {
        let settings = RasterizeSettings { sums, ..SETTINGS };
        let (output, state) = rasterize(&client, &inputs, &scene.frames, &settings).unwrap();
        let grad = upload(&client, &weights);
        let grads = gradients(
            &client,
            &inputs,
            &state,
            &grad,
            &scene.frames,
            &settings,
            needs_grad,
        );
        (
            download(&client, &output),
            grads.map(|g| g.map(|g| download(&client, &g))),
        )
    };
    let first = run(Sums::Ordered, [true; 4]);
    for _ in 0..3 {
        assert_eq!(run(Sums::Ordered, [true; 4]), first);
    }
    for sums in ALL_SUMS {
        for wanted in [
            [true, false, false, false],
            [false, true, false, false],
            [false, false, true, true],
            [false; 4],
        ] {
            let (_, some) = run(sums, wanted);
            for i in 0..4 {
                assert_eq!(some[i].is_some(), wanted[i]);
                if let (Some(some), Some(all)) = (&some[i], &first.1[i]) {
                    assert_close("wanted alone", some, &wide(all), 1e-6);
                }
            }
        }
    }
}

#[test]
fn sums_of_thousands_of_tiles_lose_nothing() {
    let Some(client) = client() else { return };
    // Each of three splats covers all 4,096 tiles, whose units all add to the same few floats.
    let side = 1024;
    let mut scene = Scene::new(1, 3, side, side, 2, [0.3, 0.5], 45);
    for (i, row) in scene.packed.chunks_mut(9).enumerate() {
        let middle = side as f32 / 2.0;
        row.copy_from_slice(&[
            middle,
            middle,
            1.0 + i as f32,
            1e-4,
            0.0,
            1e-4,
            1.0,
            4e4,
            4e4,
        ]);
    }
    let inputs = scene.inputs(&client);
    // All of one sign, so nothing cancels, and a missing tile shows as 1 of 4,096.
    let weights = uniform(&mut rng(46), (side * side * 3) as usize, 0.5, 1.0);
    let grad = upload(&client, &weights);
    let [ordered, atomic, exchange] = ALL_SUMS.map(|sums| {
        let settings = RasterizeSettings { sums, ..SETTINGS };
        let (_, state) = rasterize(&client, &inputs, &scene.frames, &settings).unwrap();
        assert_eq!(state.lists.intersections, 3 * 64 * 64);
        assert_eq!(state.lists.slots.is_some(), sums == Sums::Ordered);
        let [packed, colors, ..] = gradients(
            &client,
            &inputs,
            &state,
            &grad,
            &scene.frames,
            &settings,
            [true; 4],
        );
        [packed, colors].map(|grad| download(&client, &grad.unwrap()))
    });
    let [packed, colors] = ordered;
    for (name, [other_packed, other_colors]) in [("atomic", atomic), ("exchange", exchange)] {
        for (a, b) in other_colors.iter().zip(&colors) {
            let error = (a - b).abs() / b.abs();
            assert!(error <= 5e-5, "{name}: {a}, in order {b}");
        }
        assert_close(name, &other_packed, &wide(&packed), 1e-5);
    }
}

#[test]
fn more_tiles_than_one_dimension_of_workgroups_can_hold() {
    let Some(client) = client() else { return };
    // One pixel wide: 65,600 tiles in a column.
    let height = 16 * 65_600;
    let mut scene = Scene::new(1, 3, 1, height, 1, [0.5, 0.9], 42);
    scene.background = None;
    for (row, y) in scene
        .packed
        .chunks_mut(9)
        .zip([0.5, 16.0 * 65_535.0, f64::from(height) - 0.5])
    {
        row[0] = 0.5;
        row[1] = y as f32;
    }
    let inputs = scene.inputs(&client);
    let (output, state) = rasterize(&client, &inputs, &scene.frames, &SETTINGS).unwrap();
    let expected = scene.reference(&scene.wide());
    assert_close("image", &download(&client, &output), &expected, 1e-6);
    let grad = upload(&client, &vec![1.0; output.len()]);
    let [_, colors, ..] = gradients(
        &client,
        &inputs,
        &state,
        &grad,
        &scene.frames,
        &SETTINGS,
        [false, true, false, false],
    );
    // One splat of colour 1 lights all pixels: the sum of its weights.
    let expected: Vec<f64> = (0..3)
        .map(|n| {
            let mut alone = scene.wide();
            alone[1] = (0..3)
                .map(|other| f64::from(u8::from(other == n)))
                .collect();
            scene
                .reference(&alone)
                .chunks(2)
                .map(|pixel| pixel[0])
                .sum()
        })
        .collect();
    assert_close(
        "colours",
        &download(&client, &colors.unwrap()),
        &expected,
        1e-5,
    );
}

#[test]
fn evaluations_are_counted() {
    let Some(client) = client() else { return };
    let scene = Scene::new(1, 400, 50, 35, 1, [0.5, 0.98], 44);
    let inputs = scene.inputs(&client);
    let (_, state) = rasterize(&client, &inputs, &scene.frames, &SETTINGS).unwrap();
    let count = count_evaluations(&client, &inputs, &state, &scene.frames, &SETTINGS).unwrap();

    let [packed, _, opacities, _] = scene.wide();
    let mut order: Vec<usize> = (0..scene.frames.gaussians).collect();
    order.sort_by(|&a, &b| packed[a * 9 + 2].total_cmp(&packed[b * 9 + 2]));
    let (mut blended, mut stopped, mut until_stop) = (0, 0, 0);
    for pixel in 0..50 * 35 {
        let (x, y) = ((pixel % 50) as f64 + 0.5, (pixel / 50) as f64 + 0.5);
        let mut t = 1.0;
        for &i in &order {
            until_stop += 1;
            let raw = reference::raw_alpha(&packed[i * 9..i * 9 + 9], opacities[i], x, y);
            if raw < splat_core::ALPHA_MIN {
                continue;
            }
            let next = t * (1.0 - raw.min(0.99));
            if next < 9.999e-5 {
                stopped += 1;
                break;
            }
            t = next;
            blended += 1;
        }
    }
    println!("{count:?}; {until_stop} without any lists");
    assert_eq!(count.blended, blended);
    // A pixel walks the splats that it blends, and the one before which it stops.
    assert!(stopped > 0, "no pixel stops");
    assert_eq!(count.seen, blended + stopped);
    assert!(count.tested > count.blended && count.tested < until_stop / 2);
}

/// Processor time of this process in seconds, unaffected by other work on the machine.
fn processor_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // After the name in parentheses, utime and stime are entries 11 and 12, in hundredths of a
    // second.
    let fields = stat.rsplit(')').next().unwrap_or_default();
    let ticks = fields.split_whitespace().skip(11).take(2);
    ticks
        .filter_map(|ticks| ticks.parse::<f64>().ok())
        .sum::<f64>()
        / 100.0
}

/// Prints processor times of the stages on a software device; run it by name with `--ignored
/// --nocapture`.
#[test]
#[ignore = "a measurement, not a check"]
fn time_of_the_stages_at_270_by_480() {
    let Some(client) = client() else { return };
    let scene = Scene::new(1, 15_000, 270, 480, 3, [0.05, 0.95], 43);
    let inputs = scene.inputs(&client);
    let grad = upload(&client, &vec![1.0; 270 * 480 * 4]);
    for round in 0..4 {
        let mut at = processor_seconds();
        let mut lap = |name: &str| {
            let now = processor_seconds();
            print!("{name} {:.2} s, ", now - at);
            at = now;
        };
        print!("round {round}: ");
        let lists = splat_kernels::intersect::intersect(
            &client,
            &inputs.packed,
            &inputs.opacities,
            &scene.frames,
        )
        .unwrap();
        download_u32(&client, &lists.ranges);
        lap("intersect");
        let (output, state) = rasterize(&client, &inputs, &scene.frames, &SETTINGS).unwrap();
        download(&client, &output);
        lap("intersect + forward");
        let grads = gradients(
            &client,
            &inputs,
            &state,
            &grad,
            &scene.frames,
            &SETTINGS,
            [true; 4],
        );
        download(&client, grads[2].as_ref().unwrap());
        lap("backward");
        println!("{} intersections", lists.intersections);
        if round == 3 {
            let count =
                count_evaluations(&client, &inputs, &state, &scene.frames, &SETTINGS).unwrap();
            let walked = download_u32(&client, &state.walked);
            let walked: u64 = walked.into_iter().map(u64::from).sum();
            println!("{count:?}; {walked} splats of their tiles' lists were walked by all pixels");
        }
    }
}
