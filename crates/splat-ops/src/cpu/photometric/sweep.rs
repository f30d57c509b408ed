//! The sweep over the rows of an image.
//!
//! ```text
//! S = A C / (B D),  A = 2 mx my + c1,  B = mx^2 + my^2 + c1,  C = 2 (p - mx my) + c2,  D = q - mx^2 - my^2 + c2
//! d(sum S)/dx = blur(dS/dmx) + 2 x blur(dS/dq) + y blur(dS/dp)
//! ```
//!
//! Here mx, my, q, p are the windowed means of x, y, x^2 + y^2, xy. Outside the pixels that count,
//! the three derivatives (the fields) are zero.
//!
//! A band of rows is one unit of parallel work and is processed in strips of columns, from top to
//! bottom. Ring buffers hold the rows that the window spans: rows of the images, and rows of
//! fields. Each step reads two rows of the images, makes two rows of fields one radius above, and
//! from these two rows of the gradient another radius above. Neighbouring bands and strips both
//! compute what the window reaches beyond them.

use core::ops::Range;

use super::pictures::{Pictures, Rows};
use super::rows::{self, FIELDS, MOMENTS};
use crate::cpu::buffer::overwritten;
use crate::cpu::real::Real;
use crate::settings::SsimArgs;
use crate::ssim::counted;

/// Most pixels of a strip, so that its rings fit into a core's L2 cache.
const STRIP: usize = 320;
/// Inputs and settings shared by all bands.
pub(super) struct Sweep<'a, T> {
    rows: Rows<'a, T>,
    height: usize,
    /// Rows and columns of the pixels that count.
    counted: [Range<isize>; 2],
    /// Number of values that count.
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

    /// Adds the absolute differences and similarities of rows of an image to the `sums` of each
    /// row, starting at `first`. `slope` is the memory of these rows for the gradient of the mean
    /// similarity.
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
        // Extra rows of fields that a gradient needs.
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
                // From here on all rows under the window are loaded.
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

/// Scratch memory, reused by all bands of a thread.
pub(super) struct Scratch<T> {
    /// x and y, per row of the ring.
    pictures: Vec<T>,
    /// The fields, per row of the ring.
    fields: Vec<T>,
    /// Two rows blurred along the columns.
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
    /// Makes room for rings of this size. All memory is written before it is read.
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

/// A strip of a band. Rows in memory extend two radii of pixels on either side: fields are needed
/// one radius beyond the strip, and images another radius.
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

    /// Number of rows under the windows of two adjacent rows.
    fn ring(&self) -> usize {
        self.sweep.window.len() + 1
    }

    /// The strip with a margin, clipped to `within`.
    fn with_margin(&self, margin: isize, within: &Range<isize>) -> Range<isize> {
        let start = (self.columns.start - margin).max(within.start);
        start..(self.columns.end + margin).min(within.end).max(start)
    }

    /// Position of columns within a row in memory.
    fn values(&self, columns: &Range<isize>) -> Range<usize> {
        let origin = self.columns.start - 2 * self.radius;
        let at = |column| (column - origin) as usize * self.sweep.rows.channels;
        at(columns.start)..at(columns.end)
    }

    /// Position of a row in a ring with N rows per row.
    fn place<const N: usize>(&self, row: isize) -> Range<usize> {
        let slot = row.rem_euclid(self.ring() as isize) as usize;
        slot * N * self.length..(slot + 1) * N * self.length
    }

    /// Rows of a ring under the windows around `row` and the next one, top to bottom.
    fn under_window<'m, const N: usize>(&self, ring: &'m [T], row: isize) -> Vec<[&'m [T]; N]> {
        (row - self.radius..=row + self.radius + 1)
            .map(|row| split(&ring[self.place::<N>(row)], self.length))
            .collect()
    }

    /// Loads a row of the images, zero outside. Returns the strip's sum of absolute differences.
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

    /// Computes a row of fields and the next one; zero where no pixel counts. Returns the strip's
    /// sums of similarities.
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

    /// Blurs fields along the columns, for the gradient of a row and the next one.
    fn blur_fields(&self, row: isize, scratch: &mut Scratch<T>) {
        let fields = self.under_window::<FIELDS>(&scratch.fields, row);
        let mut blurred = split_twice(&mut scratch.blurred, self.length);
        rows::fields_down::<T>(&fields, &self.sweep.window, &mut blurred);
    }

    /// Computes a row of the gradient from the first or second row of blurred fields.
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

/// The first N rows, and the next N rows.
fn split_twice<T, const N: usize>(memory: &mut [T], length: usize) -> [[&mut [T]; N]; 2] {
    let (first, second) = memory.split_at_mut(N * length);
    [first, second].map(|memory| split_mut(memory, length))
}
