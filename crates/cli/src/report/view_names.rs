//! File names for the pictures of views, unique for any view names.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::Path;

/// Longest stem in bytes; systems allow 255 for a whole name.
const MOST_BYTES: usize = 220;

/// File stems of several views, distinct even on file systems that ignore case.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ViewNames {
    /// Name of each view's picture without `.png`, in the given order.
    pub stems: Vec<String>,
    /// View and stem, for views that would have shared a file.
    pub renamed: Vec<(String, String)>,
}

impl ViewNames {
    /// Names the pictures of the views called `names`. Each picture is written to the stem, one of
    /// `suffixes`, and `.png`; no two of these files collide.
    ///
    /// The stem is the view's name without its extension, in one folder: separators become `_`.
    /// Views that would share a file keep their extension (`shot_jpg`, `shot_png`), or get a number
    /// if that collides too.
    pub fn new<'a>(names: impl IntoIterator<Item = &'a str>, suffixes: &[&str]) -> Self {
        let names: Vec<&str> = names.into_iter().collect();
        let suffixes: BTreeSet<&&str> = suffixes.iter().collect();
        let mut stems: Vec<String> = names.iter().map(|name| stem(name)).collect();
        // Lower case after upper case: some letters have one form in one and two in the other.
        let key = |file: String| file.to_uppercase().to_lowercase();
        let files = |stem: &str| -> Vec<String> {
            suffixes
                .iter()
                .map(|suffix| key(format!("{stem}{suffix}")))
                .collect()
        };
        let mut wanted: HashMap<String, usize> = HashMap::new();
        for file in stems.iter().flat_map(|stem| files(stem)) {
            *wanted.entry(file).or_default() += 1;
        }
        let shared: Vec<usize> = (0..names.len())
            .filter(|&view| files(&stems[view]).iter().any(|file| wanted[file] > 1))
            .collect();
        // Number of views with each name, extension included.
        let mut with_ending: HashMap<String, usize> = HashMap::new();
        for &view in &shared {
            *with_ending.entry(key(flat(names[view]))).or_default() += 1;
        }
        let mut taken: HashSet<String> = wanted.into_keys().collect();
        let mut renamed = Vec::with_capacity(shared.len());
        for view in shared {
            let ending = flat(names[view]);
            let ending = Some(ending).filter(|ending| with_ending[&key(ending.clone())] == 1);
            let numbered = (1..).map(|number: u64| format!("{}_{number}", stems[view]));
            let is_free = |stem: &String| !files(stem).iter().any(|file| taken.contains(file));
            // Numbers never run out.
            if let Some(free) = ending.into_iter().chain(numbered).find(is_free) {
                taken.extend(files(&free));
                renamed.push((names[view].to_owned(), free.clone()));
                stems[view] = free;
            }
        }
        Self { stems, renamed }
    }

    /// A line for the user about renamed pictures, if any.
    pub fn note(&self) -> Option<String> {
        const SHOWN: usize = 4;
        let shown = self.renamed.iter().take(SHOWN);
        let shown: Vec<String> = shown
            .map(|(view, stem)| format!("`{view}` as {stem}.png"))
            .collect();
        let count = self.renamed.len();
        let more = if count > SHOWN { ", ..." } else { "" };
        (count > 0).then(|| {
            let shown = shown.join(", ");
            format!(
                "{count} views would share the names of their pictures; written are {shown}{more}"
            )
        })
    }
}

/// A view's name without its extension, in one folder.
fn stem(name: &str) -> String {
    in_one_folder(&Path::new(name).with_extension("").to_string_lossy())
}

/// A view's name with its extension, in one folder.
fn flat(name: &str) -> String {
    let stem = stem(name);
    match Path::new(name).extension() {
        Some(ending) => in_one_folder(&format!("{stem}_{}", ending.to_string_lossy())),
        None => stem,
    }
}

/// Replaces path separators and characters that end a name, and truncates long names.
fn in_one_folder(name: &str) -> String {
    let mut name = name.replace(['/', '\\', ':', '\0'], "_");
    let mut end = name.len().min(MOST_BYTES);
    while !name.is_char_boundary(end) {
        end -= 1;
    }
    name.truncate(end);
    name
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Stems of pictures without other channels.
    fn stems(names: &[&str]) -> Vec<String> {
        ViewNames::new(names.iter().copied(), &[""]).stems
    }

    #[test]
    fn names_that_do_not_collide_stay() {
        let names = [
            "left/a.b.JPG",
            "../../up.png",
            "c:\\d.png",
            "plain",
            "shot.bmp.png",
        ];
        let named = ViewNames::new(names, &["", ".alpha", ".depth", ""]);
        assert_eq!(
            named.stems,
            ["left_a.b", ".._.._up", "c__d", "plain", "shot.bmp"]
        );
        assert_eq!(named.renamed, []);
        assert_eq!(named.note(), None);
    }

    #[test]
    fn every_view_has_its_own_file() {
        assert_eq!(
            stems(&[
                "shot.png",
                "a/b_c.png",
                "shot.jpg",
                "a_b/c.png",
                "other.png"
            ]),
            ["shot_png", "a_b_c_1", "shot_jpg", "a_b_c_2", "other"]
        );
        // Names of other views are not taken from them.
        assert_eq!(
            stems(&[
                "shot.png",
                "shot.jpg",
                "shot_png.png",
                "shot_jpg",
                "shot_1.png"
            ]),
            ["shot_2", "shot_3", "shot_png", "shot_jpg", "shot_1"]
        );
        // One name three times, as a camera file may have.
        assert_eq!(stems(&["x", "x", "x", "x_2"]), ["x_1", "x_3", "x_4", "x_2"]);
    }

    #[test]
    fn upper_and_lower_case_are_one() {
        assert_eq!(
            stems(&["A.png", "a.png", "STRASSE.png", "straße.png"]),
            ["A_1", "a_2", "STRASSE_1", "straße_2"]
        );
    }

    #[test]
    fn channels_do_not_meet_other_views() {
        let names = ["a.png", "a.alpha.png", "b.png"];
        assert_eq!(stems(&names), ["a", "a.alpha", "b"]);
        let named = ViewNames::new(names, &["", ".alpha"]);
        assert_eq!(named.stems, ["a_png", "a.alpha_png", "b"]);
        assert_eq!(
            named.renamed[1],
            ("a.alpha.png".to_owned(), "a.alpha_png".to_owned())
        );
        assert!(named.note().unwrap().contains("`a.png` as a_png.png"));
    }

    #[test]
    fn long_names_are_cut_and_stay_apart() {
        let long = |end: &str| format!("{}{end}.png", "ü/".repeat(200));
        let names = [long("a"), long("b")];
        let stems = stems(&[&names[0], &names[1]]);
        assert_ne!(stems[0], stems[1]);
        assert!(stems.iter().all(|stem| stem.len() < 240));
    }
}
