//! Clusters of many points: a tree of k-means.
//!
//! Lloyd's algorithm compares every point with every centre, which for a million points and 65,536
//! centres of 45 numbers takes hours. Here, a set too large for that is first divided among about
//! the square root of its centres; each part then gets centres of its own, as many as its share of
//! the squared error, and the parts are clustered independently. The result is the same on any
//! number of threads.

use rand::seq::index;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

/// Most comparisons of a point and a centre in a round over a set that is not divided further.
const SMALL: usize = 1 << 21;
/// Rounds of Lloyd's algorithm on a set.
const ROUNDS: usize = 8;
/// Points from which a set's parts are found, per part.
const SAMPLE: usize = 64;
/// Centres that are compared with a point at once.
const LANES: usize = 8;

/// Centres, and the index of each point's.
pub(super) struct Clusters {
    /// `[centres][width]`, flattened.
    pub centroids: Vec<f32>,
    pub labels: Vec<u16>,
}

/// Divides `points`, `[N][width]`, into at most `most` clusters, which is at most 65,536.
pub(super) fn cluster(points: &[f32], width: usize, most: usize) -> Clusters {
    let points = Points { points, width };
    let all: Vec<u32> = (0..(points.points.len() / width) as u32).collect();
    let mut centroids = Vec::new();
    let mut labels = vec![0; all.len()];
    for part in points.divide(all, most, 1) {
        let label = (centroids.len() / width) as u16;
        centroids.extend(part.centre);
        for index in part.members {
            labels[index as usize] = label;
        }
    }
    Clusters { centroids, labels }
}

/// A cluster.
struct Part {
    centre: Vec<f32>,
    members: Vec<u32>,
}

#[derive(Clone, Copy)]
struct Points<'a> {
    points: &'a [f32],
    width: usize,
}

