//! Text files from other programs: byte-order marks, encodings and line ends.

use std::fmt::{self, Display};

/// Bytes of a text file without a leading byte-order mark.
///
/// # Errors
///
/// The reason, if the bytes do not begin as UTF-8 or ASCII text, most often UTF-16.
pub fn without_mark(bytes: &[u8]) -> Result<&[u8], &'static str> {
    if let Some(text) = bytes.strip_prefix(&[0xef, 0xbb, 0xbf]) {
        return Ok(text);
    }
    let utf16_mark = bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]);
    // In UTF-16, numbers and English words have a zero in every second byte.
    if utf16_mark || bytes.iter().take(4).any(|&byte| byte == 0) {
        return Err("UTF-16 text, or no text at all; save it as UTF-8");
    }
    Ok(bytes)
}

/// Text of a file without its byte-order mark.
///
/// # Errors
///
/// Position of the first bytes that are not UTF-8, and what to do.
pub fn utf8(bytes: &[u8]) -> Result<&str, String> {
    std::str::from_utf8(without_mark(bytes)?)
        .map_err(|error| format!("no text in UTF-8 ({error}); save it as such"))
}

/// Joins the lines of a message into one; messages of libraries span several.
pub fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Lines with their index from 0. They end as on Unix or Windows, or as on an old Mac if there is
/// no other line end.
pub fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, &[u8])> {
    let end = if bytes.contains(&b'\n') { b'\n' } else { b'\r' };
    let lines = bytes.split(move |&byte| byte == end);
    lines.map(<[u8]>::trim_ascii).enumerate()
}

/// Shows part of a user's file in a message, in one line and shortened.
pub struct Excerpt<'a>(pub &'a str);

impl Display for Excerpt<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const MOST: usize = 80;
        write!(
            f,
            "{}",
            self.0.chars().take(MOST).collect::<String>().escape_debug()
        )?;
        if self.0.chars().nth(MOST).is_some() {
            f.write_str("...")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_go_and_utf16_is_named() {
        for (bytes, text) in [
            (&b"\xef\xbb\xbf# hi"[..], &b"# hi"[..]),
            (b"# hi", b"# hi"),
            (b"", b""),
            (b"\xef\xbb\xbf", b""),
        ] {
            assert_eq!(without_mark(bytes), Ok(text));
        }
        let utf16 = |big: bool| -> Vec<u8> {
            let units = "\u{feff}# hi".encode_utf16();
            let bytes = |unit: u16| {
                if big {
                    unit.to_be_bytes()
                } else {
                    unit.to_le_bytes()
                }
            };
            units.flat_map(bytes).collect()
        };
        for bytes in [utf16(true), utf16(false)] {
            assert!(without_mark(&bytes).unwrap_err().contains("UTF-16"));
            assert!(without_mark(&bytes[2..]).unwrap_err().contains("UTF-16"));
        }
    }

    #[test]
    fn lines_end_as_on_any_system() {
        for text in [
            "a\nb c\n\nd",
            "a\r\nb c\r\n\r\nd",
            "a\rb c\r\rd",
            "a\n b c \n\n\td",
        ] {
            let lines: Vec<_> = lines(text.as_bytes()).collect();
            let expected = [&b"a"[..], b"b c", b"", b"d"];
            assert_eq!(lines, (0..).zip(expected).collect::<Vec<_>>(), "{text:?}");
        }
    }

    #[test]
    fn excerpts_are_short_and_in_one_line() {
        assert_eq!(Excerpt("a\n\u{1b}b").to_string(), "a\\n\\u{1b}b");
        assert_eq!(Excerpt(&"x".repeat(999)).to_string().len(), 83);
    }
}
