//! Keypoints of a capture that has none: corners of a photo, found again in its neighbours.
//!
//! The poses are nearly right, and so are the points: together they say where to look, and how the
//! patch around a corner is turned and scaled there. The search is by normalised correlation, in
//! photos of a quarter of the size and then as they are.

use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DMat4, DVec3};
use rayon::prelude::*;
use splat_data::{BoundedLens, Camera, CaptureError, View};

use super::picture::{Patch, Picture, UPRIGHT, Warp};
use super::problem::Sight;
use super::watched::Watched;
use crate::quantile::median;

/// Photos are searched at this length of their longer side, or up to twice it.
const SIDE: u32 = 480;
/// Squares of one corner each, along the longer side.
const SQUARES: usize = 32;
/// A neighbour looks in the same direction, up to this many degrees.
const LARGEST_ANGLE: f64 = 45.0;
/// Places in the list of a photo's neighbours, nearest first, of those that are searched: near ones
/// for what they share, far ones so that no error adds up from photo to photo.
const NEIGHBORS: [usize; 10] = [0, 1, 2, 3, 5, 7, 10, 13, 17, 22];
/// Correlation of a corner that was found.
const LEAST_SCORE: f32 = 0.8;
/// The second best place of the search is no better than this share of the best.
const LARGEST_SECOND: f32 = 0.95;
/// Corners that fewer neighbours have are left out.
const FEWEST_FOUND: usize = 2;
/// The small photos of the first search have their sides divided by this.
const COARSE: u32 = 4;
/// Pixels around the place of the first search.
const FINE_REACH: i32 = 4;

/// A training photo to search.
struct Photo {
    view: View,
    lens: BoundedLens,
    to_world: DMat4,
    whole: Picture,
    small: Picture,
}

/// Corners as points, and where photos have them.
pub(super) struct Matched {
    pub points: Vec<DVec3>,
    /// Sorted by point.
    pub sights: Vec<Sight>,
}

/// Training photos, ready to be searched with any poses.
pub(super) struct Photos(Vec<Photo>);

impl Photos {
    /// # Errors
    /// When a photo on the disk cannot be read.
    pub fn of(views: &[&View]) -> Result<Self, CaptureError> {
        let photo = |view: &&View| -> Result<Photo, CaptureError> {
            let view = view.loaded()?;
            let view = view.downscaled((view.width.max(view.height) / SIDE).max(1));
            Ok(Photo {
                lens: view.lens.bounded(),
                to_world: view.camera().viewmat.inverse(),
                small: Picture::of(&view.downscaled(COARSE)),
                whole: Picture::of(&view),
                view: View {
                    image: Default::default(),
                    ..view
                },
            })
        };
        let photos = views.par_iter().map(photo).collect::<Result<_, _>>()?;
        Ok(Self(photos))
    }

    /// Moves every photo to another pose.
    pub fn place(&mut self, viewmats: &[DMat4]) {
        for (photo, viewmat) in self.0.iter_mut().zip(viewmats) {
            let camera = Camera {
                viewmat: *viewmat,
                ..photo.view.camera()
            };
            photo.view = photo.view.with_pose(&camera);
            photo.to_world = viewmat.inverse();
        }
    }

    /// Looks for the corners of every photo in its neighbours, up to a share of the longer side
    /// away from where the poses and these points have them. Fewer photos are searched if it is
    /// interrupted.
    pub fn matched(&self, watched: Watched<'_>, points: &[DVec3], reach: f64) -> Matched {
        let done = AtomicUsize::new(0);
        let of_photo = |index: usize| {
            if watched.is_interrupted() {
                return vec![];
            }
            let found = self.matches_of(index, points, reach);
            watched.done(1 + done.fetch_add(1, Ordering::Relaxed), self.0.len());
            found
        };
        let found: Vec<_> = (0..self.0.len()).into_par_iter().map(of_photo).collect();
        let mut matched = Matched {
            points: vec![],
            sights: vec![],
        };
        for (point, places) in found.into_iter().flatten() {
            let index = matched.points.len();
            matched.points.push(point);
            let sight = |(view, position)| Sight {
                view,
                point: index,
                position,
            };
            matched.sights.extend(places.into_iter().map(sight));
        }
        matched
    }

