//! Groups emitted tiles by tile, and sorts each tile's splats.

use core::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rayon::prelude::*;

use super::TileLists;
use super::emit::Emitted;
use crate::cpu::buffer::overwritten;
use crate::cpu::real::Real;
use crate::cpu::tiles::{CHUNK, Grid};
use crate::cpu::uninit::{Part, Uncleared};

/// Most parts of the counting sort; each part counts the tiles on its own.
const PARTS: usize = 16;

/// Emitted intersections grouped by tile, in the order of emission.
pub(super) struct ByTile {
    /// Splat of each emitted intersection.
    owners: Vec<u32>,
    /// End of the emitted intersections of each splat.
    ends: Vec<u32>,
    /// The emitted intersections by tile.
    intersections: Vec<AtomicU32>,
    /// Start of each tile, and the end of the last one.
    tiles: Vec<u32>,
}

impl ByTile {
    /// Counting sort.
    pub(super) fn new(emitted: &[Emitted], splats: usize, grid: Grid) -> Self {
        let length = emitted.len().div_ceil(PARTS).max(1);
        let mut counts: Vec<Vec<u32>> = emitted
            .par_chunks(length)
            .map(|part| {
                let mut counts = vec![0; grid.tiles()];
                for tile in part.iter().flat_map(|emitted| &emitted.tiles) {
                    counts[*tile as usize] += 1;
                }
                counts
            })
            .collect();
        // Turns counts into positions: by tile, and within a tile by part.
        let mut tiles = Vec::with_capacity(grid.tiles() + 1);
        let mut next = 0;
        for tile in 0..grid.tiles() {
            tiles.push(next);
            for counts in &mut counts {
                let own = core::mem::replace(&mut counts[tile], next);
                next += own;
            }
        }
        tiles.push(next);

        let intersections = unset(next as usize);
        let mut owners = Uncleared::<u32>::new(next as usize);
        let mut ends = Uncleared::<u32>::new(splats);
        let mut start = 0;
        let of_owners = owners.parts(emitted.iter().map(|emitted| emitted.tiles.len()));
        let pieces: Vec<Piece> = (emitted.iter().zip(of_owners).zip(ends.chunks(CHUNK)))
            .zip((0..).step_by(CHUNK))
            .map(|(((emitted, owners), ends), first)| {
                let next = start + emitted.tiles.len() as u32;
                Piece {
                    emitted,
                    first,
                    start: core::mem::replace(&mut start, next),
                    owners,
                    ends,
                }
            })
            .collect();
        pieces
            .into_par_iter()
            .chunks(length)
            .zip(counts)
            .for_each(|(part, mut next)| {
                for piece in part {
                    piece.place(&mut next, &intersections);
                }
            });
        Self {
            owners: owners.written(),
            ends: ends.written(),
            intersections,
            tiles,
        }
    }

    /// The lists of the given Gaussians. Each tile is sorted front to back; equal depths keep the
    /// order of the Gaussians.
    pub(super) fn sorted<T: Real>(self, listed: Vec<u32>, depths: &[T]) -> TileLists {
        let count = self.intersections.len();
        let mut splats = Uncleared::<u32>::new(count);
        let places = unset(count);
        splats
            .parts(
                self.tiles
                    .windows(2)
                    .map(|ends| (ends[1] - ends[0]) as usize),
            )
            .into_par_iter()
            .zip(&self.tiles)
            .for_each_init(Vec::new, |keys, (splats, first)| {
                let splats = splats.overwritten();
                keys.clear();
                // Intersections are numbered in the order of the splats.
                let intersections = &self.intersections[*first as usize..][..splats.len()];
                keys.extend(intersections.iter().map(|intersection| {
                    let intersection = intersection.load(Relaxed);
                    let depth = depths[self.owners[intersection as usize] as usize];
                    depth.sort_key(intersection)
                }));
                keys.sort_unstable();
                for ((splat, place), key) in splats.iter_mut().zip(*first..).zip(&*keys) {
                    let intersection = T::index_of(*key) as usize;
                    places[intersection].store(place, Relaxed);
                    *splat = self.owners[intersection];
                }
            });
        TileLists {
            listed,
            ends: self.ends,
            places,
            splats: splats.written(),
            tiles: self.tiles,
        }
    }
}

/// Tiles emitted by a chunk of splats, with their positions.
struct Piece<'a> {
    emitted: &'a Emitted,
    /// First splat.
    first: u32,
    /// First intersection.
    start: u32,
    owners: Part<'a, u32>,
    ends: Part<'a, u32>,
}

impl Piece<'_> {
    /// Puts each intersection at the next position of its tile.
    fn place(self, next: &mut [u32], intersections: &[AtomicU32]) {
        let Emitted { tiles, ends, .. } = self.emitted;
        // Number of splats that begin at an intersection; the running sum gives the splat of each.
        let owners = self.owners.cleared();
        for ((end, own), splat) in self.ends.overwritten().iter_mut().zip(ends).zip(1..) {
            *end = self.start + own;
            if let Some(owner) = owners.get_mut(*own as usize) {
                *owner = splat;
            }
        }
        let mut splat = 0;
        for owner in owners {
            splat = splat.max(*owner);
            *owner = self.first + splat;
        }
        // Positions of one piece are scattered, but no two pieces share one.
        for (tile, intersection) in tiles.iter().zip(self.start..) {
            let place = &mut next[*tile as usize];
            intersections[*place as usize].store(intersection, Relaxed);
            *place += 1;
        }
    }
}

/// Memory that several threads write at disjoint positions. Every position is written before any is
/// read.
fn unset(len: usize) -> Vec<AtomicU32> {
    let values = overwritten::<u32>(len).into_iter();
    values.map(AtomicU32::new).collect()
}
