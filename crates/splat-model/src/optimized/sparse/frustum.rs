//! What a camera cannot see: a test of boxes of Gaussians that never loses one that the projection
//! would draw.
//!
//! A splat is drawn when its mean, plus or minus its extent, touches the image (`project`). With
//! `reach` standard deviations in an extent and `b` the deviation of the low-pass filter, the
//! extent along x is at most `reach (|J1| s + b)` pixels, s the largest scale and J1 the first row
//! of the camera's Jacobian.
//!
//! - A pinhole has `J1 = fx/z (w1 - u w3)`, with u in the bounds of the clamp. Times z, "left of
//!   the right edge" becomes linear: `fx x - (W - cx + reach b) z < reach fx max|w1 - u w3| s`. So
//!   each edge of the image is a half-space.
//! - A perspective lens with distortion bends the edges. The directions from which an extent
//!   reaches the image are found by trying a grid of them, for some ratios of scale to distance;
//!   outside of the half-spaces around these nothing of such a ratio is seen.
//! - A fisheye sees behind the image plane, where half-spaces do not help: its directions lie
//!   between some angles from the axis. Those right behind the camera may be among them, where the
//!   Jacobian has no bound.

use core::f64::consts::{FRAC_PI_2, TAU};

use splat_data::{Camera, Lens};
use splat_ops::ProjectSettings;

use super::bounds::GroupBox;

/// Relative error that rounding to single precision may cause, generously.
const ROUNDING: f64 = 1e-5;
/// Ratios of scale to distance for which directions are tried.
const RATIOS: [f64; 6] = [0.001, 0.004, 0.016, 0.064, 0.25, 1.0];
/// Directions of the half-spaces around a distorted image.
const SIDES: usize = 16;
/// Directions from the axis that are tried, and angles along each.
const AZIMUTHS: usize = 64;
const ANGLES: usize = 192;
/// Steps between angles and directions that a tried point stands for, on both sides.
const CELL: f64 = 1.5;
/// Factor for what lies between the points at which a Jacobian is evaluated.
const JACOBIAN_SLACK: f64 = 1.5;

/// A camera, as a test of boxes.
#[derive(Debug, Clone)]
pub(super) struct Frustum {
    /// Rows of the rotation, and the translation.
    w: [[f64; 3]; 3],
    t: [f64; 3],
    near: f64,
    far: f64,
    shape: Shape,
}

#[derive(Debug, Clone)]
enum Shape {
    Pinhole {
        depth: Linear,
        /// One for each edge of the image.
        edges: [HalfSpace; 4],
    },
    Bent {
        depth: Linear,
        lens: Bent,
        /// Outside of which a level of the lens sees nothing, where not below zero.
        sides: Vec<[Linear; SIDES]>,
    },
    Fisheye(Bent),
    /// Nothing is known.
    Unknown,
}

/// A linear function of a position in the world.
#[derive(Debug, Clone, Copy)]
struct Linear {
    along: [f64; 3],
    offset: f64,
}

/// Outside where the function is at least `per_scale` times the scale.
#[derive(Debug, Clone, Copy)]
struct HalfSpace {
    function: Linear,
    per_scale: f64,
}

/// A lens with distortion: the directions that it sees, by ratio.
#[derive(Debug, Clone)]
struct Bent {
    levels: Vec<Level>,
}

/// The directions from which Gaussians up to a ratio of scale to distance reach the image.
#[derive(Debug, Clone)]
struct Level {
    ratio: f64,
    /// Half-spaces around them: largest `cos(k) x/z + sin(k) y/z`.
    sides: [f64; SIDES],
    /// The angles from the axis, in order, as intervals that do not touch.
    angles: Vec<[f64; 2]>,
}

