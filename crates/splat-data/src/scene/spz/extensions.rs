//! Extensions: records of a type, a length and that many bytes.

use std::path::Path;

use super::super::SceneFileError;
use super::super::axes::AxisFlip;

/// Adobe's limits of a viewer's camera, which do not change the scene.
const SAFE_ORBIT_CAMERA: u32 = 0xADBE_0002;
/// Adobe's name of the axes.
const COORDINATE_SYSTEM: u32 = 0xADBE_0003;

/// What the extensions say.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Extensions {
    /// From the file's axes to ours, if they are not the usual ones.
    pub flip: Option<AxisFlip>,
    /// Unknown extensions.
    pub not_understood: Vec<String>,
}

/// Reads the records of extensions.
pub(super) fn read(path: &Path, mut bytes: &[u8]) -> Result<Extensions, SceneFileError> {
    let bad = |reason: String| SceneFileError::Field {
        path: path.to_path_buf(),
        field: "extensions",
        reason,
    };
    let mut extensions = Extensions::default();
    // Fewer bytes than a record's head are padding.
    while let Some((head, rest)) = bytes.split_first_chunk::<8>() {
        let [a, b, c, d, e, f, g, h] = *head;
        let kind = u32::from_le_bytes([a, b, c, d]);
        let len = u32::from_le_bytes([e, f, g, h]) as usize;
        let Some((payload, rest)) = rest.split_at_checked(len) else {
            return Err(bad(format!(
                "0x{kind:08X} has {len} bytes, of which {} are there; the file is damaged",
                rest.len()
            )));
        };
        match (kind, payload.first_chunk::<4>()) {
            (SAFE_ORBIT_CAMERA, _) => {}
            (COORDINATE_SYSTEM, Some(system)) => {
                extensions.flip = flip(u32::from_le_bytes(*system)).map_err(bad)?;
            }
            // A few are enough for a warning.
            _ if extensions.not_understood.len() < 8 => {
                let text = format!("SPZ extension 0x{kind:08X} ({len} bytes)");
                extensions.not_understood.push(text);
            }
            _ => {}
        }
        bytes = rest;
    }
    Ok(extensions)
}

/// Reversals from a numbered system of axes to ours. The numbers 1 to 8 are those of LDB, RDB, LUB,
/// RUB, LDF, RDF, LUF and RUF: left or right, down or up, backward or forward.
fn flip(system: u32) -> Result<Option<AxisFlip>, String> {
    match system {
        0 => Ok(None),
        1..=8 => {
            let bits = system - 1;
            let sign = |bit: u32, ours: u32| if bits >> bit & 1 == ours { 1.0 } else { -1.0 };
            Ok(Some(AxisFlip {
                signs: [sign(0, 1), sign(1, 0), sign(2, 1)],
            }))
        }
        9..=16 => Err(format!(
            "axes number {system}, which exchange y and z, are not supported; write the file again with the axes RUB"
        )),
        _ => Err(format!(
            "axes number {system} do not exist; the file is damaged"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(kind: u32, payload: &[u8]) -> Vec<u8> {
        let mut bytes = kind.to_le_bytes().to_vec();
        bytes.extend((payload.len() as u32).to_le_bytes());
        bytes.extend(payload);
        bytes
    }

    #[test]
    fn named_axes_replace_the_usual_ones() {
        let path = Path::new("a.spz");
        let of = |system: u32| read(path, &record(COORDINATE_SYSTEM, &system.to_le_bytes()));
        assert_eq!(of(0).unwrap().flip, None);
        for (system, signs) in [
            (4, [1.0, -1.0, -1.0]), // RUB
            (6, [1.0, 1.0, 1.0]),   // RDF, ours
            (7, [-1.0, -1.0, 1.0]), // LUF
        ] {
            assert_eq!(of(system).unwrap().flip, Some(AxisFlip { signs }));
        }
        assert!(of(9).unwrap_err().to_string().contains("RUB"));
        assert!(of(17).is_err());
    }

    #[test]
    fn unknown_extensions_are_passed_over_and_named() {
        let path = Path::new("a.spz");
        let mut bytes = record(SAFE_ORBIT_CAMERA, &[0; 12]);
        bytes.extend(record(0x1234_0001, &[1, 2, 3]));
        bytes.extend([0; 5]);
        let extensions = read(path, &bytes).unwrap();
        assert_eq!(extensions.flip, None);
        assert_eq!(
            extensions.not_understood,
            ["SPZ extension 0x12340001 (3 bytes)"]
        );
        let message = read(path, &bytes[..29]).unwrap_err().to_string();
        assert!(
            message.contains("a.spz: extensions: 0x12340001"),
            "{message}"
        );
    }
}
