//! The plot: for each capture, held-out PSNR against training time, and against Gaussians.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::row::Row;
use crate::plots::scaling::short;
use crate::report::curves::padded;
use splat_trainer::RECIPES;

/// Size of one panel in pixels.
const PANEL: (u32, u32) = (560, 360);

/// Points from left to right.
type Curve = Vec<(f64, f64)>;
type DrawError<'a> = DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>;

/// One set of axes.
struct Panel<'a> {
    title: String,
    across: &'static str,
    /// Curves of the recipes, each with its name; several for a recipe follow each other. A curve
    /// ends in a dot.
    curves: Vec<(&'a str, Curve)>,
    /// Labels of the horizontal axis.
    label: fn(&f64) -> String,
}

/// Draws the rows of these captures; those of a recipe on a capture follow each other.
pub(super) fn svg(captures: &[&str], rows: &[&Row]) -> Result<String, String> {
    let mut svg = String::new();
    {
        let lines = captures.len().max(1);
        let size = (2 * PANEL.0, PANEL.1 * lines as u32);
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        let text = |error: DrawingAreaErrorKind<_>| error.to_string();
        root.fill(&WHITE).map_err(text)?;
        let panels = captures.iter().flat_map(|capture| panels(capture, rows));
        for (area, panel) in root.split_evenly((lines, 2)).iter().zip(panels) {
            panel.draw(area).map_err(text)?;
        }
        root.present().map_err(text)?;
    }
    Ok(svg)
}

/// The panels of a capture.
fn panels<'a>(capture: &str, rows: &[&'a Row]) -> [Panel<'a>; 2] {
    let curves = |curve: fn(&Row) -> Curve| -> Vec<(&'a str, Curve)> {
        let own = rows.iter().filter(|row| row.key.capture == capture);
        own.map(|row| (&*row.key.recipe, finite(curve(row))))
            .collect()
    };
    [
        Panel {
            title: format!("{capture}: held-out PSNR (dB) against training time"),
            across: "seconds",
            curves: curves(|row| row.curve.clone()),
            label: |seconds| match *seconds {
                few if few < 10.0 => format!("{few:.1}"),
                many => format!("{many:.0}"),
            },
        },
        Panel {
            title: format!("{capture}: held-out PSNR (dB) against Gaussians"),
            across: "Gaussians",
            curves: curves(|row| vec![(row.gaussians as f64, row.psnr)]),
            label: |count| short(count.round()),
        },
    ]
}

/// Points that can be drawn.
fn finite(points: Curve) -> Curve {
    let is_finite = |point: &(f64, f64)| point.0.is_finite() && point.1.is_finite();
    points.into_iter().filter(is_finite).collect()
}

impl Panel<'_> {
    fn draw<'a>(&self, area: &DrawingArea<SVGBackend<'a>, Shift>) -> Result<(), DrawError<'a>> {
        let points = || self.curves.iter().flat_map(|(_, curve)| curve);
        let most = points().map(|point| point.0).fold(0.0, f64::max);
        let Some(up) = padded(points().map(|point| point.1)).filter(|_| most > 0.0) else {
            return Ok(());
        };
        let mut chart = ChartBuilder::on(area)
            .caption(&self.title, ("sans-serif", 16))
            .margin(10)
            .margin_right(24)
            .x_label_area_size(36)
            .y_label_area_size(52)
            .build_cartesian_2d(0.0..1.05 * most, up)?;
        chart
            .configure_mesh()
            .x_desc(self.across)
            .x_labels(8)
            .x_label_formatter(&self.label)
            .light_line_style(WHITE)
            .draw()?;
        let mut before = "";
        for &(recipe, ref curve) in &self.curves {
            let color = color_of(recipe);
            let line = LineSeries::new(curve.iter().copied(), color.stroke_width(1));
            let drawn = chart.draw_series(line)?;
            if recipe != before {
                drawn
                    .label(recipe)
                    .legend(move |(x, y)| PathElement::new([(x, y), (x + 14, y)], color));
            }
            before = recipe;
            let end = curve.last().copied();
            chart.draw_series(end.map(|end| Circle::new(end, 3, color.filled())))?;
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()
    }
}

/// The colour of a recipe, the same in every plot. Those of files are chosen by the letters.
fn color_of(recipe: &str) -> RGBAColor {
    let at = RECIPES.iter().position(|known| known.name == recipe);
    let letters = || recipe.bytes().map(usize::from).sum::<usize>();
    Palette99::pick(at.unwrap_or_else(|| RECIPES.len() + letters() % 80)).to_rgba()
}

#[cfg(test)]
mod tests {
    use super::super::row::example;
    use super::*;

    #[test]
    fn every_capture_and_recipe_is_drawn() {
        let mut rows = [
            example("garden", "default", 0, 20.0),
            example("garden", "default", 1, 20.5),
            example("garden", "mcmc", 0, 21.0),
            example("truck", "default", 0, f64::INFINITY),
        ];
        rows[2].curve.clear();
        let rows: Vec<&Row> = rows.iter().collect();
        let svg = svg(&["garden", "truck", "empty"], &rows).unwrap();
        for word in [
            "garden: held-out PSNR (dB) against training time",
            "garden: held-out PSNR (dB) against Gaussians",
            "mcmc",
            "</svg>",
        ] {
            assert!(svg.contains(word), "no {word}");
        }
        // Nothing of them can be drawn.
        assert!(!svg.contains("truck") && !svg.contains("empty"));
        // Dots of three runs, and of the two that have a curve.
        assert_eq!(svg.matches("<circle").count(), 5);
    }
}
