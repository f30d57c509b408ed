//! The sweep over the rows of a picture.
//!
//! ```text
//! S = A C / (B D),  A = 2 mx my + c1,  B = mx^2 + my^2 + c1,  C = 2 (p - mx my) + c2,  D = q - mx^2 - my^2 + c2
//! d(sum S)/dx = blur(dS/dmx) + 2 x blur(dS/dq) + y blur(dS/dp)
//! ```
//!
//! mx, my, q, p being the windowed means of x, y, x^2 + y^2, xy; outside of the pixels that count
//! the three derivatives, the fields, are zero.
//!
//! A band of rows is one unit of parallel work; it goes down a strip of columns at a time. What the
//! window reaches over is kept in rings: rows of the pictures, and rows of fields. A step takes in
//! two rows of the pictures, makes two of fields, a radius higher, and with these two of the
//! gradient, a radius higher again. What the window reaches over beyond a band or a strip is
//! computed by both neighbours.

use core::ops::Range;

use super::pictures::{Pictures, Rows};
use super::rows::{self, FIELDS, MOMENTS};
use crate::cpu::buffer::overwritten;
use crate::cpu::real::Real;
use crate::settings::SsimArgs;
use crate::ssim::counted;

/// Most pixels of a strip: its rings stay in a core's second-level cache.
const STRIP: usize = 320;
/// Inputs and settings that all bands share.
pub(super) struct Sweep<'a, T> {
    rows: Rows<'a, T>,
    height: usize,
    /// Rows and columns of the pixels that count.
    counted: [Range<isize>; 2],
    /// How many values count.
    pub(super) count: usize,
    window: Vec<T>,
    constants: [T; 2],
}

impl<'a, T: Real> Sweep<'a, T> {
    pub(super) fn new(pictures: &'a Pictures, args: &SsimArgs) -> Self {
        let [b, h, w, d] = pictures.shape;
        let counted = counted([h, w], args.window.len());
        let [rows, columns] = counted.clone().map(|range| range.len());
        Self {
            rows: pictures.rows(),
            height: h,
            counted: counted.map(|range| range.start as isize..range.end as isize),
            count: b * rows * columns * d,
            window: args.window.iter().map(|weight| T::of(*weight)).collect(),
            constants: [args.c1, args.c2].map(T::of),
        }
    }

    /// Adds the absolute differences and the similarities of rows of an image to the `sums` of
    /// each, which has the rows from `first` on. `slope` is the memory of these rows, for the
    /// gradient of the mean similarity.
    pub(super) fn band(
        &self,
        image: usize,
        first: usize,
        sums: &mut [[f64; 2]],
        mut slope: Option<&mut [T]>,
        scratch: &mut Scratch<T>,
    ) {
        let (width, channels) = (self.rows.width, self.rows.channels);
        let rows = first as isize..(first + sums.len()) as isize;
        let radius = (self.window.len() / 2) as isize;
        // Rows of fields that a gradient needs beyond its own.
        let reach = if slope.is_some() { radius } else { 0 };
        let strips = width.div_ceil(STRIP);
        for index in 0..strips {
            let columns = index * width / strips..(index + 1) * width / strips;
            let strip = Strip::new(self, image, columns.clone());
            scratch.reserve(strip.ring(), strip.length);
            let mut count = |sum: usize, row: isize, value: f64| {
                if rows.contains(&row) {
                    sums[(row - rows.start) as usize][sum] += value;
                }
            };
            for row in (rows.start - reach - radius..rows.end + reach + radius).step_by(2) {
                for row in [row, row + 1] {
                    count(0, row, strip.load(row, scratch));
                }
                // From here on all rows under the window are there.
                let row = row - radius;
                if row < rows.start - reach {
                    continue;
                }
                let [upper, lower] = strip.fields(row, scratch);
                count(1, row, upper);
                count(1, row + 1, lower);
                let row = row - radius;
                if let Some(slope) = slope.as_deref_mut().filter(|_| row >= rows.start) {
                    strip.blur_fields(row, scratch);
                    for (index, row) in (row..(row + 2).min(rows.end)).enumerate() {
                        let start = (row - rows.start) as usize * width;
                        let out = start + columns.start..start + columns.end;
                        let out = &mut slope[out.start * channels..out.end * channels];
                        strip.slope(row, index, scratch, out);
                    }
                }
            }
        }
    }
}

