//! A step of Adam on seen rows, or on rows in groups, equals a step on all rows, bit for bit; and
//! catching up does what steps without a gradient do.

use cubecl::client::Client;
use splat_core::{AdamGap, AdamRows, AdamStep, RowGroups};
use splat_kernels::Buffer;
use splat_kernels::adam::{adam, adam_catch_up, adam_rows};

use crate::device::{client, download, rng, uniform, upload};

const STEP: AdamStep = AdamStep {
    beta_1: 0.9,
    beta_2: 0.999,
    rate: 1e-2,
    epsilon: 1e-15,
    rows: AdamRows::All,
};

/// Parameter, gradient and both moments.
struct Values {
    param: Vec<f32>,
    grad: Vec<f32>,
    moments: [Vec<f32>; 2],
    width: usize,
}

impl Values {
    /// Rows of `width`; every third has no gradient, and the first few have special values.
    fn new(rows: usize, width: usize) -> Self {
        let mut rng = rng(36);
        let len = rows * width;
        let mut grad = uniform(&mut rng, len, -1.0, 1.0);
        for row in grad.chunks_mut(width).step_by(3) {
            row.fill(0.0);
        }
        let odd = [
            f32::NAN,
            f32::INFINITY,
            f32::NEG_INFINITY,
            -0.0,
            // The smallest non-zero number, and one whose square is not finite.
            f32::from_bits(1),
            -1e30,
            1.0,
        ];
        // In the last position of a row, so that rows are read to their ends.
        for (row, value) in grad.chunks_mut(width).zip(odd) {
            row.fill(0.0);
            row[width - 1] = value;
        }
        Self {
            param: uniform(&mut rng, len, -1.0, 1.0),
            grad,
            moments: [
                uniform(&mut rng, len, -1.0, 1.0),
                uniform(&mut rng, len, 0.0, 1.0),
            ],
            width,
        }
    }

    fn before(&self) -> [&[f32]; 3] {
        [&self.param, &self.moments[0], &self.moments[1]]
    }

    /// Results of a step, as bits. `held` keeps inputs from being overwritten; they must stay
    /// unchanged.
    fn after(&self, client: &Client, rows: AdamRows, held: [bool; 3]) -> [Vec<u32>; 3] {
        let step = AdamStep { rows, ..STEP };
        let before = self.before().map(|values| upload(client, values));
        let kept: Vec<Option<Buffer>> = before
            .iter()
            .zip(held)
            .map(|(buffer, held)| held.then(|| buffer.clone()))
            .collect();
        let [param, moment_1, moment_2] = before;
        let grad = upload(client, &self.grad);
        let after = adam(
            client,
            param,
            &grad,
            [moment_1, moment_2],
            &step,
            self.width,
        );
        for (kept, before) in kept.iter().zip(self.before()) {
            if let Some(kept) = kept {
                assert_eq!(download(client, kept), before, "{held:?}");
            }
        }
        after.map(|buffer| bits(&download(client, &buffer)))
    }
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}

#[test]
fn seen_rows_are_stepped_as_all_are_and_the_others_keep_every_bit() {
    let Some(client) = client() else { return };
    let nobody = [false; 3];
    // Less than a workgroup, many workgroups, and rows that a workgroup's units do not divide or do
    // not cover.
    for (rows, width) in [
        (7, 1),
        (1000, 1),
        (700, 3),
        (701, 4),
        (300, 45),
        (9, 256),
        (11, 700),
    ] {
        let values = Values::new(rows, width);
        let all = values.after(&client, AdamRows::All, nobody);
        let before = values.before().map(bits);
        let mut stepped = [0; 2];
        let seen = values.after(&client, AdamRows::Seen, nobody);
        for (row, grad) in values.grad.chunks(width).enumerate() {
            let is_seen = grad.iter().any(|g| g.abs() > 0.0);
            stepped[usize::from(is_seen)] += 1;
            let expected = if is_seen { &all } else { &before };
            let at = row * width..(row + 1) * width;
            for (found, expected) in seen.iter().zip(expected) {
                let case = format!("{rows} x {width}, row {row}, gradient {grad:?}");
                assert_eq!(found[at.clone()], expected[at.clone()], "{case}");
            }
        }
        assert!(stepped[0] >= 2 && stepped[1] >= 4, "{stepped:?}");
        assert_ne!(all[0], before[0]);
    }
}

