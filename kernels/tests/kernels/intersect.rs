//! Tile lists, compared with brute force over pixels.

use rand::RngExt;
use splat_kernels::intersect::{Frames, TILE, TileLists, intersect};

use crate::device::{client, download_u32, rng, upload, wide};
use crate::reference::raw_alpha;

const ALPHA_MIN: f32 = splat_core::ALPHA_MIN as f32;

/// A packed row with the covariance R diag(a², b²) Rᵀ + 0.3 I.
fn row(x: f32, y: f32, depth: f32, a: f64, b: f64, angle: f64) -> [f32; 9] {
    let (s, c) = angle.sin_cos();
    let xx = (a * c).powi(2) + (b * s).powi(2) + 0.3;
    let yy = (a * s).powi(2) + (b * c).powi(2) + 0.3;
    let xy = (a * a - b * b) * s * c;
    let det = a * a * b * b + 0.3 * (a * a + b * b) + 0.09;
    let w22 = (xx / det).sqrt();
    let reach = (2.0 * 255.0f64.ln()).sqrt();
    [
        x,
        y,
        depth,
        (1.0 / xx.sqrt()) as f32,
        (-(xy / xx) * w22) as f32,
        w22 as f32,
        1.0,
        (reach * xx.sqrt()) as f32,
        (reach * yy.sqrt()) as f32,
    ]
}

fn random_rows(splats: usize, seed: u64) -> (Vec<f32>, Vec<f32>) {
    let mut rng = rng(seed);
    let mut packed = Vec::new();
    let mut opacities = Vec::new();
    for i in 0..splats {
        // Round splats, long ones, and needles of 1000 x 0.1 and 10,000 x 1 pixels.
        let (a, b) = match i % 4 {
            0 => (rng.random_range(0.1..8.0), rng.random_range(0.1..8.0)),
            1 => (rng.random_range(10.0..60.0), rng.random_range(0.1..3.0)),
            2 => (1000.0, 0.1),
            _ => (10_000.0, 1.0),
        };
        let x = rng.random_range(-30.0f32..150.0);
        let y = rng.random_range(-30.0f32..110.0);
        // Few depths, for many ties: negative ones, both zeros, and two neighbouring f32 numbers.
        let depth = [-3.5f32, -0.0, 0.0, 1.0, 1e4, 1e4 + 0.001][rng.random_range(0..6)];
        packed.extend(row(
            x,
            y,
            depth,
            a,
            b,
            rng.random_range(0.0..std::f64::consts::PI),
        ));
        opacities.push(if i % 7 == 0 {
            rng.random_range(0.0..0.01)
        } else {
            rng.random_range(0.01..1.0)
        });
    }
    (packed, opacities)
}

fn lists(frames: &Frames, packed: &[f32], opacities: &[f32]) -> Option<(TileLists, Vec<Vec<u32>>)> {
    let client = client()?;
    let lists = intersect(
        &client,
        &upload(&client, packed),
        &upload(&client, opacities),
        frames,
    )
    .unwrap();
    let splats = download_u32(&client, &lists.splats);
    let ranges = download_u32(&client, &lists.ranges);
    assert_eq!(splats.len(), lists.intersections);
    let tiles = ranges
        .chunks(2)
        .map(|r| splats[r[0] as usize..r[1] as usize].to_vec())
        .collect();
    Some((lists, tiles))
}