impl Points<'_> {
    fn get(&self, index: u32) -> &[f32] {
        let start = index as usize * self.width;
        &self.points[start..start + self.width]
    }

    /// Divides `members` into at most `most` clusters without empty ones.
    fn divide(self, members: Vec<u32>, most: usize, seed: u64) -> Vec<Part> {
        let most = most.min(members.len());
        if most <= 1 {
            return vec![self.part(members)];
        }
        if members.len() == most {
            return members
                .into_iter()
                .map(|index| self.part(vec![index]))
                .collect();
        }
        if members.len().saturating_mul(most) <= SMALL {
            let centres = self.lloyd(&members, most, seed);
            return self.assign(&centres, &members);
        }
        // Few enough that every level is cheap, and at least two.
        let coarse = (most as f64).sqrt().ceil() as usize;
        let sample = index::sample(
            &mut Pcg64Mcg::seed_from_u64(seed),
            members.len(),
            members.len().min(SAMPLE * coarse),
        );
        let sample: Vec<u32> = sample.into_iter().map(|at| members[at]).collect();
        let count = members.len();
        let parts = self.assign(&self.lloyd(&sample, coarse, seed), &members);
        if parts.len() == 1 || parts.iter().any(|part| part.members.len() == count) {
            // Equal points, or nearly so: more centres would change nothing that can be seen.
            return parts;
        }
        let shares = self.shares(&parts, most);
        let parts: Vec<Vec<Part>> = (parts.into_par_iter().zip(shares))
            .enumerate()
            .map(|(at, (part, share))| {
                let seed = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ at as u64;
                self.divide(part.members, share, seed)
            })
            .collect();
        parts.into_iter().flatten().collect()
    }

    /// Number of centres for each part: one, and the rest by squared error.
    fn shares(&self, parts: &[Part], most: usize) -> Vec<usize> {
        let errors: Vec<f64> = parts.par_iter().map(|part| self.error(part)).collect();
        let total: f64 = errors.iter().sum();
        let rest = most.saturating_sub(parts.len());
        let share = |(part, error): (&Part, &f64)| {
            let more = (rest as f64 * error / total) as usize;
            (1 + more).min(part.members.len())
        };
        let mut shares: Vec<usize> = parts.iter().zip(&errors).map(share).collect();
        // What rounding and small parts have left goes to those with the largest error per centre.
        let mut left = most.saturating_sub(shares.iter().sum());
        let mut by_error: Vec<usize> = (0..parts.len()).collect();
        by_error.sort_by(|&a, &b| {
            let each = |at: usize| errors[at] / shares[at] as f64;
            each(b).total_cmp(&each(a))
        });
        for at in by_error {
            let more = left.min((parts[at].members.len() - shares[at]).min(shares[at]));
            shares[at] += more;
            left -= more;
        }
        shares
    }

    /// Squared distances of a part's members to its centre.
    fn error(&self, part: &Part) -> f64 {
        let members = part.members.iter();
        members
            .map(|&index| {
                let both = self.get(index).iter().zip(&part.centre);
                both.map(|(x, c)| f64::from(x - c).powi(2)).sum::<f64>()
            })
            .sum()
    }

    /// A part with its mean as the centre.
    fn part(&self, members: Vec<u32>) -> Part {
        let mut sum = vec![0.0; self.width];
        for &index in &members {
            for (sum, x) in sum.iter_mut().zip(self.get(index)) {
                *sum += f64::from(*x);
            }
        }
        let count = members.len().max(1) as f64;
        Part {
            centre: sum.into_iter().map(|sum| (sum / count) as f32).collect(),
            members,
        }
    }

    /// Members far from each other, by k-means++ (Arthur and Vassilvitskii 2007): each next one
    /// with a probability proportional to its squared distance to those before. Fewer than `count`
    /// if all others are equal to one of them.
    fn start(&self, members: &[u32], count: usize, rng: &mut Pcg64Mcg) -> Vec<&[f32]> {
        let mut distances = vec![f32::INFINITY; members.len()];
        let mut next = rng.random_range(0..members.len());
        let mut start = Vec::with_capacity(count);
        while start.len() < count {
            let centre = self.get(members[next]);
            start.push(centre);
            let mut total = 0.0;
            for (distance, &index) in distances.iter_mut().zip(members) {
                let both = self.get(index).iter().zip(centre);
                let to_centre = both.map(|(x, c)| (x - c) * (x - c)).sum();
                *distance = distance.min(to_centre);
                total += f64::from(*distance);
            }
            let mut left = rng.random_range(0.0..1.0) * total;
            let chosen = distances.iter().position(|&distance| {
                left -= f64::from(distance);
                left < 0.0
            });
            match chosen {
                Some(chosen) => next = chosen,
                None => break,
            }
        }
        start
    }

    /// Centres by Lloyd's algorithm.
    fn lloyd(&self, members: &[u32], count: usize, seed: u64) -> Centres {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let start = self.start(members, count.min(members.len()), &mut rng);
        let mut centres = Centres::new(&start, self.width);
        for _ in 0..ROUNDS {
            let parts = self.assign(&centres, members);
            let mut means: Vec<&[f32]> = parts.iter().map(|part| &part.centre[..]).collect();
            // A centre that no point is nearest to begins again at a random one.
            while means.len() < start.len() {
                let at = rng.random_range(0..members.len());
                means.push(self.get(members[at]));
            }
            let next = Centres::new(&means, self.width);
            if next == centres {
                break;
            }
            centres = next;
        }
        centres
    }

    /// Divides members by their nearest centre; centres without members are left out.
    fn assign(&self, centres: &Centres, members: &[u32]) -> Vec<Part> {
        let nearest: Vec<u32> = members
            .par_iter()
            .with_min_len(256)
            .map(|&index| centres.nearest(self.get(index)))
            .collect();
        let mut parts = vec![vec![]; centres.count];
        for (&index, &nearest) in members.iter().zip(&nearest) {
            parts[nearest as usize].push(index);
        }
        parts.retain(|part| !part.is_empty());
        parts.into_par_iter().map(|part| self.part(part)).collect()
    }
}

