//! Normal equations of one step, solved by conjugate gradients.
//!
//! Points are eliminated: each only meets the views that observe it, so that its 3x3 block is
//! inverted by itself, and what is left (Schur's complement) has six unknowns for each view. It is
//! never stored; its product with a vector is a pass over the keypoints (Agarwal et al. 2010,
//! "Bundle Adjustment in the Large", section 4). Sums are in one order, so that the result is the
//! same in every run.

use glam::{DMat3, DVec3};

use super::problem::{Cost, Linearized, Problem, Row, Sight, Step};

/// Conjugate gradients end when they have reduced the residual to this share of itself, or after so
/// many steps: the next linearisation corrects what is left.
const REDUCED: f64 = 1e-4;
const MOST_STEPS: usize = 300;

type Six = [f64; 6];

/// The step that the damped normal equations give, or `None` if it is not finite.
pub(super) fn step(
    problem: &Problem<'_>,
    at: &Linearized,
    cost: Cost,
    damping: f64,
    free_points: bool,
) -> Option<Step> {
    let normal = Normal::new(problem, at, cost, damping, free_points);
    let views = normal.views()?;
    let points = normal.points_after(&views);
    let finite = views.as_flattened().iter().all(|x| x.is_finite())
        && points.iter().all(|point| point.is_finite());
    finite.then_some(Step { views, points })
}

struct Normal<'a> {
    sights: &'a [Sight],
    /// Rows of each keypoint, times the root of its weight.
    rows: Vec<[Row; 2]>,
    /// Damped blocks of the views, and their factors.
    view_blocks: Vec<[Six; 6]>,
    factors: Vec<Cholesky>,
    view_gradients: Vec<Six>,
    /// Inverses of the damped blocks of the points; zero for points that stay where they are.
    point_inverses: Vec<DMat3>,
    point_gradients: Vec<DVec3>,
}

impl<'a> Normal<'a> {
    fn new(
        problem: &'a Problem<'_>,
        at: &Linearized,
        cost: Cost,
        damping: f64,
        free_points: bool,
    ) -> Self {
        let weighted = |rows: &[Row; 2]| {
            let root = cost.weight(rows[0].error.hypot(rows[1].error)).sqrt();
            rows.map(|row| Row {
                error: root * row.error,
                view: row.view.map(|x| root * x),
                point: root * row.point,
            })
        };
        let rows: Vec<[Row; 2]> = at.rows.iter().map(weighted).collect();
        let mut view_blocks = vec![[[0.0; 6]; 6]; problem.views];
        let mut view_gradients = vec![[0.0; 6]; problem.views];
        let mut point_blocks = vec![DMat3::ZERO; problem.points];
        let mut point_gradients = vec![DVec3::ZERO; problem.points];
        for (sight, rows) in problem.sights.iter().zip(&rows) {
            for row in rows {
                let block = &mut view_blocks[sight.view];
                for (i, a) in row.view.iter().enumerate() {
                    add(&mut block[i], *a, &row.view);
                }
                add(&mut view_gradients[sight.view], row.error, &row.view);
                let [x, y, z] = (row.point).to_array().map(|x| x * row.point);
                point_blocks[sight.point] += DMat3::from_cols(x, y, z);
                point_gradients[sight.point] += row.error * row.point;
            }
        }
        for block in &mut view_blocks {
            for (i, row) in block.iter_mut().enumerate() {
                row[i] *= 1.0 + damping;
            }
        }
        let inverse = |block: DMat3| {
            let diagonal = DVec3::new(block.x_axis.x, block.y_axis.y, block.z_axis.z);
            let inverse = (block + DMat3::from_diagonal(diagonal * damping)).inverse();
            match inverse.is_finite() && free_points {
                true => inverse,
                false => DMat3::ZERO,
            }
        };
        Self {
            sights: &problem.sights,
            rows,
            factors: view_blocks.iter().map(Cholesky::new).collect(),
            view_blocks,
            view_gradients,
            point_inverses: point_blocks.into_iter().map(inverse).collect(),
            point_gradients,
        }
    }

    /// Keypoints of each point, with their rows.
    fn tracks(&self) -> impl Iterator<Item = (&[Sight], &[[Row; 2]])> {
        let mut start = 0;
        let tracks = self.sights.chunk_by(|a, b| a.point == b.point);
        tracks.map(move |track| {
            let rows = &self.rows[start..start + track.len()];
            start += track.len();
            (track, rows)
        })
    }

    /// Adds to `views` what a shift of every point, a function of its coupling with the views,
    /// does to them.
    fn couple(&self, views: &mut [Six], shift: impl Fn(&[Sight], &[[Row; 2]]) -> DVec3) {
        for (track, rows) in self.tracks() {
            let shift = self.point_inverses[track[0].point] * shift(track, rows);
            for (sight, rows) in track.iter().zip(rows) {
                for row in rows {
                    add(&mut views[sight.view], -row.point.dot(shift), &row.view);
                }
            }
        }
    }

