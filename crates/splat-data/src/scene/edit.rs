//! Scenes of some of the Gaussians of another, or of lower degree.

use super::SplatData;

impl SplatData {
    /// The scene of these Gaussians, in this order; one that is named twice is there twice.
    ///
    /// # Panics
    /// When there is no such Gaussian.
    #[must_use]
    pub fn select(&self, indices: &[usize]) -> Self {
        let width = self.sh_rest_len();
        let rest = indices
            .iter()
            .flat_map(|i| &self.sh_rest[i * width..(i + 1) * width]);
        Self {
            origin: self.origin,
            means: indices.iter().map(|i| self.means[*i]).collect(),
            log_scales: indices.iter().map(|i| self.log_scales[*i]).collect(),
            quats: indices.iter().map(|i| self.quats[*i]).collect(),
            opacity_logits: indices.iter().map(|i| self.opacity_logits[*i]).collect(),
            sh0: indices.iter().map(|i| self.sh0[*i]).collect(),
            sh_rest: rest.copied().collect(),
            sh_degree: self.sh_degree,
            settings: self.settings.clone(),
        }
    }

    /// The highest degree of spherical harmonics of which a Gaussian has a coefficient other than
    /// zero.
    ///
    /// # Panics
    /// When there is no such Gaussian.
    pub fn degree_of(&self, index: usize) -> usize {
        let width = self.sh_rest_len();
        let rest = &self.sh_rest[index * width..(index + 1) * width];
        let used = rest
            .iter()
            .rposition(|x| *x != 0.0)
            .map_or(0, |at| at / 3 + 1);
        (0..self.sh_degree)
            .find(|degree| (degree + 1) * (degree + 1) > used)
            .unwrap_or(self.sh_degree)
    }

    /// The scene with no higher degree than a Gaussian has a coefficient of.
    #[must_use]
    pub fn with_lowest_degree(mut self) -> Self {
        let degree = (0..self.len())
            .map(|i| self.degree_of(i))
            .max()
            .unwrap_or(0);
        let (width, kept) = (self.sh_rest_len(), 3 * ((degree + 1).pow(2) - 1));
        if degree < self.sh_degree {
            self.sh_rest = (self.sh_rest.chunks_exact(width))
                .flat_map(|rest| &rest[..kept])
                .copied()
                .collect();
            self.sh_degree = degree;
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> SplatData {
        let mut rest = vec![0.0; 3 * 24];
        rest[24] = 1.0; // the second of degree 1
        rest[48 + 9] = 1.0; // the third of degree 2
        SplatData {
            means: vec![[0.0; 3], [1.0; 3], [2.0; 3]],
            log_scales: vec![[0.0; 3]; 3],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 3],
            opacity_logits: vec![0.0, 1.0, 2.0],
            sh0: vec![[0.5; 3]; 3],
            sh_rest: rest,
            sh_degree: 2,
            ..SplatData::default()
        }
    }

    #[test]
    fn some_of_the_gaussians() {
        let some = scene().select(&[2, 1]);
        some.check_shape().unwrap();
        assert_eq!(some.means, [[2.0; 3], [1.0; 3]]);
        assert_eq!(some.opacity_logits, [2.0, 1.0]);
        assert_eq!(some.sh_rest[..24], scene().sh_rest[48..]);
        assert_eq!(scene().select(&[0, 1, 2]), scene());
        assert!(scene().select(&[]).is_empty());
    }

    #[test]
    fn degrees_are_those_of_the_last_coefficient() {
        assert_eq!([0, 1, 2].map(|i| scene().degree_of(i)), [0, 1, 2]);
        assert_eq!(scene().with_lowest_degree(), scene());
        let lower = scene().select(&[1, 0]).with_lowest_degree();
        lower.check_shape().unwrap();
        assert_eq!((lower.sh_degree, lower.sh_rest[0]), (1, 1.0));
        let flat = lower.select(&[1]).with_lowest_degree();
        assert_eq!((flat.sh_degree, flat.sh_rest.len()), (0, 0));
        flat.check_shape().unwrap();
    }
}
