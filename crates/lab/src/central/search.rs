//! Search for wrong elements: one by one in small inputs, by bisection in large ones.
//!
//! In a large input all elements are moved at once, by their sizes with random signs. The analytic
//! derivative along such a direction is free, as one backward pass gives the whole gradient. A
//! single wrong element changes it by its error, which the sum of the others does not hide, as
//! differences are exact to many digits. On disagreement, halves of the elements are moved,
//! recursively down to one.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::judge::Analytic;
use super::ladder::{Slope, climb_down};
use super::line::{Line, Probe, sizes};
use super::noise::{Noise, noise_at_the_bottom};
use super::report::{Comparison, Coverage, Finding, Kind, Row};
use super::sample::Extent;
use super::{CheckError, Settings};
use crate::gradcheck::index_of;

/// Most findings of a kind in one input; there may be more.
const MOST: usize = 8;
/// The same in large inputs, where each finding takes as many evaluations as there are halvings.
const MOST_BY_HALVING: usize = 3;

/// Attempts to measure noise.
const NOISE_TRIES: u64 = 5;

/// The search in one input.
pub(super) struct Search<'a, 'p> {
    pub probe: &'a mut Probe<'p>,
    pub settings: &'a Settings,
    pub input: usize,
    pub shape: &'a [usize],
    pub values: &'a [f64],
    /// The analytic gradient; `None` if autodiff has none.
    pub gradient: Option<&'a [f64]>,
}

/// Known properties of all lines through the input.
#[derive(Clone, Copy)]
struct Known<'s> {
    /// Sizes of the elements.
    sizes: &'s [f64],
    /// Root mean square of derivative times size.
    rms: f64,
    noise: Noise,
}

/// Result of following a line.
struct Followed {
    analytic: Analytic,
    slope: Option<Slope>,
    kind: Option<Kind>,
}

impl Followed {
    /// Difference as a multiple of the allowed one.
    fn severity(&self, settings: &Settings) -> f64 {
        let Some(slope) = &self.slope else {
            return f64::INFINITY;
        };
        let difference = (self.analytic.value.unwrap_or(0.0) - slope.central.value).abs();
        if difference == 0.0 {
            return 0.0;
        }
        difference / self.analytic.allowed(slope, settings)
    }
}

impl Search<'_, '_> {
    pub(super) fn run(mut self, name: &str) -> Result<Row, CheckError> {
        let sizes = sizes(self.values);
        let gradient = self.gradient.unwrap_or_default();
        let squares = gradient.iter().zip(&sizes).map(|(g, s)| (g * s).powi(2));
        let known = Known {
            sizes: &sizes,
            rms: (squares.sum::<f64>() / sizes.len() as f64).sqrt(),
            noise: self.noise(&sizes)?,
        };
        let mut row = Row {
            name: name.into(),
            shape: self.shape.to_vec(),
            coverage: Coverage::Elements(self.values.len()),
            worst: None,
            all_zero: true,
            findings: Vec::new(),
        };
        if self.values.len() <= self.settings.each_up_to {
            self.each(known, &mut row)?;
        } else {
            self.along_directions(known, &mut row)?;
        }
        Ok(row)
    }

    /// Checks every element individually.
    fn each(&mut self, known: Known, row: &mut Row) -> Result<(), CheckError> {
        let mut most_severe = -1.0;
        let (mut failures, mut kinks) = (0, 0);
        let sizes = known.sizes;
        for i in 0..sizes.len() {
            let followed = self.follow(i..i + 1, sizes, known)?;
            let comparison = self.comparison(&followed, Some(i), sizes[i]);
            row.all_zero &= comparison.is_zero();
            let severity = followed.severity(self.settings);
            if severity > most_severe {
                most_severe = severity;
                row.worst = Some(comparison.clone());
            }
            if let Some(kind) = followed.kind {
                let count = if kind.fails() {
                    &mut failures
                } else {
                    &mut kinks
                };
                *count += 1;
                if *count <= MOST {
                    let kind = per_element(kind, sizes[i]);
                    row.findings.push(Finding { kind, comparison });
                }
            }
        }
        Ok(())
    }

    /// Checks random directions, and the elements where they disagree. Elements already found are
    /// not moved again.
    fn along_directions(&mut self, known: Known, row: &mut Row) -> Result<(), CheckError> {
        let n = known.sizes.len();
        let (mut most_severe, mut limit) = (-1.0, f64::INFINITY);
        let mut found = Vec::new();
        for direction in 0..self.settings.directions {
            let mut moves = self.direction(known.sizes, direction as u64);
            for i in &found {
                moves[*i] = 0.0;
            }
            loop {
                let followed = self.follow(0..n, &moves, known)?;
                let whole = self.comparison(&followed, None, 1.0);
                row.all_zero &= whole.is_zero();
                let Some(kind) = followed.kind else {
                    limit = self.limit(&followed).min(limit);
                    let severity = followed.severity(self.settings);
                    if severity > most_severe && row.is_ok() {
                        most_severe = severity;
                        row.worst = Some(whole);
                    }
                    break;
                };
                let finding = match self.narrow(&moves, known)? {
                    Some((i, finding)) if found.len() < MOST_BY_HALVING => {
                        found.push(i);
                        moves[i] = 0.0;
                        finding
                    }
                    // No single element explains it, or there are too many.
                    _ => Finding {
                        kind: refused(kind),
                        comparison: whole,
                    },
                };
                let ends = finding.comparison.at.is_none();
                if row.is_ok() || ends {
                    row.worst = Some(finding.comparison.clone());
                }
                row.findings.push(finding);
                if ends {
                    break;
                }
            }
            if !row.is_ok() {
                break;
            }
        }
        row.coverage = Coverage::Directions {
            count: self.settings.directions,
            limit,
        };
        Ok(())
    }