    /// Points of the corners of one photo, each with the photos that have it.
    #[expect(
        clippy::type_complexity,
        reason = "a list of lists, taken apart at once"
    )]
    fn matches_of(
        &self,
        index: usize,
        points: &[DVec3],
        reach: f64,
    ) -> Vec<(DVec3, Vec<(usize, [f64; 2])>)> {
        let photo = &self.0[index];
        let longer = photo.view.width.max(photo.view.height) as usize;
        let side = (longer / SQUARES).max(8);
        let depths = Depths::of(&photo.view, points, 2 * side);
        let neighbors = self.neighbors(index);
        let reach = (reach * longer as f64) as i32;
        let mut found = Vec::new();
        for corner in photo.whole.corners(side) {
            let Some((point, warped)) = photo.placed(corner, &depths) else {
                continue;
            };
            let Some(patches) = photo.patches(corner) else {
                continue;
            };
            let mut places = vec![(index, plane(&photo.view, corner))];
            for other in &neighbors {
                let neighbor = &self.0[*other];
                if let Some(place) = neighbor.find(&patches, &warped, reach) {
                    places.push((*other, plane(&neighbor.view, place)));
                }
            }
            if places.len() > FEWEST_FOUND {
                places.sort_by_key(|place| place.0);
                found.push((point, places));
            }
        }
        found
    }

    /// Photos that look in about the same direction, some near and some farther away.
    fn neighbors(&self, index: usize) -> Vec<usize> {
        let (center, axis) = (
            |photo: &Photo| photo.to_world.w_axis.truncate(),
            |photo: &Photo| photo.to_world.z_axis.truncate(),
        );
        let own = &self.0[index];
        let least = LARGEST_ANGLE.to_radians().cos();
        let mut others: Vec<(f64, usize)> = (self.0.iter().enumerate())
            .filter(|(other, photo)| *other != index && axis(own).dot(axis(photo)) >= least)
            .map(|(other, photo)| (center(own).distance(center(photo)), other))
            .collect();
        others.sort_by(|a, b| a.0.total_cmp(&b.0));
        (NEIGHBORS.iter().filter_map(|place| others.get(*place)))
            .map(|(_, other)| *other)
            .collect()
    }
}

/// A point in the world and two beside it, one pixel to the right and one below in the photo that
/// they are of.
type Corner = [DVec3; 3];

impl Photo {
    /// The point of a corner, at the depth of the points around it.
    fn placed(&self, [x, y]: [f64; 2], depths: &Depths) -> Option<(DVec3, Corner)> {
        let depth = depths.around([x, y])?;
        let [fx, fy, cx, cy] = self.view.intrinsics;
        let point = |x: f64, y: f64| {
            let ray = self.lens.undistort([(x - cx) / fx, (y - cy) / fy])?;
            Some((self.to_world).transform_point3(DVec3::from_array(ray) * depth))
        };
        let corner = [point(x, y)?, point(x + 1.0, y)?, point(x, y + 1.0)?];
        Some((corner[0], corner))
    }

    /// The patch around a corner, in the small photo and in the whole one.
    fn patches(&self, corner: [f64; 2]) -> Option<[Patch; 2]> {
        let small = corner.map(|x| x / f64::from(COARSE));
        Some([
            self.small.patch(small, UPRIGHT)?,
            self.whole.patch(corner, UPRIGHT)?,
        ])
    }

    /// Finds a corner of another photo in this one.
    fn find(&self, [small, whole]: &[Patch; 2], corner: &Corner, reach: i32) -> Option<[f64; 2]> {
        let project = |point: &DVec3| Some(self.view.project(point.to_array())?.0);
        let [at, right, below] = [
            project(&corner[0])?,
            project(&corner[1])?,
            project(&corner[2])?,
        ];
        let warp: Warp = [0, 1].map(|k| [right[k] - at[k], below[k] - at[k]]);
        let area = warp[0][0] * warp[1][1] - warp[0][1] * warp[1][0];
        // A patch that is much larger or smaller there has other things in it.
        if !(0.4..2.5).contains(&area) {
            return None;
        }
        let scale = f64::from(COARSE);
        let coarse = (self.small).find(
            small,
            at.map(|x| x / scale),
            warp,
            reach / COARSE as i32 + 1,
        )?;
        if coarse.score < LEAST_SCORE - 0.1 || coarse.second > LARGEST_SECOND * coarse.score {
            return None;
        }
        let near = coarse.position.map(|x| x * scale);
        let fine = self.whole.find(whole, near, warp, FINE_REACH)?;
        (fine.score >= LEAST_SCORE).then_some(fine.position)
    }
}

/// Position on the image plane of a pixel.
fn plane(view: &View, [x, y]: [f64; 2]) -> [f64; 2] {
    let [fx, fy, cx, cy] = view.intrinsics;
    [(x - cx) / fx, (y - cy) / fy]
}

/// Depths of points in a photo, by squares.
struct Depths {
    side: usize,
    columns: usize,
    squares: Vec<Vec<f64>>,
}

impl Depths {
    /// Fewest points around a pixel that say how far it is.
    const FEWEST: usize = 3;

    fn of(view: &View, points: &[DVec3], side: usize) -> Self {
        let (width, height) = (view.width as usize, view.height as usize);
        let (columns, rows) = (width.div_ceil(side), height.div_ceil(side));
        let mut squares = vec![vec![]; columns * rows];
        let project = view.projection();
        for point in points {
            if let Some(([x, y], depth)) = project(point.to_array())
                && (0.0..width as f64).contains(&x)
                && (0.0..height as f64).contains(&y)
            {
                squares[y as usize / side * columns + x as usize / side].push(depth);
            }
        }
        Self {
            side,
            columns,
            squares,
        }
    }

    /// The median depth in the square of a pixel. Points behind what the photo shows are in it too,
    /// which the correlation finds out.
    fn around(&self, [x, y]: [f64; 2]) -> Option<f64> {
        let square = y as usize / self.side * self.columns + x as usize / self.side;
        let depths = self.squares.get(square)?;
        (depths.len() >= Self::FEWEST).then(|| median(depths.iter().copied()))
    }
}
