//! A few seconds of fuzzing of every reader, always with the same inputs. `fuzz/run.sh` continues
//! from there.

use splat_fuzz::{Campaign, TARGETS};

fn runs(name: &str, executions: u64) {
    let target = TARGETS.iter().find(|target| target.name == name);
    let target = target.unwrap_or_else(|| panic!("no target {name}"));
    let mut campaign = Campaign::new(target, 1).unwrap_or_else(|failure| panic!("{failure}"));
    while campaign.report.executions < executions {
        campaign
            .step()
            .unwrap_or_else(|failure| panic!("{failure}"));
    }
    let report = campaign.finish();
    println!("{name}: {report:?}");
    assert!(report.accepted > executions / 100, "{report:?}");
    assert!(report.accepted < executions, "{report:?}");
}

#[test]
fn colmap_binary() {
    runs("colmap_binary", 700_000);
}

#[test]
fn colmap_text() {
    runs("colmap_text", 600_000);
}

#[test]
fn transforms() {
    runs("transforms", 150_000);
}

#[test]
fn points() {
    runs("points", 300_000);
}

#[test]
fn ply() {
    runs("ply", 300_000);
}

#[test]
fn spz() {
    runs("spz", 60_000);
}

#[test]
fn sog() {
    runs("sog", 30_000);
}

#[test]
fn fixture() {
    runs("fixture", 60_000);
}

#[test]
fn checkpoint() {
    runs("checkpoint", 60_000);
}

#[test]
fn config() {
    runs("config", 300_000);
}

#[test]
fn gaussians() {
    runs("gaussians", 100_000);
}
