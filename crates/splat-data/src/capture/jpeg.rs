//! Checks that a JPEG file contains its whole picture.
//!
//! Decoders invent missing data without an error: they paint grey after a truncation, and continue
//! with zero bits if the data end early. This module therefore walks the coded data block by block
//! (ITU T.81), only to find their length. JPEG has no checksums; damage in the middle is noticed if
//! it puts the data out of step, which it usually does.

mod bits;
mod scan;

use bits::{Bits, Broken, Huffman};
use scan::{BLOCK, Component, Frame, Member, Scan, UNSENT, Unfinished};

/// The two bytes that end a picture.
pub(super) const END: [u8; 2] = [0xff, 0xd9];
/// Most scans that are walked: each costs time, however short. Encoders write about 10.
const MOST_SCANS: usize = 100;

/// Properties of a file that contains its whole picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Whole {
    /// True if the picture ends with [`END`]. If not, it is complete nevertheless.
    pub ended: bool,
    /// The file is likely damaged: more data than the picture needs, or an end before the scans
    /// with its detail.
    pub suspect: bool,
}

/// Walks the file; an error says what is missing.
///
/// Needs at most 64 bytes of memory for every byte of the file.
pub(super) fn check(bytes: &[u8]) -> Result<Whole, String> {
    if !bytes.starts_with(&[0xff, 0xd8]) {
        return Err("it does not begin as a JPEG file does".to_owned());
    }
    let mut bits = Bits::new(bytes, 2);
    let mut picture = Picture::default();
    let ended = loop {
        match bits.marker() {
            None => break false,
            Some(0xd9) => break true,
            // Start of image, restarts, and the only other marker without a length.
            Some(0xd0..=0xd8 | 0x01) => continue,
            Some(marker) => {
                let Some(segment) = bits.segment() else {
                    break false;
                };
                picture.read(marker, segment, &mut bits)?;
            }
        }
    };
    picture.whole(ended)
}

/// State of the picture so far.
#[derive(Default)]
struct Picture {
    frame: Option<Frame>,
    dc: [Option<Huffman>; 4],
    ac: [Option<Huffman>; 4],
    restart: usize,
    scans: usize,
    left_over: bool,
}

impl Picture {
    /// Processes a segment, and the coded data after it if it starts a scan.
    fn read(&mut self, marker: u8, segment: &[u8], bits: &mut Bits<'_>) -> Result<(), String> {
        let bad = |what: &str| format!("its {what} is damaged");
        match marker {
            0xc4 => self.tables(segment).ok_or_else(|| bad("Huffman table"))?,
            0xc0..=0xc2 if self.frame.is_some() => {
                return Err("it holds two pictures in one".to_owned());
            }
            0xc0..=0xc2 => {
                let frame = frame(segment, marker == 0xc2).ok_or_else(|| bad("header"))?;
                // Every block takes at least one bit, which also bounds the memory.
                let blocks = frame.blocks();
                if blocks.div_ceil(8) > bits.file_len() {
                    return Err(format!(
                        "its size is too little for the {blocks} blocks of its picture"
                    ));
                }
                self.frame = Some(frame.with_room());
            }
            0xc3 | 0xc5..=0xcf => {
                return Err(format!(
                    "it is a kind of JPEG that is not read (marker {marker:x})"
                ));
            }
            0xdd => match *segment {
                [high, low] => self.restart = u16::from_be_bytes([high, low]).into(),
                _ => return Err(bad("restart interval")),
            },
            0xda => self.scan(segment, bits)?,
            _ => {}
        }
        Ok(())
    }

    /// Huffman tables: class and slot, 16 counts, symbols; repeated.
    fn tables(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((&[class_and_place, ref counts @ ..], rest)) =
            segment.split_first_chunk::<17>()
        {
            let symbols: usize = counts.iter().map(|&count| usize::from(count)).sum();
            let (symbols, rest) = rest.split_at_checked(symbols)?;
            let tables = match class_and_place >> 4 {
                0 => &mut self.dc,
                1 => &mut self.ac,
                _ => return None,
            };
            let place = usize::from(class_and_place & 15);
            *tables.get_mut(place)? = Some(Huffman::new(counts, symbols)?);
            segment = rest;
        }
        segment.is_empty().then_some(())
    }

    fn scan(&mut self, segment: &[u8], bits: &mut Bits<'_>) -> Result<(), String> {
        self.scans += 1;
        if self.scans > MOST_SCANS {
            return Err(format!("it has more than {MOST_SCANS} scans"));
        }
        let frame = self.frame.as_mut().ok_or("its picture has no size")?;
        let scan = scan_of(segment, frame, [&self.dc, &self.ac], self.restart);
        let scan = scan.ok_or("the header of a scan is damaged")?;
        self.left_over |= scan
            .walk(frame, bits)
            .map_err(|unfinished| unfinished.in_words())?;
        for member in &scan.members {
            frame.components[member.component].sent[scan.first..=scan.last].fill(scan.low);
        }
        Ok(())
    }

