//! Warnings of captures.

use std::fmt;
use std::path::PathBuf;

use splat_core::memory::in_units;

/// A problem that did not prevent reading the capture. `Display` gives one line.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum CaptureWarning {
    /// Photos were rescaled without rewriting the cameras; the intrinsics were scaled to the
    /// photos.
    RescaledPhotos {
        /// Number of such photos.
        count: usize,
        /// The first of them.
        first: String,
        /// Its width and height.
        photo: [u32; 2],
        /// Its camera's width and height.
        camera: [u32; 2],
    },
    /// Photos with transparent pixels; these are masked.
    TransparentPhotos {
        /// Number of such photos.
        count: usize,
        /// The first of them.
        first: String,
    },
    /// Masks that ignore a whole photo.
    EmptyMasks {
        /// Number of such photos.
        count: usize,
        /// The first of them.
        first: String,
    },
    /// Photos without a mask, beside a folder of masks.
    PhotosWithoutMask {
        /// The folder of masks.
        folder: PathBuf,
        /// Number of such photos.
        count: usize,
        /// Number of all photos.
        photos: usize,
        /// The first of them.
        first: String,
    },
    /// Photos that would need too much memory; each is decoded whenever it is needed.
    PhotosOnDisk {
        /// Number of photos.
        photos: usize,
        /// Bytes that all would need.
        needed: u64,
        /// Bytes that they may take.
        bound: u64,
    },
    /// A text file of the model lists more or fewer records than its comments announce.
    Miscounted {
        /// The file.
        path: PathBuf,
        /// The listed items.
        what: &'static str,
        /// The number in the comments.
        announced: u64,
        /// The number of records.
        read: usize,
    },
    /// JPEG files with more data than their picture needs, or less detail than announced.
    DamagedPhotos {
        /// Number of such photos.
        count: usize,
        /// The first of them.
        first: String,
    },
    /// Photos in the folder that the model does not name; they are not used.
    UnregisteredPhotos {
        /// Number of such photos.
        count: usize,
        /// The first of them, by name.
        first: String,
    },
    /// More than one model was found; only the one with the most images is read.
    OtherModels {
        /// The folder that was read.
        used: PathBuf,
        /// Number of its images.
        images: u64,
        /// Number of other models beside it that can be read.
        others: usize,
    },
    /// Models that cannot be read, beside the one that is; they may have more images.
    DamagedModels {
        /// The folder that was read.
        used: PathBuf,
        /// Number of such models.
        count: usize,
        /// Why the first of them cannot be read, with the name of the file.
        first: String,
    },
    /// The folder holds another capture, which is not read.
    OtherCapture {
        /// The one that is read.
        used: String,
        /// The other one.
        other: PathBuf,
    },
    /// Frames without a photo on the disk; they are skipped.
    MissingPhotos {
        /// Number of such frames.
        count: usize,
        /// Number of frames.
        frames: usize,
        /// The first photo that does not exist.
        first: PathBuf,
    },
    /// Held-out photos that are for training too; they are not held out.
    RepeatedPhotos {
        /// Number of such photos.
        count: usize,
        /// The first of them.
        first: String,
    },
    /// `fisheye_crop_radius` has no effect.
    CropRadiusIgnored {
        /// The file that has it.
        path: PathBuf,
    },
    /// The capture has no points; random ones take their place.
    RandomPoints {
        /// Number of points.
        count: usize,
        /// Centre of the cube in which they are.
        center: [f64; 3],
        /// Half of its side.
        half_side: f64,
    },
    /// Lenses that fold back inside of the photo: no direction falls on its border.
    LensFoldsBack {
        /// Number of photos with such a lens.
        count: usize,
        /// The first of them.
        first: String,
        /// Share of its pixels that no direction falls on.
        share: f64,
    },
    /// Principal points outside of the photo by more than the photo's size.
    PrincipalPointFarAway {
        /// Number of photos with such a camera.
        count: usize,
        /// The first of them.
        first: String,
        /// The principal point of its camera in its pixels, x and y.
        center: [f64; 2],
        /// Its width and height.
        size: [u32; 2],
    },
    /// The split names photos that the capture does not have.
    SplitNamesUnknown {
        /// Where the split is from, such as `split.json`.
        source: String,
        /// Number of such names.
        count: usize,
        /// The first of them.
        first: String,
    },
    /// The split leaves photos out of both lists; they are not used.
    SplitLeavesOut {
        /// Where the split is from, such as `split.json`.
        source: String,
        /// Number of such photos.
        count: usize,
        /// The first of them.
        first: String,
    },
}

