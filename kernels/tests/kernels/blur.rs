//! Tests of the separable window.

use splat_kernels::blur::blur;

use crate::device::{assert_close, client, download, rng, uniform, upload};

#[test]
fn windows_agree_with_float64_also_when_wider_than_the_image() {
    let Some(client) = client() else { return };
    let window: Vec<f32> = vec![0.05, 0.1, 0.2, 0.3, 0.2, 0.1, 0.05];
    for [b, h, w, d] in [[2, 9, 13, 3], [1, 1, 1, 1], [1, 2, 40, 2], [1, 17, 1, 4]] {
        let image = uniform(&mut rng(11), b * h * w * d, -1.0, 1.0);
        let at = |bi: usize, y: isize, x: isize, di: usize| -> f64 {
            if y < 0 || x < 0 || y >= h as isize || x >= w as isize {
                return 0.0;
            }
            f64::from(image[((bi * h + y as usize) * w + x as usize) * d + di])
        };
        let mut expected = Vec::new();
        for i in 0..b * h * w * d {
            let (di, x, y, bi) = (i % d, i / d % w, i / d / w % h, i / d / w / h);
            let mut sum = 0.0;
            for (ky, wy) in window.iter().enumerate() {
                for (kx, wx) in window.iter().enumerate() {
                    sum += f64::from(*wy)
                        * f64::from(*wx)
                        * at(
                            bi,
                            y as isize + ky as isize - 3,
                            x as isize + kx as isize - 3,
                            di,
                        );
                }
            }
            expected.push(sum);
        }
        let blurred = download(
            &client,
            &blur(&client, &upload(&client, &image), h, w, d, &window),
        );
        assert_close(&format!("{b}x{h}x{w}x{d}"), &blurred, &expected, 1e-6);
    }
}