/// Memory that the bands of a thread share.
pub(super) struct Scratch<T> {
    /// Per row of the ring x and y.
    pictures: Vec<T>,
    /// Per row of the ring the fields.
    fields: Vec<T>,
    /// Two rows blurred down the columns.
    blurred: Vec<T>,
    /// A row of results.
    results: Vec<T>,
}

impl<T> Default for Scratch<T> {
    fn default() -> Self {
        let [pictures, fields, blurred, results] = [(); 4].map(|()| Vec::new());
        Self {
            pictures,
            fields,
            blurred,
            results,
        }
    }
}

impl<T: Real> Scratch<T> {
    /// Memory for rings of so many rows. What it holds is written before it is read.
    fn reserve(&mut self, ring: usize, length: usize) {
        for (memory, rows) in [
            (&mut self.pictures, 2 * ring),
            (&mut self.fields, FIELDS * ring),
            (&mut self.blurred, 2 * MOMENTS),
            (&mut self.results, 1),
        ] {
            if memory.len() < rows * length {
                *memory = overwritten(rows * length);
            }
        }
    }
}

/// A strip of a band. Rows in memory have two radii of pixels on either side of it: fields are
/// needed one radius beyond it, and pictures another.
struct Strip<'a, T> {
    sweep: &'a Sweep<'a, T>,
    image: usize,
    columns: Range<isize>,
    radius: isize,
    /// Values of a row in memory.
    length: usize,
}

impl<'a, T: Real> Strip<'a, T> {
    fn new(sweep: &'a Sweep<'a, T>, image: usize, columns: Range<usize>) -> Self {
        let radius = sweep.window.len() / 2;
        Self {
            sweep,
            image,
            length: rows::padded((columns.len() + 4 * radius) * sweep.rows.channels),
            columns: columns.start as isize..columns.end as isize,
            radius: radius as isize,
        }
    }

    /// Rows that the windows of two rows reach over.
    fn ring(&self) -> usize {
        self.sweep.window.len() + 1
    }

    /// The strip with a margin, as far as it lies in `within`.
    fn with_margin(&self, margin: isize, within: &Range<isize>) -> Range<isize> {
        let start = (self.columns.start - margin).max(within.start);
        start..(self.columns.end + margin).min(within.end).max(start)
    }

    /// Where columns lie in a row in memory.
    fn values(&self, columns: &Range<isize>) -> Range<usize> {
        let origin = self.columns.start - 2 * self.radius;
        let at = |column| (column - origin) as usize * self.sweep.rows.channels;
        at(columns.start)..at(columns.end)
    }

    /// The place of a row in a ring of N rows per row.
    fn place<const N: usize>(&self, row: isize) -> Range<usize> {
        let slot = row.rem_euclid(self.ring() as isize) as usize;
        slot * N * self.length..(slot + 1) * N * self.length
    }

