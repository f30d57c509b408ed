//! Findings of a check, as a table.

use std::fmt;

/// Result of [`gradcheck`](super::gradcheck) or of [`Fixture::check`](super::Fixture::check).
///
/// `Display` prints a table with one row per input, and a line for each finding.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// Source of the compared derivatives: `numeric` or `expected`.
    pub compared_with: &'static str,
    /// One row per input, in order; for a fixture, one per output too.
    pub rows: Vec<Row>,
}

/// Findings in one tensor.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Name of the tensor.
    pub name: String,
    /// Shape of the tensor.
    pub shape: Vec<usize>,
    /// How the tensor was examined.
    pub coverage: Coverage,
    /// The comparison that came closest to failing, or failed most; `None` if nothing was compared.
    pub worst: Option<Comparison>,
    /// True if every derivative is exactly zero on both sides: the function does not depend on this
    /// input at this point, so little was checked.
    pub all_zero: bool,
    /// Failures and kinks. At most eight are listed; there may be more.
    pub findings: Vec<Finding>,
}

/// How a tensor was examined.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Coverage {
    /// Element by element.
    Elements(usize),
    /// Along random directions over all elements.
    Directions {
        /// Number of directions.
        count: usize,
        /// Smallest error of a single element's derivative that is certain to be seen, in units of
        /// the root mean square derivative; both times the element's size.
        limit: f64,
    },
    /// Not examined: a constant.
    Constant,
}

/// An analytic derivative and the value it is compared with.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// Index of the element; `None` for a direction over all elements.
    pub at: Option<Vec<usize>>,
    /// The function's own gradient.
    pub analytic: f64,
    /// The reference value.
    pub numeric: f64,
    /// Error bound of `numeric`.
    pub error: f64,
}

/// A finding at one element.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// Kind of finding.
    pub kind: Kind,
    /// Position and numbers.
    pub comparison: Comparison,
}

/// Kinds of findings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Kind {
    /// The analytic derivative differs from the numeric one.
    Wrong,
    /// Autodiff has no gradient, although the function depends on the input.
    NoGradient,
    /// The derivatives on the left and on the right differ.
    Kink {
        /// Slope towards smaller values.
        left: f64,
        /// Slope towards larger values.
        right: f64,
        /// True if it passes: the analytic derivative lies between both, and kinks are not refused.
        accepted: bool,
    },
    /// The numeric derivative cannot be determined: a discontinuity, noise, or a function that
    /// changes faster than the steps.
    Unresolved,
    /// The function is not finite at any step near this point.
    OutsideDomain,
}

impl Kind {
    /// True if it fails the check.
    pub fn fails(self) -> bool {
        !matches!(self, Self::Kink { accepted: true, .. })
    }
}

/// The first failure of a check, in words.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct Failure(String);

impl Report {
    /// True if no finding fails.
    pub fn is_ok(&self) -> bool {
        self.failure().is_none()
    }

    /// Returns the report if it is ok.
    ///
    /// # Errors
    /// Otherwise a message with input, element, numbers, and remedy.
    pub fn check(self) -> Result<Self, Failure> {
        match self.failure() {
            None => Ok(self),
            Some((row, finding)) => Err(Failure(self.sentence(row, finding))),
        }
    }

    /// Asserts that the report is ok. For tests.
    ///
    /// # Panics
    /// Otherwise, with the table.
    #[track_caller]
    pub fn expect(&self) {
        assert!(self.is_ok(), "{self}");
    }

    /// The row of an input; `None` for an unknown name.
    pub fn row(&self, name: &str) -> Option<&Row> {
        self.rows.iter().find(|row| row.name == name)
    }

    /// The largest relative difference among the rows' worst comparisons.
    pub fn worst_relative(&self) -> f64 {
        let worst = self.rows.iter().filter_map(|row| row.worst.as_ref());
        worst.map(Comparison::relative).fold(0.0, f64::max)
    }

    fn failure(&self) -> Option<(&Row, &Finding)> {
        let findings = self
            .rows
            .iter()
            .flat_map(|row| row.findings.iter().map(move |finding| (row, finding)));
        findings.into_iter().find(|(_, f)| f.kind.fails())
    }