/// Centres in groups of [`LANES`], coordinate by coordinate, so that a point is compared with all
/// of a group at once.
#[derive(PartialEq)]
struct Centres {
    groups: Vec<[f32; LANES]>,
    count: usize,
    width: usize,
}

impl Centres {
    fn new(centres: &[&[f32]], width: usize) -> Self {
        // Lanes without a centre are far from everything.
        let mut groups = vec![[f32::INFINITY; LANES]; centres.len().div_ceil(LANES) * width];
        for (at, centre) in centres.iter().enumerate() {
            for (k, x) in centre.iter().enumerate() {
                groups[at / LANES * width + k][at % LANES] = *x;
            }
        }
        Self {
            groups,
            count: centres.len(),
            width,
        }
    }

    /// The nearest centre; the first of equals.
    fn nearest(&self, point: &[f32]) -> u32 {
        let mut best = (f32::INFINITY, 0);
        for (group, lanes) in self.groups.chunks_exact(self.width).enumerate() {
            let mut distances = [0.0f32; LANES];
            for (x, centres) in point.iter().zip(lanes) {
                for lane in 0..LANES {
                    let difference = x - centres[lane];
                    distances[lane] += difference * difference;
                }
            }
            for (lane, &distance) in distances.iter().enumerate() {
                if distance < best.0 {
                    best = (distance, group * LANES + lane);
                }
            }
        }
        best.1 as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(count: usize, width: usize) -> Vec<f32> {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        (0..count * width)
            .map(|_| rng.random_range(-1.0..1.0))
            .collect()
    }

    fn mean_squared_error(points: &[f32], width: usize, clusters: &Clusters) -> f64 {
        let each = points.chunks_exact(width).zip(&clusters.labels);
        let error = each.map(|(point, &label)| {
            let centre = &clusters.centroids[usize::from(label) * width..][..width];
            let both = point.iter().zip(centre);
            both.map(|(x, c)| f64::from(x - c).powi(2)).sum::<f64>()
        });
        error.sum::<f64>() / clusters.labels.len() as f64
    }

    #[test]
    fn as_many_centres_as_points_are_exact() {
        let points = points(50, 3);
        let clusters = cluster(&points, 3, 64);
        assert_eq!(mean_squared_error(&points, 3, &clusters), 0.0);
        let same = cluster(&[0.5; 90], 9, 8);
        assert_eq!(mean_squared_error(&[0.5; 90], 9, &same), 0.0);
    }

    #[test]
    fn separate_heaps_are_found() {
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        let heaps = 400usize;
        let points: Vec<f32> = (0..40_000)
            .flat_map(|i| {
                let heap = i % heaps;
                let mut at = |x: usize| x as f32 + rng.random_range(-0.01..0.01);
                [at(heap % 20), at(heap / 20)]
            })
            .collect();
        // More centres than heaps, and too many comparisons for one set: none is far from its own.
        let clusters = cluster(&points, 2, 1_024);
        assert!(clusters.centroids.len() / 2 <= 1_024);
        let error = mean_squared_error(&points, 2, &clusters);
        assert!(error < 1e-4, "{error}");
    }

    /// The tree loses little against Lloyd's algorithm on everything.
    #[test]
    fn a_divided_set_is_nearly_as_good() {
        let points = points(40_000, 3);
        let tree = mean_squared_error(&points, 3, &cluster(&points, 3, 512));
        let all = Points {
            points: &points,
            width: 3,
        };
        let members: Vec<u32> = (0..40_000).collect();
        let centres = all.lloyd(&members, 512, 1);
        let plain = all.assign(&centres, &members);
        let plain: f64 = plain.iter().map(|part| all.error(part)).sum::<f64>() / 40_000.0;
        assert!(tree < 1.1 * plain, "{tree} {plain}");
    }

    #[test]
    fn threads_do_not_matter() {
        let points = points(20_000, 9);
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            pool.build().unwrap().install(|| cluster(&points, 9, 700))
        };
        let (one, many) = (on(1), on(4));
        assert!(one.labels == many.labels && one.centroids == many.centroids);
    }
}
