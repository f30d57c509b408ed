//! What a refinement decides, from plain values; steps of the optimiser; settings.

use super::*;
use crate::Gaussians;
use crate::opacity::logit;
use crate::strategy::RunSchedule;

pub(super) fn at(steps: usize, step: usize) -> StepInfo {
    let run = RunSchedule {
        steps,
        scene_scale: splat_data::SceneScale::new(1.0).unwrap(),
        seed: 1,
    };
    StepInfo { step, run }
}

/// So many Gaussians of these opacities in turn.
fn splats(count: usize, opacities: &[f64]) -> Splats {
    let opacities = opacities.iter().cycle().take(count);
    Splats {
        means: vec![[0.0; 3]; count],
        log_scales: vec![[0.0, -1.0, -2.0]; count],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: opacities.map(|opacity| logit(*opacity)).collect(),
    }
}

const GRADIENTS: [f64; 100] = [4e-4; 100];

/// Of a hundred that may all be split.
fn refining(budget: usize) -> Refining<'static> {
    Refining {
        gradients: &GRADIENTS,
        scores: &[1.0; 100],
        threshold: 3e-4,
        budget,
        unrecovered: 0,
        prune_opacity: 0.005,
    }
}

fn planned(splats: &Splats, refining: &Refining) -> (RowEdit, Refinement) {
    let at = at(30_000, 600);
    plan(splats, refining, |row| draw::uniform(&at, row as u64))
}

#[test]
fn as_many_are_split_as_the_budget_leaves_room_for() {
    for (budget, split) in [(0, 0), (100, 0), (101, 1), (130, 30), (900, 100)] {
        let (edit, report) = planned(&splats(100, &[0.5]), &refining(budget));
        assert_eq!((report.split, report.pruned), (split, 0), "{budget}");
        assert_eq!(edit.len(), 100 + split);
        let moments = edit.moments();
        let new = moments.iter().filter(|row| **row == Moments::Restart);
        assert_eq!(new.count(), 2 * split);
    }
}

#[test]
fn what_has_not_recovered_makes_room_and_is_not_split() {
    let refining = Refining {
        unrecovered: 20,
        ..refining(110)
    };
    let opacities: Vec<f64> = (0..100).map(|row| 0.1 + 0.005 * row as f64).collect();
    let (edit, report) = planned(&splats(100, &opacities), &refining);
    assert_eq!((report.split, report.pruned), (30, 20));
    assert_eq!(edit.len(), 110);
    assert!(edit.sources().iter().all(|source| *source >= 20));
}

#[test]
fn faint_ones_and_faint_halves_are_pruned_unless_all_are() {
    // Three fifths of 0.008 are less than 0.005.
    let (edit, report) = planned(&splats(100, &[0.5, 0.004, 0.008, 0.9]), &refining(900));
    assert_eq!((report.split, report.pruned), (100, 100));
    assert!(
        edit.sources()
            .iter()
            .all(|source| matches!(source % 4, 0 | 3))
    );
    let (edit, report) = planned(&splats(100, &[0.004]), &refining(900));
    assert_eq!((edit.len(), report), (100, Refinement::default()));
}

#[test]
fn a_large_score_is_split_more_often() {
    let scores: Vec<f64> = (0..100)
        .map(|row| if row < 50 { 9.0 } else { 1.0 })
        .collect();
    let refining = Refining {
        scores: &scores,
        ..refining(110)
    };
    let mut of_large = 0;
    for step in 0..100 {
        let at = at(30_000, step);
        let uniform = |row: usize| draw::uniform(&at, row as u64);
        let (edit, _) = plan(&splats(100, &[0.5]), &refining, uniform);
        let new = edit.sources().into_iter().zip(edit.moments());
        of_large += new
            .filter(|(source, moments)| *source < 50 && *moments == Moments::Restart)
            .count();
    }
    // Of 2,000 halves nine tenths, a few less as the large run out: 8.9 of 10 in expectation.
    assert!((1_700..1_860).contains(&of_large), "{of_large}");
}

