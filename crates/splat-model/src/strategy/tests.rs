//! One refinement of each strategy against a PyTorch script (`tests/fixtures/strategies.py`):
//! parameters and moments after it, from draws that are given.

mod improved;

use std::collections::BTreeMap;

use burn::module::Param;
use burn::tensor::{DType, Device, Tensor, TensorData};
use splat_data::SceneScale;
use splat_ops::AdamRows;
use splat_test_support::{Reference, relative_error};

use super::adc::{Adc, AdcSettings};
use super::mcmc::{Mcmc, McmcSettings, Rows};
use super::splats::Splats;
use super::{RunSchedule, StepInfo};
use crate::optimizer::StateRecord;
use crate::rows::{Moments, RowEdit};
use crate::{Gaussians, LearningRates, Optimized};

const FIELDS: [(&str, usize); 6] = [
    ("means", 3),
    ("log_scales", 3),
    ("quats", 4),
    ("opacity_logits", 1),
    ("sh0", 3),
    ("sh_rest", 45),
];

/// A device, the precision of the parameters there, and the largest relative error that passes.
struct Setup {
    device: Device,
    dtype: DType,
    gate: f64,
}

/// All that there are: moments are kept in single precision everywhere.
fn setups() -> Vec<Setup> {
    let mut setups = vec![
        Setup {
            device: Device::flex(),
            dtype: DType::F64,
            gate: 1e-9,
        },
        Setup {
            device: Device::flex(),
            dtype: DType::F32,
            gate: 1e-6,
        },
    ];
    #[cfg(feature = "wgpu")]
    if let Some(device) = crate::test_adapter::wgpu() {
        setups.push(Setup {
            device,
            dtype: DType::F32,
            gate: 1e-6,
        });
    }
    setups
}

fn at(file: &Reference, scene: f64) -> StepInfo {
    let run = RunSchedule {
        steps: 30_000,
        scene_scale: SceneScale::new(scene).unwrap(),
        seed: 0,
    };
    StepInfo {
        step: file.number("step") as usize,
        run,
    }
}

/// The Gaussians of a file before the refinement, with their moments.
fn before(file: &Reference, setup: &Setup) -> Optimized<Gaussians> {
    let device = setup.device.clone().autodiff();
    let n = file.shape("before.means")[0];
    let options = (&device, setup.dtype);
    let data = |name: &str| file.values(&format!("before.{name}")).to_vec();
    let two = |name: &str, width: usize| {
        let values = TensorData::new(data(name), [n, width]);
        Param::from_tensor(Tensor::<2>::from_data(values, options))
    };
    let three = |name: &str, rest: usize| {
        let values = TensorData::new(data(name), [n, rest, 3]);
        Param::from_tensor(Tensor::<3>::from_data(values, options))
    };
    let logits = TensorData::new(data("opacity_logits"), [n]);
    let model = Gaussians {
        origin: [0.0; 3],
        means: two("means", 3),
        log_scales: two("log_scales", 3),
        quats: two("quats", 4),
        opacity_logits: Param::from_tensor(Tensor::<1>::from_data(logits, options)),
        sh0: three("sh0", 1),
        sh_rest: Some(three("sh_rest", 15)),
        sh_starts: None,
    };
    let scale = SceneScale::new(1.0).unwrap();
    let rates = LearningRates::default();
    let mut model = Optimized::with_adam(model, &rates, AdamRows::All, scale).unwrap();
    // A step gives every optimiser a state, whose moments are then replaced.
    let gradients = model.fields().to_vec().into_iter().map(|field| {
        let value = model.field(&field.name).unwrap();
        (field.name, value.zeros_like())
    });
    let gradients = gradients.collect();
    model
        .step(gradients, |_| (0.0, crate::FieldStep::Step(1.0)))
        .unwrap();
    for (name, width) in FIELDS {
        let optimizer = model.optimizer(name);
        let mut state: StateRecord = optimizer.save();
        for moment in ["moment_1", "moment_2"] {
            let values = data(&format!("{moment}.{name}"));
            let values = TensorData::new(values, [n, width]);
            let found = state
                .tensors
                .insert(moment.to_owned(), values.convert::<f32>());
            assert!(found.is_some(), "an optimiser keeps no `{moment}`");
        }
        optimizer.restore(state, [n, width], &setup.device).unwrap();
    }
    model
}