#[test]
fn every_tile_with_a_visible_pixel_is_kept_and_hardly_any_other() {
    let frames = Frames {
        cameras: 1,
        gaussians: 2000,
        width: 121,
        height: 77,
        alpha_min: ALPHA_MIN,
    };
    let (packed, opacities) = random_rows(frames.gaussians, 20);
    let Some((_, tiles)) = lists(&frames, &packed, &opacities) else {
        return;
    };
    let columns = frames.width.div_ceil(TILE);
    let (mut kept, mut far_false) = (0, 0);
    for (tile, list) in tiles.iter().enumerate() {
        let (x0, y0) = (tile as u32 % columns * TILE, tile as u32 / columns * TILE);
        for splat in 0..frames.gaussians {
            let row = wide(&packed[splat * 9..splat * 9 + 9]);
            let opacity = f64::from(opacities[splat]);
            // Largest alpha over pixel centres, and over a grid eight times as fine in the same
            // rectangle.
            let best = |steps: u32| {
                let mut best = 0.0f64;
                let x1 = (x0 + TILE).min(frames.width) - 1;
                let y1 = (y0 + TILE).min(frames.height) - 1;
                for y in 0..=(y1 - y0) * steps {
                    for x in 0..=(x1 - x0) * steps {
                        let px = f64::from(x0) + f64::from(x) / f64::from(steps) + 0.5;
                        let py = f64::from(y0) + f64::from(y) / f64::from(steps) + 0.5;
                        best = best.max(raw_alpha(&row, opacity, px, py));
                    }
                }
                best
            };
            let listed = list.contains(&(splat as u32));
            kept += usize::from(listed);
            if !listed {
                assert!(
                    best(1) < f64::from(ALPHA_MIN),
                    "tile {tile} lost splat {splat}"
                );
            } else if best(1) < f64::from(ALPHA_MIN) && best(8) < 0.9 * f64::from(ALPHA_MIN) {
                far_false += 1;
            }
        }
    }
    println!("{kept} kept, {far_false} of them with nothing near alpha_min in their rectangle");
    assert!(kept > 5000);
    assert_eq!(far_false, 0);
}

#[test]
fn splats_over_many_tiles_are_listed_by_all_units_together() {
    let frames = Frames {
        cameras: 2,
        gaussians: 300,
        width: 500,
        height: 330,
        alpha_min: ALPHA_MIN,
    };
    // Every tenth splat is large: most of the image, a disc over a few hundred tiles, or a needle
    // across it.
    let mut rng = rng(23);
    let (mut packed, mut opacities) = (Vec::new(), Vec::new());
    for i in 0..2 * frames.gaussians {
        let (a, b) = match i % 30 {
            0 => (400.0, 300.0),
            10 => (90.0, 60.0),
            20 => (1000.0, 0.5),
            _ => (rng.random_range(0.1..6.0), 1.0),
        };
        let (x, y) = (
            rng.random_range(0.0f32..500.0),
            rng.random_range(0.0..330.0),
        );
        let angle = rng.random_range(0.0..std::f64::consts::PI);
        packed.extend(row(x, y, 1.0 + i as f32, a, b, angle));
        opacities.push(rng.random_range(0.01..1.0));
    }
    let Some((found, tiles)) = lists(&frames, &packed, &opacities) else {
        return;
    };
    let columns = frames.width.div_ceil(TILE);
    let rows = frames.height.div_ceil(TILE);
    let mut unseen = 0;
    for (tile, list) in tiles.iter().enumerate() {
        let (camera, tile) = (
            tile as u32 / (columns * rows),
            tile as u32 % (columns * rows),
        );
        let (x0, y0) = (tile % columns * TILE, tile / columns * TILE);
        for splat in 0..frames.gaussians as u32 {
            let splat = (camera * frames.gaussians as u32 + splat) as usize;
            let row = wide(&packed[splat * 9..splat * 9 + 9]);
            let opacity = f64::from(opacities[splat]);
            let seen = (y0..(y0 + TILE).min(frames.height)).any(|y| {
                (x0..(x0 + TILE).min(frames.width)).any(|x| {
                    let (x, y) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
                    raw_alpha(&row, opacity, x, y) >= f64::from(ALPHA_MIN)
                })
            });
            let listed = list.contains(&(splat as u32));
            assert!(listed || !seen, "camera {camera}: tile {tile} lost {splat}");
            unseen += usize::from(listed && !seen);
        }
    }
    println!(
        "{} intersections, {unseen} without a pixel",
        found.intersections
    );
    assert!(found.intersections > 10_000 && unseen < found.intersections / 50);
}

