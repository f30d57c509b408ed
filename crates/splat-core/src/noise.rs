//! Random numbers that are a function of where they are used, the same on every device.

/// Noise of this share of a Gaussian's size is not worth its draws.
pub const NEGLIGIBLE_NOISE: f64 = 1e-12;

/// Four random words, a hash of four words (`pcg4d` of Jarzynski & Olano 2020, *Hash Functions for
/// GPU Rendering*): multiplications and additions of 32 bits alone, which every device has.
pub const fn pcg4d(words: [u32; 4]) -> [u32; 4] {
    let [mut x, mut y, mut z, mut w] = words;
    x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    y = y.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    z = z.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    w = w.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    let mut round = 0;
    while round < 2 {
        x = x.wrapping_add(y.wrapping_mul(w));
        y = y.wrapping_add(z.wrapping_mul(x));
        z = z.wrapping_add(x.wrapping_mul(y));
        w = w.wrapping_add(y.wrapping_mul(z));
        if round == 0 {
            x ^= x >> 16;
            y ^= y >> 16;
            z ^= z >> 16;
            w ^= w >> 16;
        }
        round += 1;
    }
    [x, y, z, w]
}

/// Three standard normal draws, from four random words by the method of Box and Muller. Each word
/// gives 24 bits.
pub fn normals(words: [u32; 4]) -> [f64; 3] {
    let [a, b, c, d] = words.map(|word| (f64::from(word >> 8) + 0.5) / f64::from(1 << 24));
    let [first, second] = [a, c].map(|u| (-2.0 * u.ln()).sqrt());
    let [angle, other] = [b, d].map(|u| core::f64::consts::TAU * u);
    [
        first * angle.cos(),
        first * angle.sin(),
        second * other.cos(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_are_normal_and_independent() {
        const COUNT: u32 = 200_000;
        let mut moments = [[0.0; 4]; 3];
        let mut products = [0.0; 4];
        let mut before = [0.0; 3];
        for id in 0..COUNT {
            let draws = normals(pcg4d([id, 7, 3, 0]));
            for (moments, x) in moments.iter_mut().zip(draws) {
                for (power, moment) in moments.iter_mut().enumerate() {
                    *moment += x.powi(power as i32 + 1) / f64::from(COUNT);
                }
            }
            let [x, y, z] = draws;
            for (product, value) in products
                .iter_mut()
                .zip([x * y, y * z, x * z, x * before[0]])
            {
                *product += value / f64::from(COUNT);
            }
            before = draws;
        }
        // Five standard errors of each.
        let error = |variance: f64| 5.0 * (variance / f64::from(COUNT)).sqrt();
        for [mean, square, cube, fourth] in moments {
            assert!(mean.abs() < error(1.0), "{mean}");
            assert!((square - 1.0).abs() < error(2.0), "{square}");
            assert!(cube.abs() < error(15.0), "{cube}");
            assert!((fourth - 3.0).abs() < error(96.0), "{fourth}");
        }
        for product in products {
            assert!(product.abs() < error(1.0), "{product}");
        }
    }

    /// Any one bit of a word changes many bits of the result: the highest ones fewest, 29 of 128.
    #[test]
    fn every_word_counts() {
        let words = [12, 345, 6, 0];
        let plain = pcg4d(words);
        for word in 0..4 {
            for bit in 0..32 {
                let mut other = words;
                other[word] ^= 1 << bit;
                let other = pcg4d(other);
                let changed: u32 = plain
                    .iter()
                    .zip(other)
                    .map(|(a, b)| (a ^ b).count_ones())
                    .sum();
                assert!(changed > 24, "word {word}, bit {bit}: {changed} of 128");
            }
        }
    }
}
