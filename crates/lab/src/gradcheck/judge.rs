//! Compares gradients with a reference, by parameter group, and judges them.
//!
//! A single number hides too much: a gradient can have the right length and a wrong sign in one
//! field, or be zero altogether. Each group therefore gets its relative L2 error, 1 - cosine,
//! signed bias, worst element and share of zeros. The gate is on the relative L2 error, which
//! bounds the cosine (1 - cos <= rel^2 / 2 to first order) and catches a vanished gradient (rel =
//! 1).

use std::path::PathBuf;

use super::Precision;
use super::fixture::Fixture;
use super::run::Computed;
use super::scene::{Array, Inputs, index_of};

/// Gate on the relative L2 error in double precision.
const GATE_F64: f64 = 1e-9;
/// Gate in single precision for ordinary scenes.
const GATE_F32: f64 = 1e-5;
/// Gate in single precision for scenes marked hard: needles, pancakes, extreme scales and offsets.
const GATE_F32_HARD: f64 = 1e-3;

/// Largest relative L2 error that passes.
pub fn gate(precision: Precision, hard: bool) -> f64 {
    match (precision, hard) {
        (Precision::F64, _) => GATE_F64,
        (Precision::F32, false) => GATE_F32,
        (Precision::F32, true) => GATE_F32_HARD,
    }
}

/// Comparison of one group of gradients with its reference.
#[derive(Debug, Clone, PartialEq)]
pub struct GroupReport {
    /// Name of the group: a tensor of the fixture, or a part of one.
    pub name: &'static str,
    /// Relative L2 error, |g - r| / |r|. If the reference is all zero (`reference_is_zero`), the
    /// effect of g on the loss, relative to the group with the largest effect (see [`compare`]).
    pub rel_l2: f64,
    /// 1 - cos(g, r); 0 if the reference is all zero.
    pub one_minus_cosine: f64,
    /// sum(g - r) / sum |r|; 0 if the reference is all zero.
    pub bias: f64,
    /// Largest |g - r| / (|r| + 1e-6 rms(r)); the largest |g| if the reference is all zero.
    pub worst: f64,
    /// Index of that element in the fixture's tensor; empty for an empty group.
    pub worst_index: Vec<usize>,
    /// Share of exact zeros in our gradient.
    pub zeros: f64,
    /// Share of exact zeros in the reference.
    pub zeros_reference: f64,
    /// True if every element of the reference is zero.
    pub reference_is_zero: bool,
    /// True if the relative L2 error is within the gate.
    pub pass: bool,
}

/// Comparison of one image with its reference.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputReport {
    /// `image`, `alpha` or `depth`.
    pub name: &'static str,
    /// Largest absolute difference.
    pub max_abs: f64,
    /// |ours - reference| / |reference|; |ours| where the reference is all zero.
    pub rel_l2: f64,
    /// True if the relative L2 error is within the gate.
    pub pass: bool,
}

/// Result for one fixture on one device in one precision.
#[derive(Debug, Clone, PartialEq)]
pub struct FileReport {
    /// The fixture.
    pub file: PathBuf,
    /// Description of the case.
    pub case: String,
    /// Precision of the check.
    pub precision: Precision,
    /// True if the fixture is marked hard.
    pub hard: bool,
    /// Largest relative L2 error that passes.
    pub gate: f64,
    /// Groups: means, quats, scales, opacities, sh0, sh_rest, viewmat, intrinsics, background and,
    /// if the fixture has them, distortion and absgrad.
    pub groups: Vec<GroupReport>,
    /// Images: image, alpha and, if the fixture has it, depth.
    pub outputs: Vec<OutputReport>,
    /// Pixels near a threshold. In single precision those are the pixels that rounding of an alpha
    /// or a transmittance may decide differently; they are excluded from the images and from the
    /// loss. In double precision they are the pixels within a relative 1e-6, and count like any
    /// other.
    pub near_threshold: usize,
    /// Total number of pixels.
    pub pixels: usize,
    /// Reasons for failing, besides the gates.
    pub reasons: Vec<String>,
    /// True if every gate holds and there is no other reason to fail.
    pub pass: bool,
}

