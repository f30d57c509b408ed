//! Gaussians of different degrees: trained, edited, saved and lowered.

use burn::tensor::{Device, Tensor, TensorData};
use splat_ops::{AdamRows, OpError};

use super::*;
use crate::optimizer::{SplatAdam, StateRecord};
use crate::{
    Camera, CameraTensors, FieldStep, LearningRates, Lens, Moments, Optimized, RenderSettings,
    RowEdit, SceneScale, ShReductionSettings, SparseOptimized, SplatData, SplatModel,
    project_gaussians, reduce_sh_degrees, render,
};

/// Numbers of a Gaussian of degree 0.
const LEAST: usize = 14;

/// Gaussians before the camera, with all coefficients of degree 3.
fn splats(n: usize) -> SplatData {
    let value = |i: usize| (i as f32 * 0.73).sin() * 0.3;
    SplatData {
        means: (0..n)
            .map(|i| [value(i), value(i + 7), 3.0 + value(2 * i)])
            .collect(),
        log_scales: vec![[-2.0; 3]; n],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: (0..n).map(value).collect(),
        sh0: (0..n)
            .map(|i| [value(i), value(i + 1), value(i + 2)])
            .collect(),
        sh_rest: (0..45 * n).map(value).collect(),
        sh_degree: 3,
        ..SplatData::default()
    }
}

fn device() -> Device {
    Device::flex().autodiff()
}

fn camera(x: f64, device: &Device) -> CameraTensors {
    let camera = Camera {
        viewmat: glam::DMat4::from_translation(glam::DVec3::new(x, 0.1, 0.0)),
        intrinsics: [40.0, 40.0, 16.0, 12.0],
        lens: Lens::Pinhole,
        size: splat_ops::ImageSize {
            width: 32,
            height: 24,
        },
    };
    CameraTensors::from_camera(&camera, device)
}

fn optimized(gaussians: Gaussians) -> Optimized<Gaussians> {
    let scale = SceneScale::new(1.0).unwrap();
    Optimized::with_adam(gaussians, &LearningRates::new(), AdamRows::All, scale).unwrap()
}

fn uniform(n: usize) -> Optimized<Gaussians> {
    optimized(Gaussians::from_data(&splats(n), &device()))
}

fn ragged(degrees: &[usize]) -> Optimized<Gaussians> {
    let gaussians = Gaussians::from_data(&splats(degrees.len()), &device());
    optimized(gaussians.with_sh_degrees(degrees).unwrap())
}

/// A step of Adam from another view each time; the number of values that had a gradient.
fn step(model: &mut Optimized<Gaussians>, turn: usize) -> usize {
    let cameras = camera(turn as f64 * 0.2 - 0.3, &device());
    let image = render(model.model(), &cameras, &RenderSettings::new())
        .unwrap()
        .image();
    let gradients = model.gradients(&mut (image - 0.4).square().sum().backward());
    let sizes = gradients
        .values()
        .map(|gradient| gradient.shape().num_elements());
    let sizes = sizes.sum();
    model
        .step(gradients, |field| (field.rate, FieldStep::Step(1.0)))
        .unwrap();
    sizes
}

fn values(record: &StateRecord, name: &str) -> Vec<f32> {
    record.tensors[name].try_to_vec().unwrap()
}

/// Number of values in a state whose names fit.
fn numbers(record: &StateRecord, fits: impl Fn(&str) -> bool) -> usize {
    let tensors = record.tensors.iter().filter(|(name, _)| fits(name));
    tensors.map(|(_, data)| data.num_elements()).sum()
}

#[test]
fn a_gaussian_whose_colour_does_not_depend_on_the_view_has_fourteen_numbers() {
    for lowered_in_training in [false, true] {
        let n = 20;
        let mut model = match lowered_in_training {
            false => ragged(&vec![0; n]),
            true => uniform(n),
        };
        step(&mut model, 0);
        if lowered_in_training {
            assert_eq!(step(&mut model, 1), 59 * n);
            model
                .keep_owned_rows(&rows_of_degrees(&vec![0; n]))
                .unwrap();
        }
        assert_eq!(step(&mut model, 2), LEAST * n, "gradients");
        let saved = model.save().unwrap();
        let is_field = |name: &str| !name.contains('.') && !name.contains('/');
        assert_eq!(numbers(&saved, is_field), LEAST * n, "parameters");
        for moment in ["moment_1", "moment_2"] {
            let found = numbers(&saved, |name| name.ends_with(moment));
            assert_eq!(found, LEAST * n, "{moment}");
        }
        assert_eq!(model.model().to_data().sh_degree, 0);
    }
}

