//! Amount of work in a view.

use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};
use splat_model::{CameraTensors, Gaussians, RenderSettings, project_gaussians};
use splat_ops::rasterize_work;

use super::PerformanceError;
use splat_data::View;

/// Counts, averaged over views.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Work {
    /// Views counted.
    pub views: usize,
    /// Gaussians of the scene.
    pub gaussians: usize,
    /// Gaussians that reach into the view.
    pub visible: f64,
    /// (tile, Gaussian) pairs in the lists.
    pub intersections: f64,
    /// Pixels of a view.
    pub pixels: f64,
    /// (pixel, Gaussian) pairs evaluated by the inner loop.
    pub tested: f64,
    /// Pairs past the alpha cut, including those beyond the image's edges, as in
    /// [`RasterizeWork`](splat_ops::RasterizeWork).
    pub seen: f64,
    /// Pairs blended.
    pub blended: f64,
}

impl Work {
    /// Counts the work of rendering `gaussians` in `views`.
    pub(super) fn count(
        gaussians: &Gaussians,
        views: &[&View],
        settings: &RenderSettings,
        device: &Device,
    ) -> Result<Self, PerformanceError> {
        let mut work = Self {
            views: views.len(),
            gaussians: gaussians.len(),
            ..Self::default()
        };
        let share = 1.0 / views.len().max(1) as f64;
        // Counts depend on colours only if those are not finite.
        let colors = Tensor::<3>::zeros([1, gaussians.len(), 1], device);
        for view in views {
            let cameras =
                CameraTensors::from_camera(&view.camera().relative_to(gaussians.origin), device);
            let projected = project_gaussians(gaussians, &cameras, settings)?;
            let mut opacities: Tensor<2> = gaussians.opacities().reshape([1, -1]);
            if settings.antialias {
                opacities = opacities * projected.compensations();
            }
            let extents = projected.extents().narrow(2, 0, 1);
            let visible = extents.greater_scalar(0.0).int().sum();
            let counted =
                rasterize_work(&projected, colors.clone(), opacities, &settings.rasterize)?;
            work.visible += share * visible.into_scalar::<i64>() as f64;
            work.intersections += share * counted.intersections as f64;
            work.pixels += share * f64::from(view.width) * f64::from(view.height);
            work.tested += share * counted.tested as f64;
            work.seen += share * counted.seen as f64;
            work.blended += share * counted.blended as f64;
        }
        Ok(work)
    }

    /// The counts as a Markdown table.
    pub fn markdown(&self) -> String {
        let per_pixel = |count: f64| format!("{:.1}", count / self.pixels.max(1.0));
        format!(
            "| Gaussians | visible | intersections | pixels | tested per pixel | past the cut | blended | blended of tested |\n\
             |--:|--:|--:|--:|--:|--:|--:|--:|\n\
             | {} | {:.0} | {:.0} | {:.0} | {} | {} | {} | {:.0} % |\n\n\
             Means over {} views.\n",
            self.gaussians,
            self.visible,
            self.intersections,
            self.pixels,
            per_pixel(self.tested),
            per_pixel(self.seen),
            per_pixel(self.blended),
            100.0 * self.blended / self.tested.max(1.0),
            self.views
        )
    }
}

/// At most `most` views, evenly spread.
pub(super) fn sample<'a>(views: &[&'a View], most: usize) -> Vec<&'a View> {
    let count = views.len().min(most);
    (0..count).map(|i| views[i * views.len() / count]).collect()
}

#[cfg(test)]
mod tests {
    use splat_model::{CameraTensors, SceneScale, splats_from_points};

    use super::*;
    use crate::performance::scaling::{PhotoSize, synthetic_capture};

    /// Pairs past the cut and pairs blended, from the definition: every splat at every pixel, in
    /// double precision.
    fn by_hand(projected: Vec<f32>, opacities: Vec<f32>, [width, height]: [u32; 2]) -> [f64; 2] {
        let mut splats: Vec<([f64; 6], f64)> = projected
            .chunks_exact(9)
            .zip(&opacities)
            .filter(|(row, _)| row[7] > 0.0)
            .map(|(row, opacity)| {
                let row = core::array::from_fn(|i| f64::from(row[i]));
                (row, f64::from(*opacity))
            })
            .collect();
        splats.sort_by(|(a, _), (b, _)| a[2].total_cmp(&b[2]));
        let (mut seen, mut blended) = (0.0, 0.0);
        for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
            let mut left: f64 = 1.0;
            let mut stopped = false;
            for ([mean_x, mean_y, _, w11, w21, w22], opacity) in &splats {
                let (dx, dy) = (f64::from(x) + 0.5 - mean_x, f64::from(y) + 0.5 - mean_y);
                let (z1, z2) = (w11 * dx, w21 * dx + w22 * dy);
                let alpha = opacity * (-0.5 * (z1 * z1 + z2 * z2)).exp();
                if alpha < 1.0 / 255.0 {
                    continue;
                }
                seen += 1.0;
                left *= 1.0 - alpha.min(0.99);
                stopped |= left < 9.999e-5;
                if !stopped {
                    blended += 1.0;
                }
            }
        }
        [seen, blended]
    }

    #[test]
    fn counts_are_those_of_the_definition() {
        // 64 x 48: whole tiles, so that nothing is evaluated beyond the edges.
        let capture = synthetic_capture(400, PhotoSize::of_pixels(3072));
        let positions: Vec<_> = capture
            .points
            .iter()
            .map(|p| p.position.map(|x| x as f32))
            .collect();
        let colors: Vec<_> = capture.points.iter().map(|p| p.color).collect();
        let mut data = splats_from_points(
            &positions,
            &colors,
            SceneScale::new(1.0).unwrap(),
            &Default::default(),
        )
        .unwrap();
        // From faint to nearly opaque, so that pixels stop.
        for (index, logit) in data.opacity_logits.iter_mut().enumerate() {
            *logit = (index % 10) as f32 - 4.0;
        }
        let device = Device::flex();
        let gaussians = Gaussians::from_data(&data, &device);
        let view = &capture.views[0];
        let settings = RenderSettings::default();
        let work = Work::count(&gaussians, &[view], &settings, &device).unwrap();

        let cameras = CameraTensors::from_camera(&view.camera(), &device);
        let projected = project_gaussians(&gaussians, &cameras, &settings).unwrap();
        let [projected, opacities] = [
            projected.packed().clone().into_data(),
            gaussians.opacities().into_data(),
        ]
        .map(|data| data.try_into_vec::<f32>().unwrap());
        let [seen, blended] = by_hand(projected, opacities, [view.width, view.height]);
        // In single precision a pair may lie on the other side of a threshold.
        let close = |count: f64, exact: f64| {
            assert!((count - exact).abs() <= 1e-4 * exact, "{count} {exact}");
        };
        close(work.blended, blended);
        // Pairs behind the stop of a pixel need not be evaluated.
        assert!(work.seen >= work.blended && work.seen <= seen * (1.0 + 1e-4));
        assert!(blended < 0.9 * seen, "{blended} {seen}: no pixel stops");
        assert!(work.tested >= work.seen);
        assert!(work.visible > 0.0 && work.intersections >= work.visible / 2.0);
    }
}