/// Parameters and moments, by name: rows of numbers.
fn state(model: &mut Optimized<Gaussians>) -> BTreeMap<String, Vec<Vec<f64>>> {
    let mut state = BTreeMap::new();
    let rows = |values: Vec<f64>, width: usize| values.chunks(width).map(<[f64]>::to_vec).collect();
    for (name, width) in FIELDS {
        let [values] = model.read_f64([name]).unwrap();
        state.insert(name.to_owned(), rows(values, width));
        let saved = model.optimizer(name).save();
        for moment in ["moment_1", "moment_2"] {
            let values = saved.tensors[moment].clone().convert::<f64>();
            let values = values.try_into_vec().unwrap();
            state.insert(format!("{moment}.{name}"), rows(values, width));
        }
    }
    state
}

/// Compares what the model is now with the file, given which row of the file each of ours is.
fn compare(file: &Reference, setup: &Setup, model: &mut Optimized<Gaussians>, order: &[usize]) {
    for (name, ours) in state(model) {
        let expected = file.values(&format!("after.{name}"));
        let width = ours.first().map_or(1, Vec::len);
        let expected: Vec<f64> = order
            .iter()
            .flat_map(|row| expected[row * width..(row + 1) * width].to_vec())
            .collect();
        let error = relative_error(&ours.concat(), &expected);
        assert!(
            error <= setup.gate,
            "{:?} on {:?} in {:?}: `{name}` is off by {error:e}",
            file.file,
            setup.device,
            setup.dtype
        );
    }
}

/// The source of each new row, and its kind as the files number them: -1 for a row that stays, -2
/// for a clone, 0 and 1 for the halves of a split.
fn kinds(edit: &RowEdit) -> Vec<(usize, i32)> {
    let mut halves = BTreeMap::new();
    let kinds = edit.sources().into_iter().zip(edit.moments()).enumerate();
    kinds
        .map(|(row, (source, moments))| {
            let kind = match (moments, edit.offset_of(row, "means")) {
                (Moments::Restart, Some(_)) => {
                    let half = halves.entry(source).or_insert(-1);
                    *half += 1;
                    *half
                }
                (Moments::Restart, None) => -2,
                _ => -1,
            };
            (source as usize, kind)
        })
        .collect()
}

/// One refinement of density control, as the trainer would have it done at this step.
fn adc_agrees(name: &str) {
    let file = Reference::read(&format!("strategies/{name}"));
    let at = at(&file, file.number("scene_scale"));
    let settings = AdcSettings {
        absgrad: file.flag("absgrad"),
        grow_gradient: Some(file.number("grow_grad2d")),
        split_scale: file.number("grow_scale3d"),
        prune_opacity: file.number("prune_opa"),
        prune_scale: file.number("prune_scale3d"),
        revised_opacity: file.flag("revised_opacity"),
        reset_every: file.number("reset_every") as usize,
        prune_scale_start: file.number("reset_every") as usize,
        reset_opacity: 2.0 * file.number("prune_opa"),
        ..AdcSettings::default()
    };
    let (sums, counts) = (
        file.values("statistics.grad2d"),
        file.values("statistics.count"),
    );
    let means: Vec<f64> = (sums.iter().zip(counts))
        .map(|(sum, count)| sum / count.max(1.0))
        .collect();
    let draws = file.values("draws.split");
    let draw = |row: usize, half: u64| {
        let at = (row * 2 + half as usize) * 3;
        [draws[at], draws[at + 1], draws[at + 2]]
    };
    let theirs = file
        .values("after.source")
        .iter()
        .zip(file.values("after.half"));
    let theirs: Vec<(usize, i32)> = theirs
        .map(|(source, half)| (*source as usize, *half as i32))
        .collect();
    for setup in setups() {
        let mut model = before(&file, &setup);
        let splats = Splats::read(&model).unwrap();
        let strategy = Adc::new(settings.clone());
        let (edit, _) = strategy.plan_with(&at, &splats, &means, draw);
        let order = order_of(name, &kinds(&edit), &theirs);
        model.edit_rows(&edit).unwrap();
        if file.flag("reset") {
            model.clamp_opacities(settings.reset_opacity).unwrap();
        }
        compare(&file, &setup, &mut model, &order);
    }
}

/// The place of each of our rows after a refinement among those of a file.
fn order_of(name: &str, ours: &[(usize, i32)], theirs: &[(usize, i32)]) -> Vec<usize> {
    assert_eq!(ours.len(), theirs.len(), "{name}: rows after");
    ours.iter()
        .map(|row| theirs.iter().position(|other| other == row))
        .map(|place| place.unwrap_or_else(|| panic!("{name}: {ours:?} is not {theirs:?}")))
        .collect()
}

