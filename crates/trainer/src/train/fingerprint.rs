//! Fingerprint of a capture, so that a run is not resumed on another one.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use splat_data::{CameraModel, Capture, CaptureError, View};

/// Properties that identify a capture: for each view name, size, camera, use and photo; and the
/// points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Fingerprint {
    /// Name of the folder, used in messages only, since folders are moved.
    name: String,
    points: usize,
    /// Checksum of the exact positions of the points, which determine the scene's size.
    positions: u32,
    views: Vec<ViewPrint>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct ViewPrint {
    name: String,
    size: [u32; 2],
    /// Checksum of the exact intrinsics and pose.
    camera: u32,
    /// Checksum of the pixels.
    photo: u32,
    usage: Usage,
}

/// Use of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Usage {
    TrainedOn,
    HeldOut,
    NotUsed,
}

impl Fingerprint {
    /// Fingerprint of a capture as loaded, downscaling included.
    ///
    /// # Errors
    /// When a photo that is on the disk cannot be read.
    pub(super) fn of(capture: &Capture) -> Result<Self, CaptureError> {
        let views = capture.views.par_iter().map(ViewPrint::of);
        let mut views: Vec<_> = views.collect::<Result<_, _>>()?;
        for &index in &capture.split.train {
            views[index].usage = Usage::TrainedOn;
        }
        for &index in &capture.split.test {
            views[index].usage = Usage::HeldOut;
        }
        Ok(Self {
            name: capture.name.clone(),
            points: capture.points.len(),
            positions: positions(capture),
            views,
        })
    }

    /// Name of the capture's folder.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// The first difference between this capture and `given`, in words. Photos that differ in
    /// pixels only are no difference, see [`changed_photos`](Self::changed_photos).
    pub(super) fn difference(&self, given: &Self) -> Option<String> {
        let named = |print: &Self, name: &str| print.views.iter().any(|view| view.name == name);
        let missing = |from: &Self, of: &Self| {
            let mut missing = of.views.iter().filter(|view| !named(from, &view.name));
            let first = missing.next()?;
            Some((first.name.clone(), missing.count()))
        };
        if let Some((first, others)) = missing(given, self) {
            return Some(format!(
                "it lacks the photo `{first}`{}",
                and_others(others)
            ));
        }
        if let Some((first, others)) = missing(self, given) {
            let others = and_others(others);
            return Some(format!(
                "its photo `{first}`{others} was not part of the run"
            ));
        }
        for (was, is) in self.views.iter().zip(&given.views) {
            if was.name != is.name {
                return Some(format!(
                    "photo `{}` stands where `{}` was",
                    is.name, was.name
                ));
            }
            let differs = |differs: fn(&ViewPrint, &ViewPrint) -> bool| {
                let pairs = self.views.iter().zip(&given.views);
                and_others(pairs.filter(|(was, is)| differs(was, is)).count() - 1)
            };
            let name = &is.name;
            if was.size != is.size {
                let [[a, b], [c, d]] = [is.size, was.size];
                let others = differs(|was, is| was.size != is.size);
                return Some(format!(
                    "photo `{name}`{others} is {a}x{b} pixels, it was {c}x{d}"
                ));
            }
            if was.camera != is.camera {
                let others = differs(|was, is| was.camera != is.camera);
                return Some(format!("photo `{name}`{others} has another camera"));
            }
            if was.usage != is.usage {
                let others = differs(|was, is| was.usage != is.usage);
                let [is, was] = [is.usage, was.usage].map(Usage::in_words);
                return Some(format!("photo `{name}`{others} is {is}, it was {was}"));
            }
        }
        if self.points != given.points {
            let (is, was) = (given.points, self.points);
            return Some(format!("it has {is} points, it had {was}"));
        }
        (self.positions != given.positions).then(|| "its points lie in other places".to_owned())
    }

    /// Names of the photos of `given`, the same capture, whose pixels have changed.
    pub(super) fn changed_photos(&self, given: &Self) -> Vec<String> {
        let pairs = self.views.iter().zip(&given.views);
        let changed = pairs.filter(|(was, is)| was.photo != is.photo);
        changed.map(|(_, is)| is.name.clone()).collect()
    }
}

fn positions(capture: &Capture) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    for point in &capture.points {
        for value in point.position {
            hasher.update(&value.to_le_bytes());
        }
    }
    hasher.finalize()
}

