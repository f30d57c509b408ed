//! What the properties are called.

/// Names of the properties in the order they are written, for a scene of `rest` values `f_rest_*`.
pub(super) fn property_names(rest: usize) -> Vec<String> {
    let numbered = |stem: &'static str, count| (0..count).map(move |i| format!("{stem}_{i}"));
    ["x", "y", "z", "nx", "ny", "nz"]
        .into_iter()
        .map(str::to_owned)
        .chain(numbered("f_dc", 3))
        .chain(numbered("f_rest", rest))
        .chain(["opacity".to_owned()])
        .chain(numbered("scale", 3))
        .chain(numbered("rot", 4))
        .collect()
}
