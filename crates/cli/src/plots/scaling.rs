//! Step time against Gaussians and against pixels, and memory against Gaussians, on logarithmic
//! axes.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::prelude::*;

use splat_lab::performance::scaling::{Point, gaussians, pixels};

/// Size of one panel in pixels.
const PANEL: (u32, u32) = (440, 400);

type DrawError<'a> = DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>;

/// A value of a point.
type Value = fn(&Point) -> Option<f64>;

struct Panel {
    title: &'static str,
    across: (&'static str, fn(&Point) -> f64),
    up: Value,
    /// The property shared by the points of a curve.
    by: (&'static str, fn(&Point) -> f64),
    /// Draw linear growth from the first point of the lowest curve.
    linear: bool,
}

const PANELS: [Panel; 3] = [
    Panel {
        title: "Step time (ms) against Gaussians",
        across: ("Gaussians", gaussians),
        up: milliseconds,
        by: ("MP", megapixels),
        linear: true,
    },
    Panel {
        title: "Step time (ms) against pixels",
        across: ("pixels", pixels),
        up: milliseconds,
        by: ("Gaussians", gaussians),
        linear: true,
    },
    Panel {
        title: "Peak memory (MB) against Gaussians",
        across: ("Gaussians", gaussians),
        up: megabytes,
        by: ("MP", megapixels),
        linear: false,
    },
];

fn milliseconds(point: &Point) -> Option<f64> {
    Some(point.milliseconds.median)
}

fn megabytes(point: &Point) -> Option<f64> {
    Some(point.memory()? as f64 / 1e6)
}

/// Rounded to a tenth, as image sizes only approximate the requested size.
fn megapixels(point: &Point) -> f64 {
    (point.work.pixels / 1e5).round() / 10.0
}

pub(crate) fn svg(points: &[Point]) -> Result<String, String> {
    let mut svg = String::new();
    {
        let size = (PANEL.0 * PANELS.len() as u32, PANEL.1);
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        let text = |error: DrawingAreaErrorKind<_>| error.to_string();
        root.fill(&WHITE).map_err(text)?;
        let areas = root.split_evenly((1, PANELS.len()));
        for (area, panel) in areas.iter().zip(&PANELS) {
            panel.draw(area, points).map_err(text)?;
        }
        root.present().map_err(text)?;
    }
    Ok(svg)
}

impl Panel {
    fn draw<'a>(
        &self,
        area: &DrawingArea<SVGBackend<'a>, Shift>,
        points: &[Point],
    ) -> Result<(), DrawError<'a>> {
        let curves = self.curves(points);
        let all = || curves.iter().flat_map(|(_, curve)| curve);
        let (Some(across), Some(up)) = (
            widened(all().map(|point| point.0)),
            widened(all().map(|point| point.1)),
        ) else {
            return Ok(());
        };
        let mut chart = ChartBuilder::on(area)
            .caption(self.title, ("sans-serif", 16))
            .margin(10)
            .margin_right(24)
            .x_label_area_size(36)
            .y_label_area_size(52)
            .build_cartesian_2d(across.clone().log_scale(), up.clone().log_scale())?;
        chart
            .configure_mesh()
            .x_desc(self.across.0)
            .x_labels(5)
            .y_labels(12)
            .x_label_formatter(&|value| short(*value))
            .y_label_formatter(&|value| short(*value))
            .light_line_style(BLACK.mix(0.05))
            .draw()?;
        if self.linear
            && let Some(from) = bottom_left(&curves)
        {
            // Clipped to the panel.
            let last = across.end.min(from.0 * up.end / from.1);
            let line = [from, (last, from.1 * last / from.0)];
            let style = BLACK.mix(0.5);
            chart
                .draw_series(DashedLineSeries::new(line, 5, 4, style.stroke_width(1)))?
                .label("linear")
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 14, y)], style));
        }
        for (index, (label, curve)) in curves.iter().enumerate() {
            let color = Palette99::pick(index).to_rgba();
            chart
                .draw_series(LineSeries::new(
                    curve.iter().copied(),
                    color.stroke_width(2),
                ))?
                .label(label)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 14, y)], color));
            chart.draw_series(
                curve
                    .iter()
                    .map(|point| Circle::new(*point, 3, color.filled())),
            )?;
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()
    }

    /// Curves of the points that have a value, each with its label, from left to right.
    fn curves(&self, points: &[Point]) -> Vec<(String, Vec<(f64, f64)>)> {
        let mut curves: Vec<(f64, Vec<(f64, f64)>)> = vec![];
        for point in points {
            let (Some(up), common) = ((self.up)(point), (self.by.1)(point)) else {
                continue;
            };
            let place = ((self.across.1)(point), up);
            if !(place.0 > 0.0 && place.1 > 0.0 && place.1.is_finite()) {
                continue;
            }
            match curves.iter_mut().find(|(known, _)| *known == common) {
                Some((_, curve)) => curve.push(place),
                None => curves.push((common, vec![place])),
            }
        }
        for (_, curve) in &mut curves {
            curve.sort_by(|a, b| a.0.total_cmp(&b.0));
        }
        let curves = curves.into_iter();
        curves
            .map(|(common, curve)| (format!("{} {}", short(common), self.by.0), curve))
            .collect()
    }
}

/// The first point of the curve that begins lowest.
fn bottom_left(curves: &[(String, Vec<(f64, f64)>)]) -> Option<(f64, f64)> {
    let first = curves
        .iter()
        .filter_map(|(_, curve)| curve.first().copied());
    first.min_by(|a, b| a.1.total_cmp(&b.1))
}

/// Range of the positive values, slightly widened; `None` if there are none.
fn widened(values: impl Iterator<Item = f64>) -> Option<Range<f64>> {
    let (least, most) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |range, value| {
        (range.0.min(value), range.1.max(value))
    });
    (least <= most).then(|| least / 1.5..most * 1.5)
}

/// 10, 100, 10k, 2M.
pub(crate) fn short(value: f64) -> String {
    match value {
        v if v >= 1e6 => format!("{}M", v / 1e6),
        v if v >= 1e3 => format!("{}k", v / 1e3),
        v => format!("{v}"),
    }
}
