use super::*;

const SIZE: ImageSize = ImageSize {
    width: 640,
    height: 480,
};
const INTRINSICS: [f64; 4] = [500.0, 510.0, 330.0, 230.0];

fn lenses() -> Vec<Lens> {
    vec![
        Lens::Pinhole,
        Lens::OpenCv([0.0; 8]),
        Lens::OpenCv([-0.1, 0.02, 1e-3, -2e-3, 0.0, 0.0, 0.0, 0.0]),
        Lens::OpenCv([0.3, 0.1, -2e-3, 1e-3, 0.05, 0.2, 0.01, 0.0]),
        Lens::OpenCv([-0.4, 0.0, 0.01, 0.01, 0.0, 0.0, 0.0, 0.0]),
        Lens::OpenCvFisheye([0.0; 4]),
        Lens::OpenCvFisheye([-0.05, 0.01, -0.002, 1e-4]),
        Lens::OpenCvFisheye([0.1, -0.05, 0.0, 0.0]),
    ]
}

#[test]
fn undistortion_is_the_inverse() {
    for lens in lenses() {
        let mut seen = 0;
        for i in -12..=12 {
            for j in -9..=9 {
                let p = [f64::from(i) * 0.07, f64::from(j) * 0.07, 1.0];
                let Some(point) = lens.distort(p) else {
                    continue;
                };
                seen += 1;
                let [x, y, z] = lens.undistort(point).expect("was seen");
                assert!((x / z - p[0]).abs() < 1e-9, "{lens:?} {p:?}");
                assert!((y / z - p[1]).abs() < 1e-9, "{lens:?} {p:?}");
            }
        }
        assert!(seen > 200, "{lens:?} sees {seen} points");
    }
}

#[test]
fn limits_are_where_the_lens_folds_back() {
    let limit = |lens: Lens| lens.domain(INTRINSICS, SIZE).limit;
    let barrel = |k1| Lens::OpenCv([k1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    // d(r + k1 r^3)/dr = 0
    assert!((limit(barrel(-0.1)) - (1.0 / 0.3f64).sqrt()).abs() < 1e-12);
    assert_eq!(limit(barrel(0.1)), 1e6);
    assert_eq!(limit(barrel(0.0)), 1e6);
    // A pole of the denominator, 1 - q / 4.
    let pole = Lens::OpenCv([0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0]);
    assert!((limit(pole) - 2.0).abs() < 1e-12);
    // Of two roots the nearer: 1 + 3 k1 q + 5 k2 q^2 = (1 - q)(1 - q/4).
    let two = Lens::OpenCv([-1.25 / 3.0, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert!((limit(two) - 1.0).abs() < 1e-12);

    let fisheye = |k1| Lens::OpenCvFisheye([k1, 0.0, 0.0, 0.0]);
    assert!((limit(fisheye(-0.1)) - (1.0 / 0.3f64).sqrt()).abs() < 1e-12);
    assert_eq!(limit(fisheye(0.1)), 175.0f64.to_radians());
}

#[test]
fn a_fisheye_is_drawn_until_it_is_steeper_than_in_the_photo() {
    let limits = |k: [f64; 4]| {
        let lens = Lens::OpenCvFisheye(k);
        let [all, drawn] = [
            lens.domain(INTRINSICS, SIZE),
            lens.photo_domain(INTRINSICS, SIZE),
        ];
        (all.limit, drawn.limit)
    };
    // As steep everywhere, ever flatter, and with a fold.
    for k in [
        [0.0; 4],
        [-0.01, 0.0, 0.0, 0.0],
        [-0.1, 0.0, 0.0, 0.0],
        [-0.02, 0.0, 0.0, -0.001],
    ] {
        let (all, drawn) = limits(k);
        assert_eq!(drawn, all, "{k:?}");
    }
    // 1 + 9 k4 theta^8 is twice what it is at the corner.
    let k4: f64 = 0.01;
    let corner = (330.0f64 / 500.0).hypot(250.0 / 510.0);
    let (all, drawn) = limits([0.0, 0.0, 0.0, k4]);
    let slope = |theta: f64| 1.0 + 9.0 * k4 * theta.powi(8);
    assert_eq!(all, 175f64.to_radians());
    let angle = |distorted: f64| {
        let bend = |theta: f64| theta + k4 * theta.powi(9);
        (0..60).fold((0.0, 2.0), |(low, high), _| {
            let middle = 0.5 * (low + high);
            match bend(middle) < distorted {
                true => (middle, high),
                false => (low, middle),
            }
        })
    };
    let expected = 2.0 * slope(angle(corner).0);
    assert!((slope(drawn) / expected - 1.0).abs() < 1e-9, "{drawn}");

    // Nothing of the photo is lost, however steep it is there.
    for k1 in [0.5, 2.0, 10.0] {
        let lens = Lens::OpenCvFisheye([k1, 0.1, 0.0, 0.0]);
        let (_, drawn) = limits([k1, 0.1, 0.0, 0.0]);
        for corner in super::corners(INTRINSICS, SIZE) {
            let [x, y, z] = lens.undistort(corner).expect("in the domain");
            assert!(x.hypot(y).atan2(z) < drawn, "{k1}");
        }
    }
}

#[test]
fn the_clamp_reaches_beyond_the_corners_and_stays_inside_of_the_limit() {
    let domain = Lens::OpenCv([0.0; 8]).domain(INTRINSICS, SIZE);
    let corner = (330.0f64 / 500.0).hypot(250.0 / 510.0);
    assert!((domain.clamp - 1.15 * corner).abs() < 1e-12);

    // The corner itself is beyond the fold.
    let strong = Lens::OpenCv([-0.6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    let domain = strong.domain(INTRINSICS, SIZE);
    assert_eq!(domain.clamp, 0.999 * domain.limit);
}

#[test]
fn nothing_is_seen_behind_a_perspective_lens_or_beyond_the_fold() {
    let barrel = Lens::OpenCv([-0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert!(barrel.distort([0.1, 0.0, -1.0]).is_none());
    assert!(barrel.distort([1.9, 0.0, 1.0]).is_none());
    assert!(barrel.undistort([10.0, 0.0]).is_none());
    let fisheye = Lens::OpenCvFisheye([0.0; 4]);
    let [a, _] = fisheye.distort([1.0, 0.0, -1.0]).expect("135 degrees");
    assert!((a - 135.0f64.to_radians()).abs() < 1e-12);
    assert!(fisheye.distort([0.01, 0.0, -1.0]).is_none());
}

#[test]
fn no_coefficients_cause_a_panic() {
    let values = [0.0, 1e-300, -1e300, 1e300, f64::NAN, f64::INFINITY, -3.0];
    for value in values {
        for at in 0..8 {
            let mut k = [0.1, -0.2, 1e-3, 0.0, 0.05, -0.1, 0.0, 0.01];
            k[at] = value;
            for lens in [
                Lens::OpenCv(k),
                Lens::OpenCvFisheye([k[0], k[1], k[2], k[3]]),
            ] {
                lens.domain(INTRINSICS, SIZE);
                lens.domain([value, 1.0, value, 0.0], SIZE);
                lens.photo_domain(INTRINSICS, SIZE);
                lens.photo_domain([value, 1.0, value, 0.0], SIZE);
                lens.distort([0.3, 0.1, 1.0]);
                lens.undistort([0.3, value]);
            }
        }
    }
}