#[test]
fn what_something_else_holds_is_copied_and_the_result_is_the_same() {
    let Some(client) = client() else { return };
    let width = 45;
    let values = Values::new(130, width);
    for rows in [AdamRows::All, AdamRows::Seen] {
        let alone = values.after(&client, rows, [false; 3]);
        for held in [
            [true, true, true],
            [true, false, false],
            [false, true, false],
            [false, false, true],
        ] {
            let found = values.after(&client, rows, held);
            assert_eq!(found, alone, "{rows:?}, held {held:?}");
        }
    }
}

/// Groups of rows that a group's size divides or not, with the last one or without.
fn some_groups() -> [RowGroups; 4] {
    [
        RowGroups::new(4, 130, vec![0, 3, 4, 32]),
        RowGroups::new(256, 130, vec![0]),
        RowGroups::new(1, 130, vec![7, 129]),
        RowGroups::new(13, 130, vec![]),
    ]
    .map(|rows| rows.expect("in order"))
}

/// The rows of a buffer that are chosen.
fn chosen(values: &[f32], rows: &RowGroups, width: usize) -> Vec<f32> {
    let row = |row: usize| values[row * width..(row + 1) * width].to_vec();
    rows.indices().flat_map(row).collect()
}

#[test]
fn rows_in_groups_are_stepped_as_all_are_and_the_others_keep_every_bit() {
    let Some(client) = client() else { return };
    for width in [1, 3, 45] {
        let values = Values::new(130, width);
        for (steps, groups) in [AdamRows::All, AdamRows::Seen]
            .into_iter()
            .flat_map(|steps| some_groups().map(|groups| (steps, groups)))
        {
            let all = values.after(&client, steps, [false; 3]);
            let before = values.before().map(bits);
            let grad = upload(&client, &chosen(&values.grad, &groups, width));
            for held in [false, true] {
                let buffers = values.before().map(|values| upload(&client, values));
                let kept = held.then(|| buffers.clone());
                let [param, moment_1, moment_2] = buffers;
                let step = AdamStep {
                    rows: steps,
                    ..STEP
                };
                let moments = [moment_1, moment_2];
                let after = adam_rows(&client, param, &grad, moments, &step, width, &groups);
                for (kept, before) in kept.iter().flatten().zip(values.before()) {
                    assert_eq!(download(&client, kept), before);
                }
                let steps = |row: usize| groups.indices().any(|chosen| chosen == row);
                for (found, (all, before)) in after.iter().zip(all.iter().zip(&before)) {
                    let found = bits(&download(&client, found));
                    for row in 0..130 {
                        let expected = if steps(row) { all } else { before };
                        let at = row * width..(row + 1) * width;
                        assert_eq!(found[at.clone()], expected[at], "{groups:?}, row {row}");
                    }
                }
            }
        }
    }
}

#[test]
fn catching_up_does_to_chosen_rows_what_the_gap_says() {
    let Some(client) = client() else { return };
    let width = 3;
    let values = Values::new(130, width);
    for groups in some_groups() {
        let gaps: Vec<AdamGap> = (groups.chosen().iter())
            .map(|group| AdamGap {
                keep_1: 0.9f64.powi(*group as i32 % 7),
                keep_2: 0.999f64.powi(*group as i32 % 7),
                step: 0.01 * f64::from(*group % 7),
                epsilon: 1e-8,
            })
            .collect();
        let [param, moment_1, moment_2] = values.before().map(|values| upload(&client, values));
        let moments = [moment_1, moment_2];
        let after = adam_catch_up(&client, param, moments, width, &groups, &gaps);
        let after = after.map(|buffer| download(&client, &buffer));
        let [param, moment_1, moment_2] = values.before();
        let mut expected = values.before().map(<[f32]>::to_vec);
        for (group, gap) in groups.chosen().iter().zip(&gaps) {
            let rows = groups.range(*group);
            for i in rows.start * width..rows.end * width {
                let [p, m, v] = [param[i], moment_1[i], moment_2[i]].map(f64::from);
                expected[0][i] = (p - m / (v.sqrt() + gap.epsilon) * gap.step) as f32;
                expected[1][i] = (m * gap.keep_1) as f32;
                expected[2][i] = (v * gap.keep_2) as f32;
            }
        }
        for (found, expected) in after.iter().zip(&expected) {
            for (found, expected) in found.iter().zip(expected) {
                let error = (found - expected).abs();
                assert!(
                    error <= 2e-6 * expected.abs().max(1.0),
                    "{found} {expected}"
                );
            }
        }
    }
}