impl ViewPrint {
    fn of(view: &View) -> Result<Self, CaptureError> {
        let numbers = view.intrinsics.iter().chain(view.viewmat.as_flattened());
        let numbers = numbers.chain(view.lens.coefficients());
        let mut camera: Vec<u8> = numbers.flat_map(|value| value.to_le_bytes()).collect();
        if view.lens.model() != CameraModel::Pinhole {
            camera.extend(view.lens.model().name().as_bytes());
        }
        let mut photo = crc32fast::Hasher::new();
        let loaded = view.loaded()?;
        photo.update(&loaded.image);
        photo.update(loaded.mask.as_ref().map_or(&[][..], |mask| mask));
        Ok(Self {
            name: view.name.clone(),
            size: [view.width, view.height],
            camera: crc32fast::hash(&camera),
            photo: photo.finalize(),
            usage: Usage::NotUsed,
        })
    }
}

impl Usage {
    fn in_words(self) -> &'static str {
        match self {
            Self::TrainedOn => "trained on",
            Self::HeldOut => "held out",
            Self::NotUsed => "not used",
        }
    }
}

fn and_others(count: usize) -> String {
    match count {
        0 => String::new(),
        count => format!(" (and {count} more)"),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use splat_data::{CaptureSettings, Split};

    fn capture() -> Capture {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
        let options = CaptureSettings {
            downscale: 16,
            ..CaptureSettings::default()
        };
        Capture::load(folder, &options).unwrap()
    }

    /// A change, and the words that must report it.
    type Change = (fn(&mut Capture), &'static [&'static str]);

    #[test]
    fn what_differs_is_said() {
        let capture = capture();
        let print = Fingerprint::of(&capture).unwrap();
        let json = serde_json::to_string(&print).unwrap();
        assert_eq!(serde_json::from_str::<Fingerprint>(&json).unwrap(), print);

        let same: [fn(&mut Capture); 3] = [
            |_| {},
            |c| c.name = "moved".into(),
            |c| Arc::make_mut(&mut c.views[3].image).fill(0),
        ];
        for change in same {
            let mut given = capture.clone();
            change(&mut given);
            assert_eq!(print.difference(&Fingerprint::of(&given).unwrap()), None);
        }
        // `{N}` is the name of view N.
        let changes: [Change; 7] = [
            (|c| drop(c.views.remove(6)), &["lacks", "{6}"]),
            (
                |c| (c.views[1].name, c.views[2].name) = ("x".into(), "y".into()),
                &["lacks", "{1}", "1 more"],
            ),
            (
                |c| {
                    let mut more = c.views[0].clone();
                    more.name = "new.png".into();
                    c.views.push(more);
                },
                &["`new.png`", "not part"],
            ),
            (
                |c| (c.views[4].width, c.views[4].height) = (2, 6),
                &["{4}", "2x6"],
            ),
            (
                |c| c.views[5].viewmat[0][3] += 1e-9,
                &["{5}", "another camera"],
            ),
            (
                |c| c.split.test = vec![],
                &["{0}", "3 more", "not used", "held out"],
            ),
            (|c| c.points.truncate(9), &["9 points, it had"]),
        ];
        for (change, words) in changes {
            let mut given = capture.clone();
            change(&mut given);
            if given.views.len() < capture.views.len() {
                given.split = Split::every_eighth(given.views.len());
            }
            let said = print.difference(&Fingerprint::of(&given).unwrap()).unwrap();
            for word in words {
                let index = word.strip_prefix('{').and_then(|w| w.strip_suffix('}'));
                let index = index.and_then(|index| index.parse::<usize>().ok());
                let word = index.map_or((*word).to_owned(), |i| capture.views[i].name.clone());
                assert!(said.contains(&word), "no `{word}` in: {said}");
            }
        }
    }

    #[test]
    fn photos_of_other_pixels_are_named() {
        let mut given = capture();
        let print = Fingerprint::of(&given).unwrap();
        Arc::make_mut(&mut given.views[3].image).fill(0);
        let name = given.views[3].name.clone();
        assert_eq!(
            print.changed_photos(&Fingerprint::of(&given).unwrap()),
            [name]
        );
        assert!(print.changed_photos(&print).is_empty());
    }
}
