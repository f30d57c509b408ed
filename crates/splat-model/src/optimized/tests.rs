//! Tests with a model of two row sets, a shared parameter, and one that is not trained.

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData};

use crate::optimizer::SplatAdam;
use crate::{Field, FieldStep, Moments, Optimized, RowEdit};

#[derive(Module, Debug)]
struct Inner {
    means: Param<Tensor<2>>,
    heat: Param<Tensor<1>>,
}

#[derive(Module, Debug)]
struct Model {
    inner: Inner,
    detail: Param<Tensor<3>>,
    gain: Param<Tensor<1>>,
    fixed: Param<Tensor<2>>,
}

fn tensor<const D: usize>(shape: [usize; D], device: &Device) -> Param<Tensor<D>> {
    let count: usize = shape.iter().product();
    let values: Vec<f32> = (0..count).map(|i| i as f32).collect();
    Param::from_tensor(Tensor::from_data(TensorData::new(values, shape), device))
}

fn fields() -> Vec<Field> {
    vec![
        Field::rows("means", 0.1).nested("inner"),
        Field::rows("heat", 0.1).nested("inner"),
        Field::rows("detail", 0.1).in_row_set(1),
        Field::shared("gain", 0.1),
    ]
}

fn model(device: &Device) -> Model {
    Model {
        inner: Inner {
            means: tensor([3, 2], device),
            heat: tensor([3], device),
        },
        detail: tensor([2, 2, 2], device),
        gain: tensor([4], device),
        fixed: tensor([3, 2], device),
    }
}

fn optimized(device: &Device) -> Optimized<Model> {
    Optimized::new(model(device), fields(), |_| SplatAdam::new().into()).unwrap()
}

fn values<const D: usize>(param: &Param<Tensor<D>>) -> Vec<f32> {
    param.val().into_data().try_into_vec().unwrap()
}

fn step(model: &mut Optimized<Model>, how: FieldStep) {
    let inner = model.model();
    let loss = inner.inner.means.val().square().sum()
        + inner.inner.heat.val().sum()
        + inner.detail.val().sum()
        + inner.gain.val().sum()
        + inner.fixed.val().sum();
    let gradients = model.gradients(&mut loss.backward());
    assert_eq!(gradients.len(), 4, "what is no field has none");
    model.step(gradients, |field| (field.rate, how)).unwrap();
}

#[test]
fn an_edit_touches_its_row_set_and_nothing_else() {
    let device = Device::flex().autodiff();
    let mut optimized = optimized(&device);
    step(&mut optimized, FieldStep::Step(1.0));
    let before = optimized.model().clone();
    let id = before.inner.means.id;
    let mut edit = RowEdit::default();
    edit.push(2, Moments::Keep);
    let new = edit.push(0, Moments::Restart);
    edit.offset(new, "means", &[10.0, 20.0]);
    edit.set(new, "heat", &[-7.0]);
    optimized.edit_rows(&edit).unwrap();

    let after = optimized.model();
    let means = values(&before.inner.means);
    let expected = [means[4], means[5], means[0] + 10.0, means[1] + 20.0];
    assert_eq!(values(&after.inner.means), expected);
    assert_eq!(
        values(&after.inner.heat),
        [values(&before.inner.heat)[2], -7.0]
    );
    assert_eq!(values(&after.detail), values(&before.detail));
    assert_eq!(values(&after.fixed), values(&before.fixed));
    assert_eq!(after.inner.means.id, id);
    assert!(after.inner.means.val().is_require_grad());
    let saved = optimized.save().unwrap();
    let moment = saved.tensors["means.moment_1"].try_to_vec::<f32>().unwrap();
    assert!(moment[0] != 0.0 && moment[2..] == [0.0, 0.0], "{moment:?}");

    // The other set and its moments, with rows of another shape.
    let mut edit = RowEdit::of_row_set(1);
    edit.push(1, Moments::Keep);
    optimized.edit_rows(&edit).unwrap();
    assert_eq!(optimized.model().detail.val().dims(), [1, 2, 2]);
    step(&mut optimized, FieldStep::Step(1.0));
}

