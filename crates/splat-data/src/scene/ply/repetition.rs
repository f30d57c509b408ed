//! Names that a PLY header says twice.

use std::collections::HashSet;

/// The first line that repeats the name of an element, or that of a property of its element. The
/// library would keep one of the two, and read every value behind it from the wrong place.
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
