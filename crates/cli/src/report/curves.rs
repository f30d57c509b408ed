//! History of a run as one SVG: loss terms, held-out PSNR and number of Gaussians against the step.

use std::ops::Range;
use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::{ReportError, write};

/// Size of one panel in pixels.
const PANEL: (u32, u32) = (800, 260);
/// Most points per curve; longer curves are averaged over equal intervals of steps.
const MOST_POINTS: usize = 800;

/// The curves; a panel is drawn only if it has points.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Curves {
    /// Loss terms by name, each (step, value).
    pub losses: Vec<(String, Vec<(usize, f64)>)>,
    /// Held-out PSNR in dB, (step, value).
    pub held_out_psnr: Vec<(usize, f64)>,
    /// Number of Gaussians, (step, count).
    pub gaussians: Vec<(usize, usize)>,
}

impl Curves {
    /// Appends a value of the loss term `name`.
    pub fn push_loss(&mut self, name: &str, step: usize, value: f64) {
        match self.losses.iter_mut().find(|(known, _)| known == name) {
            Some((_, points)) => points.push((step, value)),
            None => self.losses.push((name.to_owned(), vec![(step, value)])),
        }
    }

    /// Writes the SVG.
    ///
    /// # Errors
    ///
    /// [`ReportError`], naming the file.
    pub fn write(&self, path: &Path) -> Result<(), ReportError> {
        let svg = self.to_svg().map_err(|reason| ReportError::Encode {
            path: path.to_path_buf(),
            reason,
        })?;
        write(path, svg.as_bytes())
    }

    /// The drawing as SVG text.
    fn to_svg(&self) -> Result<String, String> {
        let count = |&(step, count): &(usize, usize)| (step, count as f64);
        let gaussians = self.gaussians.iter().map(count).collect();
        let panels = [
            ("loss", self.losses.clone()),
            (
                "held-out PSNR (dB)",
                vec![("PSNR".to_owned(), self.held_out_psnr.clone())],
            ),
            ("Gaussians", vec![("Gaussians".to_owned(), gaussians)]),
        ];
        let panels: Vec<Panel> = panels
            .into_iter()
            .filter_map(|(title, curves)| Panel::new(title, curves))
            .collect();
        let mut svg = String::new();
        {
            let size = (PANEL.0, PANEL.1 * panels.len().max(1) as u32);
            let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
            let text = |error: DrawingAreaErrorKind<_>| error.to_string();
            root.fill(&WHITE).map_err(text)?;
            for (area, panel) in root
                .split_evenly((panels.len().max(1), 1))
                .iter()
                .zip(&panels)
            {
                panel.draw(area).map_err(text)?;
            }
            root.present().map_err(text)?;
        }
        Ok(svg)
    }
}

/// One set of axes with its curves, none of them empty.
struct Panel {
    title: &'static str,
    curves: Vec<(String, Vec<(f64, f64)>)>,
    steps: Range<f64>,
    values: Range<f64>,
}

impl Panel {
    fn new(title: &'static str, curves: Vec<(String, Vec<(usize, f64)>)>) -> Option<Self> {
        let curves: Vec<_> = curves
            .into_iter()
            .map(|(name, points)| (name, thinned(&points)))
            .filter(|(_, points)| !points.is_empty())
            .collect();
        let points = || curves.iter().flat_map(|(_, points)| points);
        let steps = padded(points().map(|point| point.0))?;
        let values = padded(points().map(|point| point.1))?;
        Some(Self {
            title,
            curves,
            steps,
            values,
        })
    }

    fn draw<'a>(
        &self,
        area: &DrawingArea<SVGBackend<'a>, Shift>,
    ) -> Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>> {
        let mut chart = ChartBuilder::on(area)
            .caption(self.title, ("sans-serif", 16))
            .margin(8)
            .x_label_area_size(32)
            .y_label_area_size(64)
            .build_cartesian_2d(self.steps.clone(), self.values.clone())?;
        chart
            .configure_mesh()
            .x_desc("step")
            .x_label_formatter(&|step| format!("{step:.0}"))
            .light_line_style(WHITE)
            .draw()?;
        for (index, (name, points)) in self.curves.iter().enumerate() {
            let color = Palette99::pick(index).to_rgba();
            let curve = chart.draw_series(LineSeries::new(points.iter().copied(), &color))?;
            curve
                .label(name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], color));
        }
        if self.curves.len() > 1 {
            chart
                .configure_series_labels()
                .background_style(WHITE)
                .border_style(BLACK.mix(0.3))
                .draw()?;
        }
        Ok(())
    }
}

/// At most [`MOST_POINTS`] points, each the mean of an interval; values that are not finite are
/// dropped.
fn thinned(points: &[(usize, f64)]) -> Vec<(f64, f64)> {
    let finite: Vec<(f64, f64)> = points
        .iter()
        .filter(|(_, value)| value.is_finite())
        .map(|&(step, value)| (step as f64, value))
        .collect();
    let stretch = finite.len().div_ceil(MOST_POINTS).max(1);
    let mean = |chunk: &[(f64, f64)]| {
        let sum = chunk.iter().fold((0.0, 0.0), |s, p| (s.0 + p.0, s.1 + p.1));
        (sum.0 / chunk.len() as f64, sum.1 / chunk.len() as f64)
    };
    finite.chunks(stretch).map(mean).collect()
}

/// Range of `values`, a twentieth wider on each side and never empty; `None` if there are no
/// values.
pub(crate) fn padded(values: impl Iterator<Item = f64>) -> Option<Range<f64>> {
    let (least, most) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |range, value| {
        (range.0.min(value), range.1.max(value))
    });
    if least > most {
        return None;
    }
    let pad = (0.05 * (most - least)).max(1e-6 * most.abs()).max(1e-9);
    Some(least - pad..most + pad)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_curve_is_drawn() {
        let mut curves = Curves::default();
        for step in 0..5000 {
            let value = 1.0 / (step as f64 + 1.0);
            curves.push_loss("L1", step, value);
            curves.push_loss("D-SSIM", step, 2.0 * value);
        }
        curves.push_loss("L1", 5000, f64::NAN);
        curves.gaussians = vec![(0, 10), (100, 20)];
        let svg = curves.to_svg().unwrap();
        for word in ["<svg", "L1", "D-SSIM", "Gaussians", "loss", "</svg>"] {
            assert!(svg.contains(word), "no {word}");
        }
        // Without PSNR there is no panel for it; and the long curves were thinned.
        assert!(!svg.contains("PSNR"));
        assert!(svg.len() < 100_000, "{}", svg.len());

        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("curves.svg");
        curves.write(&path).unwrap();
        assert_eq!(std::fs::read_to_string(path).unwrap(), svg);
    }

    #[test]
    fn a_run_without_a_step_draws_nothing() {
        assert!(Curves::default().to_svg().unwrap().contains("</svg>"));
        let mut curves = Curves::default();
        curves.push_loss("L1", 3, 0.0);
        curves.held_out_psnr = vec![(3, f64::INFINITY)];
        assert!(curves.to_svg().unwrap().contains("</svg>"));
    }

    #[test]
    fn thinning_keeps_the_mean() {
        let points: Vec<(usize, f64)> = (0..MOST_POINTS * 3).map(|i| (i, i as f64)).collect();
        let thin = thinned(&points);
        assert_eq!(thin.len(), MOST_POINTS);
        assert_eq!(thin[1], (4.0, 4.0));
    }
}