    /// Checks that everything was sent.
    fn whole(&self, ended: bool) -> Result<Whole, String> {
        let components = self
            .frame
            .as_ref()
            .map_or(&[][..], |frame| &frame.components);
        let missing = |component: &&Component| component.sent[0] == UNSENT;
        match (components.len(), components.iter().filter(missing).count()) {
            (0, _) => return Err("it holds no picture".to_owned()),
            (_, 0) => {}
            (all, missing) => {
                return Err(format!(
                    "{missing} of its {all} colour components are missing"
                ));
            }
        }
        let refined = |component: &Component| component.sent.iter().all(|&bit| bit == 0);
        let refined = components.iter().all(refined);
        if !ended && !refined {
            return Err("it ends before the scans that hold its detail".to_owned());
        }
        if !ended && self.left_over {
            return Err("its picture data are damaged, and their end is missing".to_owned());
        }
        Ok(Whole {
            ended,
            suspect: self.left_over || !refined,
        })
    }
}

impl Frame {
    /// Number of blocks that every picture of this size sends.
    fn blocks(&self) -> usize {
        self.components.iter().map(|c| c.across * c.down).sum()
    }

    /// Reserves memory for the state that later scans depend on.
    fn with_room(mut self) -> Self {
        if self.progressive {
            for component in &mut self.components {
                let mcu = component.horizontal * component.vertical;
                component.nonzero = vec![0; self.across * self.down * mcu];
            }
        }
        self
    }
}

impl Unfinished {
    fn in_words(&self) -> String {
        let Self { why, done, total } = self;
        match why {
            Broken::Early => format!("its picture data end after {done} of {total} blocks"),
            Broken::Corrupt => {
                format!("its picture data are damaged after {done} of {total} blocks")
            }
        }
    }
}

/// The frame of a header: precision, height, width, and the components with their sampling.
fn frame(segment: &[u8], progressive: bool) -> Option<Frame> {
    let (&[_precision, h1, h0, w1, w0, count], rest) = segment.split_first_chunk()?;
    let height = usize::from(u16::from_be_bytes([h1, h0]));
    let width = usize::from(u16::from_be_bytes([w1, w0]));
    let (specs, _) = rest.as_chunks::<3>();
    if specs.len() != usize::from(count) || !(1..=4).contains(&count) || width * height == 0 {
        return None;
    }
    let sampling = |spec: &[u8; 3]| (usize::from(spec[1] >> 4), usize::from(spec[1] & 15));
    let most = |side: fn((usize, usize)) -> usize| specs.iter().map(|s| side(sampling(s))).max();
    let (h_most, v_most) = (most(|s| s.0)?, most(|s| s.1)?);
    let mut components = Vec::with_capacity(specs.len());
    for spec in specs {
        let (horizontal, vertical) = sampling(spec);
        if !(1..=4).contains(&horizontal) || !(1..=4).contains(&vertical) {
            return None;
        }
        components.push(Component {
            id: spec[0],
            horizontal,
            vertical,
            across: (width * horizontal).div_ceil(8 * h_most),
            down: (height * vertical).div_ceil(8 * v_most),
            sent: [UNSENT; BLOCK],
            nonzero: Vec::new(),
        });
    }
    Some(Frame {
        progressive,
        across: width.div_ceil(8 * h_most),
        down: height.div_ceil(8 * v_most),
        components,
    })
}

/// The scan of a header: components with their tables, then which coefficients and bits.
fn scan_of<'a>(
    segment: &[u8],
    frame: &Frame,
    [dc, ac]: [&'a [Option<Huffman>; 4]; 2],
    restart: usize,
) -> Option<Scan<'a>> {
    let (&count, rest) = segment.split_first()?;
    let (specs, rest) = rest.split_at_checked(2 * usize::from(count))?;
    let &[first, last, bits] = rest else {
        return None;
    };
    let mut members = Vec::with_capacity(count.into());
    for &[id, tables] in specs.as_chunks::<2>().0 {
        members.push(Member {
            component: frame.components.iter().position(|c| c.id == id)?,
            dc: dc.get(usize::from(tables >> 4))?.as_ref(),
            ac: ac.get(usize::from(tables & 15))?.as_ref(),
        });
    }
    let mut scan = Scan {
        members,
        first: first.into(),
        last: last.into(),
        high: bits >> 4,
        low: bits & 15,
        restart,
    };
    if !frame.progressive {
        // A sequential picture sends everything at once, regardless of these fields.
        (scan.first, scan.last, scan.high, scan.low) = (0, BLOCK - 1, 0, 0);
    } else if scan.last >= BLOCK || scan.first > scan.last {
        return None;
    } else if scan.first == 0 && scan.last > 0 || scan.first > 0 && scan.members.len() > 1 {
        // The mean of a block is sent separately from the rest, and the rest by one component at a
        // time.
        return None;
    }
    (1..=4).contains(&scan.members.len()).then_some(scan)
}

#[cfg(test)]
mod tests;