fn step_of(strategy: &ImprovedGs, at: StepInfo, field: &str) -> FieldStep {
    Strategy::<Gaussians>::field_step(strategy, &at, &Field::rows(field, 0.1))
}

#[test]
fn the_optimiser_steps_for_many_views_late_in_a_long_run() {
    let strategy = ImprovedGs::new(ImprovedGsSettings::new());
    let updates = |of: usize, from: usize, to: usize| {
        let steps = (from..to).map(|step| step_of(&strategy, at(of, step), "means"));
        steps.filter(|step| *step == FieldStep::Step(1.0)).count()
    };
    assert_eq!(updates(30_000, 0, 15_000), 15_000);
    assert_eq!(updates(30_000, 15_000, 22_500), 1_500);
    assert_eq!(updates(30_000, 22_500, 30_000), 375);
    assert_eq!(
        step_of(&strategy, at(30_000, 29_999), "means"),
        FieldStep::Step(1.0)
    );
    // As many in a run of a quarter, and all in a short one.
    assert_eq!(updates(7_500, 5_625, 7_500), 375);
    assert_eq!(updates(1_500, 0, 1_500), 1_500);
}

#[test]
fn opacities_are_learned_faster_during_selection() {
    let selection = SelectionSettings::new().with_final_gaussians(10);
    let mut strategy = ImprovedGs::new(ImprovedGsSettings::new().with_selection(selection));
    let step = at(30_000, 16_000);
    assert_eq!(step_of(&strategy, step, OPACITIES), FieldStep::Step(1.0));
    let (times, _) = strategy.selecting(&step).unwrap();
    strategy.selection.control(&times, 15_000, 0.5);
    assert_eq!(step_of(&strategy, step, OPACITIES), FieldStep::Step(4.0));
    assert_eq!(step_of(&strategy, step, "means"), FieldStep::Step(1.0));
}

#[test]
fn settings_out_of_range_are_named() {
    let new = ImprovedGsSettings::new;
    assert_eq!(new().validate(), Ok(()));
    let selection = |change: &dyn Fn(&mut SelectionSettings)| {
        let mut selection = SelectionSettings::new().with_final_gaussians(100);
        change(&mut selection);
        new().with_max_gaussians(300).with_selection(selection)
    };
    assert_eq!(selection(&|_| ()).validate(), Ok(()));
    for (name, settings) in [
        ("every", new().with_every(0)),
        ("reset_every", new().with_reset_every(0)),
        ("edge_views", new().with_edge_views(0)),
        ("max_gaussians", new().with_max_gaussians(0)),
        ("grow_gradient", new().with_grow_gradient(f64::NAN)),
        ("fill_gradient", new().with_fill_gradient(-1.0)),
        ("early_prune_opacity", new().with_early_prune_opacity(1.0)),
        ("recovery_prune_share", new().with_recovery_prune_share(1.0)),
        ("reset_opacity", new().with_reset_opacity(0.005)),
        (
            "selection.final_gaussians",
            selection(&|settings| settings.final_gaussians = Some(0)),
        ),
        (
            "selection.final_gaussians",
            selection(&|settings| settings.final_gaussians = Some(300)),
        ),
        (
            "selection.stop",
            selection(&|settings| settings.stop = 15_000),
        ),
        (
            "selection.overgrowth",
            selection(&|settings| settings.overgrowth = 0.9),
        ),
        (
            "selection.opacity_rate",
            selection(&|settings| settings.opacity_rate = f64::INFINITY),
        ),
        (
            "selection.weight",
            selection(&|settings| settings.weight = -1.0),
        ),
        (
            "selection.prune_opacity",
            selection(&|settings| settings.prune_opacity = f64::NAN),
        ),
    ] {
        let message = settings.validate().unwrap_err();
        assert!(message.contains(&format!("`{name}`")), "{message}");
        assert!(!message.contains('\n'));
    }
}
