//! A step of Adam on seen rows equals a step on all rows, bit for bit.

use cubecl::client::Client;
use splat_core::{AdamRows, AdamStep};
use splat_kernels::Buffer;
use splat_kernels::adam::adam;

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