impl Frustum {
    pub(super) fn new(camera: &Camera, settings: &ProjectSettings) -> Self {
        let row = |i: usize| camera.viewmat.row(i).truncate().to_array();
        let mut frustum = Self {
            w: [row(0), row(1), row(2)],
            t: [0, 1, 2].map(|i| camera.viewmat.row(i).w),
            near: settings.near,
            far: settings.far,
            shape: Shape::Unknown,
        };
        let [fx, fy, ..] = camera.intrinsics;
        if !(fx > 0.0 && fy > 0.0 && settings.near > 0.0) {
            return frustum;
        }
        let depth = frustum.linear([0.0, 0.0, 1.0]);
        frustum.shape = match camera.lens {
            Lens::Pinhole => Shape::Pinhole {
                depth,
                edges: frustum.edges(camera, settings),
            },
            Lens::OpenCv(_) | Lens::OpenCvFisheye(_) => {
                let fisheye = matches!(camera.lens, Lens::OpenCvFisheye(_));
                match bent(camera, &frustum.w, settings) {
                    None => Shape::Unknown,
                    Some(lens) if fisheye => Shape::Fisheye(lens),
                    Some(lens) => Shape::Bent {
                        depth,
                        sides: lens
                            .levels
                            .iter()
                            .map(|level| frustum.sides(level))
                            .collect(),
                        lens,
                    },
                }
            }
        };
        frustum
    }

    /// `normal . p`, p in camera space.
    fn linear(&self, normal: [f64; 3]) -> Linear {
        let sum = |of: &dyn Fn(usize) -> f64| (0..3).map(|i| normal[i] * of(i)).sum();
        Linear {
            along: [0, 1, 2].map(|axis| sum(&|i| self.w[i][axis])),
            offset: sum(&|i| self.t[i]),
        }
    }

    fn edges(&self, camera: &Camera, settings: &ProjectSettings) -> [HalfSpace; 4] {
        let [fx, fy, cx, cy] = camera.intrinsics;
        let (reach, blur) = reach(settings);
        let edge = |axis: usize, f: f64, c: f64, side: u32, sign: f64| {
            let side = f64::from(side);
            let margin = settings.clamp_margin * side;
            // The norm is convex in u, so it is largest at an end.
            let steepest = [-(c + margin) / f, (side - c + margin) / f]
                .map(|u| norm([0, 1, 2].map(|i| self.w[axis][i] - u * self.w[2][i])))
                .into_iter()
                .fold(0.0, f64::max);
            let mut normal = [0.0; 3];
            normal[axis] = sign * f;
            normal[2] = if sign > 0.0 {
                -(side - c + blur)
            } else {
                -(c + blur)
            };
            HalfSpace {
                function: self.linear(normal),
                per_scale: (1.0 + ROUNDING) * reach * f * steepest,
            }
        };
        let (width, height) = (camera.size.width, camera.size.height);
        [
            edge(0, fx, cx, width, 1.0),
            edge(0, fx, cx, width, -1.0),
            edge(1, fy, cy, height, 1.0),
            edge(1, fy, cy, height, -1.0),
        ]
    }

    fn sides(&self, level: &Level) -> [Linear; SIDES] {
        core::array::from_fn(|side| {
            let (sin, cos) = azimuth(side as f64, SIDES).sin_cos();
            self.linear([cos, sin, -level.sides[side]])
        })
    }

    /// True if the camera sees no Gaussian of the group. Comparisons are written so that NaN is
    /// seen.
    pub(super) fn misses(&self, group: &GroupBox) -> bool {
        let scale = f64::from(group.scale);
        match &self.shape {
            Shape::Unknown => false,
            Shape::Pinhole { depth, edges } => {
                let [low, high] = depth.range(group);
                high < self.near
                    || low > self.far
                    || (edges.iter())
                        .any(|edge| edge.function.range(group)[0] >= edge.per_scale * scale)
            }
            Shape::Bent { depth, lens, sides } => {
                let [low, high] = depth.range(group);
                high < self.near
                    || low > self.far
                    || (lens.level(scale, low.max(self.near)))
                        .and_then(|level| sides.get(level))
                        .is_some_and(|sides| sides.iter().any(|side| side.range(group)[0] >= 0.0))
            }
            Shape::Fisheye(lens) => self.between_angles(lens, group),
        }
    }

