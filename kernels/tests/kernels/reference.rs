//! The formulas of the kernels in float64, without tiles and as simple as possible.

#[derive(Clone, Copy)]
pub struct View {
    pub width: usize,
    pub height: usize,
    pub near: f64,
    pub far: f64,
    pub eps2d: f64,
    pub margin: f64,
    pub alpha_min: f64,
}

impl View {
    pub fn new(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            near: 0.01,
            far: 1e10,
            eps2d: 0.3,
            margin: 0.15,
            alpha_min: splat_core::ALPHA_MIN,
        }
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Projects one Gaussian to one camera: the packed row, zero if culled.
pub fn project(
    mean: &[f64],
    quat: &[f64],
    scale: &[f64],
    viewmat: &[f64],
    intrinsics: &[f64],
    view: &View,
) -> [f64; 9] {
    let w: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| viewmat[i * 4 + j]));
    let p: [f64; 3] =
        std::array::from_fn(|i| dot(w[i], [mean[0], mean[1], mean[2]]) + viewmat[i * 4 + 3]);
    let [x, y, z] = p;
    let [fx, fy, cx, cy] = [intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]];
    let length = quat.iter().map(|v| v * v).sum::<f64>().sqrt();
    if !(z >= view.near && z <= view.far && length > 0.0) {
        return [0.0; 9];
    }
    let (sx, sy) = (view.width as f64, view.height as f64);
    let m = view.margin;
    let u = (x / z).clamp(-(cx + m * sx) / fx, (sx - cx + m * sx) / fx);
    let v = (y / z).clamp(-(cy + m * sy) / fy, (sy - cy + m * sy) / fy);
    let [qw, qx, qy, qz] = std::array::from_fn(|i| quat[i] / length);
    let r = [
        [
            1.0 - 2.0 * (qy * qy + qz * qz),
            2.0 * (qx * qy - qw * qz),
            2.0 * (qx * qz + qw * qy),
        ],
        [
            2.0 * (qx * qy + qw * qz),
            1.0 - 2.0 * (qx * qx + qz * qz),
            2.0 * (qy * qz - qw * qx),
        ],
        [
            2.0 * (qx * qz - qw * qy),
            2.0 * (qy * qz + qw * qx),
            1.0 - 2.0 * (qx * qx + qy * qy),
        ],
    ];
    let j = [[fx / z, 0.0, -fx * u / z], [0.0, fy / z, -fy * v / z]];
    // V = J W R diag(s)
    let rows: [[f64; 3]; 2] = std::array::from_fn(|i| {
        let jw: [f64; 3] = std::array::from_fn(|k| (0..3).map(|l| j[i][l] * w[l][k]).sum());
        std::array::from_fn(|k| (0..3).map(|l| jw[l] * r[l][k]).sum::<f64>() * scale[k])
    });
    let [v1, v2] = rows;
    let minors = [
        v1[1] * v2[2] - v1[2] * v2[1],
        v1[2] * v2[0] - v1[0] * v2[2],
        v1[0] * v2[1] - v1[1] * v2[0],
    ];
    let e = view.eps2d;
    let a = dot(v1, v1) + e;
    let b = dot(v1, v2);
    let det = dot(minors, minors) + e * (dot(v1, v1) + dot(v2, v2)) + e * e;
    let w22 = (a / det).sqrt();
    let reach = (2.0 * (1.0 / view.alpha_min).ln()).sqrt();
    let row = [
        fx * x / z + cx,
        fy * y / z + cy,
        z,
        1.0 / a.sqrt(),
        -(b / a) * w22,
        w22,
        (dot(minors, minors) / det).sqrt(),
        reach * a.sqrt(),
        reach * (dot(v2, v2) + e).sqrt(),
    ];
    let on_screen = row[0] + row[7] > 0.0
        && row[0] - row[7] < sx
        && row[1] + row[8] > 0.0
        && row[1] - row[8] < sy;
    if on_screen && row.iter().all(|v| v.is_finite()) {
        row
    } else {
        [0.0; 9]
    }
}

/// o exp(-sigma) of a packed row at a pixel centre.
pub fn raw_alpha(row: &[f64], opacity: f64, x: f64, y: f64) -> f64 {
    let (dx, dy) = (x - row[0], y - row[1]);
    let z1 = row[3] * dx;
    let z2 = row[4] * dx + row[5] * dy;
    opacity * (-0.5 * (z1 * z1 + z2 * z2)).exp()
}

/// The image [H, W, D + 1] of one camera.
pub fn rasterize(
    packed: &[f64],
    colors: &[f64],
    opacities: &[f64],
    background: &[f64],
    view: &View,
) -> Vec<f64> {
    let channels = background.len();
    let mut order: Vec<usize> = (0..opacities.len())
        .filter(|n| packed[n * 9 + 7] > 0.0)
        .collect();
    order.sort_by(|a, b| packed[a * 9 + 2].total_cmp(&packed[b * 9 + 2]));
    let mut image = Vec::with_capacity(view.width * view.height * (channels + 1));
    for py in 0..view.height {
        for px in 0..view.width {
            let mut t = 1.0;
            let mut sum = vec![0.0; channels];
            for &n in &order {
                let raw = raw_alpha(
                    &packed[n * 9..n * 9 + 9],
                    opacities[n],
                    px as f64 + 0.5,
                    py as f64 + 0.5,
                );
                if raw < view.alpha_min {
                    continue;
                }
                let alpha = raw.min(0.99);
                if t * (1.0 - alpha) < 9.999e-5 {
                    break;
                }
                for (channel, sum) in sum.iter_mut().enumerate() {
                    *sum += t * alpha * colors[n * channels + channel];
                }
                t *= 1.0 - alpha;
            }
            image.extend(sum.iter().zip(background).map(|(sum, back)| sum + t * back));
            image.push(1.0 - t);
        }
    }
    image
}

/// Colour in one direction, from 3DGS's table.
pub fn spherical_harmonics(coefficients: &[f64], dir: &[f64], degree: usize) -> [f64; 3] {
    let length = dir.iter().map(|v| v * v).sum::<f64>().sqrt();
    let [x, y, z] = std::array::from_fn(|i| if length > 0.0 { dir[i] / length } else { 0.0 });
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let basis = [
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3.0 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4.0 * zz - xx - yy),
        0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.4570457994644658 * x * (4.0 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3.0 * yy),
    ];
    std::array::from_fn(|channel| {
        (0..(degree + 1) * (degree + 1))
            .map(|k| basis[k] * coefficients[k * 3 + channel])
            .sum()
    })
}
