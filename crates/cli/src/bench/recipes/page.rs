//! The tables, and their page `recipes.md`.

use std::fmt::Write;
use std::time::Duration;

use super::SVG;
use super::comparison::{OnCapture, Overall, on_captures, overall};
use super::pictures::Pictured;
use super::plan::Plan;
use super::row::Row;

/// What the page is made of.
pub(super) struct Page<'a> {
    pub plan: &'a Plan,
    /// What is measured of the plan, by capture, then by recipe, then by seed.
    pub rows: &'a [&'a Row],
    pub shown: &'a [Pictured],
    /// The command that writes the page.
    pub command: &'a str,
    /// Description of the machine.
    pub machine: &'a str,
    /// Time that it took to make plot and pictures.
    pub reporting: Duration,
}

impl Page<'_> {
    /// The page.
    pub(super) fn markdown(&self) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        let _ = self.write(&mut text);
        text
    }

    /// The tables alone.
    pub(super) fn tables(&self) -> String {
        let mut text = String::new();
        let _ = self.write_tables(&mut text);
        text
    }

    fn write(&self, text: &mut String) -> std::fmt::Result {
        writeln!(
            text,
            "# Recipes compared\n\nWritten by `{}`.\n",
            self.command
        )?;
        writeln!(
            text,
            "Machine: {} Device: {}.\n",
            self.machine, self.plan.device
        )?;
        writeln!(
            text,
            "PSNR and SSIM are means over the held-out views at the end of a run. Seconds are those of training: the \
             trainer's own clock runs during steps, and stands still while held-out views are measured and results \
             saved. With ± are standard errors of the mean over the seeds.\n"
        )?;
        self.write_tables(text)?;
        writeln!(
            text,
            "\n![held-out PSNR against training time and against Gaussians]({SVG})\n\nA curve or dot for each seed.\n"
        )?;
        for pictured in self.shown {
            let Pictured {
                capture,
                view,
                recipes,
            } = pictured;
            writeln!(
                text,
                "`{capture}.png`: the view `{view}`, of those that are held out the worst-scored of the capture's first run. \
                 From left to right: the photo, {}.\n",
                recipes.join(", ")
            )?;
        }
        Ok(())
    }

    fn write_tables(&self, text: &mut String) -> std::fmt::Result {
        writeln!(
            text,
            "| capture | recipe | steps | seeds | PSNR dB | SSIM | Gaussians | seconds | MB as SPZ |"
        )?;
        writeln!(text, "|---|---|{}", "--:|".repeat(7))?;
        for row in on_captures(self.rows) {
            write_on_capture(text, &row)?;
        }
        let captures = self.plan.captures.len();
        let recipes = self.plan.recipes.iter();
        let recipes: Vec<&str> = recipes.map(|recipe| recipe.name.as_str()).collect();
        let base = recipes.first().copied().unwrap_or_default();
        writeln!(
            text,
            "\nMeans over captures, of {captures}, and against `{base}` on the same captures with the same seeds: the mean \
             difference with its standard error over the pairs of runs, and geometric means of the ratios.\n"
        )?;
        writeln!(
            text,
            "| recipe | captures | PSNR dB | SSIM | Gaussians | seconds | MB as SPZ | pairs | dB against `{base}` | Gaussians | \
             seconds | bytes |"
        )?;
        writeln!(text, "|---|{}", "--:|".repeat(11))?;
        for row in overall(&recipes, self.rows) {
            write_overall(text, &row)?;
        }
        writeln!(text, "\n{}", self.share())
    }

    /// The share of the time that was not spent in training.
    fn share(&self) -> String {
        let sum = |seconds: fn(&Row) -> f64| self.rows.iter().map(|row| seconds(row)).sum::<f64>();
        let outside = sum(|row| row.outside_seconds) + self.reporting.as_secs_f64();
        let whole = sum(|row| row.seconds) + outside;
        let percent = 100.0 * outside / whole;
        format!(
            "Outside of training, with photos read, runs set up, held-out views measured and results saved: {percent:.1} % of \
             {whole:.0} s."
        )
    }
}

fn write_on_capture(text: &mut String, row: &OnCapture<'_>) -> std::fmt::Result {
    writeln!(
        text,
        "| {} | {} | {} | {} | {} | {} | {} | {} | {} |",
        row.capture.replace('|', "\\|"),
        row.recipe,
        row.steps,
        row.seeds,
        row.psnr.with(2),
        row.ssim.with(4),
        row.gaussians.with(0),
        row.seconds.with(1),
        row.megabytes.with(2)
    )
}

fn write_overall(text: &mut String, row: &Overall<'_>) -> std::fmt::Result {
    write!(
        text,
        "| {} | {} | {:.2} | {:.4} | {:.0} | {:.1} | {:.2} |",
        row.recipe, row.captures, row.psnr, row.ssim, row.gaussians, row.seconds, row.megabytes
    )?;
    match &row.against {
        Some(against) => writeln!(
            text,
            " {} | {} | {:.2} | {:.2} | {:.2} |",
            against.pairs,
            against.psnr.signed(2),
            against.gaussians,
            against.seconds,
            against.bytes
        ),
        None => writeln!(text, "{}", " |".repeat(5)),
    }
}

#[cfg(test)]
mod tests {
    use super::super::plan::{Named, Subject};
    use super::super::row::example;
    use super::*;
    use crate::photos::PhotoArgs;

    const BASE: &str = "default";

    #[test]
    fn the_page_has_both_tables_and_the_share() {
        let recipes = [BASE, "mcmc"].map(|name| Named::of_text(name).unwrap());
        let photos = PhotoArgs {
            downscale: Some(4),
            ..PhotoArgs::default()
        };
        let plan = Plan {
            captures: vec![Subject {
                name: "a|b".to_owned(),
                folder: "a|b".into(),
                contents: String::new(),
            }],
            ..Plan::new(recipes.into(), 2, Some(100), photos).unwrap()
        };
        let mut rows = [
            example("a|b", BASE, 0, 20.0),
            example("a|b", BASE, 1, 22.0),
            example("a|b", "mcmc", 0, 20.5),
        ];
        rows[2].gaussians = 500;
        let rows: Vec<&Row> = rows.iter().collect();
        let shown = [Pictured {
            capture: "a|b".to_owned(),
            view: "left.jpg".to_owned(),
            recipes: vec![BASE.to_owned(), "mcmc".to_owned()],
        }];
        let page = Page {
            plan: &plan,
            rows: &rows,
            shown: &shown,
            command: "splat bench recipes",
            machine: "one.",
            reporting: Duration::from_millis(250),
        };
        let text = page.markdown();
        assert!(text.contains(&page.tables()));
        for line in [
            "| a\\|b | default | 100 | 2 | 21.00 ± 1.00 | 0.5000 ± 0.0000 | 1000 ± 0 | 10.0 ± 0.0 | 0.02 ± 0.00 |",
            "| a\\|b | mcmc | 100 | 1 | 20.50 | 0.5000 | 500 | 10.0 | 0.02 |",
            "| default | 1 | 21.00 | 0.5000 | 1000 | 10.0 | 0.02 | | | | | |",
            "| mcmc | 1 | 20.50 | 0.5000 | 500 | 10.0 | 0.02 | 1 | +0.50 | 0.50 | 1.00 | 1.00 |",
            "results saved: 3.2 % of 31 s.",
            "the photo, default, mcmc.",
        ] {
            assert!(text.contains(line), "no `{line}` in: {text}");
        }
    }
}
