//! One measured run.

/// What a run is of. Rows with equal keys are of the same run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Key {
    /// Name of the capture.
    pub capture: String,
    /// Name of the recipe.
    pub recipe: String,
    /// Seed of the run.
    pub seed: u64,
    /// Steps of the run.
    pub steps: usize,
    /// Factor by which the photos were area-averaged.
    pub downscale: u32,
    /// Name of the device.
    pub device: String,
}

/// What became of a run.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Row {
    /// The run.
    pub key: Key,
    /// [`digest`] of the run's settings, capture and program.
    pub digest: String,
    /// Held-out PSNR in dB.
    pub psnr: f64,
    /// Held-out SSIM.
    pub ssim: f64,
    /// Gaussians at the end.
    pub gaussians: usize,
    /// Most Gaussians at any time.
    pub most_gaussians: usize,
    /// Seconds spent in training steps.
    pub seconds: f64,
    /// Seconds between the end of the run before, or the start of the command, and the end of this
    /// one that were not spent in training steps.
    pub outside_seconds: f64,
    /// Size of the scene as PLY.
    pub ply_bytes: u64,
    /// Size of the scene as SPZ.
    pub spz_bytes: u64,
    /// Name of the held-out view of which there is a picture, if there is one.
    pub view: Option<String>,
    /// Held-out PSNR in dB after so many seconds of training.
    pub curve: Vec<(f64, f64)>,
}

/// FNV-1a of a text, 64 bits as hexadecimal digits: another one for another text, and the same on
/// every machine.
pub(super) fn digest(text: &str) -> String {
    let hash = text.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    format!("{hash:016x}")
}

/// A row for tests.
#[cfg(test)]
pub(super) fn example(capture: &str, recipe: &str, seed: u64, psnr: f64) -> Row {
    Row {
        key: Key {
            capture: capture.to_owned(),
            recipe: recipe.to_owned(),
            seed,
            steps: 100,
            downscale: 4,
            device: "cpu".to_owned(),
        },
        digest: digest("recipe"),
        psnr,
        ssim: 0.5,
        gaussians: 1000,
        most_gaussians: 1500,
        seconds: 10.0,
        outside_seconds: 0.25,
        ply_bytes: 236_000,
        spz_bytes: 20_000,
        view: None,
        curve: vec![(5.0, psnr - 1.0), (10.0, psnr)],
    }
}

#[cfg(test)]
mod tests {
    use super::digest;

    /// Values of the algorithm's authors.
    #[test]
    fn the_digest_is_fnv() {
        assert_eq!(digest(""), "cbf29ce484222325");
        assert_eq!(digest("a"), "af63dc4c8601ec8c");
        assert_eq!(digest("foobar"), "85944171f73967e8");
    }
}
