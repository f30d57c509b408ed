//! `recipes.csv`: a row for each run.

use std::path::PathBuf;
use std::str::FromStr;

use super::row::{Key, Row};
use crate::Failure;
use crate::report::losses::quoted;
use crate::report::write_durably;
use crate::text;
use splat_data::WriteError;
use splat_data::text::Excerpt;

/// The columns. `curve` has pairs `seconds:psnr` with blanks between them.
const COLUMNS: [&str; 17] = [
    "capture",
    "recipe",
    "digest",
    "device",
    "seed",
    "steps",
    "downscale",
    "psnr",
    "ssim",
    "gaussians",
    "most_gaussians",
    "seconds",
    "outside_seconds",
    "ply_bytes",
    "spz_bytes",
    "view",
    "curve",
];

/// All rows, and their file.
pub(super) struct Table {
    path: PathBuf,
    /// The rows, the latest last.
    pub rows: Vec<Row>,
}

impl Table {
    /// Reads the file; no rows if there is none.
    pub(super) fn open(path: PathBuf) -> Result<Self, Failure> {
        let rows = match path.exists() {
            true => text::read(&path, parse)?,
            false => Vec::new(),
        };
        Ok(Self { path, rows })
    }

    /// Takes a row in place of that of the same run, if there is one, and saves all.
    pub(super) fn put(&mut self, row: Row) -> Result<(), WriteError> {
        self.rows.retain(|old| old.key != row.key);
        self.rows.push(row);
        write_durably(&self.path, to_text(&self.rows).as_bytes()).map_err(|source| WriteError {
            path: self.path.clone(),
            source,
        })
    }

    /// Path of the file.
    pub(super) fn path(&self) -> std::path::Display<'_> {
        self.path.display()
    }
}

fn to_text(rows: &[Row]) -> String {
    let mut text = COLUMNS.join(",");
    text.push('\n');
    for row in rows {
        text += &fields(row).map(|field| quoted(&field)).join(",");
        text.push('\n');
    }
    text
}

/// The values of a row in the order of [`COLUMNS`].
fn fields(row: &Row) -> [String; COLUMNS.len()] {
    let pair = |(seconds, psnr): &(f64, f64)| format!("{seconds}:{psnr}");
    let curve: Vec<String> = row.curve.iter().map(pair).collect();
    [
        row.key.capture.clone(),
        row.key.recipe.clone(),
        row.digest.clone(),
        row.key.device.clone(),
        row.key.seed.to_string(),
        row.key.steps.to_string(),
        row.key.downscale.to_string(),
        row.psnr.to_string(),
        row.ssim.to_string(),
        row.gaussians.to_string(),
        row.most_gaussians.to_string(),
        row.seconds.to_string(),
        row.outside_seconds.to_string(),
        row.ply_bytes.to_string(),
        row.spz_bytes.to_string(),
        row.view.clone().unwrap_or_default(),
        curve.join(" "),
    ]
}

fn parse(text: &str) -> Result<Vec<Row>, String> {
    let mut records = records(text)?.into_iter();
    let Some(head) = records.next() else {
        return Ok(Vec::new());
    };
    if head.fields != COLUMNS {
        return Err(
            "its columns are not those of this program; choose another --out, or move the file away"
                .to_owned(),
        );
    }
    records.map(|record| record.row()).collect()
}

/// The fields of a row of the file.
struct Record {
    /// Line on which it begins, from 1.
    line: usize,
    fields: Vec<String>,
}

impl Record {
    fn row(&self) -> Result<Row, String> {
        let count = self.fields.len();
        if count != COLUMNS.len() {
            return Err(self.problem(format_args!("{count} fields, not {}", COLUMNS.len())));
        }
        let view = self.text("view");
        Ok(Row {
            key: Key {
                capture: self.text("capture").to_owned(),
                recipe: self.text("recipe").to_owned(),
                seed: self.number("seed")?,
                steps: self.number("steps")?,
                downscale: self.number("downscale")?,
                device: self.text("device").to_owned(),
            },
            digest: self.text("digest").to_owned(),
            psnr: self.measure("psnr")?,
            ssim: self.measure("ssim")?,
            gaussians: self.number("gaussians")?,
            most_gaussians: self.number("most_gaussians")?,
            seconds: self.measure("seconds")?,
            outside_seconds: self.measure("outside_seconds")?,
            ply_bytes: self.number("ply_bytes")?,
            spz_bytes: self.number("spz_bytes")?,
            view: (!view.is_empty()).then(|| view.to_owned()),
            curve: self.curve()?,
        })
    }

    /// The text of a column.
    fn text(&self, name: &str) -> &str {
        let at = COLUMNS.iter().position(|column| *column == name);
        let field = at.and_then(|at| self.fields.get(at));
        field.map_or("", String::as_str)
    }

    fn number<T: FromStr>(&self, name: &str) -> Result<T, String> {
        let text = self.text(name);
        let unusable = || self.problem(format_args!("`{name}` cannot be `{}`", Excerpt(text)));
        text.parse().map_err(|_| unusable())
    }