    /// The rows of a ring under the windows around `row` and the next, from above.
    fn under_window<'m, const N: usize>(&self, ring: &'m [T], row: isize) -> Vec<[&'m [T]; N]> {
        (row - self.radius..=row + self.radius + 1)
            .map(|row| split(&ring[self.place::<N>(row)], self.length))
            .collect()
    }

    /// Takes in a row of the pictures, zeros outside. The strip's sum of absolute differences.
    fn load(&self, row: isize, scratch: &mut Scratch<T>) -> f64 {
        let Sweep { rows, height, .. } = self.sweep;
        let memory = &mut scratch.pictures[self.place::<2>(row)];
        if !(0..*height as isize).contains(&row) {
            memory.fill(T::ZERO);
            return 0.0;
        }
        let within = self.with_margin(2 * self.radius, &(0..rows.width as isize));
        let values = self.values(&within);
        let (x, y) = memory.split_at_mut(self.length);
        let columns = within.start as usize..within.end as usize;
        let row = self.image * height + row as usize;
        rows.load(row, columns, &mut x[values.clone()], &mut y[values.clone()]);
        for row in [&mut *x, &mut *y] {
            row[..values.start].fill(T::ZERO);
            row[values.end..].fill(T::ZERO);
        }
        let own = self.values(&self.columns);
        rows::sum_of_differences(&x[own.clone()], &y[own])
    }

    /// Makes a row of fields and the next, zero where no pixel counts. The strip's sums of
    /// similarities.
    fn fields(&self, row: isize, scratch: &mut Scratch<T>) -> [f64; 2] {
        let [counted, columns] = &self.sweep.counted;
        let within = self.with_margin(self.radius, columns);
        let counts = [row, row + 1].map(|row| counted.contains(&row) && !within.is_empty());
        let window = &self.sweep.window;
        if counts != [false; 2] {
            let pictures = self.under_window::<2>(&scratch.pictures, row);
            let mut blurred = split_twice(&mut scratch.blurred, self.length);
            rows::moments_down::<T>(&pictures, window, &mut blurred);
        }
        let own = self.values(&self.with_margin(0, columns));
        let mut sums = [0.0; 2];
        for index in 0..2 {
            let fields = &mut scratch.fields[self.place::<FIELDS>(row + index as isize)];
            if !counts[index] {
                fields.fill(T::ZERO);
                continue;
            }
            rows::fields_along(
                split(
                    &scratch.blurred[index * MOMENTS * self.length..],
                    self.length,
                ),
                self.values(&within),
                self.sweep.rows.channels,
                window,
                self.sweep.constants,
                &mut split_mut(fields, self.length),
                &mut scratch.results,
            );
            sums[index] = rows::sum(&scratch.results[own.clone()]);
        }
        sums
    }

    /// Blurs fields down the columns, for the gradient of a row and the next.
    fn blur_fields(&self, row: isize, scratch: &mut Scratch<T>) {
        let fields = self.under_window::<FIELDS>(&scratch.fields, row);
        let mut blurred = split_twice(&mut scratch.blurred, self.length);
        rows::fields_down::<T>(&fields, &self.sweep.window, &mut blurred);
    }

    /// Makes a row of the gradient, of the first or the second row of blurred fields.
    fn slope(&self, row: isize, index: usize, scratch: &mut Scratch<T>, out: &mut [T]) {
        let own = self.values(&self.columns);
        rows::slope_along(
            split(
                &scratch.blurred[index * FIELDS * self.length..],
                self.length,
            ),
            split(&scratch.pictures[self.place::<2>(row)], self.length),
            own.clone(),
            self.sweep.rows.channels,
            &self.sweep.window,
            T::of(2.0 / self.sweep.count as f64),
            &mut scratch.results,
        );
        out.copy_from_slice(&scratch.results[own]);
    }
}

/// The first N rows.
fn split<T, const N: usize>(memory: &[T], length: usize) -> [&[T]; N] {
    core::array::from_fn(|n| &memory[n * length..(n + 1) * length])
}

/// The first N rows.
fn split_mut<T, const N: usize>(memory: &mut [T], length: usize) -> [&mut [T]; N] {
    let mut rows = memory.chunks_exact_mut(length);
    core::array::from_fn(|_| rows.next().unwrap_or_default())
}

/// The first N rows, and the next N.
fn split_twice<T, const N: usize>(memory: &mut [T], length: usize) -> [[&mut [T]; N]; 2] {
    let (first, second) = memory.split_at_mut(N * length);
    [first, second].map(|memory| split_mut(memory, length))
}
