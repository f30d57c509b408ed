//! Detection of repeated names in a PLY header.

use std::collections::HashSet;

/// The first line that repeats the name of an element, or of a property within its element. The
/// library would keep only one of the two, and read all later values from the wrong position.
pub(super) fn repetition(header: &str) -> Option<&str> {
    let (mut elements, mut properties) = (HashSet::new(), HashSet::new());
    for line in header.lines() {
        let mut words = line.split_whitespace();
        let (known, name) = match words.next() {
            Some("element") => {
                properties.clear();
                (&mut elements, words.next())
            }
            Some("property") => (&mut properties, words.last()),
            _ => continue,
        };
        if name.is_some_and(|name| !known.insert(name)) {
            return Some(line.trim());
        }
    }
    None
}