    /// A number that was measured. Infinity is one: PSNR of two equal pictures.
    fn measure(&self, name: &str) -> Result<f64, String> {
        match self.number::<f64>(name)? {
            value if value.is_nan() => Err(self.problem(format_args!("`{name}` is not a number"))),
            value => Ok(value),
        }
    }

    fn curve(&self) -> Result<Vec<(f64, f64)>, String> {
        let pair = |text: &str| -> Option<(f64, f64)> {
            let (seconds, psnr) = text.split_once(':')?;
            let (seconds, psnr): (f64, f64) = (seconds.parse().ok()?, psnr.parse().ok()?);
            (!seconds.is_nan() && !psnr.is_nan()).then_some((seconds, psnr))
        };
        let point = |text: &str| {
            pair(text).ok_or_else(|| {
                self.problem(format_args!("`curve` cannot have `{}`", Excerpt(text)))
            })
        };
        self.text("curve").split_whitespace().map(point).collect()
    }

    fn problem(&self, what: std::fmt::Arguments<'_>) -> String {
        let line = self.line;
        format!("line {line}: {what}; remove the line, and its run is measured again")
    }
}

/// The records of a file with fields quoted as in RFC 4180, without empty lines.
fn records(text: &str) -> Result<Vec<Record>, String> {
    let mut records = Vec::new();
    let (mut fields, mut field) = (Vec::new(), String::new());
    let (mut line, mut begin, mut inside) = (1, 1, false);
    // A last line without its end has one.
    let end = (!text.ends_with('\n')).then_some('\n');
    let mut characters = text.chars().chain(end).peekable();
    while let Some(character) = characters.next() {
        line += usize::from(character == '\n');
        match character {
            '"' if inside && characters.peek() == Some(&'"') => {
                characters.next();
                field.push('"');
            }
            '"' => inside = !inside,
            ',' if !inside => fields.push(std::mem::take(&mut field)),
            '\r' if !inside && characters.peek() == Some(&'\n') => {}
            '\n' if !inside => {
                fields.push(std::mem::take(&mut field));
                let fields = std::mem::take(&mut fields);
                if fields != [""] {
                    records.push(Record {
                        line: begin,
                        fields,
                    });
                }
                begin = line;
            }
            other => field.push(other),
        }
    }
    match inside {
        false => Ok(records),
        true => Err(format!(
            "line {begin}: a quotation mark is not closed; close it, or remove the line, and its run is measured again"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::super::row::example;
    use super::*;

    #[test]
    fn rows_are_read_as_they_were_written() {
        let plain = example("garden", "default", 0, 24.123_456_789);
        let mut odd = example("a, \"b\"\r\nc", "mcmc", u64::MAX, f64::INFINITY);
        odd.view = Some("left/a,b.jpg".to_owned());
        odd.key.device = "wgpu (\"GPU\", 2)".to_owned();
        odd.curve = vec![];
        let rows = vec![plain, odd];
        let text = to_text(&rows);
        assert_eq!(parse(&text), Ok(rows.clone()));
        assert_eq!(parse(text.trim_end()), Ok(rows.clone()));
        // As a spreadsheet saves it.
        let plain = to_text(&rows[..1]);
        assert_eq!(
            parse(&plain.replace('\n', "\r\n")),
            Ok(rows[..1].to_vec()),
            "{plain}"
        );
        assert_eq!(parse(""), Ok(vec![]));
        assert_eq!(parse(&to_text(&[])), Ok(vec![]));
    }

    #[test]
    fn a_damaged_file_is_refused_with_its_line() {
        let text = to_text(&[
            example("a\nb", "default", 0, 20.0),
            example("c", "default", 0, 21.0),
        ]);
        let refused = |text: &str| parse(text).unwrap_err();
        let words = refused(&text.replace(",21,", ",much,"));
        assert!(
            words.contains("line 4") && words.contains("`psnr` cannot be `much`"),
            "{words}"
        );
        for wrong in ["5;19 ", "5:NaN "] {
            let words = refused(&text.replace("5:19 ", wrong));
            assert!(words.contains("line 2: `curve`"), "{words}");
        }
        let words = refused(&text.replace(",21,", ",NaN,"));
        assert!(words.contains("line 4: `psnr` is not"), "{words}");
        let words = refused(&text[..text.len() - 30]);
        assert!(words.contains("line 4: "), "{words}");
        let words = refused(&text.replace("b\"", "b"));
        assert!(words.contains("quotation mark"), "{words}");
        assert!(refused("a,b\n1,2\n").contains("--out"));
    }

    #[test]
    fn a_row_takes_the_place_of_that_of_the_same_run() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("new/recipes.csv");
        let mut table = Table::open(path.clone()).unwrap();
        for row in [
            example("a", "default", 0, 20.0),
            example("a", "default", 1, 21.0),
            example("a", "default", 0, 22.0),
        ] {
            table.put(row).unwrap();
        }
        let read = Table::open(path).unwrap().rows;
        assert_eq!(read, table.rows);
        let scores: Vec<f64> = read.iter().map(|row| row.psnr).collect();
        assert_eq!(scores, [21.0, 22.0]);
    }
}
