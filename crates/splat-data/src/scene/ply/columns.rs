//! Position of a Gaussian's values in a row of the file, and their allowed values.

use std::path::Path;

use ply_rs_bw::ply::{Header, PropertyType};

use super::super::{SceneFileError, SplatData};
use super::Row;

/// Column of each value of a Gaussian.
pub(super) struct Columns {
    means: [usize; 3],
    sh0: [usize; 3],
    /// In the order of [`SplatData::sh_rest`].
    sh_rest: Vec<usize>,
    opacity: usize,
    scales: [usize; 3],
    quats: [usize; 4],
    sh_degree: usize,
}

impl Columns {
    pub(super) fn find(path: &Path, header: &Header) -> Result<Self, SceneFileError> {
        let header_error = |reason: &str| SceneFileError::Header {
            path: path.to_path_buf(),
            reason: reason.to_owned(),
        };
        let Some(vertex) = header.elements.get("vertex") else {
            return Err(header_error(
                "no element `vertex`; this is no PLY file in the 3DGS layout",
            ));
        };
        if vertex.properties.contains_key("packed_position") {
            return Err(header_error(
                "a compressed PLY file, which cannot be read yet; convert it to a plain one",
            ));
        }
        if vertex.count == 0 {
            return Err(SceneFileError::Empty {
                path: path.to_path_buf(),
            });
        }
        let column = |name: &str| match vertex.properties.get_full(name) {
            Some((column, _, property))
                if matches!(property.data_type, PropertyType::Scalar(_)) =>
            {
                Ok(column)
            }
            _ => Err(SceneFileError::MissingProperty {
                path: path.to_path_buf(),
                property: name.to_owned(),
            }),
        };
        let names = vertex.properties.keys();
        let rest = names.filter(|name| name.starts_with("f_rest_")).count();
        let sh_degree = match rest {
            0 => 0,
            9 => 1,
            24 => 2,
            45 => 3,
            count => {
                return Err(SceneFileError::RestCount {
                    path: path.to_path_buf(),
                    count,
                });
            }
        };
        // Coefficient k of channel c is f_rest_(c (K - 1) + k).
        let per_channel = rest / 3;
        let sh_rest = (0..rest)
            .map(|i| column(&format!("f_rest_{}", (i % 3) * per_channel + i / 3)))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            means: [column("x")?, column("y")?, column("z")?],
            sh0: [column("f_dc_0")?, column("f_dc_1")?, column("f_dc_2")?],
            sh_rest,
            opacity: column("opacity")?,
            scales: [column("scale_0")?, column("scale_1")?, column("scale_2")?],
            quats: [
                column("rot_0")?,
                column("rot_1")?,
                column("rot_2")?,
                column("rot_3")?,
            ],
            sh_degree,
        })
    }

    pub(super) fn empty_scene(&self, capacity: usize) -> SplatData {
        SplatData {
            means: Vec::with_capacity(capacity),
            log_scales: Vec::with_capacity(capacity),
            quats: Vec::with_capacity(capacity),
            opacity_logits: Vec::with_capacity(capacity),
            sh0: Vec::with_capacity(capacity),
            sh_rest: Vec::with_capacity(capacity * self.sh_rest.len()),
            sh_degree: self.sh_degree,
            ..SplatData::default()
        }
    }

    /// Appends the row's Gaussian to `scene`, or returns the first column, in the order of the
    /// fields, whose value is not allowed (see [`may_be`]).
    pub(super) fn take(&self, row: &Row, scene: &mut SplatData) -> Result<(), usize> {
        let value = |column: usize| {
            let value = row.values[column];
            let property = || match column {
                _ if column == self.opacity => "opacity",
                _ if self.scales.contains(&column) => "scale_",
                _ => "",
            };
            if value.is_finite() || may_be(property(), value) {
                Ok(value)
            } else {
                Err(column)
            }
        };
        fn all<const N: usize>(
            columns: [usize; N],
            value: impl Fn(usize) -> Result<f32, usize>,
        ) -> Result<[f32; N], usize> {
            let mut values = [0.0; N];
            for (out, column) in values.iter_mut().zip(columns) {
                *out = value(column)?;
            }
            Ok(values)
        }
        scene.means.push(all(self.means, value)?);
        scene.sh0.push(all(self.sh0, value)?);
        for &column in &self.sh_rest {
            scene.sh_rest.push(value(column)?);
        }
        scene.opacity_logits.push(value(self.opacity)?);
        scene.log_scales.push(all(self.scales, value)?);
        scene.quats.push(all(self.quats, value)?);
        Ok(())
    }
}

/// True if a property may have this value. Infinity is allowed where it has a meaning: opacity
/// logits of plus and minus infinity are opacities of 1 and 0, and a log-scale of minus infinity is
/// a flat Gaussian.
pub(super) fn may_be(property: &str, value: f32) -> bool {
    match property {
        "opacity" => !value.is_nan(),
        _ if property.starts_with("scale_") => value < f32::INFINITY,
        _ => value.is_finite(),
    }
}
