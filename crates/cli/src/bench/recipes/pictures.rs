//! Pictures: a held-out view beside what each recipe makes of it.
//!
//! Every run of the first seed leaves its render of one view, the worst-scored of the capture's
//! first run, in `views/CAPTURE`. From these files the capture's picture is put together, also when
//! the runs were made by several calls.

use std::path::{Path, PathBuf};

use super::row::{Key, Row};
use crate::Failure;
use crate::report::png::Picture;
use splat_data::View;

/// The folder of renders and photos.
const VIEWS: &str = "views";

/// A picture that was written.
pub(super) struct Pictured {
    /// Name of the capture.
    pub capture: String,
    /// Name of the view.
    pub view: String,
    /// Names of the recipes, from left to right, to the right of the photo.
    pub recipes: Vec<String>,
}

/// The picture of a capture.
pub(super) fn of_capture(folder: &Path, capture: &str) -> PathBuf {
    folder.join(format!("{capture}.png"))
}

fn of_run(folder: &Path, key: &Key) -> PathBuf {
    let name = format!("{}-{}-{}.png", key.recipe, key.steps, key.downscale);
    folder.join(VIEWS).join(&key.capture).join(name)
}

fn of_photo(folder: &Path, capture: &str, downscale: u32) -> PathBuf {
    let name = format!("photo-{downscale}.png");
    folder.join(VIEWS).join(capture).join(name)
}

/// The view of a capture of which there are pictures, that of the latest row.
pub(super) fn view_of<'a>(rows: &'a [Row], capture: &str, downscale: u32) -> Option<&'a str> {
    let own = |row: &&Row| row.key.capture == capture && row.key.downscale == downscale;
    let mut latest = rows.iter().rev().filter(own);
    latest.find_map(|row| row.view.as_deref())
}

/// Keeps the render of a view, `H x W x 3` values, and its photo.
pub(super) fn keep(folder: &Path, key: &Key, view: &View, rendered: &[f32]) -> Result<(), Failure> {
    let loaded = view.loaded()?;
    let photo = Picture::from_rgb8(view.width, view.height, loaded.image.to_vec())?;
    let render = Picture::from_rgb_f32(view.width, view.height, rendered)?;
    photo.write(&of_photo(folder, &key.capture, key.downscale))?;
    Ok(render.write(&of_run(folder, key))?)
}

/// Writes the picture of a capture: the photo, then the renders of its `rows`, which are in the
/// order of the recipes; `all` are those of the file. A render that is no longer there is left out.
pub(super) fn assemble(
    folder: &Path,
    capture: &str,
    downscale: u32,
    rows: &[&Row],
    all: &[Row],
) -> Result<Option<Pictured>, Failure> {
    let Some(view) = view_of(all, capture, downscale) else {
        return Ok(None);
    };
    let Some(mut picture) = read(&of_photo(folder, capture, downscale)) else {
        return Ok(None);
    };
    let mut recipes = Vec::new();
    let shows = |row: &&&Row| row.key.capture == capture && row.view.as_deref() == Some(view);
    for row in rows.iter().filter(shows) {
        let render = read(&of_run(folder, &row.key));
        if let Some(Ok(wider)) = render.map(|render| picture.beside(&render)) {
            picture = wider;
            recipes.push(row.key.recipe.clone());
        }
    }
    if recipes.is_empty() {
        return Ok(None);
    }
    picture.write(&of_capture(folder, capture))?;
    Ok(Some(Pictured {
        capture: capture.to_owned(),
        view: view.to_owned(),
        recipes,
    }))
}

/// A picture, if there is one.
fn read(path: &Path) -> Option<Picture> {
    let pixels = image::open(path).ok()?.into_rgb8();
    let (width, height) = pixels.dimensions();
    Picture::from_rgb8(width, height, pixels.into_raw()).ok()
}

#[cfg(test)]
mod tests {
    use super::super::row::example;
    use super::*;

    fn save(path: &Path, height: u32, value: f32) {
        let values = vec![value; 2 * height as usize];
        let picture = Picture::from_gray_f32(2, height, &values).unwrap();
        picture.write(path).unwrap();
    }

    #[test]
    fn renders_stand_beside_the_photo() {
        let folder = tempfile::TempDir::new().unwrap();
        let folder = folder.path();
        let mut rows = ["default", "mcmc", "fast", "best"].map(|recipe| {
            let mut row = example("a", recipe, 0, 20.0);
            row.view = Some("left.jpg".to_owned());
            row
        });
        // Of another view, of another size, and not there.
        rows[1].view = Some("right.jpg".to_owned());
        rows.swap(0, 1);
        let view = view_of(&rows, "a", 4);
        assert_eq!(view, Some("left.jpg"));
        assert_eq!(view_of(&rows, "a", 2), None);
        assert_eq!(view_of(&rows, "b", 4), None);

        let shown = |rows: &[Row]| {
            let own: Vec<&Row> = rows.iter().collect();
            assemble(folder, "a", 4, &own, rows).unwrap()
        };
        assert!(shown(&rows).is_none());
        save(&of_photo(folder, "a", 4), 3, 1.0);
        assert!(shown(&rows).is_none());
        save(&of_run(folder, &rows[0].key), 3, 0.2);
        save(&of_run(folder, &rows[1].key), 3, 0.4);
        save(&of_run(folder, &rows[2].key), 5, 0.6);
        let pictured = shown(&rows).unwrap();
        assert_eq!(pictured.recipes, ["default"]);
        assert_eq!(pictured.view, "left.jpg");
        let picture = image::open(of_capture(folder, "a")).unwrap().into_rgb8();
        // Two pixels, a gap of four, and two pixels.
        assert_eq!(picture.dimensions(), (8, 3));
        assert_eq!(picture.get_pixel(0, 0).0, [255; 3]);
        assert_eq!(picture.get_pixel(7, 2).0, [102; 3]);
    }
}
