//! Which Gaussians need which degree of spherical harmonics (reduced-3dgs, Papantonakis et al.
//! 2024, section 4.2), and the step that drops the rest.
//!
//! Over all training views, with the weight of a Gaussian in a view and its colours `C_d` at degree
//! d in the direction of that view:
//! - where the weighted standard deviation of its colour, as a mean of the three channels, is below
//!   a threshold, it gets degree 0 and its weighted mean colour;
//! - else the lowest degree d of 1 and 2 for which the weighted mean of `|C_3 - C_d|` is below
//!   another threshold.
//!
//! The paper's weight is the mean transmittance over the pixels that a Gaussian touches. Ours is
//! the sum over pixels of its share in them ([`weighted_contributions`]), which also counts its
//! opacity and how large it is there: a view that shows it from afar says less. The second mean of
//! the paper is over views and multiplied by the transmittance, which is at most 1 and makes
//! hidden Gaussians simpler; ours is divided by the weights, so that the thresholds are levels of
//! colour whatever the size of photos and Gaussians.

use burn::tensor::{Tensor, TensorData};
use derive_setters::Setters;
use serde::{Deserialize, Serialize};
use splat_core::SH_C0;
use splat_ops::device::to_host;
use splat_ops::{OpError, SH_DEGREE_MAX};

use crate::sh_degrees::rows_of_degrees;
use crate::strategy::weighted_contributions;
use crate::{
    CameraTensors, Optimized, RenderSettings, SH_COEFFICIENTS, SplatModel, project_gaussians,
};

/// When degrees of spherical harmonics are lowered in a run, and how much may be lost by it.
///
/// ```
/// use splat_model::ShReductionSettings;
///
/// let settings = ShReductionSettings::new().with_std(0.06);
/// assert_eq!((settings.at, settings.std), (0.5, 0.06));
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Setters)]
#[serde(default, deny_unknown_fields)]
#[setters(prefix = "with_")]
pub struct ShReductionSettings {
    /// Share of the run after which it is done, once. Default 0.5, as in the paper.
    pub at: f64,
    /// Where the colour of a Gaussian varies by less than this standard deviation over the views,
    /// in [0, 1] and as a mean of its channels, it gets degree 0. Default 0.04; 0.06 for high
    /// compression.
    pub std: f64,
    /// A degree is lowered to 1 or 2 if that changes the colour by less than this distance in [0,
    /// 1]^3 on average. Default 6 sqrt(3) / 255, 6 levels of each channel; 8 for high compression.
    pub distance: f64,
}

impl Default for ShReductionSettings {
    fn default() -> Self {
        Self {
            at: 0.5,
            std: 0.04,
            distance: 6.0 * 3f64.sqrt() / 255.0,
        }
    }
}

impl ShReductionSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }

    /// Checks that the settings can be used.
    ///
    /// # Errors
    /// The field and why its value cannot be used, in one line.
    pub fn validate(&self) -> Result<(), String> {
        if !(0.0..1.0).contains(&self.at) {
            return Err(format!("`at` must lie in [0, 1), it is {}", self.at));
        }
        for (field, value) in [("std", self.std), ("distance", self.distance)] {
            // Infinity is a way to lower all.
            if !(value >= 0.0) {
                return Err(format!("`{field}` must be at least 0, it is {value}"));
            }
        }
        Ok(())
    }
}

/// Lowers the degree of spherical harmonics of the Gaussians whose colours hardly depend on the
/// view, as seen by some cameras, usually all training views. What they need no longer leaves the
/// model, with its moments; the others go on as they were. Returns how many Gaussians have degree
/// 0, 1, 2 and 3 then.
///
/// `cameras` has one camera in each entry. Colours and weights are those of `render`, at the
/// highest degree. A Gaussian that no camera sees gets degree 0, with the coefficients that it has
/// of that. Repeatable bit for bit where the rasteriser is.
///
/// # Errors
/// When there is no camera, a setting cannot be used, or the model has no field `sh0` or no
/// coefficients beyond degree 0 that Gaussians own ([`SplatModel::keep_owned_rows`]); and those of
/// the ops. The model is then unchanged.
pub fn reduce_sh_degrees<M: SplatModel>(
    model: &mut Optimized<M>,
    cameras: impl IntoIterator<Item = Result<CameraTensors, OpError>>,
    render: &RenderSettings,
    settings: &ShReductionSettings,
) -> Result<[usize; SH_DEGREE_MAX + 1], OpError> {
    settings.validate().map_err(wrong)?;
    let render = RenderSettings {
        sh_degree: SH_DEGREE_MAX,
        ..render.clone()
    };
    let mut colors = ColorsOverViews::new(model.model().count());
    let mut views = 0;
    for camera in cameras {
        colors.add_view(model.model(), &camera?.detached(), &render)?;
        views += 1;
    }
    if views == 0 {
        return Err(wrong("no camera, so nothing says what is seen".to_owned()));
    }
    let lowered = colors.lowered(settings);
    let had: Option<Vec<u32>> = own_rows(model).map(|rows| rows.counts().collect());
    let [mut sh0] = model.read_f64(["sh0"])?;
    model.keep_owned_rows(&rows_of_degrees(&lowered.degrees))?;
    for (i, mean) in lowered.constant.iter().enumerate() {
        // One that was of degree 0 before has the colour that it was trained to.
        let varied = had.as_ref().is_none_or(|had| had[i] > 0);
        if let (Some(mean), true) = (mean, varied) {
            sh0[3 * i..3 * i + 3].copy_from_slice(mean);
        }
    }
    model.update("sh0", |value| {
        let options = (&value.device(), value.dtype());
        Tensor::from_data(TensorData::new(sh0, value.dims()), options)
    })?;
    let mut counts = [0; SH_DEGREE_MAX + 1];
    let rows = own_rows(model).into_iter();
    for count in rows.flat_map(|rows| rows.counts().collect::<Vec<_>>()) {
        let degree = splat_ops::sh_degree_of(count as usize);
        counts[degree.unwrap_or(SH_DEGREE_MAX)] += 1;
    }
    Ok(counts)
}

