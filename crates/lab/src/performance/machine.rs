//! Description of the machine, and resource use of this process.

use std::time::{SystemTime, UNIX_EPOCH};

use serde::Serialize;
use splat_ops::cpu::InstructionSet;

use crate::accuracy::report::machine;

/// Date and machine of a measurement.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Machine {
    /// Day of the measurement, UTC, as 2026-01-31.
    pub date: String,
    /// Processor, threads, system.
    pub name: String,
    /// Instruction set of the inner loops.
    pub instructions: String,
    /// Wide instruction sets of the processor.
    pub available: Vec<&'static str>,
}

impl Machine {
    /// This machine, now.
    pub fn here() -> Self {
        let since = SystemTime::now().duration_since(UNIX_EPOCH);
        Self {
            date: date(since.map_or(0, |since| since.as_secs() / 86_400)),
            name: machine(),
            instructions: InstructionSet::chosen().to_string(),
            available: available(),
        }
    }

    /// One-line description.
    pub fn line(&self) -> String {
        let available = match &self.available[..] {
            [] => "none that is known here".to_owned(),
            some => some.join(", "),
        };
        format!(
            "{}. Wide instructions: {available}; the inner loops ran with {}. {}.",
            self.name, self.instructions, self.date
        )
    }
}

#[cfg(target_arch = "x86_64")]
fn available() -> Vec<&'static str> {
    let features = [
        ("AVX2", is_x86_feature_detected!("avx2")),
        ("FMA", is_x86_feature_detected!("fma")),
        ("AVX-512F", is_x86_feature_detected!("avx512f")),
    ];
    let has = features.into_iter().filter(|(_, has)| *has);
    has.map(|(name, _)| name).collect()
}

#[cfg(not(target_arch = "x86_64"))]
fn available() -> Vec<&'static str> {
    if cfg!(target_arch = "aarch64") {
        vec!["NEON"]
    } else {
        vec![]
    }
}

/// Gregorian date of a number of days after 1970-01-01. Years begin in March, so that the leap day
/// is the last of a year; 400 years are 146,097 days.
fn date(days: u64) -> String {
    let days = days + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let (year, month) = if month < 10 {
        (year, month + 3)
    } else {
        (year + 1, month - 9)
    };
    format!("{:04}-{month:02}-{day:02}", era * 400 + year)
}

/// Resources used by a process.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Usage {
    /// Pages touched for the first time, or again after being returned.
    pub(super) page_faults: f64,
    /// Processor time of all threads, with a resolution of a hundredth of a second.
    pub(super) cpu_seconds: f64,
}

impl Usage {
    /// Usage of this process so far, on Linux; `None` elsewhere.
    pub(super) fn so_far() -> Option<Self> {
        Self::parse(&std::fs::read_to_string("/proc/self/stat").ok()?)
    }

    /// Usage since an earlier moment.
    pub(super) fn since(self, earlier: Self) -> Self {
        Self {
            page_faults: self.page_faults - earlier.page_faults,
            cpu_seconds: self.cpu_seconds - earlier.cpu_seconds,
        }
    }

    /// Parses the tenth field of `/proc/self/stat`, and the sum of the fourteenth and fifteenth, in
    /// ticks of 10 ms; the second field is a name in brackets with arbitrary contents.
    fn parse(stat: &str) -> Option<Self> {
        let (_, after_name) = stat.rsplit_once(')')?;
        let fields: Vec<&str> = after_name.split_whitespace().collect();
        let field = |number: usize| fields.get(number - 3)?.parse::<f64>().ok();
        Some(Self {
            page_faults: field(10)?,
            cpu_seconds: 0.01 * (field(14)? + field(15)?),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn days_are_counted_over_leap_years() {
        let known = [
            (0, "1970-01-01"),
            (59, "1970-03-01"),
            (11_016, "2000-02-29"),
            (11_017, "2000-03-01"),
            (20_453, "2025-12-31"),
            (47_540, "2100-02-28"),
            (47_541, "2100-03-01"),
        ];
        for (days, expected) in known {
            assert_eq!(date(days), expected);
        }
    }

    #[test]
    fn usage_is_found_behind_any_name() {
        let stat = "12 (a) b (c) R 1 2 3 4 5 4194304 678 0 9 0 150 25 0 0";
        let usage = Usage::parse(stat).unwrap();
        assert_eq!((usage.page_faults, usage.cpu_seconds), (678.0, 1.75));
        assert_eq!(Usage::parse("12 (a"), None);
        assert_eq!(Usage::parse("12 (a) R 1 2"), None);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn fresh_memory_faults_and_work_takes_time() {
        let before = Usage::so_far().unwrap();
        let touched = vec![1u8; 64 << 20];
        let mut sum = 0u64;
        let start = std::time::Instant::now();
        while start.elapsed().as_millis() < 100 || sum == 0 {
            sum += touched.iter().map(|byte| u64::from(*byte)).sum::<u64>();
        }
        let used = Usage::so_far().unwrap().since(before);
        assert!(used.page_faults > 0.0 && used.cpu_seconds > 0.0, "{used:?}");
    }
}
