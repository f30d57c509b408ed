//! One scan of a JPEG file: walks its blocks without decoding their values.

use super::bits::{Bits, Broken, Huffman};

/// Coefficients per block.
pub(super) const BLOCK: usize = 64;
/// A coefficient that no scan has sent.
pub(super) const UNSENT: u8 = u8::MAX;

/// The picture: its size in blocks, and how much of it was sent.
pub(super) struct Frame {
    pub progressive: bool,
    /// MCUs (blocks that are sent together) per row, and rows of them.
    pub across: usize,
    pub down: usize,
    pub components: Vec<Component>,
}

/// A colour component of the picture.
pub(super) struct Component {
    pub id: u8,
    /// Blocks per MCU.
    pub horizontal: usize,
    pub vertical: usize,
    /// Blocks per row and number of rows, without MCU padding.
    pub across: usize,
    pub down: usize,
    /// Lowest bit of every coefficient that was sent.
    pub sent: [u8; BLOCK],
    /// Non-zero coefficients of every block, in zigzag order from bit 0. Only for progressive
    /// pictures, whose later scans depend on them. Padding blocks are included.
    pub nonzero: Vec<u64>,
}

/// A component's role in a scan.
pub(super) struct Member<'a> {
    /// Index of the component.
    pub component: usize,
    pub dc: Option<&'a Huffman>,
    pub ac: Option<&'a Huffman>,
}

/// Contents of a scan: coefficients `first..=last` down to the bit `low`; `high` is the lowest bit
/// sent before, or 0.
pub(super) struct Scan<'a> {
    pub members: Vec<Member<'a>>,
    pub first: usize,
    pub last: usize,
    pub high: u8,
    pub low: u8,
    /// MCUs between restart markers; 0 for none.
    pub restart: usize,
}

/// A scan that ends before its blocks do.
pub(super) struct Unfinished {
    pub why: Broken,
    pub done: usize,
    pub total: usize,
}

impl Scan<'_> {
    /// Walks all blocks of the scan; returns true if coded data was left over.
    pub fn walk(&self, frame: &mut Frame, bits: &mut Bits<'_>) -> Result<bool, Unfinished> {
        let single = self.members.len() == 1;
        let (across, down) = match &self.members[..] {
            // A scan of one component sends its blocks row by row.
            [member] => {
                let component = &frame.components[member.component];
                (component.across, component.down)
            }
            _ => (frame.across, frame.down),
        };
        let total = across * down;
        let mut walk = Walk {
            scan: self,
            progressive: frame.progressive,
            skipped: 0,
        };
        let mut left_over = false;
        for done in 0..total {
            let unfinished = |why| Unfinished { why, done, total };
            if self.restart > 0 && done > 0 && done % self.restart == 0 {
                left_over |= bits.end();
                let expected = 0xd0 + ((done / self.restart - 1) % 8) as u8;
                if bits.marker() != Some(expected) {
                    return Err(unfinished(Broken::Early));
                }
                walk.skipped = 0;
            }
            let (column, row) = (done % across, done / across);
            for member in &self.members {
                let component = &mut frame.components[member.component];
                let stride = frame.across * component.horizontal;
                let (h, v) = if single {
                    (1, 1)
                } else {
                    (component.horizontal, component.vertical)
                };
                for (y, x) in (0..v).flat_map(|y| (0..h).map(move |x| (y, x))) {
                    let index = (row * v + y) * stride + column * h + x;
                    let mut unused = 0;
                    let nonzero = component.nonzero.get_mut(index).unwrap_or(&mut unused);
                    walk.block(member, nonzero, bits).map_err(unfinished)?;
                }
            }
        }
        Ok(left_over | bits.end())
    }
}

/// State carried from block to block.
struct Walk<'a> {
    scan: &'a Scan<'a>,
    progressive: bool,
    /// Remaining blocks that send nothing new (the run of an EOBn symbol).
    skipped: u32,
}

