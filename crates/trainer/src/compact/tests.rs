use super::*;
use burn::tensor::Device;
use splat_data::{Capture, CaptureSettings};

use crate::{TrainSettings, Trainer};

fn capture() -> Capture {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
    Capture::load(folder, &CaptureSettings::new().with_downscale(8)).unwrap()
}

fn trained(capture: &Capture) -> SplatData {
    let trainer = Trainer::builder(capture.clone())
        .settings(TrainSettings::new().with_steps(200))
        .device(Device::flex());
    trainer.build().unwrap().run().unwrap().to_data()
}

#[test]
fn a_scene_loses_what_it_may_and_no_more() {
    let capture = capture();
    let splats = trained(&capture);
    let views: Vec<_> = capture.train_views().collect();
    let device = Device::flex();
    let mut before = splats.len();
    for max_loss in [0.05, 0.5] {
        let settings = CompactSettings::new().with_max_loss(max_loss);
        let mut told = Vec::new();
        let small = compact(&splats, &views, &settings, &device, |name, done, of| {
            assert!(done <= of, "{name}: {done} of {of}");
            told.push(name);
        });
        let small = small.unwrap();
        told.dedup();
        assert_eq!(told, ["removing Gaussians", "lowering degrees"]);
        small.splats.check_shape().unwrap();
        // More loss, fewer Gaussians.
        assert!(
            small.splats.len() < before,
            "{} {before}",
            small.splats.len()
        );
        before = small.splats.len();
        let [whole, pruned, reduced] = &small.stages[..] else {
            panic!("{:?}", small.stages)
        };
        assert!(
            pruned.psnr >= whole.psnr - 0.5 * max_loss,
            "{:?}",
            small.stages
        );
        assert!(
            reduced.psnr >= whole.psnr - 0.75 * max_loss,
            "{:?}",
            small.stages
        );
        assert!(reduced.degrees[0] > pruned.degrees[0]);
        let again = Judge::new(&views, &device).psnr(&small.splats).unwrap();
        assert_eq!(again, reduced.psnr);
    }
}

#[test]
fn what_no_view_sees_goes_without_a_loss() {
    let capture = capture();
    let mut splats = trained(&capture);
    let hidden = splats.select(&[0, 1]);
    let count = splats.len();
    let everywhere = splats.select(&(0..count).chain([0, 1]).collect::<Vec<_>>());
    assert_eq!(everywhere.len(), count + 2);
    splats = everywhere;
    for row in [count, count + 1] {
        splats.means[row] = [0.0, -1e6, 0.0];
    }
    assert_eq!(hidden.len(), 2);
    let views: Vec<_> = capture.train_views().collect();
    let settings = CompactSettings::new().with_max_loss(0.0);
    let small = compact(&splats, &views, &settings, &Device::flex(), |_, _, _| {}).unwrap();
    assert!(small.splats.means.iter().all(|mean| mean[1] > -1e5));
}

#[test]
fn scenes_and_splits_without_anything_are_no_panic() {
    let capture = capture();
    let views: Vec<_> = capture.train_views().collect();
    let (settings, device) = (CompactSettings::new(), Device::flex());
    let nothing = SplatData::default();
    let small = compact(&nothing, &views, &settings, &device, |_, _, _| {}).unwrap();
    assert!(small.splats.is_empty());
    let error = compact(&nothing, &[], &settings, &device, |_, _, _| {}).unwrap_err();
    assert!(error.to_string().contains("no views"), "{error}");
}
