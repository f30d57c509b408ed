//! Readers that are no part of the library's face, for fuzz targets.

pub use crate::capture::in_memory::parse as parse_capture;
pub use crate::gradcheck::FIXTURE_KEYS;
pub use crate::train::expected_checksum;