fn wrong(what: String) -> OpError {
    OpError::Argument {
        op: "reduce_sh_degrees",
        what,
    }
}

fn own_rows<M: SplatModel>(model: &Optimized<M>) -> Option<crate::OwnedRows> {
    let mut rows = model.model().owned_rows().into_iter();
    rows.find(|rows| rows.row_set() == SH_COEFFICIENTS)
}

/// Sums over views, for each Gaussian.
struct ColorsOverViews {
    weights: Vec<f64>,
    sums: Vec<[f64; 3]>,
    squares: Vec<[f64; 3]>,
    /// Weighted distances of the colour from that at degree 1 and 2.
    distances: [Vec<f64>; 2],
}

/// What the Gaussians are lowered to.
#[derive(Debug, PartialEq)]
struct Lowered {
    /// At most these.
    degrees: Vec<usize>,
    /// The coefficients of degree 0 of those of degree 0 that were seen.
    constant: Vec<Option<[f64; 3]>>,
}

impl ColorsOverViews {
    fn new(n: usize) -> Self {
        Self {
            weights: vec![0.0; n],
            sums: vec![[0.0; 3]; n],
            squares: vec![[0.0; 3]; n],
            distances: [vec![0.0; n], vec![0.0; n]],
        }
    }

    /// Adds what a camera sees.
    fn add_view<M: SplatModel>(
        &mut self,
        model: &M,
        cameras: &CameraTensors,
        render: &RenderSettings,
    ) -> Result<(), OpError> {
        let [views, _, _] = cameras.viewmats.dims();
        if views != 1 {
            return Err(wrong(format!(
                "{views} cameras at once; give one at a time"
            )));
        }
        let model = model.clone().no_grad();
        let projected = project_gaussians(&model, cameras, render)?;
        let colors = |degree: usize| -> Result<Vec<f32>, OpError> {
            let settings = RenderSettings {
                sh_degree: degree,
                ..render.clone()
            };
            to_host(model.shade(cameras, &projected, &settings)?)
        };
        let full = colors(render.sh_degree)?;
        let lower = [colors(1)?, colors(2)?];
        let shape = [
            1,
            cameras.size.height as usize,
            cameras.size.width as usize,
            1,
        ];
        let ones = Tensor::ones(shape, &cameras.viewmats.device());
        let weights = to_host(weighted_contributions(&model, cameras, render, ones)?)?;
        self.add(&weights, &full, [&lower[0], &lower[1]]);
        Ok(())
    }

    /// Adds a view: weights `[N]`, and colours `[N, 3]` at the highest degree and at 1 and 2.
    fn add(&mut self, weights: &[f32], full: &[f32], lower: [&[f32]; 2]) {
        let colors = full.as_chunks::<3>().0;
        for (i, (weight, color)) in weights.iter().zip(colors).enumerate() {
            let weight = f64::from(*weight);
            // What is not seen has no colour there; and NaN would spread.
            if !(weight > 0.0) {
                continue;
            }
            self.weights[i] += weight;
            for (channel, value) in color.iter().enumerate() {
                let value = f64::from(*value);
                self.sums[i][channel] += weight * value;
                self.squares[i][channel] += weight * value * value;
            }
            for (distances, lower) in self.distances.iter_mut().zip(lower) {
                let lower = &lower[3 * i..3 * i + 3];
                let squares = color
                    .iter()
                    .zip(lower)
                    .map(|(a, b)| f64::from(a - b).powi(2));
                distances[i] += weight * squares.sum::<f64>().sqrt();
            }
        }
    }