#[test]
fn numbers_follow_the_degrees() {
    let degrees = [3, 0, 1, 2, 0];
    let numbers: usize = degrees
        .iter()
        .map(|degree| 11 + 3 * (degree + 1) * (degree + 1))
        .sum();
    let mut model = ragged(&degrees);
    assert_eq!(step(&mut model, 0), numbers);
    assert_eq!(model.model().sh_degrees(), degrees);
    let data = model.model().to_data();
    data.check_shape().unwrap();
    let found: Vec<usize> = (0..5).map(|i| data.degree_of(i)).collect();
    assert_eq!((data.sh_degree, &found[..]), (3, &degrees[..]));
    // Again as uniform, and the same colours.
    let again = Gaussians::from_data(&data, &device());
    let centers = Tensor::<2>::from_floats([[0.3, -0.2, 0.1]], &device());
    let colors = |model: &Gaussians| host(model.colors(centers.clone(), 3, None).unwrap());
    assert_eq!(colors(model.model()), colors(&again));
}

/// Clones, splits, prunes, relocates and reorders, as strategies do.
fn edit(n: usize) -> RowEdit {
    let mut edit = RowEdit::default();
    for row in (0..n).rev().filter(|row| row % 5 != 1) {
        let kept = edit.push(row, Moments::Keep);
        match row % 4 {
            0 => {
                let new = edit.push(row, Moments::Restart);
                edit.offset(new, "means", &[0.1, 0.0, 0.0]);
            }
            1 => edit.set_moments(kept, Moments::Restart),
            2 => edit.relocate(kept, n - 1 - row, Moments::Of(row)),
            _ => {}
        }
    }
    edit
}

/// With all of degree 3 nothing differs from rows of 45 numbers, edits and moments included.
#[test]
fn gaussians_of_degree_three_train_as_ever() {
    let n = 40;
    let [mut one, mut other] = [ragged(&vec![3; n]), uniform(n)];
    for model in [&mut one, &mut other] {
        for turn in [0, 1, 2] {
            step(model, turn);
        }
        model.edit_rows(&edit(n)).unwrap();
        for turn in [3, 4, 5] {
            step(model, turn);
        }
    }
    assert!(one.model().to_data() == other.model().to_data());
    let [one, other] = [one, other].map(|model| model.save().unwrap());
    for moment in ["sh_rest.moment_1", "sh_rest.moment_2"] {
        assert_eq!(values(&one, moment), values(&other, moment), "{moment}");
    }
}