impl fmt::Display for CaptureWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::RescaledPhotos {
                count,
                first,
                photo,
                camera,
            } => write!(
                f,
                "{count} photo(s) differ in size from their camera, from `{first}` ({}x{} against {}x{}); the intrinsics were scaled to the photos",
                photo[0], photo[1], camera[0], camera[1]
            ),
            Self::TransparentPhotos { count, first } => write!(
                f,
                "{count} photo(s) have transparent pixels, from `{first}`; these are masked, and count neither in training nor in scores"
            ),
            Self::EmptyMasks { count, first } => write!(
                f,
                "{count} photo(s) are masked as a whole, from `{first}`: they teach nothing; in a mask, white counts and black is ignored"
            ),
            Self::PhotosWithoutMask {
                folder,
                count,
                photos,
                first,
            } => write!(
                f,
                "{count} of {photos} photo(s) have no mask in {}, from `{first}` (`{first}.png`), and count as a whole",
                folder.display()
            ),
            Self::PhotosOnDisk {
                photos,
                needed,
                bound,
            } => write!(
                f,
                "{photos} photos would need {} of memory, more than {}: each is decoded whenever it is needed, which takes time; read them smaller (--downscale) to keep them in memory",
                in_units(*needed),
                in_units(*bound)
            ),
            Self::DamagedPhotos { count, first } => write!(
                f,
                "{count} photo(s) hold more or less data than their picture takes and are likely damaged, from `{first}`; look at them"
            ),
            Self::UnregisteredPhotos { count, first } => write!(
                f,
                "{count} photo(s) are not in the model and are not used, from `{first}`"
            ),
            Self::MissingPhotos {
                count,
                frames,
                first,
            } => write!(
                f,
                "{count} of {frames} frames have no photo and are skipped, from {}",
                first.display()
            ),
            Self::RepeatedPhotos { count, first } => write!(
                f,
                "{count} held-out photo(s) are for training too, from `{first}`; they are not held out"
            ),
            _ => self.of_the_model(f),
        }
    }
}

impl CaptureWarning {
    /// A warning of photos whose size is not their camera's, if there are any: their names, and
    /// the sizes of photo and camera.
    pub(super) fn rescaled<'a>(
        photos: impl IntoIterator<Item = (&'a str, [[u32; 2]; 2])>,
    ) -> Option<Self> {
        let mut photos = photos.into_iter();
        let (first, [photo, camera]) = photos.next()?;
        Some(Self::RescaledPhotos {
            count: 1 + photos.count(),
            first: first.to_owned(),
            photo,
            camera,
        })
    }

    /// Those about cameras, points and the split.
    fn of_the_model(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Miscounted {
                path,
                what,
                announced,
                read,
            } => write!(
                f,
                "{}: its comments announce {announced} {what}, but it lists {read}; the file may be cut off, or was edited",
                path.display()
            ),
            Self::OtherModels {
                used,
                images,
                others,
            } => write!(
                f,
                "only the model in {} is read, which has the most images ({images}) of {}",
                used.display(),
                others + 1
            ),
            Self::DamagedModels { used, count, first } => write!(
                f,
                "{count} model(s) beside {} cannot be read, and may have more images; repair or remove them; the first: {first}",
                used.display()
            ),
            Self::OtherCapture { used, other } => write!(
                f,
                "{} is not read, because the folder has {used} too; name that file instead of the folder to read it",
                other.display()
            ),
            Self::CropRadiusIgnored { path } => write!(
                f,
                "{}: fisheye_crop_radius has no effect; mask the photos where nothing is seen",
                path.display()
            ),
            Self::RandomPoints {
                count,
                center: [x, y, z],
                half_side,
            } => write!(
                f,
                "the capture has no points: training starts from {count} random ones in a cube of +-{half_side:.4} about ({x:.4}, {y:.4}, {z:.4}); triangulated points (`colmap point_triangulator`) give better results"
            ),
            Self::PrincipalPointFarAway {
                count,
                first,
                center: [x, y],
                size: [width, height],
            } => write!(
                f,
                "{count} photo(s) have a camera whose principal point is far outside of them, from `{first}`: ({x:?}, {y:?}) in its {width}x{height} pixels; correct cx and cy of the camera, which usually are about half of the width and height"
            ),
            Self::LensFoldsBack {
                count,
                first,
                share,
            } => write!(
                f,
                "{count} photo(s) have a lens that folds back inside of them, from `{first}`: no direction falls on {:.0} % of its pixels, at the border, which therefore stay empty; calibrate it again, mask the border, or undistort the photos",
                (100.0 * share).max(1.0)
            ),
            Self::SplitNamesUnknown {
                source,
                count,
                first,
            } => write!(
                f,
                "{source} names {count} photo(s) that the capture does not have, from `{first}`"
            ),
            Self::SplitLeavesOut {
                source,
                count,
                first,
            } => write!(
                f,
                "{source} puts {count} photo(s) in neither list; they are not used, from `{first}`"
            ),
            // Those that `fmt` shows itself.
            Self::RescaledPhotos { .. }
            | Self::TransparentPhotos { .. }
            | Self::EmptyMasks { .. }
            | Self::PhotosWithoutMask { .. }
            | Self::DamagedPhotos { .. }
            | Self::PhotosOnDisk { .. }
            | Self::UnregisteredPhotos { .. }
            | Self::MissingPhotos { .. }
            | Self::RepeatedPhotos { .. } => Ok(()),
        }
    }
}
