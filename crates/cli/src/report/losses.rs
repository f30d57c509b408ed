//! The loss of every step, as `losses.csv`, for plotting and comparing runs.

use std::fmt::Write;
use std::path::Path;

use super::{ReportError, write};
use splat_trainer::History;

/// Writes one row per step: `step`, `loss` (the weighted sum), then each term without its weight.
///
/// # Errors
///
/// [`ReportError`], naming the file.
pub fn write_losses(path: &Path, history: &History) -> Result<(), ReportError> {
    write(path, csv(history).as_bytes())
}

fn csv(history: &History) -> String {
    let mut text = String::from("step,loss");
    for name in &history.terms {
        text.push(',');
        text.push_str(&quoted(name));
    }
    text.push('\n');
    for record in &history.losses {
        // Writing into a string cannot fail.
        let _ = write!(text, "{},{}", record.step, record.total);
        for value in &record.terms {
            let _ = write!(text, ",{value}");
        }
        text.push('\n');
    }
    text
}

/// A field quoted for readers of RFC 4180.
pub(crate) fn quoted(name: &str) -> String {
    if name.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", name.replace('"', "\"\""))
    } else {
        name.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_trainer::LossRecord;

    #[test]
    fn a_row_per_step_under_the_names_of_the_terms() {
        let history = History {
            terms: vec!["l1".into(), "a, \"b\"".into()],
            losses: vec![LossRecord {
                step: 1,
                total: 0.5,
                terms: vec![0.25, 1e-9],
            }],
            ..History::default()
        };
        assert_eq!(
            csv(&history),
            "step,loss,l1,\"a, \"\"b\"\"\"\n1,0.5,0.25,0.000000001\n"
        );
    }
}