    fn lowered(&self, settings: &ShReductionSettings) -> Lowered {
        let n = self.weights.len();
        let mut lowered = Lowered {
            degrees: vec![SH_DEGREE_MAX; n],
            constant: vec![None; n],
        };
        for i in 0..n {
            let weight = self.weights[i];
            if !(weight > 0.0) {
                lowered.degrees[i] = 0;
                continue;
            }
            let mean = self.sums[i].map(|sum| sum / weight);
            let deviations = mean.iter().zip(&self.squares[i]).map(|(mean, square)| {
                let variance = square / weight - mean * mean;
                // Rounding can make it negative; NaN stays.
                if variance < 0.0 { 0.0 } else { variance.sqrt() }
            });
            if deviations.sum::<f64>() / 3.0 < settings.std {
                lowered.degrees[i] = 0;
                lowered.constant[i] = Some(mean.map(|mean| (mean - 0.5) / SH_C0));
                continue;
            }
            let close = |distances: &Vec<f64>| distances[i] / weight < settings.distance;
            if let Some(at) = self.distances.iter().position(close) {
                lowered.degrees[i] = at + 1;
            }
        }
        lowered
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Adds a view of one Gaussian: its weight, its colour, and how far from that it is in one
    /// channel at degree 1 and 2.
    fn add(colors: &mut ColorsOverViews, weight: f32, color: [f32; 3], [one, two]: [f32; 2]) {
        let moved = |by: f32| [color[0] - by, color[1], color[2]];
        colors.add(&[weight], &color, [&moved(one), &moved(two)]);
    }

    #[test]
    fn a_colour_that_hardly_varies_becomes_its_mean() {
        let mut colors = ColorsOverViews::new(1);
        add(&mut colors, 3.0, [0.5, 0.25, 1.0], [1.0, 1.0]);
        add(&mut colors, 1.0, [0.5, 0.25, 0.8], [1.0, 1.0]);
        // Not seen, and black for that.
        add(&mut colors, 0.0, [0.0; 3], [0.0, 0.0]);
        // The deviation of blue is 0.1 sqrt(3 / 4), a third of that the mean.
        let deviation = 0.1 * 0.75f64.sqrt() / 3.0;
        let settings = ShReductionSettings::new().with_std(deviation + 1e-6);
        let lowered = colors.lowered(&settings);
        assert_eq!(lowered.degrees, [0]);
        let constant = lowered.constant[0].unwrap();
        for (found, mean) in constant.iter().zip([0.5, 0.25, 0.95]) {
            assert!((found * SH_C0 + 0.5 - mean).abs() < 1e-6, "{constant:?}");
        }
        let settings = settings.with_std(deviation - 1e-6);
        let lowered = colors.lowered(&settings);
        assert_eq!(
            (&lowered.degrees[..], lowered.constant[0]),
            (&[3][..], None)
        );
    }

    /// The mean distances are 0.15 and 0.05.
    #[test]
    fn the_lowest_degree_that_is_close_enough_is_taken() {
        let mut colors = ColorsOverViews::new(1);
        add(&mut colors, 1.0, [0.0; 3], [0.3, 0.1]);
        add(&mut colors, 1.0, [1.0; 3], [0.0, 0.0]);
        let degree = |distance: f64| {
            let settings = ShReductionSettings::new().with_distance(distance);
            colors.lowered(&settings).degrees[0]
        };
        assert_eq!([0.16, 0.14, 0.06, 0.04].map(degree), [1, 2, 2, 3]);
    }

    /// No photo tells what their coefficients should be.
    #[test]
    fn gaussians_that_no_view_sees_get_degree_zero_and_keep_their_colour() {
        let colors = ColorsOverViews::new(2);
        let lowered = colors.lowered(&ShReductionSettings::new());
        assert_eq!(
            (lowered.degrees, lowered.constant),
            (vec![0; 2], vec![None; 2])
        );
    }

    #[test]
    fn a_broken_colour_lowers_nothing() {
        let mut colors = ColorsOverViews::new(1);
        add(&mut colors, 1.0, [f32::NAN; 3], [0.0, 0.0]);
        let lowered = colors.lowered(&ShReductionSettings::new());
        assert_eq!((lowered.degrees, lowered.constant), (vec![3], vec![None]));
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let problem = |settings: ShReductionSettings| settings.validate().unwrap_err();
        let usual = ShReductionSettings::new();
        assert_eq!(usual.validate(), Ok(()));
        assert!(problem(usual.with_at(1.0)).contains("`at`"));
        assert!(problem(usual.with_std(f64::NAN)).contains("`std`"));
        assert!(problem(usual.with_distance(-1.0)).contains("`distance`"));
    }
}
