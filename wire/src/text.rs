//! Reads untrusted text within a limit. Refuses names that could break out of a log line, a label
//! or a terminal.

use crate::cursor::{Cursor, Endianness, Reason, WireError};

/// Returns a cursor after the encapsulation header of plain CDR (RTPS 2.5, 10.2). Plain CDR2 is
/// accepted, too: it differs in the alignment of 64-bit values, which the callers' types do not have.
pub(crate) fn plain_cdr(payload: &[u8]) -> Result<Cursor<'_>, WireError> {
    let mut cursor = Cursor::new(payload, Endianness::Big);
    let error = cursor.error("encapsulation", Reason::BadMarker);
    let endianness = match cursor.u16("encapsulation")? {
        0x0000 | 0x0006 => Endianness::Big,
        0x0001 | 0x0007 => Endianness::Little,
        _ => return Err(error),
    };
    cursor.u16("encapsulation options")?;
    Ok(cursor.with_endianness(endianness))
}

/// Reads a CDR string: a `u32` length that includes the terminating NUL, the bytes, and padding to
/// four. Does not check the characters, unlike [`name`].
///
/// Accepts more than one NUL at the end (Fast DDS includes one in some lengths); a length of zero
/// is an empty string. The limit is in bytes of text.
pub(crate) fn string<'a>(
    cursor: &mut Cursor<'a>,
    what: &'static str,
    limit: usize,
) -> Result<&'a str, WireError> {
    let start = *cursor;
    let bytes = octets(cursor, what)?;
    let text = core::str::from_utf8(bytes).map_err(|_| start.error(what, Reason::BadText))?;
    if !text.is_empty() && !text.ends_with('\0') {
        return Err(start.error(what, Reason::BadText));
    }
    let text = text.trim_end_matches('\0');
    if text.len() > limit {
        return Err(start.error(what, Reason::OverLimit));
    }
    Ok(text)
}

/// Reads a CDR octet sequence: a `u32` length, the bytes, and padding to four.
pub(crate) fn octets<'a>(
    cursor: &mut Cursor<'a>,
    what: &'static str,
) -> Result<&'a [u8], WireError> {
    let bytes = unpadded(cursor, what)?;
    cursor.align(4);
    Ok(bytes)
}

fn unpadded<'a>(cursor: &mut Cursor<'a>, what: &'static str) -> Result<&'a [u8], WireError> {
    cursor.align(4);
    let start = *cursor;
    let length =
        usize::try_from(cursor.u32(what)?).map_err(|_| start.error(what, Reason::BadLength))?;
    cursor.take(what, length)
}

/// Reads a CDR string of any encoding, without its terminator. Unlike [`octets`], it leaves the
/// padding before the next field, whose alignment may be smaller.
pub(crate) fn unterminated<'a>(
    cursor: &mut Cursor<'a>,
    what: &'static str,
) -> Result<&'a [u8], WireError> {
    let bytes = unpadded(cursor, what)?;
    Ok(bytes.strip_suffix(b"\0").unwrap_or(bytes))
}

/// Returns whether a name can stand unquoted on a terminal, in a label and in a log line: no
/// control characters, quotation marks or escapes. DDS and ROS names never have them (DDS 1.4,
/// annex B: letters, digits, underscore; slashes in ROS's mapping).
pub(crate) fn is_plain(text: &str) -> bool {
    !text.chars().any(|c| {
        c.is_control()
            || matches!(c, '"' | '\'' | '`' | '\\')
            // Line and paragraph separators, and the characters that reorder text on a terminal.
            || matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{feff}')
    })
}

/// Reads a [`string`] and requires it to be plain, see [`is_plain`].
pub(crate) fn name<'a>(
    cursor: &mut Cursor<'a>,
    what: &'static str,
    limit: usize,
) -> Result<&'a str, WireError> {
    let start = *cursor;
    let text = string(cursor, what, limit)?;
    if is_plain(text) {
        Ok(text)
    } else {
        Err(start.error(what, Reason::BadText))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bytes: &[u8]) -> Result<&str, Reason> {
        name(&mut Cursor::new(bytes, Endianness::Little), "name", 8).map_err(|error| error.reason)
    }

    #[test]
    fn a_string_without_its_terminator_is_refused() {
        assert_eq!(read(b"\x03\0\0\0ab\0\0"), Ok("ab"));
        assert_eq!(read(b"\x02\0\0\0ab\0\0"), Err(Reason::BadText));
        assert_eq!(read(b"\0\0\0\0"), Ok(""));
        assert_eq!(read(b"\x01\0\0\0\0"), Ok(""));
    }

    #[test]
    fn a_length_beyond_the_input_is_reported_as_truncated() {
        assert_eq!(read(b"\xff\xff\xff\xffab\0\0"), Err(Reason::Truncated));
        assert_eq!(read(b"\x05\0\0\0ab\0\0"), Err(Reason::Truncated));
    }

    #[test]
    fn hostile_names_are_refused() {
        assert_eq!(read(b"\x0a\0\0\0abcdefghi\0"), Err(Reason::OverLimit));
        assert_eq!(read(b"\x03\0\0\0\xff\xfe\0"), Err(Reason::BadText));
        for bad in [
            "a\"b",
            "a\nb",
            "a\0b",
            "a\\b",
            "a'b",
            "a`b",
            "\u{1b}[2J",
            "\u{202e}x",
        ] {
            assert!(!is_plain(bad), "{bad:?}");
        }
        assert!(is_plain("rt/röbot/scan"));
    }
}
