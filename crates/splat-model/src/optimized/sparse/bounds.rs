//! Boxes around the groups of rows of a model.

/// Means and scales of a group of Gaussians. Finite, in single precision and rounded outwards, so
/// that a checkpoint keeps it as it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct GroupBox {
    /// Smallest and largest coordinates of the means.
    pub(super) low: [f32; 3],
    pub(super) high: [f32; 3],
    /// The largest scale.
    pub(super) scale: f32,
}

/// Boxes of all groups, as they were at some time; means and scales may have moved since.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Bounds {
    pub(super) boxes: Vec<GroupBox>,
    /// Version of the model that they are of.
    pub(super) version: usize,
    /// Steps of all rows by which the boxes were widened instead of measured again.
    pub(super) widened: usize,
}

impl GroupBox {
    /// Numbers of a box.
    pub(super) const WIDTH: usize = 7;

    /// The box around rows with these means and log-scales, `[n][3]` flattened. Rows with NaN are
    /// never drawn, and left out.
    pub(super) fn around(means: &[f32], log_scales: &[f32]) -> Self {
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for mean in means.as_chunks::<3>().0 {
            for axis in 0..3 {
                low[axis] = low[axis].min(mean[axis]);
                high[axis] = high[axis].max(mean[axis]);
            }
        }
        let largest = log_scales.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let (low, high) = (low.map(f64::from), high.map(f64::from));
        Self::rounded(low, high, f64::from(largest).exp())
    }

    /// The box when means may have moved so far along each axis, and logarithms of scales so much.
    pub(super) fn widened(&self, means: f64, log_scales: f64) -> Self {
        Self::rounded(
            self.low.map(|x| f64::from(x) - means),
            self.high.map(|x| f64::from(x) + means),
            f64::from(self.scale) * log_scales.exp(),
        )
    }

    /// Two steps outwards: one for the rounding here, one for that of values read in single
    /// precision.
    fn rounded(low: [f64; 3], high: [f64; 3], scale: f64) -> Self {
        let down = |x: f64| (x as f32).next_down().next_down();
        let up = |x: f64| (x as f32).next_up().next_up();
        let finite = |x: f32, otherwise: f32| match x.is_finite() {
            true => x,
            false => otherwise,
        };
        Self {
            low: low.map(|x| finite(down(x), f32::MIN)),
            high: high.map(|x| finite(up(x), f32::MAX)),
            // The exponential of a rounded logarithm is off by more.
            scale: finite(up(scale * (1.0 + 1e-5)), f32::MAX),
        }
    }

    pub(super) fn to_array(self) -> [f32; Self::WIDTH] {
        let ([a, b, c], [d, e, f]) = (self.low, self.high);
        [a, b, c, d, e, f, self.scale]
    }

    pub(super) fn from_array([a, b, c, d, e, f, scale]: [f32; Self::WIDTH]) -> Self {
        Self {
            low: [a, b, c],
            high: [d, e, f],
            scale,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_holds_its_rows_and_how_far_they_may_go() {
        let means = [0.0, 1.0, 2.0, -1.0, f32::NAN, 5.0];
        let group = GroupBox::around(&means, &[-1.0, 0.0, f32::NAN, -2.0, 0.5, -9.0]);
        for (axis, (low, high)) in [(-1.0, 0.0), (1.0, 1.0), (2.0, 5.0)]
            .into_iter()
            .enumerate()
        {
            assert!(group.low[axis] < low && group.low[axis] > low - 1e-5);
            assert!(group.high[axis] > high && group.high[axis] < high + 1e-5);
        }
        assert!(group.scale > 0.5f32.exp() && group.scale < 1.0001 * 0.5f32.exp());
        let wide = group.widened(0.5, 0.1);
        assert!(wide.low[0] < -1.4 && wide.high[2] > 5.4);
        assert!((wide.scale / group.scale - 0.1f32.exp()).abs() < 1e-4);
        assert_eq!(GroupBox::from_array(wide.to_array()), wide);
    }

    /// What has no number, or no end, is never left out of a view.
    #[test]
    fn boxes_are_finite() {
        for odd in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let group = GroupBox::around(&[odd; 3], &[odd; 3]);
            assert!(group.to_array().iter().all(|x| x.is_finite()), "{group:?}");
        }
        assert_eq!(
            GroupBox::around(&[0.0; 3], &[f32::NEG_INFINITY; 3]).scale,
            up_from_zero()
        );
    }

    fn up_from_zero() -> f32 {
        0.0f32.next_up().next_up()
    }
}
