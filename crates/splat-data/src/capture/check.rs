//! Whether a capture can be trained on.

use super::{Capture, CaptureError, View};

impl Capture {
    /// Checks that there is at least one view to train on, and a pixel that counts in one of them.
    ///
    /// Photos that are not in memory are decoded for this, up to the first with such a pixel.
    ///
    /// # Errors
    ///
    /// [`CaptureError::NothingToTrainOn`], for example for a single photo under the default split;
    /// [`CaptureError::BadRecord`] if masks ignore all training photos as a whole; and those of
    /// [`View::loaded`].
    pub fn check_trainable(&self) -> Result<(), CaptureError> {
        if self.split.train.is_empty() {
            return Err(CaptureError::NothingToTrainOn {
                root: self.root.clone(),
                photos: self.views.len(),
            });
        }
        for view in self.train_views() {
            if counts(view)? {
                return Ok(());
            }
        }
        Err(CaptureError::BadRecord {
            path: self.root.clone(),
            record: "masks".to_owned(),
            reason: format!(
                "nothing to train on: those of all {} training photo(s) ignore every pixel; in a mask, or in the alpha of a photo, black is ignored and white counts: invert the masks, or remove them",
                self.split.train.len()
            ),
        })
    }
}

/// True if a pixel of the photo counts, at least in part.
fn counts(view: &View) -> Result<bool, CaptureError> {
    let view = view.loaded()?;
    let mask = view.mask.as_ref();
    Ok(mask.is_none_or(|mask| mask.iter().any(|&value| value > 0)))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use image::{GrayImage, Luma};

    use super::super::test_capture::{TestCapture, good};
    use super::*;
    use crate::CaptureSettings;

    /// Writes a mask of one value for a photo of the capture.
    fn mask(root: &Path, name: &str, value: u8) {
        let photo = root.join("images").join(name);
        let (width, height) = image::image_dimensions(photo).unwrap();
        std::fs::create_dir_all(root.join("masks")).unwrap();
        GrayImage::from_pixel(width, height, Luma([value]))
            .save(root.join("masks").join(format!("{name}.png")))
            .unwrap();
    }

    fn check(root: &Path, options: &CaptureSettings) -> Result<(), CaptureError> {
        Capture::load(root, options).unwrap().check_trainable()
    }

    #[test]
    fn photos_that_are_all_masked_as_a_whole_are_refused() {
        let (root, TestCapture { images, .. }) = good();
        for (_, _, _, _, name) in &images {
            mask(root.path(), name, 0);
        }
        // The first one is held out.
        mask(root.path(), "view r.png", 255);
        let in_memory = CaptureSettings::new();
        let on_disk = CaptureSettings::new().with_memory(0);
        for options in [&in_memory, &on_disk] {
            let message = check(root.path(), options).unwrap_err().to_string();
            for word in [
                "masks",
                "all 7 training",
                "black is ignored",
                "white counts",
            ] {
                assert!(message.contains(word), "`{message}` does not say `{word}`");
            }
            assert!(!message.contains('\n'), "{message}");
        }
        // The last training photo counts, if little.
        mask(root.path(), "view y.png", 2);
        for options in [&in_memory, &on_disk] {
            check(root.path(), options).unwrap();
        }
    }
}