    /// Finds the first wrong element by bisection.
    fn narrow(
        &mut self,
        moves: &[f64],
        known: Known,
    ) -> Result<Option<(usize, Finding)>, CheckError> {
        let mut range = 0..moves.len();
        while range.len() > 1 {
            let middle = range.start + range.len() / 2;
            let first = self.follow(range.start..middle, moves, known)?;
            range = match first.kind {
                Some(_) => range.start..middle,
                None => middle..range.end,
            };
        }
        let i = range.start;
        if moves[i] == 0.0 {
            return Ok(None);
        }
        let size = known.sizes[i];
        let followed = self.follow(range, known.sizes, known)?;
        let comparison = self.comparison(&followed, Some(i), size);
        Ok(followed.kind.map(|kind| {
            let kind = per_element(kind, size);
            (i, Finding { kind, comparison })
        }))
    }

    /// Moves of all elements by their size or half of it, with random signs. Two sizes make it
    /// unlikely that equal errors of opposite sign cancel.
    fn direction(&self, sizes: &[f64], number: u64) -> Vec<f64> {
        let seed = self.settings.seed ^ (number << 32) ^ ((self.input as u64) << 48);
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let move_ = |size: &f64| size * [1.0, -1.0, 0.5, -0.5][rng.random_range(0..4usize)];
        sizes.iter().map(move_).collect()
    }

    /// Magnitude of rounding: the smallest of several attempts, each with about half of the
    /// elements, since one that crosses a kink or jump takes that for noise.
    fn noise(&mut self, sizes: &[f64]) -> Result<Noise, CheckError> {
        let mut least: Option<Noise> = None;
        for number in 0..NOISE_TRIES {
            let mut moves = self.direction(sizes, u64::from(u32::MAX) - number);
            for (v, size) in moves.iter_mut().zip(sizes) {
                if v.abs() < *size {
                    *v = 0.0;
                }
            }
            let line = Line {
                input: self.input,
                range: 0..sizes.len(),
                moves: &moves,
            };
            let mut extent = Extent::default();
            let found = noise_at_the_bottom(self.settings.step, |step| {
                let sample = self.probe.sample(&line, step)?;
                extent = sample.map_or(extent, |sample| extent.or(sample.extent));
                Ok::<_, CheckError>(sample)
            })?;
            let Some(found) = found.filter(|_| extent.size > 0.0) else {
                continue;
            };
            let noise = Noise::that_explains(found, extent);
            if least.is_none_or(|least| noise.factor < least.factor) {
                least = Some(noise);
            }
            if noise == Noise::LEAST {
                break;
            }
        }
        Ok(least.unwrap_or(Noise::LEAST))
    }

    fn follow(
        &mut self,
        range: std::ops::Range<usize>,
        moves: &[f64],
        known: Known,
    ) -> Result<Followed, CheckError> {
        let analytic = self.analytic(range.clone(), moves, known.rms);
        let line = Line {
            input: self.input,
            range,
            moves,
        };
        let enough = analytic.enough(self.settings);
        let slope = climb_down(self.settings.step, known.noise, enough, |step| {
            self.probe.sample(&line, step)
        })?;
        let kind = analytic.judge(slope.as_ref(), self.settings);
        Ok(Followed {
            analytic,
            slope,
            kind,
        })
    }

    fn analytic(&self, range: std::ops::Range<usize>, moves: &[f64], rms: f64) -> Analytic {
        let Some(gradient) = self.gradient else {
            return Analytic {
                value: None,
                scale: 0.0,
                rms: 0.0,
            };
        };
        let parts = gradient[range.clone()].iter().zip(&moves[range]);
        let (value, scale) = parts.fold((0.0, 0.0), |(sum, squares), (g, v)| {
            (sum + g * v, squares + (g * v).powi(2))
        });
        Analytic {
            value: Some(value),
            scale: scale.sqrt(),
            rms,
        }
    }

    /// Error of a single element that would have been seen, in units of the root mean square
    /// derivative. Elements move by at least half their size.
    fn limit(&self, followed: &Followed) -> f64 {
        let (Some(slope), rms) = (&followed.slope, followed.analytic.rms) else {
            return f64::INFINITY;
        };
        let unseen = 2.0 * followed.analytic.allowed(slope, self.settings);
        if unseen == 0.0 { 0.0 } else { unseen / rms }
    }

    fn comparison(&self, followed: &Followed, at: Option<usize>, size: f64) -> Comparison {
        let (numeric, error) = match &followed.slope {
            Some(slope) => (slope.central.value, slope.central.error),
            None => (f64::NAN, f64::NAN),
        };
        Comparison {
            at: at.map(|i| index_of(i, self.shape)),
            analytic: followed.analytic.value.unwrap_or(0.0) / size,
            numeric: numeric / size,
            error: error / size,
        }
    }
}

/// The same kind without accepted kinks, as others were not searched for.
fn refused(kind: Kind) -> Kind {
    match kind {
        Kind::Kink { left, right, .. } => Kind::Kink {
            left,
            right,
            accepted: false,
        },
        kind => kind,
    }
}

/// Slopes per unit of the element instead of its size.
fn per_element(kind: Kind, size: f64) -> Kind {
    match kind {
        Kind::Kink {
            left,
            right,
            accepted,
        } => Kind::Kink {
            left: left / size,
            right: right / size,
            accepted,
        },
        kind => kind,
    }
}
