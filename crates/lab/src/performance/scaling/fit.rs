//! Growth of time, and composition of memory, fitted to the points.

use std::fmt;

use serde::Serialize;

use super::Point;

/// Terms of the sum: a constant, Gaussians, intersections, pixels.
const TERMS: usize = 4;

/// Terms of a point, and its bytes.
type Row = ([f64; TERMS], f64);

/// Gaussians of a point.
pub fn gaussians(point: &Point) -> f64 {
    point.work.gaussians as f64
}

/// Pixels of a photo at a point.
pub fn pixels(point: &Point) -> f64 {
    point.work.pixels
}

/// Largest exponent of step time in `size` between neighbouring points that differ only in it;
/// `None` if there are no such points.
pub fn steepest(points: &[Point], size: fn(&Point) -> f64) -> Option<f64> {
    let same_else = |a: &Point, b: &Point| {
        let same = |of: fn(&Point) -> f64| of(a) == of(b);
        size(a) < size(b) && (same(gaussians) || same(pixels))
    };
    let mut steepest: Option<f64> = None;
    for a in points {
        let larger = points.iter().filter(|b| same_else(a, b));
        let Some(b) = larger.min_by(|b, c| size(b).total_cmp(&size(c))) else {
            continue;
        };
        let growth = (b.milliseconds.median / a.milliseconds.median).ln();
        let exponent = growth / (size(b) / size(a)).ln();
        steepest = Some(steepest.map_or(exponent, |most| most.max(exponent)));
    }
    steepest
}

/// Peak memory as `constant + a Gaussians + b intersections + c pixels`, with non-negative terms,
/// by least squares of the relative error.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MemoryFit {
    /// Constant bytes.
    pub constant: f64,
    /// Bytes per Gaussian.
    pub per_gaussian: f64,
    /// Bytes per (tile, Gaussian) pair of a view.
    pub per_intersection: f64,
    /// Bytes per pixel of a view.
    pub per_pixel: f64,
    /// Largest relative deviation of a point from the sum.
    pub worst: f64,
}

impl MemoryFit {
    /// `None` if there are no more points than terms, if the points do not determine the terms, or
    /// without memory figures.
    pub fn of(points: &[Point]) -> Option<Self> {
        let rows: Vec<Row> = points
            .iter()
            .filter_map(|point| {
                let bytes = point.memory()? as f64;
                Some((terms(point), bytes))
            })
            .collect();
        // If all terms together would include a negative one, the best sum of fewer terms.
        let fits = (1..1 << TERMS).filter_map(|chosen| {
            let solution = least_squares(&rows, chosen)?;
            let usable = solution.iter().all(|factor| *factor >= 0.0);
            usable.then(|| (squared_error(&rows, &solution), solution))
        });
        let (_, best) = fits.min_by(|a, b| a.0.total_cmp(&b.0))?;
        let [constant, per_gaussian, per_intersection, per_pixel] = best;
        // The terms are determined, and there are further rows to check them.
        (rows.len() > TERMS && least_squares(&rows, (1 << TERMS) - 1).is_some()).then(|| Self {
            constant,
            per_gaussian,
            per_intersection,
            per_pixel,
            worst: errors(&rows, &best).fold(0.0, |worst, error| error.abs().max(worst)),
        })
    }
}

fn terms(point: &Point) -> [f64; TERMS] {
    [
        1.0,
        gaussians(point),
        point.work.intersections,
        pixels(point),
    ]
}

/// Relative deviations of a sum from the measurements.
fn errors<'a>(rows: &'a [Row], factors: &'a [f64; TERMS]) -> impl Iterator<Item = f64> + 'a {
    rows.iter().map(move |(terms, bytes)| {
        let sum: f64 = terms
            .iter()
            .zip(factors)
            .map(|(term, factor)| term * factor)
            .sum();
        sum / bytes - 1.0
    })
}

fn squared_error(rows: &[Row], factors: &[f64; TERMS]) -> f64 {
    errors(rows, factors).map(|error| error * error).sum()
}

/// Factors of the terms whose bits are set in `chosen`, zero for the others; `None` if the rows do
/// not determine them.
fn least_squares(rows: &[Row], chosen: usize) -> Option<[f64; TERMS]> {
    // Normal equations of rows divided by their bytes, so that each has the right side 1. Excluded
    // terms have the equation `factor = 0`.
    let mut system = [[0.0; TERMS + 1]; TERMS];
    let is_chosen = |term: usize| chosen & 1 << term != 0;
    for i in 0..TERMS {
        if !is_chosen(i) {
            system[i][i] = 1.0;
            continue;
        }
        for (terms, bytes) in rows {
            for j in (0..TERMS).filter(|j| is_chosen(*j)) {
                system[i][j] += terms[i] * terms[j] / (bytes * bytes);
            }
            system[i][TERMS] += terms[i] / bytes;
        }
    }
    solve(system)
}