    /// Schur's complement times a vector.
    fn times(&self, x: &[Six]) -> Vec<Six> {
        let block = |(block, x): (&[Six; 6], &Six)| block.map(|row| dot(&row, x));
        let mut out: Vec<Six> = self.view_blocks.iter().zip(x).map(block).collect();
        self.couple(&mut out, |track, rows| coupled(track, rows, x));
        out
    }

    /// The step of the views, by conjugate gradients that are preconditioned by the views' blocks.
    fn views(&self) -> Option<Vec<Six>> {
        let mut right: Vec<Six> = self.view_gradients.iter().map(|g| g.map(|x| -x)).collect();
        self.couple(&mut right, |track, _| -self.point_gradients[track[0].point]);
        let solved = |residual: &[Six]| -> Vec<Six> {
            let pairs = self.factors.iter().zip(residual);
            pairs.map(|(factor, r)| factor.solve(r)).collect()
        };
        let product =
            |a: &[Six], b: &[Six]| -> f64 { a.iter().zip(b).map(|(a, b)| dot(a, b)).sum() };
        let mut x = vec![[0.0; 6]; right.len()];
        let mut residual = right;
        let mut z = solved(&residual);
        let mut direction = z.clone();
        let mut size = product(&residual, &z);
        let enough = REDUCED * REDUCED * size;
        for _ in 0..MOST_STEPS {
            if !(size > enough) {
                break;
            }
            let image = self.times(&direction);
            let along = product(&direction, &image);
            if !(along > 0.0) {
                // Rounding is all that is left.
                break;
            }
            let length = size / along;
            for i in 0..x.len() {
                add(&mut x[i], length, &direction[i]);
                add(&mut residual[i], -length, &image[i]);
            }
            z = solved(&residual);
            let next = product(&residual, &z);
            let share = next / size;
            for (d, z) in direction.iter_mut().zip(&z) {
                *d = std::array::from_fn(|i| z[i] + share * d[i]);
            }
            size = next;
        }
        size.is_finite().then_some(x)
    }

    /// The step of the points after that of the views.
    fn points_after(&self, views: &[Six]) -> Vec<DVec3> {
        let mut points = vec![DVec3::ZERO; self.point_inverses.len()];
        for (track, rows) in self.tracks() {
            let point = track[0].point;
            let pull = self.point_gradients[point] + coupled(track, rows, views);
            points[point] = -(self.point_inverses[point] * pull);
        }
        points
    }
}

/// What motions of the views do to the gradient of a point.
fn coupled(track: &[Sight], rows: &[[Row; 2]], views: &[Six]) -> DVec3 {
    let mut sum = DVec3::ZERO;
    for (sight, rows) in track.iter().zip(rows) {
        for row in rows {
            sum += dot(&row.view, &views[sight.view]) * row.point;
        }
    }
    sum
}

fn add(to: &mut Six, factor: f64, x: &Six) {
    for (to, x) in to.iter_mut().zip(x) {
        *to += factor * x;
    }
}

fn dot(a: &Six, b: &Six) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// The lower triangle whose product with its transpose is a block, or zero where that has none: a
/// view without keypoints stays where it is.
struct Cholesky([Six; 6]);

impl Cholesky {
    fn new(block: &[Six; 6]) -> Self {
        let mut lower = [[0.0; 6]; 6];
        for i in 0..6 {
            for j in 0..=i {
                let done: f64 = (0..j).map(|k| lower[i][k] * lower[j][k]).sum();
                let left = block[i][j] - done;
                lower[i][j] = match i == j {
                    true => left.max(0.0).sqrt(),
                    false if lower[j][j] > 0.0 => left / lower[j][j],
                    false => 0.0,
                };
            }
        }
        Self(lower)
    }

    fn solve(&self, right: &Six) -> Six {
        let Self(lower) = self;
        let mut x = *right;
        let divided = |x: f64, pivot: f64| if pivot > 0.0 { x / pivot } else { 0.0 };
        for i in 0..6 {
            let done: f64 = (0..i).map(|k| lower[i][k] * x[k]).sum();
            x[i] = divided(x[i] - done, lower[i][i]);
        }
        for i in (0..6).rev() {
            let done: f64 = (i + 1..6).map(|k| lower[k][i] * x[k]).sum();
            x[i] = divided(x[i] - done, lower[i][i]);
        }
        x
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_solved() {
        let mut block = [[0.0; 6]; 6];
        for seed in 0..7 {
            let row: Six =
                std::array::from_fn(|i| f64::from((7 * seed + 3 * i as i32 * seed + 5) % 11) - 5.0);
            for i in 0..6 {
                add(&mut block[i], row[i], &row);
            }
            block[seed as usize % 6][seed as usize % 6] += 1.0;
        }
        let x = [1.0, -2.0, 0.5, 3.0, 0.0, -1.0];
        let right = block.map(|row| dot(&row, &x));
        let solved = Cholesky::new(&block).solve(&right);
        for (a, b) in solved.iter().zip(x) {
            assert!((a - b).abs() < 1e-9, "{solved:?}");
        }
        assert_eq!(Cholesky::new(&[[0.0; 6]; 6]).solve(&x), [0.0; 6]);
    }
}
