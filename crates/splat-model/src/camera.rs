//! Pinhole cameras.

use burn::tensor::{Device, Tensor, TensorData};
use glam::{DMat4, DVec3};
use splat_ops::ImageSize;

/// A pinhole camera: axes +x right, +y down, +z forward (OpenCV, COLMAP).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// World to camera.
    pub viewmat: DMat4,
    /// fx, fy, cx, cy in pixels; the centre of the first pixel is at (0.5, 0.5).
    pub intrinsics: [f64; 4],
    /// Image size in pixels.
    pub size: ImageSize,
}

impl Camera {
    /// Where the camera stands, in the world.
    pub fn position(&self) -> DVec3 {
        let [r0, r1, r2] = [0, 1, 2].map(|i| self.viewmat.row(i));
        -(r0.truncate() * r0.w + r1.truncate() * r1.w + r2.truncate() * r2.w)
    }

    /// The same camera in a world that counts from `origin`. To be done before the camera becomes a tensor: in double
    /// precision the difference of two large coordinates is exact.
    pub fn relative_to(&self, origin: [f64; 3]) -> Self {
        Self {
            viewmat: self.viewmat * DMat4::from_translation(DVec3::from(origin)),
            ..*self
        }
    }

    /// The camera as the ops take it.
    pub fn tensors(&self, device: &Device) -> CameraTensors {
        let rows: Vec<f32> = (0..4)
            .flat_map(|i| self.viewmat.row(i).to_array())
            .map(|value| value as f32)
            .collect();
        let intrinsics = self.intrinsics.map(|value| value as f32);
        CameraTensors {
            viewmats: Tensor::from_data(TensorData::new(rows, [1, 4, 4]), device),
            intrinsics: Tensor::from_data(TensorData::new(intrinsics.to_vec(), [1, 4]), device),
            size: self.size,
        }
    }
}

/// C cameras of one image size, as tensors: give them `require_grad` to refine poses or intrinsics.
#[derive(Debug, Clone)]
pub struct CameraTensors {
    /// World to camera, `[C, 4, 4]`.
    pub viewmats: Tensor<3>,
    /// fx, fy, cx, cy in pixels, `[C, 4]`.
    pub intrinsics: Tensor<2>,
    /// Image size in pixels.
    pub size: ImageSize,
}

impl CameraTensors {
    /// Camera centres `[C, 3]`: `-W^T t` for `viewmat = [W | t]`. Differentiable.
    pub fn centers(&self) -> Tensor<2> {
        let upper = self.viewmats.clone().narrow(1, 0, 3);
        let rotation = upper.clone().narrow(2, 0, 3);
        let translation = upper.narrow(2, 3, 1);
        (rotation * translation).sum_dim(1).squeeze_dim(1).neg()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    #[test]
    fn position_is_what_the_camera_sees_at_its_origin() {
        let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.7, 1.1);
        let viewmat = DMat4::from_rotation_translation(rotation, DVec3::new(1.0, -2.0, 3.0));
        let camera = Camera {
            viewmat,
            intrinsics: [500.0, 500.0, 50.0, 50.0],
            size: ImageSize {
                width: 100,
                height: 100,
            },
        };
        let seen = viewmat.transform_point3(camera.position());
        assert!(seen.length() < 1e-12, "{seen}");

        let (origin, point) = (DVec3::new(4e6, -5e5, 1e3), DVec3::new(0.5, -2.0, 7.0));
        let local = camera.relative_to(origin.to_array());
        let seen = local.viewmat.transform_point3(point);
        assert!((seen - viewmat.transform_point3(origin + point)).length() < 1e-8);
    }
}
