//! The lenses against `splat_core`'s definition and against central differences, in double
//! precision; and in single precision against double.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use splat_core::{CameraModel, Lens};

use super::super::real::Real;
use super::camera::COEFFICIENTS;
use super::distorted::{Bend, Plane};
use super::fisheye::OpenCvFisheye;
use super::opencv::OpenCv;

const BARREL: [f64; 8] = [-0.2, 0.03, 1e-3, -2e-3, 0.0, 0.0, 0.0, 0.0];
const RATIONAL: [f64; 8] = [0.3, 0.1, -2e-3, 1e-3, 0.05, 0.2, 0.01, 0.004];
const WIDE: [f64; 4] = [-0.02, 0.005, -0.001, 5e-5];
const BENT: [f64; 4] = [0.1, -0.04, 0.01, -0.002];

fn lenses() -> Vec<Lens> {
    vec![
        Lens::OpenCv([0.0; 8]),
        Lens::OpenCv(BARREL),
        Lens::OpenCv(RATIONAL),
        Lens::OpenCvFisheye([0.0; 4]),
        Lens::OpenCvFisheye(WIDE),
        Lens::OpenCvFisheye(BENT),
    ]
}

/// Domain for the tests: a clamp that some points are beyond.
fn domain(lens: &Lens) -> [f64; 2] {
    let size = splat_core::ImageSize {
        width: 8,
        height: 8,
    };
    [lens.domain([8.0, 8.0, 4.0, 4.0], size).limit, 0.7]
}

/// Values of a plane in one row.
fn row<T: Real>(plane: &Plane<T>) -> [f64; 9] {
    let [a, b] = plane.jacobian;
    let [x, y] = plane.point;
    [x, y, plane.depth, a[0], a[1], a[2], b[0], b[1], b[2]].map(Real::wide)
}

fn plane<T: Real>(lens: &Lens, p: [f64; 3]) -> Plane<T> {
    let k: Vec<T> = lens.coefficients().iter().map(|k| T::of(*k)).collect();
    let (domain, p) = (domain(lens).map(T::of), p.map(T::of));
    match lens.model() {
        CameraModel::OpenCv => OpenCv::new(&k, &domain).plane(p),
        _ => OpenCvFisheye::new(&k, &domain).plane(p),
    }
}

fn backward<T: Real>(lens: &Lens, p: [f64; 3], g: [f64; 9]) -> [f64; 3 + COEFFICIENTS] {
    let k: Vec<T> = lens.coefficients().iter().map(|k| T::of(*k)).collect();
    let (domain, p, g) = (domain(lens).map(T::of), p.map(T::of), g.map(T::of));
    let (point, depth) = ([g[0], g[1]], g[2]);
    let jacobian = [[g[3], g[4], g[5]], [g[6], g[7], g[8]]];
    let (dp, dk) = match lens.model() {
        CameraModel::OpenCv => OpenCv::new(&k, &domain).plane_backward(p, point, depth, jacobian),
        _ => OpenCvFisheye::new(&k, &domain).plane_backward(p, point, depth, jacobian),
    };
    let mut all = [0.0; 3 + COEFFICIENTS];
    for (to, from) in all.iter_mut().zip(dp.into_iter().chain(dk)) {
        *to = from.wide();
    }
    all
}

/// Points in view of every lens: near the axis, at its series' end, and far out; beyond the clamp
/// for the perspective lenses, behind the image plane for fisheyes.
fn points(lens: &Lens) -> Vec<[f64; 3]> {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let most = match lens.model() {
        CameraModel::OpenCv => domain(lens)[0].min(1.4).atan(),
        _ => domain(lens)[0].min(3.0),
    };
    let mut points = vec![[0.0, 0.0, 2.0], [1e-9, -2e-9, 1.5], [1e-4, 2e-4, 1.0]];
    for step in 1..60 {
        let theta = most * 0.98 * f64::from(step) / 60.0;
        let phi = rng.random_range(0.0..std::f64::consts::TAU);
        let r = rng.random_range(0.5..3.0);
        points.push([
            r * theta.sin() * phi.cos(),
            r * theta.sin() * phi.sin(),
            r * theta.cos(),
        ]);
    }
    points
}

