//! A row: a header with the type of each column, and their values.

/// A row, of which only the start may have been read.
pub(super) struct Row<'a> {
    bytes: &'a [u8],
}

/// A value of a row.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) enum Value<'a> {
    Null,
    Integer(i64),
    Real,
    Text(&'a str),
    /// Bytes, up to the part of the row that was read.
    Blob(&'a [u8]),
}

impl<'a> Row<'a> {
    pub(super) const fn new(bytes: &'a [u8]) -> Self {
        Self { bytes }
    }

    /// Returns the value of the column at this position.
    pub(super) fn value(&self, place: usize) -> Option<Value<'a>> {
        let (length, rest) = varint(self.bytes)?;
        let read = self.bytes.len() - rest.len();
        let length = usize::try_from(length).ok()?;
        let mut types = rest.get(..length.checked_sub(read)?)?;
        let mut values = self.bytes.get(length..)?;
        for _ in 0..place {
            let (kind, rest) = varint(types)?;
            types = rest;
            values = values.get(size(kind)?..)?;
        }
        let (kind, _) = varint(types)?;
        let size = size(kind)?;
        let bytes = values.get(..size);
        Some(match kind {
            0 => Value::Null,
            1..=6 => Value::Integer(integer(bytes?)),
            7 => Value::Real,
            8 => Value::Integer(0),
            9 => Value::Integer(1),
            12.. if kind % 2 == 0 => Value::Blob(bytes.unwrap_or(values)),
            13.. => Value::Text(std::str::from_utf8(bytes?).ok()?),
            _ => return None,
        })
    }
}

impl<'a> Value<'a> {
    pub(super) const fn integer(self) -> Option<i64> {
        match self {
            Self::Integer(value) => Some(value),
            _ => None,
        }
    }

    pub(super) const fn text(self) -> Option<&'a str> {
        match self {
            Self::Text(text) => Some(text),
            _ => None,
        }
    }
}

/// Parses a varint of up to 9 bytes. Returns its value and the remaining bytes.
pub(super) fn varint(bytes: &[u8]) -> Option<(i64, &[u8])> {
    let mut value = 0_u64;
    for (index, byte) in bytes.iter().enumerate().take(9) {
        let rest = bytes.get(index + 1..)?;
        if index == 8 {
            value = value << 8 | u64::from(*byte);
            return Some((value.cast_signed(), rest));
        }
        value = value << 7 | u64::from(byte & 0x7f);
        if byte & 0x80 == 0 {
            return Some((value.cast_signed(), rest));
        }
    }
    None
}

/// Returns the length of a value of this type.
fn size(kind: i64) -> Option<usize> {
    match kind {
        0 | 8 | 9 => Some(0),
        1..=4 => usize::try_from(kind).ok(),
        5 => Some(6),
        6 | 7 => Some(8),
        12.. => usize::try_from((kind - 12) / 2).ok(),
        _ => None,
    }
}

/// Parses a signed big-endian integer.
fn integer(bytes: &[u8]) -> i64 {
    let negative = bytes.first().is_some_and(|first| first & 0x80 != 0);
    let begin = if negative { -1 } else { 0 };
    bytes
        .iter()
        .fold(begin, |value, byte| value << 8 | i64::from(*byte))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_varint_has_up_to_nine_bytes() {
        assert_eq!(varint(&[0x7f, 1]), Some((127, &[1][..])));
        assert_eq!(varint(&[0x81, 0x00]), Some((128, &[][..])));
        assert_eq!(varint(&[0xff; 9]), Some((-1, &[][..])));
        assert_eq!(varint(&[0xff; 8]), None);
    }

    #[test]
    fn values_are_decoded_by_the_types_in_the_header() {
        // NULL, -2 in one byte, the constant 1, `ab`, and three bytes of which one is missing.
        let bytes = [6, 0, 1, 9, 17, 18, 0xfe, b'a', b'b', 7, 8];
        let row = Row::new(&bytes);
        let values = [
            Value::Null,
            Value::Integer(-2),
            Value::Integer(1),
            Value::Text("ab"),
            Value::Blob(&[7, 8]),
        ];
        for (place, value) in values.into_iter().enumerate() {
            assert_eq!(row.value(place), Some(value));
        }
        assert_eq!(row.value(5), None);
        assert_eq!(Row::new(&bytes[..7]).value(3), None);
    }
}