#[test]
fn coefficients_and_moments_go_where_their_gaussians_go() {
    let degrees = [2, 0, 1, 3];
    let mut model = ragged(&degrees);
    step(&mut model, 0);
    let before = model.save().unwrap();
    let mut edit = RowEdit::default();
    edit.push(3, Moments::Keep);
    edit.push(2, Moments::Restart);
    edit.push(1, Moments::Keep);
    edit.push(0, Moments::Of(2));
    model.edit_rows(&edit).unwrap();
    assert_eq!(model.model().sh_degrees(), [3, 1, 0, 2]);
    let after = model.save().unwrap();
    assert_eq!(values(&after, "owned/65535"), [15.0, 3.0, 0.0, 8.0]);
    // Rows before: 8 of the first, 3 of the third, 15 of the last.
    let rows = |record: &StateRecord, name: &str, from: usize, count: usize| {
        values(record, name)[3 * from..3 * (from + count)].to_vec()
    };
    for (to, from, count) in [(0, 11, 15), (15, 8, 3), (18, 0, 8)] {
        let [found, expected] =
            [(&after, to), (&before, from)].map(|(record, at)| rows(record, "sh_rest", at, count));
        assert_eq!(found, expected);
    }
    for moment in ["sh_rest.moment_1", "sh_rest.moment_2"] {
        assert_eq!(rows(&after, moment, 0, 15), rows(&before, moment, 11, 15));
        assert!(rows(&before, moment, 8, 3).iter().all(|x| *x != 0.0));
        assert_eq!(rows(&after, moment, 15, 3), [0.0; 9]);
        // Values of one with 8 rows, moments of one with 3.
        assert_eq!(rows(&after, moment, 18, 3), rows(&before, moment, 8, 3));
        assert_eq!(rows(&after, moment, 21, 5), [0.0; 15]);
    }
    step(&mut model, 1);
    // The last Gaussian with coefficients goes.
    let mut edit = RowEdit::default();
    edit.push(2, Moments::Keep);
    edit.push(2, Moments::Restart);
    model.edit_rows(&edit).unwrap();
    assert_eq!(step(&mut model, 2), 2 * LEAST);
    model.edit_rows(&RowEdit::identity(2)).unwrap();
    assert_eq!(model.model().to_data().sh_degree, 0);
}

#[test]
fn what_is_kept_goes_on_with_its_moments() {
    let n = 3;
    let mut model = uniform(n);
    step(&mut model, 0);
    let before = model.save().unwrap();
    let rates = model.fields().to_vec();
    model.keep_owned_rows(&rows_of_degrees(&[1, 3, 0])).unwrap();
    for (name, field) in rates.iter().zip(model.fields()) {
        assert_eq!((&name.name, name.rate), (&field.name, field.rate));
    }
    let after = model.save().unwrap();
    for name in ["sh_rest", "sh_rest.moment_1", "sh_rest.moment_2"] {
        let before = values(&before, name);
        let expected = [&before[..9], &before[45..90]].concat();
        assert_eq!(values(&after, name), expected, "{name}");
    }
    // And once more, from rows of their own.
    model.keep_owned_rows(&rows_of_degrees(&[0, 2, 3])).unwrap();
    assert_eq!(model.model().sh_degrees(), [0, 2, 0]);
    let again = model.save().unwrap();
    assert_eq!(
        values(&again, "sh_rest.moment_1"),
        values(&after, "sh_rest.moment_1")[9..33]
    );
    let error = model
        .keep_owned_rows(&rows_of_degrees(&[0, 2]))
        .unwrap_err();
    assert!(error.to_string().contains("a model of 3"), "{error}");
    assert_eq!(model.model().sh_degrees(), [0, 2, 0]);
    step(&mut model, 1);
}

#[test]
fn a_saved_run_goes_on_with_other_rows_in_a_model_of_one_degree() {
    let inner = Device::flex();
    let mut first = ragged(&[2, 0, 1, 3, 0, 3]);
    step(&mut first, 0);
    first.edit_rows(&edit(6)).unwrap();
    step(&mut first, 1);
    let saved = first.save().unwrap();
    for mut second in [uniform(9), ragged(&[1, 2])] {
        second.restore(saved.clone(), &inner).unwrap();
        let degrees = first.model().sh_degrees();
        assert_eq!(second.model().sh_degrees(), degrees);
        assert_eq!(second.fields(), first.fields());
        let mut same = ragged(&[0]);
        same.restore(saved.clone(), &inner).unwrap();
        step(&mut second, 2);
        step(&mut same, 2);
        assert!(second.model().to_data() == same.model().to_data());
        second.edit_rows(&edit(degrees.len())).unwrap();
    }
    step(&mut first, 2);
    let mut same = uniform(1);
    same.restore(saved.clone(), &inner).unwrap();
    step(&mut same, 2);
    assert_eq!(same.save().unwrap(), first.save().unwrap());

    let refused = |change: &dyn Fn(&mut StateRecord)| {
        let mut record = saved.clone();
        change(&mut record);
        let mut model = uniform(4);
        let message = model.restore(record, &inner).unwrap_err();
        assert_eq!(model.model().to_data(), splats(4));
        assert!(model.model().sh_starts.is_none());
        message
    };
    let with = |counts: Vec<f32>| {
        move |record: &mut StateRecord| {
            let shape = [counts.len(), 1];
            let data = TensorData::new(counts.clone(), shape);
            record.tensors.insert("owned/65535".into(), data);
        }
    };
    let mut counts = values(&saved, "owned/65535");
    counts.pop();
    assert!(refused(&with(counts.clone())).contains("`owned/65535`"));
    // As many rows in all, but not those of degrees.
    let mut counts = values(&saved, "owned/65535");
    let places: Vec<usize> = (0..counts.len()).filter(|i| counts[*i] > 1.0).collect();
    counts[places[0]] -= 1.0;
    counts[places[1]] += 1.0;
    assert!(refused(&with(counts)).contains("0, 3, 8 or 15"));
    assert!(refused(&|record| drop(record.tensors.remove("owned/65535"))).contains("`sh_rest`"));
    let of_uniform = uniform(2).save().unwrap();
    let message = ragged(&[1, 2]).restore(of_uniform, &inner).unwrap_err();
    assert!(message.contains("`owned/65535` is missing"), "{message}");
}

