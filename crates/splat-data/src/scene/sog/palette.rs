//! The palette of spherical harmonics: one of up to 65,536 sets of coefficients for each Gaussian.

use std::path::Path;

use super::super::{SceneFileError, SplatData};
use super::image::{self, Grid};
use super::meta;
use super::{SogSettings, codebook, kmeans};

/// Most entries: as many as 16 bits count.
pub(super) const MOST: u32 = 1 << 16;
/// Entries in a row of the palette's image.
const PER_ROW: usize = 64;

/// The palette of a scene.
pub(super) struct Palette {
    pub count: u32,
    pub codebook: Vec<f32>,
    /// Size of the image of the entries.
    pub grid: Grid,
    pub centroids: Vec<[u8; 3]>,
    pub labels: Vec<[u8; 3]>,
}

/// Finds a palette for the harmonics of a scene, whose degree is not 0.
pub(super) fn encode(scene: &SplatData, order: &[u32], settings: &SogSettings) -> Palette {
    let width = scene.sh_rest_len();
    let most = (1usize << scene.len().ilog2()).min(settings.palette as usize);
    let clusters = kmeans::cluster(&scene.sh_rest, width, most);
    let count = clusters.centroids.len() / width;
    let codebook = codebook::fit(clusters.centroids.clone());
    let codes = codebook::Codes::new(&codebook);
    let coefficients = clusters.centroids.as_chunks::<3>().0.iter();
    let mut centroids: Vec<[u8; 3]> = coefficients
        .map(|rgb| rgb.map(|value| codes.nearest(value)))
        .collect();
    let rows = count.div_ceil(PER_ROW);
    let grid = Grid {
        width: (PER_ROW * width / 3) as u32,
        height: rows as u32,
    };
    centroids.resize(PER_ROW * width / 3 * rows, [0; 3]);
    let label = |&index: &u32| {
        let [low, high] = clusters.labels[index as usize].to_le_bytes();
        [low, high, 0]
    };
    Palette {
        count: count as u32,
        codebook: codebook::full(codebook),
        grid,
        centroids,
        labels: order.iter().map(label).collect(),
    }
}

/// Coefficients of all Gaussians, in the order of [`SplatData::sh_rest`].
pub(super) fn decode(
    path: &Path,
    palette: &meta::Palette,
    centroids: &[u8],
    labels: &[[u8; 4]],
) -> Result<Vec<f32>, SceneFileError> {
    let bad = |reason: String| SceneFileError::Field {
        path: path.to_path_buf(),
        field: "shN",
        reason,
    };
    if !(1..=MOST).contains(&palette.count) {
        return Err(bad(format!(
            "count is {}; a palette has 1 to {MOST} entries",
            palette.count
        )));
    }
    let coefficients = (palette.bands + 1).pow(2) - 1;
    let width = PER_ROW * coefficients;
    let most = (MOST as usize).div_ceil(PER_ROW);
    // Writers announce more entries than there are rows for if a scene has fewer.
    let fits = |grid: Grid| grid.width as usize == width && (grid.height as usize) <= most;
    let expected = format!("a palette of degree {}", palette.bands);
    let (grid, pixels) = image::decode(path, "shN", centroids, fits, &expected)?;
    let entries = (palette.count as usize).min(PER_ROW * grid.height as usize);
    let mut values = Vec::with_capacity(3 * coefficients * labels.len());
    for (index, label) in labels.iter().enumerate() {
        let bad = |reason: String| SceneFileError::BadElement {
            path: path.to_path_buf(),
            index,
            reason: format!("shN: {reason}"),
        };
        let label = usize::from(u16::from_le_bytes([label[0], label[1]]));
        if label >= entries {
            return Err(bad(format!(
                "entry {label} of a palette of {entries}; the file is damaged"
            )));
        }
        for [r, g, b, _] in &pixels[label * coefficients..(label + 1) * coefficients] {
            for code in [r, g, b] {
                values.push(codebook::value(&palette.codebook, *code).map_err(bad)?);
            }
        }
    }
    Ok(values)
}