    /// True if the lens sees no angle of those that a sphere around the box has.
    fn between_angles(&self, bent: &Bent, group: &GroupBox) -> bool {
        let (low, high) = (group.low.map(f64::from), group.high.map(f64::from));
        let middle = [0, 1, 2].map(|i| 0.5 * (low[i] + high[i]));
        let half = [0, 1, 2].map(|i| 0.5 * (high[i] - low[i]));
        let p = [0, 1, 2].map(|i| dot(self.w[i], middle) + self.t[i]);
        let distance = norm(p);
        let size = norm(middle) + norm(self.t) + norm(half);
        let radius = stretch(&self.w) * norm(half) + ROUNDING * size;
        let nearest = distance - radius;
        if distance + radius < self.near || nearest > self.far {
            return true;
        }
        let level = bent.level(group.scale.into(), nearest.max(self.near));
        let Some(level) = level.and_then(|level| bent.levels.get(level)) else {
            return false;
        };
        // The sphere around the box must not contain the camera.
        if !(nearest > 0.0) {
            return false;
        }
        let angle = p[0].hypot(p[1]).atan2(p[2]);
        let width = (radius / distance).asin();
        let apart = |seen: &[f64; 2]| seen[1] < angle - width || seen[0] > angle + width;
        level.angles.iter().all(apart)
    }
}

impl Bent {
    /// The level of a group with this largest scale, nowhere nearer than `nearest`.
    fn level(&self, scale: f64, nearest: f64) -> Option<usize> {
        let ratio = (1.0 + ROUNDING) * scale / nearest;
        self.levels.iter().position(|level| ratio <= level.ratio)
    }
}

impl Linear {
    /// Least and largest value in a box, with room for rounding.
    fn range(&self, group: &GroupBox) -> [f64; 2] {
        let (mut low, mut high, mut size) = (self.offset, self.offset, self.offset.abs());
        for axis in 0..3 {
            let a = self.along[axis] * f64::from(group.low[axis]);
            let b = self.along[axis] * f64::from(group.high[axis]);
            low += a.min(b);
            high += a.max(b);
            size += a.abs().max(b.abs());
        }
        [low - ROUNDING * size, high + ROUNDING * size]
    }
}

/// Standard deviations in an extent, and the pixels that the low-pass filter adds to one.
fn reach(settings: &ProjectSettings) -> (f64, f64) {
    let reach = (-2.0 * settings.alpha_min.ln()).max(0.0).sqrt();
    (reach, reach * settings.eps2d.sqrt())
}

/// `None` where the lens sees nothing, which is too odd to rely on.
fn bent(camera: &Camera, w: &[[f64; 3]; 3], settings: &ProjectSettings) -> Option<Bent> {
    let Camera {
        intrinsics: [fx, fy, cx, cy],
        lens,
        size,
        ..
    } = *camera;
    let fisheye = matches!(lens, Lens::OpenCvFisheye(_));
    let domain = lens.photo_domain(camera.intrinsics, size);
    let (reach, blur) = reach(settings);
    let growth = reach * fx.max(fy) * JACOBIAN_SLACK * stretch(w);

    let mut levels = RATIOS.map(|ratio| Level {
        ratio,
        sides: [f64::NEG_INFINITY; SIDES],
        angles: Vec::new(),
    });
    let last = if fisheye {
        domain.limit
    } else {
        domain.limit.atan()
    };
    // Half of the angles where the image is, if that is known, half beyond.
    let inner = match fisheye {
        true => 0.5 * last,
        false => (2.0 * domain.clamp).atan().min(0.5 * last).max(0.0),
    };
    let angle = |step: f64| {
        let half = 0.5 * ANGLES as f64;
        let angle = match step < half {
            true => inner * step / half,
            false => inner + (last - inner) * (step - half) / half,
        };
        // `clamp` would not have a limit of NaN.
        angle.min(last).max(0.0)
    };
    let bounded = lens.bounded();
    for i in 0..ANGLES {
        let middle = i as f64 + 0.5;
        let (sin, cos) = angle(middle).sin_cos();
        let ends = [angle(middle - CELL), angle(middle + CELL)];
        for j in 0..AZIMUTHS {
            let direction = azimuth(j as f64, AZIMUTHS);
            let (across, along) = direction.sin_cos();
            let Some([a, b]) = bounded.distort([sin * along, sin * across, cos]) else {
                continue;
            };
            let (x, y) = (fx * a + cx, fy * b + cy);
            let beyond = |value: f64, side: u32| (-value).max(value - f64::from(side));
            let outside = beyond(x, size.width).max(beyond(y, size.height));
            let slope = growth * steepness(&lens, domain.clamp, angle(middle), [along, across]);
            for level in &mut levels {
                // NaN is seen.
                if outside > slope * level.ratio + blur {
                    continue;
                }
                match fisheye {
                    true => level.include_angles(ends),
                    false => level.include(direction, ends),
                }
            }
        }
    }
    let sees = |level: &Level| !level.angles.is_empty() || level.sides[0] > f64::NEG_INFINITY;
    levels.iter().all(sees).then(|| Bent {
        levels: levels.to_vec(),
    })
}