/// Gauss-Jordan elimination with diagonal pivots, which suffice for a symmetric positive matrix;
/// `None` if it is singular or nearly so.
fn solve(mut system: [[f64; TERMS + 1]; TERMS]) -> Option<[f64; TERMS]> {
    let diagonal: [f64; TERMS] = core::array::from_fn(|i| system[i][i]);
    for k in 0..TERMS {
        let pivot = system[k][k];
        if !(pivot > 1e-7 * diagonal[k]) {
            return None;
        }
        let row = system[k].map(|value| value / pivot);
        for other in &mut system {
            let factor = other[k];
            for (value, part) in other.iter_mut().zip(row) {
                *value -= factor * part;
            }
        }
        system[k] = row;
    }
    Some(system.map(|row| row[TERMS]))
}

impl fmt::Display for MemoryFit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "Peak memory = {:.0} MB + {:.0} bytes per Gaussian + {:.0} per intersection + {:.0} per pixel, within {:.0} %.",
            1e-6 * self.constant,
            self.per_gaussian,
            self.per_intersection,
            self.per_pixel,
            100.0 * self.worst
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::performance::{Spread, Work};

    fn point(gaussians: usize, intersections: f64, pixels: f64, milliseconds: f64) -> Point {
        let bytes = 5e7 + 900.0 * gaussians as f64 + 40.0 * intersections + 100.0 * pixels;
        Point {
            work: Work {
                gaussians,
                intersections,
                pixels,
                ..Work::default()
            },
            threads: 2,
            steps: 1,
            milliseconds: Spread::of(vec![milliseconds]),
            stages: vec![],
            peak_rss_bytes: Some(bytes as u64),
            device_memory: None,
        }
    }

    #[test]
    fn memory_that_is_such_a_sum_is_found() {
        let points = [
            point(10_000, 5e4, 1e5, 1.0),
            point(10_000, 2e5, 2e6, 1.0),
            point(1_000_000, 4e6, 1e5, 1.0),
            point(1_000_000, 9e6, 2e6, 1.0),
            point(100_000, 7e5, 5e5, 1.0),
        ];
        let fit = MemoryFit::of(&points).unwrap();
        let close = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 1e-4, "{a} {b}");
        close(fit.constant, 5e7);
        close(fit.per_gaussian, 900.0);
        close(fit.per_intersection, 40.0);
        close(fit.per_pixel, 100.0);
        assert!(fit.worst < 1e-6);

        assert_eq!(MemoryFit::of(&points[..4]), None);
        let same = [0; 5].map(|_| points[0].clone());
        assert_eq!(MemoryFit::of(&same), None);
        // Intersections take nothing here, and their count is wrong: no other term may compensate
        // with negative bytes.
        let off = points.clone().map(|point| {
            let bytes = 5e7 + 900.0 * gaussians(&point) - 9.0 * point.work.intersections;
            Point {
                peak_rss_bytes: Some(bytes as u64),
                ..point
            }
        });
        let fit = MemoryFit::of(&off).unwrap();
        assert_eq!((fit.per_intersection, fit.per_pixel), (0.0, 0.0));
        assert!((800.0..900.0).contains(&fit.per_gaussian), "{fit:?}");

        let unknown = points.map(|point| Point {
            peak_rss_bytes: None,
            ..point
        });
        assert_eq!(MemoryFit::of(&unknown), None);
    }

    #[test]
    fn the_steepest_neighbours_are_found() {
        let points = [
            point(10, 0.0, 100.0, 1.0),
            point(100, 0.0, 100.0, 5.0),
            point(1000, 0.0, 100.0, 500.0),
            point(10, 0.0, 10_000.0, 10.0),
            // Nearest to the first, but different in the other size too.
            point(50, 0.0, 10_000.0, 50.0),
        ];
        let exponent = steepest(&points, gaussians).unwrap();
        assert!((exponent - 2.0).abs() < 1e-12, "{exponent}");
        let exponent = steepest(&points, pixels).unwrap();
        assert!((exponent - 0.5).abs() < 1e-12, "{exponent}");
        assert_eq!(steepest(&points[..1], gaussians), None);
    }
}
