//! The Huffman-coded bits of a JPEG file, and the markers between them.

/// Why coded data cannot be followed to the end of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Broken {
    /// The file ends, or a marker follows, where more data is required.
    Early,
    /// Bits that no encoder writes.
    Corrupt,
}

/// A Huffman table (ITU T.81, annex C), indexed by the next 16 bits: length * 256 + symbol; 0 if
/// they begin with no code.
pub(super) struct Huffman(Vec<u16>);

impl Huffman {
    /// The table with `counts[i]` codes of `i + 1` bits, or `None` if there are more codes than
    /// fit.
    pub fn new(counts: &[u8; 16], symbols: &[u8]) -> Option<Self> {
        let mut lookup = vec![0; 1 << 16];
        let mut symbols = symbols.iter();
        let mut next = 0;
        for (length, &count) in (1u16..).zip(counts) {
            let span = 1 << (16 - length);
            for &symbol in symbols.by_ref().take(count.into()) {
                lookup
                    .get_mut(next..next + span)?
                    .fill(length << 8 | u16::from(symbol));
                next += span;
            }
        }
        Some(Self(lookup))
    }
}

/// A cursor over a file: by bytes between scans, by bits inside them.
pub(super) struct Bits<'a> {
    bytes: &'a [u8],
    /// First byte that is not in `buffer`.
    at: usize,
    /// Bits read but not yet consumed, the next one on top; zeros below.
    buffer: u64,
    held: u32,
}

impl<'a> Bits<'a> {
    /// Starts at byte `at`.
    pub fn new(bytes: &'a [u8], at: usize) -> Self {
        Self {
            bytes,
            at,
            buffer: 0,
            held: 0,
        }
    }

    /// Code of the next marker, skipping anything before it; `None` at the end of the file.
    pub fn marker(&mut self) -> Option<u8> {
        loop {
            let rest = self.bytes.get(self.at..)?;
            self.at += rest.iter().position(|&byte| byte == 0xff)? + 1;
            match *self.bytes.get(self.at)? {
                // A stuffed byte of coded data.
                0 => self.at += 1,
                // Fill before a marker.
                0xff => {}
                code => {
                    self.at += 1;
                    return Some(code);
                }
            }
        }
    }

    /// Contents of the segment after the marker just read; `None` if the file ends first.
    pub fn segment(&mut self) -> Option<&'a [u8]> {
        let rest = self.bytes.get(self.at..)?;
        let (length, _) = rest.split_first_chunk()?;
        let length = usize::from(u16::from_be_bytes(*length));
        let segment = rest.get(2..length)?;
        self.at += length;
        Some(segment)
    }

    /// Position of the next byte.
    #[cfg(test)]
    pub fn at(&self) -> usize {
        self.at
    }

    /// Number of bytes in the whole file.
    pub fn file_len(&self) -> usize {
        self.bytes.len()
    }

    /// Reads `count` bits, at most 16.
    pub fn take(&mut self, count: u32) -> Result<u32, Broken> {
        if count == 0 {
            return Ok(0);
        }
        if self.held < count {
            self.fill();
        }
        let value = (self.buffer >> (64 - count)) as u32;
        self.drop(count)?;
        Ok(value)
    }

    /// Reads one symbol.
    pub fn symbol(&mut self, table: &Huffman) -> Result<u8, Broken> {
        if self.held < 16 {
            self.fill();
        }
        let code = table.0[(self.buffer >> 48) as usize];
        if code == 0 {
            let early = self.held < 16;
            return Err(if early {
                Broken::Early
            } else {
                Broken::Corrupt
            });
        }
        self.drop(u32::from(code >> 8))?;
        Ok(code as u8)
    }

    /// Ends a run of coded data; returns true if more was left than the padding of the last byte.
    pub fn end(&mut self) -> bool {
        self.fill();
        let left_over = self.held >= 8;
        (self.buffer, self.held) = (0, 0);
        left_over
    }

    fn drop(&mut self, count: u32) -> Result<(), Broken> {
        if count > self.held {
            return Err(Broken::Early);
        }
        self.buffer <<= count;
        self.held -= count;
        Ok(())
    }

    /// Reads bytes until the buffer is full or a marker or the end of the file follows.
    fn fill(&mut self) {
        while self.held <= 56 {
            let Some(&byte) = self.bytes.get(self.at) else {
                return;
            };
            if byte == 0xff {
                if self.bytes.get(self.at + 1) != Some(&0) {
                    return;
                }
                self.at += 1;
            }
            self.at += 1;
            self.buffer |= u64::from(byte) << (56 - self.held);
            self.held += 8;
        }
    }
}
