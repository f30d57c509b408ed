//! Grey pictures, their corners, and patches found again by correlation.

use splat_data::View;

/// Pixels from the middle of a patch to its side.
const HALF: i32 = 3;
/// Pixels of a patch.
const PATCH: usize = (2 * HALF as usize + 1).pow(2);
/// A patch whose grey varies by less has nothing to find: standard deviation, from 0 to 1.
const LEAST_CONTRAST: f32 = 0.02;

/// A picture in grey, from 0 to 1, or NaN where a mask hides it. The centre of its first pixel is
/// at (0.5, 0.5).
pub(super) struct Picture {
    width: usize,
    height: usize,
    grey: Vec<f32>,
}

/// The grey of a patch without its mean, of length 1.
pub(super) struct Patch([f32; PATCH]);

/// Maps offsets in a patch's own picture to those in another.
pub(super) type Warp = [[f64; 2]; 2];
/// Offsets as they are.
pub(super) const UPRIGHT: Warp = [[1.0, 0.0], [0.0, 1.0]];

/// The best place of a search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Found {
    pub position: [f64; 2],
    /// Correlation there, at most 1.
    pub score: f32,
    /// The best correlation farther than two pixels from there.
    pub second: f32,
}

impl Picture {
    pub fn of(view: &View) -> Self {
        let grey = |pixel: &[u8]| pixel.iter().map(|x| f32::from(*x)).sum::<f32>() / (3.0 * 255.0);
        let mut grey: Vec<f32> = view.image.chunks_exact(3).map(grey).collect();
        for (grey, mask) in grey.iter_mut().zip(view.mask.iter().flat_map(|m| m.iter())) {
            if *mask < u8::MAX {
                *grey = f32::NAN;
            }
        }
        Self {
            width: view.width as usize,
            height: view.height as usize,
            grey,
        }
    }

    /// The grey at a position; `None` beyond the centres of the outermost pixels.
    fn at(&self, [x, y]: [f64; 2]) -> Option<f32> {
        let (x, y) = (x - 0.5, y - 0.5);
        if !(x >= 0.0 && y >= 0.0) {
            return None;
        }
        let (i, j) = (x as usize, y as usize);
        if i + 1 >= self.width || j + 1 >= self.height {
            return None;
        }
        let (u, v) = ((x - i as f64) as f32, (y - j as f64) as f32);
        let row = |j: usize| {
            let at = j * self.width + i;
            self.grey[at] * (1.0 - u) + self.grey[at + 1] * u
        };
        Some(row(j) * (1.0 - v) + row(j + 1) * v)
    }

    /// The patch around a position. `None` if it reaches beyond the picture or under a mask, or is
    /// of one grey.
    pub fn patch(&self, [x, y]: [f64; 2], warp: Warp) -> Option<Patch> {
        let mut values = [0.0; PATCH];
        let mut at = 0;
        for j in -HALF..=HALF {
            for i in -HALF..=HALF {
                let (i, j) = (f64::from(i), f64::from(j));
                let [a, b] = warp.map(|row| row[0] * i + row[1] * j);
                values[at] = self.at([x + a, y + b])?;
                at += 1;
            }
        }
        let mean = values.iter().sum::<f32>() / PATCH as f32;
        values.iter_mut().for_each(|value| *value -= mean);
        let length = values.iter().map(|value| value * value).sum::<f32>().sqrt();
        // NaN neither.
        if !(length >= LEAST_CONTRAST * (PATCH as f32).sqrt()) {
            return None;
        }
        values.iter_mut().for_each(|value| *value /= length);
        Some(Patch(values))
    }

    /// Looks for a patch at whole pixels around a position, up to a distance along both axes.
    pub fn find(&self, patch: &Patch, [x, y]: [f64; 2], warp: Warp, reach: i32) -> Option<Found> {
        let side = (2 * reach + 1) as usize;
        let mut scores = vec![f32::NEG_INFINITY; side * side];
        for (at, score) in scores.iter_mut().enumerate() {
            let [i, j] = [at % side, at / side].map(|k| f64::from(k as i32 - reach));
            if let Some(other) = self.patch([x + i, y + j], warp) {
                *score = patch.correlation(&other);
            }
        }
        let best = (0..scores.len()).max_by(|a, b| scores[*a].total_cmp(&scores[*b]))?;
        if scores[best] == f32::NEG_INFINITY {
            return None;
        }
        let (i, j) = (best % side, best / side);
        let far = |at: &usize| (at % side).abs_diff(i).max((at / side).abs_diff(j)) > 2;
        let second = (0..scores.len()).filter(far).map(|at| scores[at]);
        let score = |i: usize, j: usize| scores[j * side + i];
        // Within a pixel the best place is that of the parabola through the neighbours.
        let within = |before: f32, after: f32| {
            let bend = before - 2.0 * scores[best] + after;
            let shift = 0.5 * (before - after) / bend;
            if bend < 0.0 && shift.abs() <= 0.5 {
                f64::from(shift)
            } else {
                0.0
            }
        };
        let inner = 1..side - 1;
        let dx = if inner.contains(&i) {
            within(score(i - 1, j), score(i + 1, j))
        } else {
            0.0
        };
        let dy = if inner.contains(&j) {
            within(score(i, j - 1), score(i, j + 1))
        } else {
            0.0
        };
        let offset = |k: usize| f64::from(k as i32 - reach);
        Some(Found {
            position: [x + offset(i) + dx, y + offset(j) + dy],
            score: scores[best],
            second: second.fold(f32::NEG_INFINITY, f32::max),
        })
    }