#[test]
fn edits_that_do_not_fit_are_refused_before_anything_changes() {
    let device = Device::flex().autodiff();
    let mut optimized = optimized(&device);
    let refused = |optimized: &mut Optimized<Model>, edit: &RowEdit| {
        let message = optimized.edit_rows(edit).unwrap_err().to_string();
        assert_eq!(values(&optimized.model().inner.heat), [0.0, 1.0, 2.0]);
        message
    };
    let mut edit = RowEdit::default();
    edit.push(3, Moments::Keep);
    assert!(refused(&mut optimized, &edit).contains("row 3 of `means`"));
    let mut edit = RowEdit::identity(3);
    edit.offset(0, "detail", &[0.0; 4]);
    assert!(refused(&mut optimized, &edit).contains("`detail`"));
    let mut edit = RowEdit::identity(3);
    edit.set(1, "means", &[0.0; 3]);
    assert!(refused(&mut optimized, &edit).contains("3 values of `means`, which has 2 a row"));
    assert!(
        optimized
            .read(["heat", "cold"])
            .unwrap_err()
            .to_string()
            .contains("`cold`")
    );
}

#[test]
fn fields_that_the_model_does_not_have_are_named() {
    let device = Device::flex().autodiff();
    let refused = |change: &dyn Fn(&mut Vec<Field>)| {
        let mut fields = fields();
        change(&mut fields);
        let built = Optimized::new(model(&device), fields, |_| SplatAdam::new().into());
        built.map(drop).unwrap_err().to_string()
    };
    assert!(
        refused(&|fields| fields[0].path = "means".into()).contains("no float parameter `means`")
    );
    assert!(refused(&|fields| fields[1].name = "means".into()).contains("one name"));
    assert!(refused(&|fields| fields[2].row_set = Some(0)).contains("2 rows"));
    assert!(refused(&|fields| fields[3].name = "a.b".into()).contains("dot"));
}

/// Two accumulated gradients and a step equal one step along the sum of three gradients.
#[test]
fn gradients_that_wait_are_added_up() {
    let device = Device::flex().autodiff();
    let (mut waiting, mut other) = (optimized(&device), optimized(&device));
    step(&mut waiting, FieldStep::Accumulate);
    step(&mut waiting, FieldStep::Accumulate);
    assert_eq!(values(&waiting.model().gain), [0.0, 1.0, 2.0, 3.0]);
    // The accumulated gradient survives saving and restoring.
    let saved = waiting.save().unwrap();
    let mut restored = optimized(&device);
    restored
        .restore(saved, &device.clone().without_autodiff())
        .unwrap();
    step(&mut restored, FieldStep::Step(1.0));
    step(&mut waiting, FieldStep::Step(1.0));
    assert_eq!(
        values(&restored.model().gain),
        values(&waiting.model().gain)
    );
    let moment = waiting.save().unwrap().tensors["gain.moment_1"]
        .try_to_vec::<f32>()
        .unwrap();
    assert!((moment[0] - 0.3).abs() < 1e-6, "{moment:?}");
    step(&mut other, FieldStep::Skip);
    assert_eq!(values(&other.model().gain), [0.0, 1.0, 2.0, 3.0]);
}

#[test]
fn a_model_is_restored_with_another_number_of_rows() {
    let device = Device::flex().autodiff();
    let mut first = optimized(&device);
    step(&mut first, FieldStep::Step(1.0));
    let mut edit = RowEdit::identity(3);
    edit.push(1, Moments::Restart);
    first.edit_rows(&edit).unwrap();
    let saved = first.save().unwrap();
    let mut second = optimized(&device);
    let inner = device.clone().without_autodiff();
    second.restore(saved.clone(), &inner).unwrap();
    assert_eq!(
        values(&second.model().inner.means),
        values(&first.model().inner.means)
    );
    for model in [&mut first, &mut second] {
        step(model, FieldStep::Step(1.0));
    }
    assert_eq!(
        values(&second.model().inner.means),
        values(&first.model().inner.means)
    );
    assert_eq!(
        values(&second.model().detail),
        values(&first.model().detail)
    );

    let mut bad = saved;
    let rows = TensorData::new(vec![0.0f32; 3], [3, 1]);
    bad.tensors.insert("heat".into(), rows);
    let message = optimized(&device).restore(bad, &inner).unwrap_err();
    assert!(
        message.contains("`heat` has 3 rows beside others of 4"),
        "{message}"
    );
}

#[test]
fn all_of_a_module_rides_along() {
    let device = Device::flex().autodiff();
    let module = Optimized::of_module(model(&device).inner, 0.1, |_| SplatAdam::new().into());
    let module = module.unwrap();
    let names: Vec<&str> = module
        .fields()
        .iter()
        .map(|field| field.name.as_str())
        .collect();
    assert_eq!(names, ["means", "heat"]);
    assert!(module.fields().iter().all(|field| field.row_set.is_none()));
}