#[test]
fn points_fall_where_the_definition_says() {
    for lens in lenses() {
        for p in points(&lens) {
            let got = plane::<f64>(&lens, p);
            assert!(got.inside, "{lens:?} {p:?}");
            let [x, y] = lens.distort(p).expect("inside");
            assert!(
                (got.point[0] - x).abs() <= 2e-15 * (1.0 + x.abs()),
                "{lens:?} {p:?}"
            );
            assert!(
                (got.point[1] - y).abs() <= 2e-15 * (1.0 + y.abs()),
                "{lens:?} {p:?}"
            );
            assert!((got.depth - lens.depth(p)).abs() < 1e-14);
        }
    }
}

/// Inside the clamp, the Jacobian is that of the point.
#[test]
fn jacobians_are_derivatives_of_the_point() {
    for lens in lenses() {
        for p in points(&lens) {
            let perspective = lens.model() == CameraModel::OpenCv;
            if perspective && p[0].hypot(p[1]) / p[2] > 0.69 {
                continue;
            }
            let jacobian = plane::<f64>(&lens, p).jacobian;
            for axis in 0..3 {
                let h = 1e-6;
                let at = |sign: f64| {
                    let mut moved = p;
                    moved[axis] += sign * h;
                    plane::<f64>(&lens, moved).point
                };
                let (up, down) = (at(1.0), at(-1.0));
                for i in 0..2 {
                    let difference = (up[i] - down[i]) / (2.0 * h);
                    let error = (difference - jacobian[i][axis]).abs();
                    assert!(error < 1e-8, "{lens:?} {p:?} {i} {axis}: {error:e}");
                }
            }
        }
    }
}

#[test]
fn gradients_are_those_of_central_differences() {
    let mut rng = Pcg64Mcg::seed_from_u64(7);
    for lens in lenses() {
        for p in points(&lens) {
            let g: [f64; 9] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
            let functional = |lens: &Lens, p: [f64; 3]| -> f64 {
                row(&plane::<f64>(lens, p))
                    .iter()
                    .zip(g)
                    .map(|(v, g)| v * g)
                    .sum()
            };
            let got = backward::<f64>(&lens, p, g);
            let count = 3 + lens.coefficients().len();
            for i in 0..count {
                let h = 1e-6;
                let at = |sign: f64| {
                    let (mut moved, mut k) = (p, lens.coefficients().to_vec());
                    if i < 3 {
                        moved[i] += sign * h;
                    } else {
                        k[i - 3] += sign * h;
                    }
                    functional(&Lens::new(lens.model(), &k).unwrap(), moved)
                };
                let difference = (at(1.0) - at(-1.0)) / (2.0 * h);
                let error = (difference - got[i]).abs() / (1.0 + got[i].abs());
                assert!(error < 1e-7, "{lens:?} {p:?} {i}: {} {difference}", got[i]);
            }
        }
    }
}

#[test]
fn single_precision_keeps_up() {
    let mut rng = Pcg64Mcg::seed_from_u64(9);
    for lens in lenses() {
        for p in points(&lens) {
            // Values that both precisions hold.
            let p = p.map(|x| f64::from(x as f32));
            let g: [f64; 9] = std::array::from_fn(|_| f64::from(rng.random_range(-1.0f32..1.0)));
            let distance = |a: &[f64], b: &[f64]| {
                let norm = b.iter().map(|b| b * b).sum::<f64>().sqrt();
                let off = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
                off.sqrt() / norm
            };
            let forward = distance(&row(&plane::<f32>(&lens, p)), &row(&plane::<f64>(&lens, p)));
            assert!(forward < 1e-6, "{lens:?} {p:?}: {forward:e}");
            let gradient = distance(&backward::<f32>(&lens, p, g), &backward::<f64>(&lens, p, g));
            assert!(gradient < 2e-5, "{lens:?} {p:?}: {gradient:e}");
        }
    }
}