impl FileReport {
    /// Names of the groups and images beyond the gate.
    pub fn failed(&self) -> Vec<&'static str> {
        let groups = self.groups.iter().filter(|g| !g.pass).map(|g| g.name);
        let outputs = self.outputs.iter().filter(|o| !o.pass).map(|o| o.name);
        groups.chain(outputs).collect()
    }

    /// The largest relative L2 error of any group, with its name.
    pub fn worst_group(&self) -> (&'static str, f64) {
        self.groups
            .iter()
            .map(|g| (g.name, g.rel_l2))
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .unwrap_or(("", 0.0))
    }
}

/// Judges computed images and gradients by the fixture's.
///
/// A group whose reference is all zero (a rotation of spheres, unused bands of spherical harmonics)
/// has no scale of its own. It is judged by its effect on the loss if the parameters moved by their
/// own size: |g| rms(x) over the largest |r| rms(x) of all groups.
pub fn compare(
    fixture: &Fixture,
    computed: &Computed,
    precision: Precision,
    near_threshold: usize,
) -> FileReport {
    let gate = gate(precision, fixture.hard);
    let ours = groups(&computed.gradients);
    let reference = groups(&fixture.gradients);
    let inputs = groups(&fixture.scene.inputs);
    let scale = reference
        .iter()
        .zip(&inputs)
        .map(|(r, x)| norm(&r.array.values) * size(&x.array))
        .fold(0.0, f64::max);
    let mut groups: Vec<_> = ours
        .iter()
        .zip(&reference)
        .zip(&inputs)
        .map(|((g, r), x)| judge_group(g, r, size(&x.array), scale, gate))
        .collect();
    if let (Some(g), Some(r)) = (&computed.absgrad, &fixture.absgrad) {
        let [g, r] = [g, r].map(|array| Group {
            name: "absgrad",
            // Ours has the cameras in front; the fixture may have none.
            array: Array {
                shape: r.shape.clone(),
                values: array.values.clone(),
            },
            offset: vec![0; r.shape.len()],
        });
        // Of a screen mean, in pixels.
        let size = fixture.scene.size;
        let size = f64::from(size.width.max(size.height));
        groups.push(judge_group(&g, &r, size, scale, gate));
    }

    let (g, r) = (&computed.outputs, &fixture.expected);
    let mut outputs = vec![
        judge_output("image", &g.image, &r.image, gate),
        judge_output("alpha", &g.alpha, &r.alpha, gate),
    ];
    if let (Some(g), Some(r)) = (&g.depth, &r.depth) {
        outputs.push(judge_output("depth", g, r, gate));
    }
    let pass = groups.iter().all(|g| g.pass) && outputs.iter().all(|o| o.pass);
    FileReport {
        file: fixture.scene.source.clone(),
        case: fixture.case.clone(),
        precision,
        hard: fixture.hard,
        gate,
        groups,
        outputs,
        near_threshold,
        pixels: r.alpha.values.len(),
        reasons: vec![],
        pass,
    }
}

/// A tensor of the fixture, or some of its bands.
struct Group {
    name: &'static str,
    array: Array,
    /// Offset of each dimension's index within the fixture's tensor.
    offset: Vec<usize>,
}

fn groups(inputs: &Inputs) -> Vec<Group> {
    let whole = |name, array: &Array| Group {
        name,
        array: array.clone(),
        offset: vec![0; array.shape.len()],
    };
    let mut groups = vec![
        whole("means", &inputs.means),
        whole("quats", &inputs.quats),
        whole("scales", &inputs.scales),
        whole("opacities", &inputs.opacities),
        bands("sh0", &inputs.sh_coeffs, 0, 1),
        bands("sh_rest", &inputs.sh_coeffs, 1, inputs.sh_coeffs.shape[1]),
        whole("viewmat", &inputs.viewmat),
        whole("intrinsics", &inputs.intrinsics),
        whole("background", &inputs.background),
    ];
    let distortion = inputs.distortion.as_ref();
    groups.extend(distortion.map(|array| whole("distortion", array)));
    groups
}

