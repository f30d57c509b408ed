//! Errors of captures.

use std::path::{Path, PathBuf};

use splat_core::memory::in_units;

use super::colmap_models;

/// Why a capture cannot be used. Every message is one line that names the file and the record, and
/// says what to do where that is not obvious.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CaptureError {
    /// A file or folder could not be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The capture's path is not a folder.
    #[error("{}: neither a folder nor a .json file; a capture is a folder with `images/` and `sparse/0/`, or with `transforms.json`", path.display())]
    NotAFolder {
        /// The path given.
        path: PathBuf,
    },
    /// The folder holds no capture in a known format.
    #[error(
        "{}: no capture: looked for COLMAP's cameras.bin and cameras.txt in `sparse/0`, `sparse` and the folder itself, and for transforms.json and transforms_train.json",
        root.display()
    )]
    NoModel {
        /// The capture's folder.
        root: PathBuf,
    },
    /// The folder of other cameras holds no COLMAP model.
    #[error(
        "{}: no cameras: they are read from a COLMAP model, the files cameras and images, both .bin or both .txt; a run that refined its cameras writes them to `cameras` in its own folder",
        folder.display()
    )]
    NoCameras {
        /// The folder.
        folder: PathBuf,
    },
    /// One of the files of a model is missing.
    #[error("{}: missing; a COLMAP model needs cameras and images, both .bin or both .txt", path.display())]
    MissingModelFile {
        /// The file.
        path: PathBuf,
    },
    /// A binary file ends inside a record.
    #[error("{}: truncated: the file ends in the {field} of {record}", path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
        /// The record, such as `image 3 of 32`.
        record: String,
        /// The field being read.
        field: &'static str,
    },
    /// A count that exceeds the rest of the file.
    #[error(
        "{}: {record} announces {count} {what}, but the {remaining} bytes that follow cannot hold them; the file is truncated or damaged",
        path.display()
    )]
    ImpossibleCount {
        /// The file.
        path: PathBuf,
        /// The record that holds the count.
        record: String,
        /// The counted items.
        what: &'static str,
        /// The count.
        count: u64,
        /// Bytes left in the file.
        remaining: usize,
    },
    /// A binary file that continues after its last record.
    #[error(
        "{}: {remaining} bytes follow the {count} {what} that the file announces; it is damaged, or its count is wrong",
        path.display()
    )]
    LeftOver {
        /// The file.
        path: PathBuf,
        /// The count at its start.
        count: usize,
        /// The counted items.
        what: &'static str,
        /// Bytes left in the file.
        remaining: usize,
    },
    /// A text file in an unsupported encoding.
    #[error("{}: {reason}", path.display())]
    NotText {
        /// The file.
        path: PathBuf,
        /// The encoding found, and what to do.
        reason: &'static str,
    },
    /// A record that cannot be parsed or makes no sense.
    #[error("{}: {record}: {reason}", path.display())]
    BadRecord {
        /// The file.
        path: PathBuf,
        /// The record, such as `image 3 of 32` or `line 7`.
        record: String,
        /// The reason.
        reason: String,
    },
    /// A `transforms.json` that is none.
    #[error("{}: {reason}", path.display())]
    BadTransforms {
        /// The file.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
    /// Most photos of a `transforms.json` do not exist.
    #[error(
        "{}: {missing} of its {frames} frames have no photo, from {}; restore the photos, or name their folder with --images",
        path.display(), first.display()
    )]
    MissingPhotos {
        /// The file with the frames.
        path: PathBuf,
        /// Number of frames without a photo.
        missing: usize,
        /// Number of frames.
        frames: usize,
        /// The first photo that does not exist.
        first: PathBuf,
    },
    /// A camera model that is not implemented.
    #[error(
        "{}: camera {camera_id} has the camera model {model}, which cannot be read: {remedy}",
        path.display()
    )]
    UnsupportedCamera {
        /// The file with the cameras.
        path: PathBuf,
        /// Id of the camera.
        camera_id: u32,
        /// Name and number of its model.
        model: String,
        /// What to do.
        remedy: &'static str,
    },
    /// A model without images.
    #[error("{}: the model holds no image; the reconstruction found no camera, run it again with more overlap", path.display())]
    NoImages {
        /// The images file.
        path: PathBuf,
    },
    /// The folder given for the photos does not exist.
    #[error(
        "{}: no such folder of photos (--images); give it relative to the capture, or whole{}",
        path.display(),
        elsewhere.as_ref().map_or_else(String::new, |folder| {
            format!("; photos of the model are in `{}`", folder.display())
        })
    )]
    NoPhotoFolder {
        /// The folder.
        path: PathBuf,
        /// Another folder of the capture that holds photos of the model, relative to the capture.
        elsewhere: Option<PathBuf>,
    },
    /// The photo of an image of the model does not exist.
    #[error(
        "{}: no such photo, but the model names the image `{image}`; {}",
        path.display(),
        match elsewhere {
            None => "restore it or remove it from the model".to_owned(),
            Some((folder, count)) => format!(
                "{count} photo(s) of the model are in the folder `{}`, which can be named with --images",
                folder.display()
            ),
        }
    )]
    MissingPhoto {
        /// Expected path of the photo.
        path: PathBuf,
        /// Name of the image in the model.
        image: String,
        /// Another folder of the capture, relative to it, that holds more photos of the model, with
        /// their number.
        elsewhere: Option<(PathBuf, usize)>,
    },
    /// A photo with a missing part, which decoders would invent.
    #[error(
        "{}: {reason}; the rest would be made up: restore the photo, or remove its image from the model",
        path.display()
    )]
    IncompletePhoto {
        /// The photo.
        path: PathBuf,
        /// The missing part.
        reason: String,
    },
    /// A photo that cannot be decoded.
    #[error("{}: cannot be decoded as JPEG, PNG, WebP or TIFF: {reason}", path.display())]
    UndecodablePhoto {
        /// The photo.
        path: PathBuf,
        /// The decoder's message.
        reason: String,
    },
    /// A photo alone needs more memory than is available.
    #[error(
        "{}: a photo needs {} of memory, and {} are left; rescale the photos to a smaller size",
        root.display(), in_units(*needed), in_units(*left)
    )]
    OutOfMemory {
        /// The capture's folder.
        root: PathBuf,
        /// Bytes of the pixels of the largest photo, before it is downscaled.
        needed: u64,
        /// Bytes that this process can still allocate.
        left: u64,
    },
    /// A photo whose aspect ratio differs from its camera's.
    #[error(
        "{}: the photo is {}x{} pixels, but its camera {camera_id} is {}x{}; {}",
        path.display(), photo[0], photo[1], camera[0], camera[1],
        if photo[0] == camera[1] && photo[1] == camera[0] {
            "it was rotated: use the photos the model was made from"
        } else {
            "use the photos the model was made from, or a uniform rescale of them"
        }
    )]
    PhotoSize {
        /// The photo.
        path: PathBuf,
        /// Its width and height.
        photo: [u32; 2],
        /// Id of its camera.
        camera_id: u32,
        /// The camera's width and height.
        camera: [u32; 2],
    },
    /// A mask that differs in size from its photo.
    #[error(
        "{}: the mask is {}x{} pixels, but its photo {} is {}x{}; rescale the mask to the photo's size, or use the photos it was made for",
        mask.display(), mask_size[0], mask_size[1], photo.display(), photo_size[0], photo_size[1]
    )]
    MaskSize {
        /// The mask.
        mask: PathBuf,
        /// Its width and height.
        mask_size: [u32; 2],
        /// The photo.
        photo: PathBuf,
        /// Its width and height.
        photo_size: [u32; 2],
    },
    /// A photo too small for SSIM.
    #[error(
        "{}: the photo is {}x{} pixels{}; at least {min}x{min} are needed, the window of SSIM",
        path.display(), size[0], size[1],
        if *downscale > 1 { format!(" after --downscale {downscale}") } else { String::new() }
    )]
    PhotoTooSmall {
        /// The photo.
        path: PathBuf,
        /// Its width and height, after downscaling.
        size: [u32; 2],
        /// The downscale factor.
        downscale: u32,
        /// Smallest width and height.
        min: u32,
    },
    /// An unusable `split.json`.
    #[error("{}: {reason}", path.display())]
    BadSplit {
        /// The file.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
    /// No view is left for training.
    #[error(
        "{}: nothing to train on: {}",
        root.display(),
        if *photos == 1 {
            "its only photo is held out; at least 2 are needed, since the first is held out by default (or hold out none, with --hold-out 0)".to_owned()
        } else {
            format!(
                "the split leaves none of the {photos} photos for training, as asked for with --hold-out (1 holds out every photo) or by the capture (split.json, or lists of its own); leave some of them, with --hold-out 8 for example"
            )
        }
    )]
    NothingToTrainOn {
        /// The capture's folder.
        root: PathBuf,
        /// Number of photos.
        photos: usize,
    },
    /// A downscale factor of 0.
    #[error("downscale: the factor must be at least 1")]
    ZeroDownscale,
}

impl CaptureError {
    pub(super) fn unsupported_camera(path: &Path, camera_id: u32, model: String) -> Self {
        Self::UnsupportedCamera {
            path: path.to_path_buf(),
            camera_id,
            remedy: colmap_models::remedy(&model),
            model,
        }
    }
}