    fn sentence(&self, row: &Row, finding: &Finding) -> String {
        let name = &row.name;
        let c = &finding.comparison;
        let place = c.place();
        let (analytic, numeric, error) = (c.analytic, c.numeric, c.error);
        let with = self.compared_with;
        match finding.kind {
            Kind::Wrong => format!(
                "`{name}` {place}: analytic {analytic:e}, {with} {numeric:e} (+- {error:.0e}); the gradient is wrong there, \
                 correct the backward pass"
            ),
            Kind::NoGradient => format!(
                "`{name}` {place}: no gradient, {with} {numeric:e} (+- {error:.0e}); is it detached, or missing in the \
                 backward pass? Otherwise declare it a constant"
            ),
            Kind::Kink {
                left,
                right,
                accepted: true,
            } => format!(
                "`{name}` {place}: a kink, slopes {left:e} on the left and {right:e} on the right; analytic {analytic:e} is \
                 accepted"
            ),
            Kind::Kink { left, right, .. } if c.at.is_none() => format!(
                "`{name}` {place}: more kinks than are looked for, slopes {left:e} and {right:e} along it. Choose another \
                 point, or a smaller input"
            ),
            Kind::Kink { left, right, .. } => format!(
                "`{name}` {place}: a kink, slopes {left:e} on the left and {right:e} on the right; analytic {analytic:e} is \
                 refused: it lies outside of them, or kinks are refused. Choose another point or correct the backward pass"
            ),
            Kind::Unresolved => format!(
                "`{name}` {place}: the {with} derivative {numeric:e} is uncertain by {error:.0e}; is there a jump or noise? \
                 Choose another point, or a smaller step"
            ),
            Kind::OutsideDomain => format!(
                "`{name}` {place}: the function is not finite beside this point; move it into the domain, or take a smaller \
                 step"
            ),
        }
    }
}

impl Comparison {
    /// True if both derivatives are exactly zero.
    pub(super) fn is_zero(&self) -> bool {
        self.analytic == 0.0 && self.numeric == 0.0
    }

    /// Difference relative to the larger of both; 0 if they are equal.
    pub fn relative(&self) -> f64 {
        let difference = (self.analytic - self.numeric).abs();
        if difference == 0.0 {
            0.0
        } else {
            difference / self.analytic.abs().max(self.numeric.abs())
        }
    }

    fn place(&self) -> String {
        match &self.at {
            Some(at) => format!("at {at:?}"),
            None => "along a direction over all elements".into(),
        }
    }
}

impl Row {
    /// Row of an input that is not examined.
    pub(super) fn constant(name: &str, shape: &[usize]) -> Self {
        Self {
            name: name.into(),
            shape: shape.to_vec(),
            coverage: Coverage::Constant,
            worst: None,
            all_zero: false,
            findings: Vec::new(),
        }
    }

    /// True if none of its findings fails.
    pub fn is_ok(&self) -> bool {
        !self.findings.iter().any(|finding| finding.kind.fails())
    }

    fn verdict(&self) -> &'static str {
        let first = self.findings.iter().find(|f| f.kind.fails());
        match first.or(self.findings.first()).map(|finding| finding.kind) {
            None if self.all_zero => "ok, all zero",
            None => "ok",
            Some(Kind::Wrong) => "WRONG",
            Some(Kind::NoGradient) => "NO GRADIENT",
            Some(Kind::Kink { accepted: true, .. }) => "ok, kink",
            Some(Kind::Kink { .. }) => "KINK",
            Some(Kind::Unresolved) => "UNRESOLVED",
            Some(Kind::OutsideDomain) => "OUTSIDE DOMAIN",
        }
    }
}

impl fmt::Display for Coverage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Elements(1) => f.write_str("1 element"),
            Self::Elements(count) => write!(f, "{count} elements"),
            Self::Directions { count, limit } => {
                write!(f, "{count} directions, sees {limit:.0e} rms")
            }
            Self::Constant => f.write_str("constant"),
        }
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let wide =
            |cells: &mut dyn Iterator<Item = usize>, least: usize| cells.fold(least, usize::max);
        let name = wide(&mut self.rows.iter().map(|row| row.name.chars().count()), 4);
        let shape = wide(
            &mut self.rows.iter().map(|row| format!("{:?}", row.shape).len()),
            5,
        );
        let checked = wide(
            &mut self.rows.iter().map(|row| row.coverage.to_string().len()),
            7,
        );
        let place = |row: &Row| match row.worst.as_ref() {
            Some(Comparison { at: Some(at), .. }) => format!("{at:?}"),
            Some(_) => "all".into(),
            None => "-".into(),
        };
        let at = wide(&mut self.rows.iter().map(|row| place(row).len()), 5);
        writeln!(
            f,
            "{:<name$}  {:<shape$}  {:<checked$}  {:<at$}  {:>12}  {:>12}  {:>7}  verdict",
            "name", "shape", "checked", "worst", "analytic", self.compared_with, "error"
        )?;
        for row in &self.rows {
            let [analytic, numeric, error] = match &row.worst {
                None => ["-".into(), "-".into(), "-".into()],
                Some(c) => [
                    format!("{:.5e}", c.analytic),
                    format!("{:.5e}", c.numeric),
                    format!("{:.0e}", c.error),
                ],
            };
            writeln!(
                f,
                "{:<name$}  {:<shape$}  {:<checked$}  {:<at$}  {analytic:>12}  {numeric:>12}  {error:>7}  {}",
                row.name,
                format!("{:?}", row.shape),
                row.coverage.to_string(),
                place(row),
                row.verdict(),
            )?;
        }
        for row in &self.rows {
            for finding in &row.findings {
                writeln!(f, "{}", self.sentence(row, finding))?;
            }
        }
        Ok(())
    }
}
