//! Breakdown of a step's time: one bar per setting, with its stages end to end.

use plotters::coord::Shift;
use plotters::element::Rectangle;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use splat_lab::performance::step::StepRow;

/// Width of the picture, and height of a bar with its gap, in pixels.
const WIDTH: u32 = 900;
const BAR: u32 = 44;
/// Room for the title, the axis, and a line of the legend.
const HEAD: u32 = 36;
const AXIS: u32 = 44;
const LEGEND_LINE: u32 = 20;
/// Columns of the legend.
const COLUMNS: usize = 3;
/// Room for the names of the bars.
const NAMES: u32 = 150;

type DrawError<'a> = DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>;

pub(crate) fn svg(rows: &[StepRow]) -> Result<String, String> {
    let mut names: Vec<&str> = vec![];
    for (name, _) in rows.iter().flat_map(|row| &row.stages) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    let legend = LEGEND_LINE * names.len().div_ceil(COLUMNS) as u32;
    let height = HEAD + BAR * rows.len() as u32 + AXIS + legend;
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (WIDTH, height)).into_drawing_area();
        let text = |error: DrawingAreaErrorKind<_>| error.to_string();
        root.fill(&WHITE).map_err(text)?;
        let (bars, legend) = root.split_vertically(height - legend);
        draw_bars(&bars, rows, &names).map_err(text)?;
        draw_legend(&legend, &names).map_err(text)?;
        root.present().map_err(text)?;
    }
    Ok(svg)
}

fn draw_bars<'a>(
    area: &DrawingArea<SVGBackend<'a>, Shift>,
    rows: &[StepRow],
    names: &[&str],
) -> Result<(), DrawError<'a>> {
    let total = |row: &StepRow| row.stages.iter().map(|(_, time)| time).sum::<f64>();
    let most = rows.iter().map(total).fold(0.0, f64::max);
    if !(most > 0.0 && most.is_finite()) {
        return Ok(());
    }
    let mut chart = ChartBuilder::on(area)
        .caption("A training step by stages", ("sans-serif", 18))
        .margin_right(24)
        .x_label_area_size(AXIS)
        .y_label_area_size(NAMES)
        .build_cartesian_2d(0.0..1.05 * most, 0.0..rows.len() as f64)?;
    chart
        .configure_mesh()
        .disable_y_mesh()
        .y_labels(0)
        .x_desc("milliseconds, medians")
        .light_line_style(WHITE)
        .draw()?;
    let beside = ("sans-serif", 13).into_text_style(area);
    let beside = beside.pos(Pos::new(HPos::Right, VPos::Center));
    for (index, row) in rows.iter().enumerate() {
        // From top to bottom.
        let middle = (rows.len() - index) as f64 - 0.5;
        let mut from = 0.0;
        let mut bars = vec![];
        for (name, time) in &row.stages {
            let color = names.iter().position(|known| known == name).unwrap_or(0);
            let corners = [(from, middle - 0.35), (from + time, middle + 0.35)];
            bars.push(Rectangle::new(corners, color_of(color).filled()));
            from += time;
        }
        chart.draw_series(bars)?;
        let plural = if row.threads == 1 { "" } else { "s" };
        let name = format!("degree {}, {} thread{plural}", row.sh_degree, row.threads);
        let (_, y) = chart.backend_coord(&(0.0, middle));
        area.draw(&Text::new(name, (NAMES as i32 - 8, y), beside.clone()))?;
    }
    Ok(())
}

fn draw_legend<'a>(
    area: &DrawingArea<SVGBackend<'a>, Shift>,
    names: &[&str],
) -> Result<(), DrawError<'a>> {
    let column = (WIDTH as usize / COLUMNS) as i32;
    for (index, name) in names.iter().enumerate() {
        let x = (index % COLUMNS) as i32 * column + 24;
        let y = (index / COLUMNS) as i32 * LEGEND_LINE as i32;
        let corners = [(x, y + 2), (x + 14, y + 14)];
        area.draw(&Rectangle::new(corners, color_of(index).filled()))?;
        area.draw(&Text::new(
            (*name).to_owned(),
            (x + 20, y + 2),
            ("sans-serif", 13),
        ))?;
    }
    Ok(())
}

/// Colours that distinguish neighbours: hues a golden section of the circle apart, alternately dark
/// and light.
fn color_of(index: usize) -> RGBAColor {
    let hue = (index as f64 * 0.381_966).fract();
    HSLColor(hue, 0.55, if index.is_multiple_of(2) { 0.45 } else { 0.65 }).to_rgba()
}
