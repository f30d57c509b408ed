//! Ordering of Gaussians that makes neighbours in space neighbours in memory (Morton 1966), by
//! interleaving the bits of the coordinates. A tile then finds its Gaussians in few pages and cache
//! lines.

/// Bits per coordinate: enough to separate neighbours in a box a million times their distance.
const BITS: u32 = 21;

/// Storage order for Gaussians with these means: indices, sorted by code. Means that are not finite
/// come first.
pub(crate) fn order(means: &[[f64; 3]]) -> Vec<usize> {
    let finite = || {
        means
            .iter()
            .filter(|mean| mean.iter().all(|x| x.is_finite()))
    };
    let bound = |choose: fn(f64, f64) -> f64, start: f64| {
        finite().fold([start; 3], |bound, mean| {
            [0, 1, 2].map(|axis| choose(bound[axis], mean[axis]))
        })
    };
    let (low, high) = (bound(f64::min, f64::MAX), bound(f64::max, f64::MIN));
    let cells = f64::from((1u32 << BITS) - 1);
    let code = |mean: &[f64; 3]| {
        let bits = [0, 1, 2].map(|axis| {
            let (low, high) = (low[axis], high[axis]);
            // The cast saturates and maps NaN to zero: for a box without extent, or a mean that is
            // not finite.
            spread(((mean[axis] - low) / (high - low) * cells) as u64)
        });
        bits[0] | bits[1] << 1 | bits[2] << 2
    };
    let codes: Vec<u64> = means.iter().map(code).collect();
    let mut order: Vec<usize> = (0..means.len()).collect();
    order.sort_by_key(|row| codes[*row]);
    order
}

/// Inserts two zeros after every bit of a number of [`BITS`] bits.
fn spread(number: u64) -> u64 {
    let mut bits = number.min((1 << BITS) - 1);
    for (shift, mask) in [
        (32, 0x001f_0000_0000_ffff),
        (16, 0x001f_0000_ff00_00ff),
        (8, 0x100f_00f0_0f00_f00f),
        (4, 0x10c3_0c30_c30c_30c3),
        (2, 0x1249_2492_4924_9249),
    ] {
        bits = (bits | bits << shift) & mask;
    }
    bits
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_spread() {
        for number in [0, 1, 2, 3, 0x12_3456, (1 << BITS) - 1] {
            let slow = (0..BITS).fold(0, |sum, bit| sum | (number >> bit & 1) << (3 * bit));
            assert_eq!(spread(number), slow, "{number:x}");
        }
    }

    /// The cells of a cube are sorted octant by octant, and in each by x, y, z.
    #[test]
    fn octants_stay_together() {
        let cell = |i: usize| [0, 2, 4].map(|shift| ((i * 37 % 64) >> shift & 3) as f64);
        let means: Vec<[f64; 3]> = (0..64).map(cell).collect();
        let order = order(&means);
        for (place, row) in order.iter().enumerate() {
            let octant = means[*row].map(|x| usize::from(x >= 2.0));
            assert_eq!(octant[0] + 2 * octant[1] + 4 * octant[2], place / 8);
            let inside = means[*row].map(|x| x as usize % 2);
            assert_eq!(inside[0] + 2 * inside[1] + 4 * inside[2], place % 8);
        }
    }

    #[test]
    fn every_row_has_a_place_whatever_its_mean() {
        let odd = [
            f64::NAN,
            f64::INFINITY,
            f64::NEG_INFINITY,
            f64::MAX,
            f64::MIN,
            0.0,
        ];
        let means: Vec<[f64; 3]> = odd.iter().map(|x| [1.0, *x, -1.0]).collect();
        for means in [&means[..], &means[..1], &[]] {
            let mut order = order(means);
            order.sort_unstable();
            assert_eq!(order, (0..means.len()).collect::<Vec<_>>());
        }
    }

    #[test]
    fn equal_means_keep_their_order() {
        assert_eq!(order(&[[1.0; 3]; 4]), [0, 1, 2, 3]);
    }
}
