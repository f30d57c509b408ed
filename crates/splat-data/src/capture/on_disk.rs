//! Photos that stay on the disk, and are decoded whenever they are needed.

use std::sync::Arc;

use super::photo_file::size_or_error;
use super::photo_loader::{Loaded, Loader};
use super::sparse_model::{SparseCamera, SparseImage};
use super::{CaptureError, View};

/// A photo on the disk, with how it is to be read. See [`View::loaded`].
#[derive(Debug, Clone)]
pub struct PhotoOnDisk(Arc<Photo>);

#[derive(Debug, Clone)]
struct Photo {
    loader: Arc<Loader>,
    image: SparseImage,
    camera: SparseCamera,
    /// Factors of [`View::downscaled`], in their order.
    factors: Vec<u32>,
}

impl PhotoOnDisk {
    /// The view of an image whose photo stays on the disk. Only the size of the photo is read.
    pub(super) fn look(
        loader: &Arc<Loader>,
        image: &SparseImage,
        camera: &SparseCamera,
    ) -> Result<Loaded, CaptureError> {
        let path = loader.folder.join(&image.name);
        let mut loaded = loader.placed(image, camera, &path, size_or_error(&path)?)?;
        loaded.view.on_disk = Some(Self(Arc::new(Photo {
            loader: loader.clone(),
            image: image.clone(),
            camera: *camera,
            factors: vec![],
        })));
        Ok(loaded)
    }

    /// The same photo, downscaled.
    pub(super) fn downscaled(&self, factor: u32) -> Self {
        let mut photo = Photo::clone(&self.0);
        photo.factors.push(factor);
        Self(Arc::new(photo))
    }

    /// Decodes the photo and its mask for a view.
    pub(super) fn load(&self, view: &View) -> Result<View, CaptureError> {
        let Photo {
            loader,
            image,
            camera,
            factors,
        } = &*self.0;
        let mut read = loader.load(image, camera)?.view;
        for factor in factors {
            read = read.downscaled(*factor);
        }
        if [read.width, read.height] != [view.width, view.height] {
            return Err(CaptureError::UndecodablePhoto {
                path: loader.folder.join(&image.name),
                reason: "its size has changed since the capture was read".to_owned(),
            });
        }
        // Camera and pose may have been changed since.
        Ok(View {
            image: read.image,
            mask: read.mask,
            on_disk: None,
            ..view.clone()
        })
    }
}