    /// The strongest corner of each square with this side, if it is one (Shi and Tomasi 1994): a
    /// pixel around which the grey changes along both axes.
    pub fn corners(&self, side: usize) -> Vec<[f64; 2]> {
        let (w, h) = (self.width, self.height);
        let margin = HALF as usize + 2;
        if w <= 2 * margin || h <= 2 * margin {
            return vec![];
        }
        let grey = |x: usize, y: usize| self.grey[y * w + x];
        // Sums over windows are differences of sums from the first pixel on.
        let mut sums = vec![[0.0f64; 3]; (w + 1) * (h + 1)];
        for y in 0..h {
            for x in 0..w {
                let inner = x > 0 && y > 0 && x + 1 < w && y + 1 < h;
                let (dx, dy) = match inner {
                    true => (
                        grey(x + 1, y) - grey(x - 1, y),
                        grey(x, y + 1) - grey(x, y - 1),
                    ),
                    false => (0.0, 0.0),
                };
                let seen = |d: f32| f64::from(if d.is_finite() { d } else { 0.0 });
                let (dx, dy) = (seen(dx), seen(dy));
                let own = [dx * dx, dx * dy, dy * dy];
                let [left, above, both] =
                    [(x, y + 1), (x + 1, y), (x, y)].map(|(x, y)| sums[y * (w + 1) + x]);
                let total = |k: usize| own[k] + left[k] + above[k] - both[k];
                sums[(y + 1) * (w + 1) + x + 1] = std::array::from_fn(total);
            }
        }
        let half = HALF as usize;
        let strength = |x: usize, y: usize| {
            let at = |x: usize, y: usize| sums[y * (w + 1) + x];
            let corners = [
                at(x + half + 1, y + half + 1),
                at(x - half, y + half + 1),
                at(x + half + 1, y - half),
                at(x - half, y - half),
            ];
            let [a, b, c] = std::array::from_fn(|k| {
                corners[0][k] - corners[1][k] - corners[2][k] + corners[3][k]
            });
            // The smaller eigenvalue.
            0.5 * (a + c - (a - c).hypot(2.0 * b))
        };
        let least = f64::from(LEAST_CONTRAST).powi(2) * PATCH as f64;
        let mut corners = Vec::new();
        for top in (margin..h - margin).step_by(side) {
            for left in (margin..w - margin).step_by(side) {
                let pixels = (top..(top + side).min(h - margin))
                    .flat_map(|y| (left..(left + side).min(w - margin)).map(move |x| (x, y)));
                let best = pixels
                    .map(|(x, y)| (strength(x, y), x, y))
                    .max_by(|a, b| a.0.total_cmp(&b.0));
                if let Some((_, x, y)) = best.filter(|(strength, _, _)| *strength > least) {
                    corners.push([x as f64 + 0.5, y as f64 + 0.5]);
                }
            }
        }
        corners
    }
}

impl Patch {
    fn correlation(&self, other: &Self) -> f32 {
        self.0.iter().zip(&other.0).map(|(a, b)| a * b).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Waves that repeat nowhere in the picture.
    fn picture(shift: [f64; 2]) -> Picture {
        let (width, height) = (60, 50);
        let grey = (0..width * height).map(|at| {
            let (x, y) = (
                (at % width) as f64 - shift[0],
                (at / width) as f64 - shift[1],
            );
            (0.5 + 0.2 * (0.5 * x + 0.003 * y * y).sin() + 0.2 * (0.4 * y - 0.004 * x * x).cos())
                as f32
        });
        Picture {
            width,
            height,
            grey: grey.collect(),
        }
    }

    #[test]
    fn a_patch_is_found_where_it_has_moved_to() {
        let (here, there) = (picture([0.0; 2]), picture([2.3, -1.6]));
        let corners = here.corners(12);
        assert!(corners.len() > 5, "{corners:?}");
        let mut found = 0;
        for [x, y] in corners {
            let patch = here.patch([x, y], UPRIGHT).unwrap();
            let Some(place) = there.find(&patch, [x + 1.0, y], UPRIGHT, 4) else {
                continue;
            };
            let [a, b] = place.position;
            // Not where the edge of the picture cuts the search off.
            if (15.0..45.0).contains(&x) && (15.0..35.0).contains(&y) {
                let off = (a - x - 2.3).hypot(b - y + 1.6);
                assert!(off < 0.5, "{off}: {place:?}");
                assert!(place.score > 0.9 && place.second < place.score);
                found += 1;
            }
        }
        assert!(found > 3, "{found}");
    }

    #[test]
    fn what_is_of_one_grey_is_no_corner() {
        let flat = Picture {
            width: 40,
            height: 40,
            grey: vec![0.4; 1600],
        };
        assert!(flat.corners(8).is_empty());
        assert!(flat.patch([20.0, 20.0], UPRIGHT).is_none());
        assert!(picture([0.0; 2]).patch([2.0, 20.0], UPRIGHT).is_none());
        let mut hidden = picture([0.0; 2]);
        hidden.grey.fill(f32::NAN);
        assert!(hidden.corners(8).is_empty());
        let tiny = Picture {
            width: 3,
            height: 2,
            grey: vec![0.0; 6],
        };
        assert!(tiny.corners(8).is_empty());
    }
}
