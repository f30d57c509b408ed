//! Error against time of the hard cases.

use plotters::coord::Shift;
use plotters::prelude::*;
use splat_lab::accuracy::report::{Report, Row};

/// Size of the picture in pixels.
const PICTURE: (u32, u32) = (900, 560);

/// Error against time, on logarithmic axes: a point per case and backend, labelled with the case's
/// number.
///
/// # Errors
/// The drawing library's error.
pub(crate) fn svg(report: &Report) -> Result<String, String> {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, PICTURE).into_drawing_area();
        let text = |error: DrawingAreaErrorKind<_>| error.to_string();
        root.fill(&WHITE).map_err(text)?;
        draw(report, &root).map_err(text)?;
        root.present().map_err(text)?;
    }
    Ok(svg)
}

fn draw<'a>(
    report: &Report,
    area: &DrawingArea<SVGBackend<'a>, Shift>,
) -> Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>> {
    /// An error of zero has no logarithm.
    const LEAST: f64 = 1e-9;
    let points: Vec<(&Row, f64, f64)> = report
        .cases
        .iter()
        .filter_map(|row| {
            let error = row.gradient.max(row.forward).max(LEAST);
            (error.is_finite()).then_some((row, 1e3 * row.seconds?, error))
        })
        .collect();
    let range = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |r, v| {
            (r.0.min(v), r.1.max(v))
        })
    };
    let (first, last) = range(&mut points.iter().map(|p| p.1));
    if !(first > 0.0 && last.is_finite()) {
        return Ok(());
    }
    let (least, most) = range(&mut points.iter().map(|p| p.2));
    let mut chart = ChartBuilder::on(area)
        .caption(
            "Error against time: hard cases, forward and backward",
            ("sans-serif", 18),
        )
        .margin(10)
        .x_label_area_size(40)
        .y_label_area_size(70)
        .build_cartesian_2d(
            (first / 1.5..last * 1.5).log_scale(),
            (least / 2.0..most.max(1e-3) * 2.0).log_scale(),
        )?;
    chart
        .configure_mesh()
        .x_desc("milliseconds")
        .y_desc("worst relative L2 error, single against double")
        .y_label_formatter(&|error| format!("{error:.0e}"))
        .x_label_formatter(&|ms| format!("{ms}"))
        .light_line_style(BLACK.mix(0.05))
        .draw()?;
    chart
        .draw_series(LineSeries::new(
            [(first / 1.5, 1e-3), (last * 1.5, 1e-3)],
            RED.mix(0.6),
        ))?
        .label("gate of hard cases")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 16, y)], RED.mix(0.6)));
    let mut backends: Vec<&str> = report
        .cases
        .iter()
        .map(|row| row.backend.as_str())
        .collect();
    backends.dedup();
    backends.sort_unstable();
    backends.dedup();
    for (index, backend) in backends.into_iter().enumerate() {
        let color = Palette99::pick(index).to_rgba();
        let own = points.iter().filter(|(row, ..)| row.backend == backend);
        chart
            .draw_series(own.map(|(row, time, error)| {
                EmptyElement::at((*time, *error))
                    + Circle::new((0, 0), 4, color.filled())
                    + Text::new(row.case.to_string(), (6, -6), ("sans-serif", 11))
            }))?
            .label(backend)
            .legend(move |(x, y)| Circle::new((x + 8, y), 4, color.filled()));
    }
    chart
        .configure_series_labels()
        .background_style(WHITE)
        .border_style(BLACK.mix(0.3))
        .draw()?;
    Ok(())
}