/// Coefficients `from..to` of `[N, K, 3]`.
fn bands(name: &'static str, coeffs: &Array, from: usize, to: usize) -> Group {
    let (n, row) = (coeffs.shape[0], 3 * coeffs.shape[1]);
    let values: Vec<f64> = coeffs
        .values
        .chunks_exact(row)
        .flat_map(|gaussian| &gaussian[from * 3..to * 3])
        .copied()
        .collect();
    Group {
        name,
        array: Array {
            shape: vec![n, to - from, 3],
            values,
        },
        offset: vec![0, from, 0],
    }
}

fn judge_group(g: &Group, r: &Group, input_size: f64, scale: f64, gate: f64) -> GroupReport {
    let (ours, reference) = (&g.array.values, &r.array.values);
    let (length, rms) = (norm(reference), r.array.rms());
    let reference_is_zero = length == 0.0;
    let share = |values: &[f64]| {
        values.iter().filter(|v| **v == 0.0).count() as f64 / values.len().max(1) as f64
    };

    let mut report = GroupReport {
        name: g.name,
        rel_l2: 0.0,
        one_minus_cosine: 0.0,
        bias: 0.0,
        worst: 0.0,
        worst_index: vec![],
        zeros: share(ours),
        zeros_reference: share(reference),
        reference_is_zero,
        pass: false,
    };
    let relative = |(g, r): (&f64, &f64)| match reference_is_zero {
        true => g.abs(),
        false => (g - r).abs() / (r.abs() + 1e-6 * rms),
    };
    let worst = ours
        .iter()
        .zip(reference)
        .map(relative)
        .enumerate()
        // NaN compares greater than every number here, so it is found and shown.
        .max_by(|a, b| a.1.total_cmp(&b.1));
    if let Some((at, value)) = worst {
        report.worst = value;
        report.worst_index = index_of(at, &g.array.shape)
            .iter()
            .zip(&g.offset)
            .map(|(i, o)| i + o)
            .collect();
    }
    if reference_is_zero {
        let effect = norm(ours) * input_size;
        report.rel_l2 = if scale > 0.0 { effect / scale } else { effect };
    } else {
        let difference = |g: &f64, r: &f64| g - r;
        let differences: Vec<_> = pairs(ours, reference, difference).collect();
        report.rel_l2 = norm(&differences) / length;
        report.one_minus_cosine = one_minus_cosine(ours, reference);
        report.bias =
            differences.iter().sum::<f64>() / reference.iter().map(|r| r.abs()).sum::<f64>();
    }
    report.pass = report.rel_l2 <= gate; // false for NaN
    report
}

fn judge_output(name: &'static str, ours: &Array, reference: &Array, gate: f64) -> OutputReport {
    let differences: Vec<_> = pairs(&ours.values, &reference.values, |g, r| g - r).collect();
    let rel_l2 = relative_l2(&ours.values, &reference.values);
    OutputReport {
        name,
        max_abs: differences
            .iter()
            .map(|d| d.abs())
            .max_by(f64::total_cmp)
            .unwrap_or(0.0),
        rel_l2,
        pass: rel_l2 <= gate,
    }
}

/// 1 - cos as half the squared distance of the unit vectors, which is exact to the last digits
/// where 1 - dot / (|g| |r|) would be rounding noise. A zero vector is at right angles to
/// everything.
fn one_minus_cosine(g: &[f64], r: &[f64]) -> f64 {
    let (lg, lr) = (norm(g), norm(r));
    if lg == 0.0 || lr == 0.0 {
        return 1.0;
    }
    pairs(g, r, |g, r| (g / lg - r / lr).powi(2)).sum::<f64>() / 2.0
}

