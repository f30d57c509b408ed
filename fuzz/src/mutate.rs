//! Generic mutations of bytes, and of lines and words of text.

use rand::{Rng, RngExt};
use rand_pcg::Pcg64Mcg;

/// Limits of integer types, and numbers near sizes that might be allocated.
const NUMBERS: [u64; 16] = [
    0,
    1,
    2,
    3,
    0x7f,
    0xff,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    0x1_0000_0000,
    0x0100_0000_0000,
    0x7fff_ffff_ffff_ffff,
    0x8000_0000_0000_0000,
    u64::MAX,
];

/// Non-finite numbers, limits of types, and numbers that underflow when squared.
const REALS: [f64; 16] = [
    f64::NAN,
    f64::INFINITY,
    f64::NEG_INFINITY,
    0.0,
    -0.0,
    1.0,
    -1.0,
    1e-320,
    1e-161,
    1e-45,
    1e30,
    3.5e38,
    -1e38,
    1e300,
    0.5,
    1e16,
];

/// Words that text parsers stumble over.
pub const WORDS: [&str; 26] = [
    "nan",
    "NaN",
    "inf",
    "-inf",
    "infinity",
    "1e999",
    "-1e999",
    "1e-999",
    "-0",
    "+1",
    "0x10",
    "1_000",
    "",
    "18446744073709551615",
    "18446744073709551616",
    "4294967295",
    "-1",
    "2147483648",
    "1.5",
    "\u{feff}",
    "\u{a0}",
    "\u{2028}",
    "#",
    "../../etc/passwd",
    "/etc/passwd",
    "\0",
];

/// An index in `0..len`.
pub fn place(rng: &mut Pcg64Mcg, len: usize) -> usize {
    if len == 0 {
        0
    } else {
        rng.random_range(0..len)
    }
}

/// One of several.
pub fn one_of<'a, T>(rng: &mut Pcg64Mcg, of: &'a [T]) -> &'a T {
    &of[place(rng, of.len())]
}

/// A number in place of a count or an id.
pub fn number(rng: &mut Pcg64Mcg) -> u64 {
    match rng.random_range(0..3) {
        0 => rng.random_range(0..10),
        _ => *one_of(rng, &NUMBERS),
    }
}

/// A number in place of a coordinate.
pub fn real(rng: &mut Pcg64Mcg) -> f64 {
    match rng.random_range(0..3) {
        0 => rng.random_range(-10.0..10.0),
        _ => *one_of(rng, &REALS),
    }
}

/// A range of up to `longest` bytes.
fn range(rng: &mut Pcg64Mcg, len: usize, longest: usize) -> std::ops::Range<usize> {
    let start = place(rng, len + 1);
    let count = rng.random_range(0..=longest.min(len - start));
    start..start + count
}

/// Mutates bytes without regard to their meaning.
pub fn bytes(bytes: &mut Vec<u8>, rng: &mut Pcg64Mcg) {
    let len = bytes.len();
    match rng.random_range(0..9) {
        0 if len > 0 => bytes[place(rng, len)] ^= 1 << rng.random_range(0..8),
        1 if len > 0 => bytes[place(rng, len)] = rng.next_u32() as u8,
        2 => bytes.truncate(place(rng, len + 1)),
        3 => {
            let range = range(rng, len, 64);
            bytes.drain(range);
        }
        4 => {
            let copy = bytes[range(rng, len, 64)].to_vec();
            let at = place(rng, len + 1);
            bytes.splice(at..at, copy);
        }
        5 => {
            let at = place(rng, len + 1);
            let new: Vec<u8> = (0..rng.random_range(0..8))
                .map(|_| rng.next_u32() as u8)
                .collect();
            bytes.splice(at..at, new);
        }
        6 => overwrite(bytes, rng, |rng| number(rng).to_le_bytes()),
        7 => overwrite(bytes, rng, |rng| real(rng).to_le_bytes()),
        _ => {
            let width = *one_of(rng, &[1, 2, 4]);
            overwrite(bytes, rng, |rng| {
                let mut new = [0; 8];
                new[..width].copy_from_slice(&number(rng).to_le_bytes()[..width]);
                if width == 4 && rng.random_bool(0.5) {
                    new[..4].copy_from_slice(&(real(rng) as f32).to_le_bytes());
                }
                new
            });
        }
    }
}

/// Overwrites eight bytes somewhere, usually where a field may begin.
fn overwrite(bytes: &mut [u8], rng: &mut Pcg64Mcg, new: impl Fn(&mut Pcg64Mcg) -> [u8; 8]) {
    let mut at = place(rng, bytes.len());
    if rng.random_bool(0.7) {
        at &= !3;
    }
    let new = new(rng);
    let count = new.len().min(bytes.len() - at);
    bytes[at..at + count].copy_from_slice(&new[..count]);
}

/// Mutates a text by lines and words; `words` are those of its format. Line ends are mostly kept.
pub fn text(text: &mut Vec<u8>, words: &[&str], rng: &mut Pcg64Mcg) {
    let mut lines: Vec<Vec<u8>> = text
        .split(|byte| *byte == b'\n')
        .map(<[u8]>::to_vec)
        .collect();
    let (a, b) = (place(rng, lines.len()), place(rng, lines.len()));
    match rng.random_range(0..12) {
        0 => lines.swap(a, b),
        1 => {
            lines.remove(a);
        }
        2 => lines.insert(b, lines[a].clone()),
        3 => lines.truncate(a),
        4 => lines[a] = vec![*one_of(rng, b"x 1#\xff"); *one_of(rng, &[1, 100, 5_000])],
        5 => {
            *text = lines.join(&b"\r\n"[..]);
            return;
        }
        6 => {
            text.splice(0..0, *b"\xef\xbb\xbf");
            return;
        }
        7 => lines.insert(a, vec![]),
        _ => word(&mut lines[a], words, rng),
    }
    *text = lines.join(&b'\n');
}

/// Mutates a word of a line.
fn word(line: &mut Vec<u8>, words: &[&str], rng: &mut Pcg64Mcg) {
    let mut parts: Vec<Vec<u8>> = line
        .split(|byte| *byte == b' ')
        .map(<[u8]>::to_vec)
        .collect();
    let (a, b) = (place(rng, parts.len()), place(rng, parts.len()));
    let known = !words.is_empty() && rng.random_bool(0.5);
    let new = one_of(rng, if known { words } else { &WORDS });
    match rng.random_range(0..8) {
        0 => parts.swap(a, b),
        1 => {
            parts.remove(a);
        }
        2 => parts.insert(b, parts[a].clone()),
        3 => parts.insert(a, new.as_bytes().to_vec()),
        4 => parts[a] = number(rng).to_string().into_bytes(),
        5 => parts[a] = format!("{}", real(rng)).into_bytes(),
        _ => parts[a] = new.as_bytes().to_vec(),
    }
    *line = parts.join(&b' ');
}