#[test]
fn tiles_are_in_order_of_depth_and_then_of_index() {
    let frames = Frames {
        cameras: 2,
        gaussians: 700,
        width: 100,
        height: 60,
        alpha_min: ALPHA_MIN,
    };
    let (packed, opacities) = random_rows(2 * frames.gaussians, 21);
    let Some((lists, tiles)) = lists(&frames, &packed, &opacities) else {
        return;
    };
    assert_eq!(tiles.len(), frames.tiles());
    assert_eq!(
        tiles.iter().map(Vec::len).sum::<usize>(),
        lists.intersections
    );
    for (tile, list) in tiles.iter().enumerate() {
        let camera = tile / (frames.tiles() / 2);
        assert!(
            list.iter()
                .all(|splat| *splat as usize / frames.gaussians == camera)
        );
        for pair in list.windows(2) {
            let depth = |splat: u32| packed[splat as usize * 9 + 2];
            let (a, b) = (pair[0], pair[1]);
            assert!(
                depth(a) < depth(b) || (depth(a) == depth(b) && a < b),
                "tile {tile}: {a} before {b}"
            );
        }
    }
}

#[test]
fn slots_of_a_splat_are_consecutive_and_name_its_intersections() {
    let frames = Frames {
        cameras: 1,
        gaussians: 300,
        width: 100,
        height: 60,
        alpha_min: ALPHA_MIN,
    };
    let (packed, opacities) = random_rows(frames.gaussians, 22);
    let Some((lists, _)) = lists(&frames, &packed, &opacities) else {
        return;
    };
    let client = client().unwrap();
    let slots = lists.slots.as_ref().unwrap();
    let [splats, slots, visible, order, offsets] = [
        &lists.splats,
        &slots.of,
        &slots.visible,
        &slots.order,
        &slots.offsets,
    ]
    .map(|b| download_u32(&client, b));
    let mut owner = vec![u32::MAX; lists.intersections];
    let found = visible[frames.gaussians] as usize;
    assert!(found > 100 && found < frames.gaussians);
    for j in 0..found {
        owner[offsets[j] as usize..offsets[j + 1] as usize].fill(order[j]);
    }
    assert_eq!(offsets[found] as usize, lists.intersections);
    for (splat, pair) in visible.windows(2).enumerate() {
        let listed = order[..found].contains(&(splat as u32));
        assert_eq!(pair[1] - pair[0], u32::from(listed), "splat {splat}");
    }
    for (splat, slot) in splats.iter().zip(&slots) {
        assert_eq!(owner[*slot as usize], *splat);
    }
    let mut sorted = slots;
    sorted.sort_unstable();
    assert!(
        sorted
            .iter()
            .enumerate()
            .all(|(i, slot)| i == *slot as usize),
        "every slot once"
    );
}

#[test]
fn nothing_to_see_gives_empty_lists() {
    let frames = Frames {
        cameras: 1,
        gaussians: 0,
        width: 33,
        height: 17,
        alpha_min: ALPHA_MIN,
    };
    let Some((none, tiles)) = lists(&frames, &[], &[]) else {
        return;
    };
    assert_eq!(none.intersections, 0);
    assert_eq!(tiles, vec![Vec::<u32>::new(); 6]);
    // All culled, all too faint, and all NaN.
    let frames = Frames {
        gaussians: 3,
        ..frames
    };
    let mut packed = vec![0.0; 9];
    packed.extend(row(10.0, 10.0, 1.0, 3.0, 3.0, 0.0));
    packed.extend(row(f32::NAN, 10.0, 1.0, 3.0, 3.0, 0.0));
    let (none, tiles) = lists(&frames, &packed, &[0.9, 0.0039, 0.9]).unwrap();
    assert_eq!(none.intersections, 0);
    assert_eq!(tiles, vec![Vec::<u32>::new(); 6]);
}