#[test]
fn adaptive_density_control_agrees_with_pytorch() {
    for name in [
        "adc",
        "adc_late",
        "adc_revised_opacity",
        "adc_refine_and_reset",
        "adc_reset",
    ] {
        adc_agrees(name);
    }
}

#[test]
fn density_control_by_absolute_gradients_agrees_with_pytorch() {
    adc_agrees("absgrad");
}

/// The stages that a file has draws of, in order.
fn mcmc_agrees(name: &str) {
    let file = Reference::read(&format!("strategies/{name}"));
    let mut at = at(&file, 1.0);
    at.run.seed = file.number("seed") as u64;
    let settings = McmcSettings::new()
        .with_min_opacity(file.number("min_opacity"))
        .with_max_gaussians(file.number("cap_max") as usize)
        .with_noise(file.number("noise_lr"));
    let strategy = Mcmc::new(settings.clone());
    for setup in setups() {
        let mut model = before(&file, &setup);
        let [log_scales, logits] = model.read_f64(["log_scales", "opacity_logits"]).unwrap();
        let mut rows = Rows::new(&logits, log_scales.as_chunks().0);
        if file.has("draws.relocate") {
            let dead = strategy.dead(&rows);
            let chosen = file.indices("draws.relocate");
            assert_eq!(dead.len(), chosen.len(), "{name}: dead rows");
            rows.relocate(&dead, &chosen, settings.min_opacity);
        }
        if file.has("draws.add") {
            let chosen = file.indices("draws.add");
            assert_eq!(strategy.room(rows.len()), chosen.len(), "{name}: new rows");
            rows.add(&chosen, settings.min_opacity);
        }
        let count = rows.len();
        model.edit_rows(&rows.finish()).unwrap();
        if file.has("draws.noise") {
            strategy
                .perturb_at_rate(&at, file.number("lr_means"), &mut model)
                .unwrap();
        }
        compare(&file, &setup, &mut model, &(0..count).collect::<Vec<_>>());
    }
}

#[test]
fn relocation_agrees_with_pytorch() {
    for name in [
        "mcmc_relocate",
        "mcmc_relocate_one_alive",
        "mcmc_add",
        "mcmc_add_capped",
    ] {
        mcmc_agrees(name);
    }
}

/// Fifty-one copies of one Gaussian and more, opaque ones, opacities at the threshold.
#[test]
fn relocation_of_many_and_of_opaque_ones_agrees_with_pytorch() {
    for name in ["mcmc_relocate_51", "mcmc_relocate_60"] {
        mcmc_agrees(name);
    }
}

#[test]
fn noise_and_all_stages_together_agree_with_pytorch() {
    for name in ["mcmc_noise", "mcmc_whole"] {
        mcmc_agrees(name);
    }
}

/// The comparison finds moments that were kept where they should be zero, and a wrong opacity.
#[test]
fn a_wrong_refinement_is_found() {
    let file = Reference::read("strategies/mcmc_relocate");
    let setup = &setups()[0];
    let relocated = |change: &dyn Fn(&mut RowEdit)| {
        let mut model = before(&file, setup);
        let [log_scales, logits] = model.read_f64(["log_scales", "opacity_logits"]).unwrap();
        let mut rows = Rows::new(&logits, log_scales.as_chunks().0);
        let strategy = Mcmc::new(McmcSettings::new());
        let dead = strategy.dead(&rows);
        rows.relocate(&dead, &file.indices("draws.relocate"), 0.005);
        let mut edit = rows.finish();
        change(&mut edit);
        model.edit_rows(&edit).unwrap();
        let order: Vec<usize> = (0..edit.len()).collect();
        let compared = std::panic::AssertUnwindSafe(|| compare(&file, setup, &mut model, &order));
        std::panic::catch_unwind(compared).is_ok()
    };
    let (dead, source) = (0, file.indices("draws.relocate")[0]);
    assert!(relocated(&|_| ()));
    assert!(!relocated(&|edit| edit.set_moments(source, Moments::Keep)));
    assert!(!relocated(&|edit| edit.set_moments(dead, Moments::Restart)));
    assert!(!relocated(&|edit| edit.set(dead, "opacity_logits", &[0.0])));
}