impl Level {
    /// Adds angles, none of which are below those added before.
    fn include_angles(&mut self, [from, to]: [f64; 2]) {
        match self.angles.last_mut() {
            Some(last) if from <= last[1] => last[1] = last[1].max(to),
            _ => self.angles.push([from, to]),
        }
    }

    /// Widens the half-spaces to hold the cell around a direction, between two angles.
    fn include(&mut self, direction: f64, angles: [f64; 2]) {
        let radii = angles.map(|angle| angle.min(FRAC_PI_2 - 1e-9).tan());
        for (side, most) in self.sides.iter_mut().enumerate() {
            let turn = (direction - azimuth(side as f64, SIDES)).abs();
            let turn = turn.min(TAU - turn) - CELL * azimuth(1.0, AZIMUTHS);
            let cos = turn.max(0.0).cos();
            *most = most.max(radii[0] * cos).max(radii[1] * cos);
        }
    }
}

fn azimuth(index: f64, count: usize) -> f64 {
    TAU * index / count as f64
}

/// Largest length of a row of the Jacobian of a lens at depth 1 (at distance 1 for a fisheye), at
/// this angle from the axis and in this direction around it; that of a perspective lens where the
/// projection evaluates it, at the clamp at most.
fn steepness(lens: &Lens, clamp: f64, angle: f64, [cos, sin]: [f64; 2]) -> f64 {
    match lens {
        Lens::Pinhole => f64::INFINITY,
        Lens::OpenCv([k1, k2, p1, p2, k3, k4, k5, k6]) => {
            let radius = angle.tan().min(clamp);
            let (a, b, q) = (radius * cos, radius * sin, radius * radius);
            let polynomial = |[x, y, z]: [&f64; 3]| {
                let value = 1.0 + q * (x + q * (y + q * z));
                (value, x + q * (2.0 * y + 3.0 * q * z))
            };
            let (above, rising) = polynomial([k1, k2, k3]);
            let (below, falling) = polynomial([k4, k5, k6]);
            let l = above / below;
            let l1 = (rising - l * falling) / below;
            let d11 = l + 2.0 * a * a * l1 + 2.0 * p1 * b + 6.0 * p2 * a;
            let d12 = 2.0 * (a * b * l1 + p1 * a + p2 * b);
            let d22 = l + 2.0 * b * b * l1 + 6.0 * p1 * b + 2.0 * p2 * a;
            let row = |x: f64, y: f64| norm([x, y, x * a + y * b]);
            row(d11, d12).max(row(d12, d22))
        }
        Lens::OpenCvFisheye([k1, k2, k3, k4]) => {
            let u = angle * angle;
            let slope = 1.0 + u * (3.0 * k1 + u * (5.0 * k2 + u * (7.0 * k3 + u * 9.0 * k4)));
            let bent = angle * (1.0 + u * (k1 + u * (k2 + u * (k3 + u * k4))));
            // Away from the axis and around it.
            slope.abs().max((bent / angle.sin()).abs())
        }
    }
}

/// Most by which a matrix makes a vector longer: 1 for a rotation.
fn stretch(w: &[[f64; 3]; 3]) -> f64 {
    let is_rotation = (0..3).all(|i| {
        (0..3).all(|j| {
            let expected = if i == j { 1.0 } else { 0.0 };
            (dot(w[i], w[j]) - expected).abs() < 1e-4
        })
    });
    match is_rotation {
        true => 1.001,
        false => w.iter().map(|row| dot(*row, *row)).sum::<f64>().sqrt(),
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}