#[test]
fn values_and_gradients_of_another_shape_are_refused() {
    let device = Device::flex().autodiff();
    let mut optimized = optimized(&device);
    let inner = device.clone().without_autodiff();
    let wrong = Tensor::<2>::ones([3, 3], &inner);
    let gradients = [("means".to_owned(), wrong.clone())].into();
    let message = optimized.step(gradients, |field| (field.rate, FieldStep::Step(1.0)));
    assert!(
        message
            .unwrap_err()
            .to_string()
            .contains("`means` has shape [3, 3]")
    );
    let message = optimized.update("gain", |_| wrong.clone()).unwrap_err();
    assert!(message.to_string().contains("`gain` has shape [3, 3]"));
    let message = optimized.update("cold", |value| value).unwrap_err();
    assert!(message.to_string().contains("no field `cold`"));
    optimized.update("gain", |value| value * 2.0).unwrap();
    assert_eq!(values(&optimized.model().gain), [0.0, 2.0, 4.0, 6.0]);
}

/// The width of every change is checked individually, not only their sum.
#[test]
fn changes_of_another_width_are_named_by_row() {
    let device = Device::flex().autodiff();
    let mut optimized = optimized(&device);
    let refused = |optimized: &mut Optimized<Model>, change: &dyn Fn(&mut RowEdit)| {
        let mut edit = RowEdit::identity(3);
        change(&mut edit);
        optimized.edit_rows(&edit).unwrap_err().to_string()
    };
    let offsets = |edit: &mut RowEdit| {
        edit.offset(0, "means", &[1.0]);
        edit.offset(2, "means", &[1.0, 2.0, 3.0]);
    };
    assert!(refused(&mut optimized, &offsets).contains("new row 0 changes 1 values of `means`"));
    let sets = |edit: &mut RowEdit| {
        edit.set(1, "means", &[1.0, 2.0, 3.0]);
        edit.set(2, "means", &[1.0]);
    };
    assert!(refused(&mut optimized, &sets).contains("new row 1 changes 3 values"));
    assert!(refused(&mut optimized, &|edit| edit.retain(|_| false)).contains("no Gaussian"));
    let moments = |edit: &mut RowEdit| edit.set_moments(1, Moments::Of(9));
    assert!(refused(&mut optimized, &moments).contains("new row 1 has the moments of row 9"));
    let mut nowhere = RowEdit::of_row_set(7);
    nowhere.push(0, Moments::Keep);
    let message = optimized.edit_rows(&nowhere).unwrap_err().to_string();
    assert!(message.contains("no row set 7"), "{message}");
}

/// Gradients accumulated in the old model do not reach the restored one.
#[test]
fn waiting_gradients_are_those_of_the_restored_state() {
    let device = Device::flex().autodiff();
    let inner = device.clone().without_autodiff();
    let saved = optimized(&device).save().unwrap();
    let mut waiting = optimized(&device);
    step(&mut waiting, FieldStep::Accumulate);
    waiting.restore(saved, &inner).unwrap();
    step(&mut waiting, FieldStep::Step(1.0));
    let mut fresh = optimized(&device);
    step(&mut fresh, FieldStep::Step(1.0));
    let moments = |model: &Optimized<Model>| {
        model.save().unwrap().tensors["means.moment_1"]
            .try_to_vec::<f32>()
            .unwrap()
    };
    assert_eq!(moments(&waiting), moments(&fresh));
}

/// Parameters that are not fields are part of the state too.
#[test]
fn parameters_that_are_no_fields_are_saved() {
    let device = Device::flex().autodiff();
    let inner = device.clone().without_autodiff();
    let mut first = model(&device);
    first.fixed = first.fixed.map(|value| value * 3.0);
    let first = Optimized::new(first, fields(), |_| SplatAdam::new().into()).unwrap();
    let mut second = optimized(&device);
    second.restore(first.save().unwrap(), &inner).unwrap();
    assert_eq!(values(&second.model().fixed), values(&first.model().fixed));
}

/// A parameter that autodiff does not track would learn nothing.
#[test]
fn a_module_that_autodiff_does_not_track_is_refused() {
    let device = Device::flex();
    let built = Optimized::of_module(model(&device), 0.1, |_| SplatAdam::new().into());
    let message = built.map(drop).unwrap_err().to_string();
    assert!(message.contains("autodiff does not track"), "{message}");
}