impl Walk<'_> {
    fn block(
        &mut self,
        member: &Member<'_>,
        nonzero: &mut u64,
        bits: &mut Bits<'_>,
    ) -> Result<(), Broken> {
        if !self.progressive {
            dc(member, bits)?;
            return sequential_ac(member, bits);
        }
        match (self.scan.first, self.scan.high) {
            (0, 0) => dc(member, bits),
            (0, _) => bits.take(1).map(|_| ()),
            (_, 0) => self.first_ac(member, nonzero, bits),
            _ => self.refine_ac(member, nonzero, bits),
        }
    }

    /// The first bits of coefficients (T.81, G.1.2.2).
    fn first_ac(
        &mut self,
        member: &Member<'_>,
        nonzero: &mut u64,
        bits: &mut Bits<'_>,
    ) -> Result<(), Broken> {
        if self.skipped > 0 {
            self.skipped -= 1;
            return Ok(());
        }
        let mut k = self.scan.first;
        while k <= self.scan.last {
            let (run, size) = run_and_size(member, bits)?;
            match (run, size) {
                (15, 0) => k += 16,
                (_, 0) => {
                    self.skipped = (1 << run) + bits.take(run)? - 1;
                    break;
                }
                _ => {
                    k += run as usize;
                    if k > self.scan.last {
                        return Err(Broken::Corrupt);
                    }
                    bits.take(size)?;
                    *nonzero |= 1 << k;
                    k += 1;
                }
            }
        }
        Ok(())
    }

    /// One more bit of each non-zero coefficient (T.81, G.1.2.3), and the sign of each that becomes
    /// non-zero.
    fn refine_ac(
        &mut self,
        member: &Member<'_>,
        nonzero: &mut u64,
        bits: &mut Bits<'_>,
    ) -> Result<(), Broken> {
        let mut k = self.scan.first;
        while self.skipped == 0 && k <= self.scan.last {
            let (mut run, size) = run_and_size(member, bits)?;
            match (run, size) {
                (15, 0) => {}
                (_, 0) => {
                    self.skipped = (1 << run) + bits.take(run)?;
                    break;
                }
                (_, 1) => {
                    bits.take(1)?;
                }
                _ => return Err(Broken::Corrupt),
            }
            while k <= self.scan.last {
                if *nonzero >> k & 1 == 1 {
                    bits.take(1)?;
                } else if run == 0 {
                    break;
                } else {
                    run -= 1;
                }
                k += 1;
            }
            if size == 1 {
                if k > self.scan.last {
                    return Err(Broken::Corrupt);
                }
                *nonzero |= 1 << k;
            }
            k += 1;
        }
        if self.skipped > 0 {
            for _ in (k..=self.scan.last).filter(|k| *nonzero >> k & 1 == 1) {
                bits.take(1)?;
            }
            self.skipped -= 1;
        }
        Ok(())
    }
}

/// Difference of a block's mean from the previous one.
fn dc(member: &Member<'_>, bits: &mut Bits<'_>) -> Result<(), Broken> {
    let table = member.dc.ok_or(Broken::Corrupt)?;
    let size = bits.symbol(table)?;
    if size > 16 {
        return Err(Broken::Corrupt);
    }
    bits.take(size.into()).map(|_| ())
}

/// All other coefficients of a block in a sequential picture (T.81, F.1.2.2).
fn sequential_ac(member: &Member<'_>, bits: &mut Bits<'_>) -> Result<(), Broken> {
    let mut k = 1;
    while k < BLOCK {
        let (run, size) = run_and_size(member, bits)?;
        match (run, size) {
            (15, 0) => k += 16,
            (_, 0) => break,
            _ => {
                k += run as usize;
                if k >= BLOCK {
                    return Err(Broken::Corrupt);
                }
                bits.take(size)?;
                k += 1;
            }
        }
    }
    Ok(())
}

/// Number of zero coefficients, and bits of the one after them.
fn run_and_size(member: &Member<'_>, bits: &mut Bits<'_>) -> Result<(u32, u32), Broken> {
    let table = member.ac.ok_or(Broken::Corrupt)?;
    let symbol = u32::from(bits.symbol(table)?);
    Ok((symbol >> 4, symbol & 15))
}