#[test]
fn rows_that_follow_the_gaussians_are_not_edited_apart() {
    let mut model = ragged(&[1, 3]);
    let mut edit = RowEdit::of_row_set(SH_COEFFICIENTS);
    edit.push(0, Moments::Keep);
    let message = model.edit_rows(&edit).unwrap_err().to_string();
    assert!(message.contains("follow"), "{message}");
    let mut edit = RowEdit::identity(2);
    edit.set(0, "sh_rest", &[0.0; 3]);
    let message = model.edit_rows(&edit).unwrap_err().to_string();
    assert!(message.contains("`sh_rest`"), "{message}");
    assert!(!SparseOptimized::new(model).can_be_sparse());
    assert!(SparseOptimized::new(uniform(2)).can_be_sparse());
}

/// Where nothing knows whose the coefficients are, an edit would leave them to other Gaussians.
#[test]
fn coefficients_that_would_not_follow_are_refused() {
    let gaussians = Gaussians::from_data(&splats(2), &device());
    let gaussians = gaussians.with_sh_degrees(&[1, 3]).unwrap();
    let fields = gaussians.fields(&LearningRates::default());
    let made = Optimized::new(gaussians, fields, |_| SplatAdam::new().into());
    let message = made.unwrap_err().to_string();
    assert!(
        message.contains("`sh_rest`") && message.contains("of_model"),
        "{message}"
    );
}

#[test]
fn degrees_that_a_model_does_not_have_are_refused() {
    let flat = SplatData {
        sh_rest: Vec::new(),
        sh_degree: 0,
        ..splats(2)
    };
    let flat = Gaussians::from_data(&flat, &device());
    let refused = |gaussians: Gaussians, degrees: &[usize]| {
        gaussians.with_sh_degrees(degrees).unwrap_err().to_string()
    };
    assert!(refused(flat, &[0, 0]).contains("no coefficients"));
    let gaussians = || Gaussians::from_data(&splats(2), &device());
    assert!(refused(gaussians(), &[0]).contains("1 Gaussians for a model of 2"));
    assert!(gaussians().with_sh_degrees(&[0, 4]).is_err());
    let nowhere = OwnedRows::of_counts(7, [0, 0]);
    let mut model = optimized(gaussians());
    assert!(
        model
            .keep_owned_rows(&nowhere)
            .unwrap_err()
            .to_string()
            .contains("set 7")
    );
    step(&mut model, 0);
}

/// Of four Gaussians, one has one colour, one varies linearly, one by degree 2 and one by degree 3.
fn of_each_degree() -> SplatData {
    let mut splats = splats(4);
    splats.sh_rest.fill(0.0);
    for (i, place) in [(1, 2), (2, 6), (3, 12)] {
        for channel in 0..3 {
            splats.sh_rest[45 * i + 3 * place + channel] = 0.9;
        }
    }
    splats.sh0 = vec![[0.3, 0.2, 0.1]; 4];
    splats.means = vec![
        [-0.4, -0.3, 2.0],
        [0.4, -0.3, 2.0],
        [-0.4, 0.3, 2.0],
        [0.4, 0.3, 2.0],
    ];
    splats
}

