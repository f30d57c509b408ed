//! Steps of some rows give what steps of all do.

use burn::tensor::{Device, Tensor, TensorData};
use glam::{DMat4, DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use splat_data::{Camera, Lens, SceneScale, SplatData};
use splat_ops::{AdamRows, ImageSize, ProjectSettings, RowGroups};

use super::SparseOptimized;
use crate::{
    CameraTensors, FieldGradients, FieldStep, Gaussians, LearningRates, Optimized, RenderSettings,
    project_gaussians, render,
};

/// Random Gaussians around the origin, neighbours in memory near each other, with a few odd ones.
fn splats(count: usize, rng: &mut Pcg64Mcg) -> SplatData {
    let mut vector = |size: f64| DVec3::from([(); 3].map(|()| rng.random_range(-size..size)));
    let means: Vec<[f64; 3]> = (0..count).map(|_| vector(5.0).to_array()).collect();
    let order = crate::morton::order(&means);
    let mut means: Vec<[f32; 3]> = order.iter().map(|i| means[*i].map(|x| x as f32)).collect();
    means[3][1] = f32::NAN;
    let mut log_scales: Vec<[f32; 3]> = (0..count)
        .map(|_| [(); 3].map(|()| rng.random_range(-5.0..-1.5)))
        .collect();
    log_scales[5][0] = f32::NEG_INFINITY;
    // One that is as large as the scene.
    log_scales[count / 2][2] = 1.0;
    SplatData {
        quats: (0..count)
            .map(|_| [(); 4].map(|()| rng.random_range(-1.0..1.0)))
            .collect(),
        opacity_logits: (0..count).map(|_| rng.random_range(-3.0..3.0)).collect(),
        sh0: (0..count)
            .map(|_| [(); 3].map(|()| rng.random_range(-1.0..1.0)))
            .collect(),
        sh_rest: (0..count * 9)
            .map(|_| rng.random_range(-0.3..0.3))
            .collect(),
        sh_degree: 1,
        means,
        log_scales,
        ..SplatData::default()
    }
}

fn model(splats: &SplatData) -> SparseOptimized<Gaussians> {
    let device = Device::flex().autodiff();
    let scale = SceneScale::new(5.0).unwrap();
    let gaussians = Gaussians::from_data(splats, &device);
    let rates = LearningRates::new();
    let model = Optimized::with_adam(gaussians, &rates, AdamRows::All, scale).unwrap();
    SparseOptimized::new(model).with_group_size(16)
}

fn lenses() -> Vec<Lens> {
    vec![
        Lens::Pinhole,
        Lens::OpenCv([0.0; 8]),
        Lens::OpenCv([-0.2, 0.05, 1e-3, -2e-3, 0.0, 0.0, 0.0, 0.0]),
        Lens::OpenCv([0.3, 0.1, -2e-3, 1e-3, 0.05, 0.2, 0.01, 0.0]),
        Lens::OpenCv([-0.4, 0.0, 0.01, 0.01, 0.0, 0.0, 0.0, 0.0]),
        Lens::OpenCvFisheye([0.0; 4]),
        Lens::OpenCvFisheye([-0.05, 0.01, -0.002, 1e-4]),
        Lens::OpenCvFisheye([0.1, -0.05, 0.0, 0.0]),
    ]
}

/// Anywhere in the scene or around it, of any focal length, the axis not always in the image.
fn camera(lens: Lens, rng: &mut Pcg64Mcg) -> Camera {
    let mut number = |low: f64, high: f64| rng.random_range(low..high);
    let turn = DQuat::from_xyzw(number(-1.0, 1.0), number(-1.0, 1.0), number(-1.0, 1.0), 0.5);
    let place = DVec3::new(number(-9.0, 9.0), number(-9.0, 9.0), number(-9.0, 9.0));
    let size = ImageSize {
        width: number(20.0, 90.0) as u32,
        height: number(20.0, 90.0) as u32,
    };
    let (w, h) = (f64::from(size.width), f64::from(size.height));
    let f = number(0.3, 3.0) * w;
    Camera {
        viewmat: DMat4::from_quat(turn.normalize()) * DMat4::from_translation(place),
        intrinsics: [
            f,
            f * number(0.9, 1.1),
            w * number(-0.1, 1.1),
            h * number(0.3, 0.7),
        ],
        lens,
        size,
    }
}

fn bits<const D: usize>(tensor: Tensor<D>) -> Vec<u32> {
    let values = tensor.into_data().try_into_vec::<f32>().unwrap();
    values.into_iter().map(f32::to_bits).collect()
}

/// Nothing is lost: the picture is the same to the bit, and so is every gradient.
#[test]
fn what_a_view_does_not_see_changes_neither_picture_nor_gradients() {
    let mut rng = Pcg64Mcg::seed_from_u64(8);
    let splats = splats(1500, &mut rng);
    let device = Device::flex().autodiff();
    let settings = RenderSettings::new();
    for lens in lenses() {
        let mut left_out = 0.0;
        const CAMERAS: usize = 12;
        for _ in 0..CAMERAS {
            let mut model = model(&splats);
            let camera = camera(lens, &mut rng);
            let cameras = CameraTensors::from_camera(&camera, &device);
            let rows = model.seen(&[camera], &settings.project).unwrap();
            left_out += 1.0 - rows.len() as f64 / 1500.0;
            let of = |model: &Gaussians| {
                let image = render(model, &cameras, &settings).unwrap().image();
                let weights = Tensor::<1>::from_data(
                    TensorData::new((0..97).map(|i| (i as f32).sin()).collect(), [97]),
                    &device,
                );
                let count = image.shape().num_elements();
                let weights = weights
                    .repeat_dim(0, count.div_ceil(97))
                    .narrow(0, 0, count);
                let loss = (image.clone().reshape([-1]) * weights).sum();
                (bits(image.inner()), loss.backward())
            };
            let all: Vec<usize> = rows.indices().collect();
            let (picture, mut gradients) = of(model.whole().model());
            let gradients = model.whole().gradients(&mut gradients);
            if rows.is_empty() {
                assert!(
                    gradients.values().all(|gradient| {
                        bits(gradient.clone()).iter().all(|bits| bits << 1 == 0)
                    })
                );
                continue;
            }
            let part = model.part(rows);
            let (of_part, mut part_gradients) = of(part.model());
            assert!(picture == of_part, "{camera:?}");
            let part_gradients = part.gradients(&model, &mut part_gradients);
            assert_eq!(part_gradients.len(), gradients.len());
            for (name, gradient) in gradients {
                let [_, width] = gradient.dims();
                let mut gradient = bits(gradient);
                let mut chosen = Vec::new();
                for row in &all {
                    let row = &mut gradient[row * width..(row + 1) * width];
                    chosen.extend_from_slice(row);
                    row.fill(0);
                }
                assert!(
                    chosen == bits(part_gradients[&name].clone()),
                    "{name}, {camera:?}"
                );
                let nothing = gradient.iter().all(|bits| bits << 1 == 0);
                assert!(nothing, "{name} of rows left out, {camera:?}");
            }
        }
        let left_out = left_out / CAMERAS as f64;
        assert!(left_out > 0.2, "{lens:?}: only {left_out} left out");
    }
}

/// More cameras, by what the projection draws alone.
#[test]
fn every_splat_that_is_drawn_is_among_the_rows_seen() {
    let mut rng = Pcg64Mcg::seed_from_u64(9);
    let splats = splats(1500, &mut rng);
    let mut model = model(&splats);
    let whole = Gaussians::from_data(&splats, &Device::flex());
    let settings = RenderSettings::new();
    for lens in lenses() {
        let mut share = [0.0; 2];
        for _ in 0..150 {
            let camera = camera(lens, &mut rng);
            let cameras = CameraTensors::from_camera(&camera, &Device::flex());
            let projected = project_gaussians(&whole, &cameras, &settings).unwrap();
            let extents = projected
                .extents()
                .into_data()
                .try_into_vec::<f32>()
                .unwrap();
            let rows = model.seen(&[camera], &settings.project).unwrap();
            let mut seen = vec![false; 1500];
            rows.indices().for_each(|row| seen[row] = true);
            for (row, extent) in extents.as_chunks::<2>().0.iter().enumerate() {
                assert!(extent[0] == 0.0 || seen[row], "row {row}, {camera:?}");
                share[0] += f64::from(u8::from(extent[0] > 0.0));
                share[1] += f64::from(u8::from(seen[row]));
            }
        }
        eprintln!(
            "{lens:?}: drawn and seen {:.3?}",
            share.map(|sum| sum / 150.0 / 1500.0)
        );
    }
}

/// A gradient for some rows of every field, which depends on the step.
fn gradient(step: usize, row: usize, column: usize) -> f32 {
    let x = (step * 31 + row * 7 + column * 3) as f32;
    (x * 0.37).sin() * 10f32.powf((x * 0.11).sin() * 3.0)
}

/// The groups that have a part in a step: few, some of them rarely.
fn groups(step: usize, count: usize) -> Vec<u32> {
    let takes_part = |group: &u32| {
        let group = *group as usize;
        match group % 4 {
            0 => step.is_multiple_of(40),
            1 => step.is_multiple_of(7),
            2 => (step / 10).is_multiple_of(2),
            _ => (step + group).is_multiple_of(3),
        }
    };
    (0..count as u32).filter(takes_part).collect()
}

fn gradients(
    model: &Optimized<Gaussians>,
    step: usize,
    rows: &RowGroups,
    of_all: bool,
) -> FieldGradients {
    let of_field = |name: &str| {
        let [count, width] = model.field(name).unwrap().dims();
        let mut values = vec![0.0; count * width];
        for row in rows.indices() {
            for column in 0..width {
                values[row * width + column] = gradient(step, row, column);
            }
        }
        if !of_all {
            let row = |row: usize| values[row * width..(row + 1) * width].to_vec();
            values = rows.indices().flat_map(row).collect();
        }
        let count = values.len() / width;
        Tensor::<2>::from_data(TensorData::new(values, [count, width]), &Device::flex())
    };
    // The higher degrees begin to learn later.
    let fields = model.fields().iter().map(|field| field.name.clone());
    let fields = fields.filter(|name| name != "sh_rest" || step >= 50);
    fields.map(|name| (name.clone(), of_field(&name))).collect()
}

const STEPS: usize = 300;

fn how(step: usize) -> impl Fn(&crate::Field) -> (f64, FieldStep) {
    let scale = SceneScale::new(5.0).unwrap();
    move |field| (field.rate_at(step, STEPS, scale), FieldStep::Step(1.0))
}

fn sparse_step(model: &mut SparseOptimized<Gaussians>, step: usize) {
    let count = model.count();
    let chosen = groups(step, count.div_ceil(model.group));
    let rows = RowGroups::new(model.group, count, chosen).unwrap();
    let part = model.part(rows.clone());
    let gradients = gradients(&model.behind, step, &rows, false);
    model.step_part(part, gradients, how(step)).unwrap();
}

fn values(model: &Gaussians) -> Vec<Vec<f32>> {
    let data = model.to_data();
    vec![
        data.means.into_flattened(),
        data.log_scales.into_flattened(),
        data.quats.into_flattened(),
        data.opacity_logits,
        data.sh0.into_flattened(),
        data.sh_rest,
    ]
}

/// Largest difference, in units of the last place of the larger value or of 1.
fn difference(a: &Gaussians, b: &Gaussians) -> f32 {
    let pairs = values(a).into_iter().zip(values(b));
    pairs
        .flat_map(|(a, b)| a.into_iter().zip(b))
        .filter(|(a, b)| a.is_finite() && a != b)
        .map(|(a, b)| (a - b).abs() / (f32::EPSILON * a.abs().max(b.abs()).max(1.0)))
        .fold(0.0, f32::max)
}

/// Over 300 steps a row that takes part in few of them is where full Adam has it: each of these
/// rounds the parameter 300 times, which adds up to some units in the last place.
#[test]
fn rows_left_out_are_where_full_adam_has_them() {
    let splats = splats(330, &mut Pcg64Mcg::seed_from_u64(10));
    let mut sparse = model(&splats);
    let mut full = model(&splats).into_whole();
    for step in 0..STEPS {
        let rows = RowGroups::new(16, 330, groups(step, 21)).unwrap();
        let gradients = gradients(&full, step, &rows, true);
        full.step(gradients, how(step)).unwrap();
        sparse_step(&mut sparse, step);
        assert!(sparse.missed.len() > 0);
    }
    let reached = difference(&sparse.model(), full.model());
    // Without what they have missed.
    let behind = difference(sparse.behind.model(), full.model());
    eprintln!("{reached} units in the last place; {behind} without catching up");
    assert!(reached < 150.0, "{reached}");
    assert!(behind > 1e4, "{behind}");

    // Reading changes nothing, and a copy is what the model becomes.
    let copy = sparse.model().into_owned();
    assert!(sparse.missed.len() > 0);
    assert!(values(&copy) == values(sparse.whole().model()) || copy.to_data().means[3][1].is_nan());
    assert_eq!(difference(&copy, sparse.whole().model()), 0.0);
    assert_eq!(difference(&copy, sparse.behind.model()), 0.0);
    let moments = |model: &Optimized<Gaussians>, name: &str| {
        let saved = model.save().unwrap();
        saved.tensors[name].try_to_vec::<f32>().unwrap()
    };
    for name in ["means.moment_1", "sh_rest.moment_2", "quats.moment_1"] {
        let pairs = moments(sparse.whole(), name)
            .into_iter()
            .zip(moments(&full, name));
        for (found, expected) in pairs {
            let error = (found - expected).abs();
            assert!(
                error <= 1e-4 * expected.abs() + 1e-30,
                "{name}: {found} {expected}"
            );
        }
    }
}

/// Going on from a saved state gives the same bits, rows that are behind included.
#[test]
fn rows_that_are_behind_are_restored_as_they_are() {
    let mut rng = Pcg64Mcg::seed_from_u64(11);
    let splats = splats(330, &mut rng);
    let settings = ProjectSettings::default();
    let cameras: Vec<Camera> = (0..4).map(|_| camera(Lens::Pinhole, &mut rng)).collect();
    let mut first = model(&splats);
    let mut second = SparseOptimized::new(model(&splats).into_whole());
    first.seen(&cameras, &settings);
    for step in 0..60 {
        sparse_step(&mut first, step);
    }
    let saved = first.save().unwrap();
    let inner = Device::flex();
    second.restore(saved.clone(), &inner).unwrap();
    for step in 60..80 {
        for model in [&mut first, &mut second] {
            sparse_step(model, step);
        }
        assert_eq!(
            first.seen(&cameras, &settings),
            second.seen(&cameras, &settings)
        );
        assert_eq!(
            first.bounds.as_ref().map(|b| &b.boxes),
            second.bounds.as_ref().map(|b| &b.boxes)
        );
    }
    assert_eq!(difference(&first.model(), &second.model()), 0.0);
    assert_eq!(difference(first.behind.model(), second.behind.model()), 0.0);

    let mut bad = saved;
    let taken = TensorData::new(vec![0.0f32; 3], [3]);
    bad.tensors.insert("sparse/rows.taken".into(), taken);
    let message = second.restore(bad, &inner).unwrap_err();
    assert!(message.contains("`taken`"), "{message}");
}

/// Boxes that were measured long ago still hold rows that have moved since.
#[test]
fn boxes_hold_rows_that_have_moved() {
    let mut rng = Pcg64Mcg::seed_from_u64(12);
    let splats = splats(330, &mut rng);
    let settings = ProjectSettings::default();
    let mut model = model(&splats);
    model.seen(&[camera(Lens::Pinhole, &mut rng)], &settings);
    let check = |model: &SparseOptimized<Gaussians>| {
        let drift = model.drift(&model.missed());
        let data = model.model().to_data();
        let bounds = model.bounds.as_ref().unwrap();
        for (group, own) in bounds.boxes.iter().enumerate() {
            let [means, log_scales] = drift[model.last(group as u32)];
            let own = own.widened(means, log_scales);
            for row in 16 * group..330.min(16 * (group + 1)) {
                for axis in 0..3 {
                    let mean = data.means[row][axis];
                    assert!(mean.is_nan() || (own.low[axis]..=own.high[axis]).contains(&mean));
                    assert!(data.log_scales[row][axis].exp() <= own.scale);
                }
            }
        }
    };
    check(&model);
    for step in 0..40 {
        sparse_step(&mut model, step);
        check(&model);
    }
    model.whole();
    check(&model);
    for step in 40..50 {
        let rows = RowGroups::new(16, 330, groups(step, 21)).unwrap();
        let gradients = gradients(&model.behind, step, &rows, true);
        model.step(gradients, how(step)).unwrap();
        check(&model);
    }
    // A change from outside is noticed.
    model.whole().update("means", |means| means + 1.0).unwrap();
    model.seen(&[camera(Lens::Pinhole, &mut rng)], &settings);
    check(&model);
}

#[test]
fn a_part_of_other_rows_is_refused() {
    let splats = splats(330, &mut Pcg64Mcg::seed_from_u64(13));
    let mut model = model(&splats);
    let part = model.part(RowGroups::all(16, 330));
    let gradients = gradients(&model.behind, 0, &RowGroups::all(16, 330), false);
    let refused = |model: &mut SparseOptimized<Gaussians>, part, gradients, step| {
        let message = model.step_part(part, gradients, |field| (field.rate, step));
        message.unwrap_err().to_string()
    };
    let some = model.part(RowGroups::new(16, 330, vec![2]).unwrap());
    let step = FieldStep::Step(1.0);
    assert!(refused(&mut model, some, gradients.clone(), step).contains("shape [330, "));
    let message = refused(&mut model, part, gradients.clone(), FieldStep::Skip);
    assert!(message.contains("step all rows"), "{message}");
    let part = model.part(RowGroups::all(16, 330));
    model
        .whole()
        .edit_rows(&crate::RowEdit::identity(10))
        .unwrap();
    let message = refused(&mut model, part, gradients, step);
    assert!(message.contains("other rows"), "{message}");
}

#[test]
fn a_checkpoint_with_groups_of_no_size_is_refused() {
    let mut rng = Pcg64Mcg::seed_from_u64(10);
    let mut model = model(&splats(100, &mut rng));
    for size in [0, u64::MAX] {
        let mut record = model.save().unwrap();
        let group = burn_pack::Scalar::UInt(size);
        record.scalars.insert("sparse/rows.group".to_owned(), group);
        let message = model.restore(record, &Device::flex()).unwrap_err();
        assert!(message.contains("`group`"), "{message}");
    }
}