/// |ours - reference| / |reference|; |ours| where the reference is all zero.
pub(crate) fn relative_l2(ours: &[f64], reference: &[f64]) -> f64 {
    let differences: Vec<_> = pairs(ours, reference, |g, r| g - r).collect();
    match norm(reference) {
        0.0 => norm(&differences),
        length => norm(&differences) / length,
    }
}

fn pairs<'a>(
    g: &'a [f64],
    r: &'a [f64],
    f: impl Fn(&f64, &f64) -> f64 + 'a,
) -> impl Iterator<Item = f64> + 'a {
    g.iter().zip(r).map(move |(g, r)| f(g, r))
}

fn norm(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// Root mean square of an input; 1 if it is zero (a black background still has a scale).
fn size(input: &Array) -> f64 {
    match input.rms() {
        0.0 => 1.0,
        rms => rms,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn group(values: &[f64]) -> Group {
        Group {
            name: "means",
            array: Array {
                shape: vec![values.len() / 2, 2],
                values: values.to_vec(),
            },
            offset: vec![0, 0],
        }
    }

    fn judged(ours: &[f64], reference: &[f64]) -> GroupReport {
        judge_group(&group(ours), &group(reference), 1.0, 100.0, 1e-4)
    }

    #[test]
    fn equal_gradients_pass() {
        let report = judged(&[1.0, 0.0, -3.0, 2.0], &[1.0, 0.0, -3.0, 2.0]);
        assert!(report.pass);
        assert_eq!(
            (report.rel_l2, report.one_minus_cosine, report.worst),
            (0.0, 0.0, 0.0)
        );
        assert_eq!((report.zeros, report.zeros_reference), (0.25, 0.25));
    }

    #[test]
    fn measures_match_their_definitions() {
        let report = judged(&[3.0, 4.5, 0.0, 0.0], &[3.0, 4.0, 0.0, 0.0]);
        assert!(!report.pass);
        assert!((report.rel_l2 - 0.1).abs() < 1e-15);
        assert!((report.bias - 0.5 / 7.0).abs() < 1e-15);
        let cosine = (9.0 + 18.0) / (5.0 * 29.25_f64.sqrt());
        assert!((report.one_minus_cosine - (1.0 - cosine)).abs() < 1e-15);
        assert_eq!(report.worst_index, [0, 1]);
        assert!((report.worst - 0.5 / (4.0 + 1e-6 * 2.5)).abs() < 1e-12);
    }

    #[test]
    fn cosine_is_stable_for_tiny_angles() {
        // An angle of 1e-9 has 1 - cos = 5e-19, far below the rounding of 1.0.
        let value = one_minus_cosine(&[1.0, 1e-9], &[1.0, 0.0]);
        assert!((value / 5e-19 - 1.0).abs() < 1e-6, "{value}");
    }

    #[test]
    fn a_vanished_a_negated_and_a_nan_gradient_fail() {
        let reference = [1.0, 2.0, 3.0, 4.0];
        for ours in [
            [0.0; 4],
            [-1.0, -2.0, -3.0, -4.0],
            [1.0, 2.0, f64::NAN, 4.0],
        ] {
            assert!(!judged(&ours, &reference).pass, "{ours:?}");
        }
    }

    #[test]
    fn a_zero_reference_is_judged_by_its_effect_on_the_loss() {
        assert!(judged(&[0.0; 4], &[0.0; 4]).pass);
        // 1e-3 relative to a largest effect of 100 is 1e-5; 1 is 1e-2.
        assert!(judged(&[1e-3, 0.0, 0.0, 0.0], &[0.0; 4]).pass);
        assert!(!judged(&[1.0, 0.0, 0.0, 0.0], &[0.0; 4]).pass);
    }
}
