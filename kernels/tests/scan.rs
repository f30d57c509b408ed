//! Prefix sums against the standard library.
fn main() {}
