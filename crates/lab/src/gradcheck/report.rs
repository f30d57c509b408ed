//! Reports of gradient checks as a table for people and as JSON for programs.

use std::fmt::Write;

use serde_json::{Map, Value, json};

use super::Precision;
use super::judge::FileReport;

/// A table with one row per file and parameter group, followed by the images.
pub fn table(reports: &[FileReport]) -> String {
    let mut text = String::new();
    for report in reports {
        write_file(&mut text, report).expect("writing to a string cannot fail");
    }
    text
}

fn write_file(text: &mut String, report: &FileReport) -> std::fmt::Result {
    writeln!(
        text,
        "{}  {}  [{}, gate {:.0e}{}]  {}",
        verdict(report.pass),
        report.file.display(),
        report.precision,
        report.gate,
        if report.hard { ", hard" } else { "" },
        report.case
    )?;
    writeln!(
        text,
        "  {:<11} {:>9} {:>9} {:>10} {:>9}  {:<14} {:>11}",
        "group", "rel L2", "1 - cos", "bias", "worst", "at", "zeros / ref"
    )?;
    for group in &report.groups {
        writeln!(
            text,
            "  {:<11} {:>9.1e} {:>9.1e} {:>10.1e} {:>9.1e}  {:<14} {:>3.0}% / {:>3.0}%{}{}",
            group.name,
            group.rel_l2,
            group.one_minus_cosine,
            group.bias,
            group.worst,
            format!("{:?}", group.worst_index),
            100.0 * group.zeros,
            100.0 * group.zeros_reference,
            if group.reference_is_zero {
                "  reference is zero"
            } else {
                ""
            },
            if group.pass { "" } else { "  FAILS" },
        )?;
    }
    for output in &report.outputs {
        writeln!(
            text,
            "  {:<11} {:>9.1e} rel L2, {:.1e} max abs{}",
            output.name,
            output.rel_l2,
            output.max_abs,
            if output.pass { "" } else { "  FAILS" },
        )?;
    }
    let leaves_out = cfg!(feature = "cpu") && report.precision == Precision::F32;
    let left_out = if leaves_out && report.near_threshold > 0 {
        ", left out above: the gradient without them is judged by ours in f64"
    } else {
        ""
    };
    writeln!(
        text,
        "  {} of {} pixels near a threshold{left_out}",
        report.near_threshold, report.pixels
    )?;
    for reason in &report.reasons {
        writeln!(text, "  FAILS: {reason}")?;
    }
    Ok(())
}

fn verdict(pass: bool) -> &'static str {
    if pass { "pass" } else { "FAIL" }
}

/// `{"files": [{"file", "case", "groups": {...}, "image": {...}, ..., "pass"}]}`. Numbers that are
/// not finite are null.
pub fn json(reports: &[FileReport]) -> Value {
    json!({ "files": reports.iter().map(file_json).collect::<Vec<_>>() })
}

fn file_json(report: &FileReport) -> Value {
    let groups: Map<String, Value> = report
        .groups
        .iter()
        .map(|group| {
            let value = json!({
                "rel_l2": group.rel_l2,
                "one_minus_cosine": group.one_minus_cosine,
                "bias": group.bias,
                "worst": group.worst,
                "worst_index": group.worst_index,
                "zeros": group.zeros,
                "zeros_reference": group.zeros_reference,
                "pass": group.pass,
            });
            (group.name.to_string(), value)
        })
        .collect();
    let mut file = json!({
        "file": report.file.display().to_string(),
        "case": report.case,
        "precision": report.precision.to_string(),
        "hard": report.hard,
        "gate": report.gate,
        "groups": groups,
        "near_threshold": report.near_threshold,
        "pixels": report.pixels,
        "reasons": report.reasons,
        "pass": report.pass,
    });
    for output in &report.outputs {
        file[output.name] = json!({ "max_abs": output.max_abs, "rel_l2": output.rel_l2 });
    }
    file
}