fn cameras() -> impl Iterator<Item = Result<CameraTensors, OpError>> {
    let at = |i: i32| camera(f64::from(i) * 0.4, &device());
    (-3..=3).map(move |i| Ok(at(i)))
}

#[test]
fn every_gaussian_keeps_the_degree_that_its_colours_need() {
    let mut model = optimized(Gaussians::from_data(&of_each_degree(), &device()));
    step(&mut model, 0);
    model
        .restore(model_of_each().save().unwrap(), &Device::flex())
        .unwrap();
    let settings = ShReductionSettings::new()
        .with_std(0.01)
        .with_distance(0.01);
    let render_settings = RenderSettings::new();
    let before = pictures(model.model());
    let reduced = reduce_sh_degrees(&mut model, cameras(), &render_settings, &settings).unwrap();
    assert_eq!(model.model().sh_degrees(), [0, 1, 2, 3]);
    assert_eq!(reduced, [1; 4]);
    let once = model.model().to_data().sh0[0];
    let after = pictures(model.model());
    let far = before.iter().zip(&after).map(|(a, b)| (a - b).abs());
    let far = far.fold(0.0, f32::max);
    assert!(far < 1e-5, "{far}");

    // All of one colour each, which is the mean.
    let settings = settings.with_std(f64::INFINITY);
    let reduced = reduce_sh_degrees(&mut model, cameras(), &render_settings, &settings).unwrap();
    assert_eq!(reduced, [4, 0, 0, 0]);
    let data = model.model().to_data();
    assert_eq!(data.sh0[0], once, "it had no coefficients already");
    let colors = |model: &Gaussians, x: f64| {
        let camera = camera(x, &device());
        let projected = project_gaussians(model, &camera, &render_settings).unwrap();
        host(model.shade(&camera, &projected, &render_settings).unwrap())
    };
    let constant = colors(model.model(), 0.0);
    let of_views: Vec<_> = (-3..=3)
        .map(|i| colors(model_of_each().model(), f64::from(i) * 0.4))
        .collect();
    for i in 0..constant.len() {
        let [low, high] = [f32::min, f32::max].map(|best: fn(f32, f32) -> f32| {
            let values = of_views.iter().map(|colors| colors[i]);
            values.reduce(best).unwrap()
        });
        assert!(
            low - 1e-6 <= constant[i] && constant[i] <= high + 1e-6,
            "{i}"
        );
    }
}

fn model_of_each() -> Optimized<Gaussians> {
    optimized(Gaussians::from_data(&of_each_degree(), &device()))
}

fn pictures(model: &Gaussians) -> Vec<f32> {
    let settings = RenderSettings::new();
    let picture = |camera: Result<CameraTensors, OpError>| {
        host(render(model, &camera.unwrap(), &settings).unwrap().image())
    };
    cameras().flat_map(picture).collect()
}

/// A model that says nothing of degrees is left alone.
#[test]
fn a_reduction_that_cannot_be_done_changes_nothing() {
    let mut model = uniform(3);
    let settings = ShReductionSettings::new();
    let two = camera(0.0, &device());
    let two = CameraTensors {
        viewmats: two.viewmats.repeat_dim(0, 2),
        intrinsics: two.intrinsics.repeat_dim(0, 2),
        ..two
    };
    let render_settings = RenderSettings::new();
    let failed = reduce_sh_degrees(&mut model, [Ok(two)], &render_settings, &settings);
    assert!(failed.unwrap_err().to_string().contains("one at a time"));
    let failed = reduce_sh_degrees(&mut model, [], &render_settings, &settings);
    assert!(failed.unwrap_err().to_string().contains("no camera"));
    let broken = settings.with_std(f64::NAN);
    let failed = reduce_sh_degrees(&mut model, cameras(), &render_settings, &broken);
    assert!(failed.unwrap_err().to_string().contains("`std`"));
    assert_eq!(model.model().to_data(), splats(3));
}
