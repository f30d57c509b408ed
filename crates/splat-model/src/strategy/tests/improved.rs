//! Improved-GS and GNS against a PyTorch script (`tests/fixtures/improved.py`).

use super::*;
use crate::strategy::improved::{Refining, edge_map, plan, pressure, relative_scores};

/// The plan of a file, with a change to what it goes by.
fn planned(file: &Reference, splats: &Splats, change: impl Fn(&mut Refining)) -> RowEdit {
    let (sums, counts) = (
        file.values("statistics.grad2d"),
        file.values("statistics.count"),
    );
    let gradients: Vec<f64> = (sums.iter().zip(counts))
        .map(|(sum, count)| sum / count.max(1.0))
        .collect();
    let share = match file.flag("recovers") {
        true => file.number("recovery_prune_share"),
        false => 0.0,
    };
    let mut refining = Refining {
        gradients: &gradients,
        scores: file.values("statistics.score"),
        threshold: file.number("grow_gradient"),
        budget: file.number("budget") as usize,
        unrecovered: (share * gradients.len() as f64) as usize,
        prune_opacity: file.number("prune_opacity"),
    };
    change(&mut refining);
    let draws = file.values("draws.uniform");
    plan(splats, &refining, |row| draws[row]).0
}

fn improved_agrees(name: &str) {
    let file = Reference::read(&format!("strategies/{name}"));
    let sources = file.indices("after.source").into_iter();
    let halves = file.values("after.half").iter().map(|half| *half as i32);
    let theirs: Vec<(usize, i32)> = sources.zip(halves).collect();
    for setup in setups() {
        let mut model = before(&file, &setup);
        let splats = Splats::read(&model).unwrap();
        let edit = planned(&file, &splats, |_| ());
        let order = order_of(name, &kinds(&edit), &theirs);
        model.edit_rows(&edit).unwrap();
        compare(&file, &setup, &mut model, &order);
    }
}

#[test]
fn improved_gs_agrees_with_pytorch() {
    for name in [
        "improved",
        "improved_budget",
        "improved_recovery",
        "improved_last",
    ] {
        improved_agrees(name);
    }
}

/// Each of the things that a refinement goes by is told apart.
#[test]
fn a_wrong_refinement_by_improved_gs_is_found() {
    let file = Reference::read("strategies/improved_recovery");
    let model = before(&file, &setups()[0]);
    let splats = Splats::read(&model).unwrap();
    let right = kinds(&planned(&file, &splats, |_| ()));
    let wrong = |change: &dyn Fn(&mut Refining)| kinds(&planned(&file, &splats, change));
    assert_ne!(right, wrong(&|by| by.unrecovered = 0));
    assert_ne!(right, wrong(&|by| by.budget += 1));
    assert_ne!(right, wrong(&|by| by.scores = by.gradients));
    assert_ne!(right, wrong(&|by| by.prune_opacity = 0.0));
}

#[test]
fn edges_and_scores_agree_with_pytorch() {
    let file = Reference::read("strategies/improved_scores");
    for setup in setups() {
        let shape: [usize; 4] = file.shape("photo").try_into().unwrap();
        let photo = TensorData::new(file.values("photo").to_vec(), shape);
        let photo = Tensor::from_data(photo, (&setup.device, setup.dtype));
        let found = edge_map(photo).into_data().convert::<f64>();
        let error = relative_error(&found.try_into_vec().unwrap(), file.values("edges"));
        assert!(error <= setup.gate, "{:?}: {error:e}", setup.dtype);
    }
    let views: Vec<Vec<f64>> = (file.values("seen").chunks(20).map(<[f64]>::to_vec)).collect();
    let error = relative_error(&relative_scores(&views), file.values("scores"));
    assert!(error <= 1e-12, "{error:e}");
}

/// The pressure of selection, and its gradient by the logits.
#[test]
fn the_pressure_of_selection_agrees_with_pytorch() {
    for (name, early) in [("gns_pressure_early", true), ("gns_pressure_late", false)] {
        let file = Reference::read(&format!("strategies/{name}"));
        let weight = file.number("weight");
        for setup in setups() {
            let device = setup.device.clone().autodiff();
            let logits = file.values("opacity_logits").to_vec();
            let logits = TensorData::new(logits, [file.values("opacity_logits").len()]);
            let logits = Tensor::<1>::from_data(logits, (&device, setup.dtype)).require_grad();
            let loss = pressure(logits.clone(), weight, early);
            let mut gradients = loss.backward();
            let gradient = logits.grad_remove(&mut gradients).unwrap();
            for (what, ours) in [
                ("pressure", loss.inner()),
                ("grad.opacity_logits", gradient),
            ] {
                let ours = ours.into_data().convert::<f64>().try_into_vec().unwrap();
                let error = relative_error(&ours, file.values(what));
                let dtype = setup.dtype;
                assert!(
                    error <= setup.gate,
                    "{name}: {what} in {dtype:?} is off by {error:e}"
                );
            }
        }
    }
}
