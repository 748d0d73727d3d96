//! Fields of records: numbers, texts and maps, little-endian, with length prefixes.

use std::collections::BTreeMap;

pub(super) fn length(out: &mut Vec<u8>, length: usize) {
    // The fallback is never reached: names, definitions and lists are bounded far below 4 GiB.
    let length = u32::try_from(length).unwrap_or(u32::MAX);
    out.extend_from_slice(&length.to_le_bytes());
}

pub(super) fn text(out: &mut Vec<u8>, text: &str) {
    length(out, text.len());
    out.extend_from_slice(text.as_bytes());
}

pub(super) fn texts(out: &mut Vec<u8>, map: &BTreeMap<String, String>) {
    let bytes = map.iter().map(|(key, value)| 8 + key.len() + value.len());
    length(out, bytes.sum());
    for (key, value) in map {
        text(out, key);
        text(out, value);
    }
}

pub(super) fn numbers(out: &mut Vec<u8>, map: &BTreeMap<u16, u64>) {
    length(out, map.len() * 10);
    for (key, value) in map {
        out.extend_from_slice(&key.to_le_bytes());
        out.extend_from_slice(&value.to_le_bytes());
    }
}

/// A cursor over the remaining bytes of a record.
pub(super) struct Cursor<'a>(pub(super) &'a [u8]);

impl<'a> Cursor<'a> {
    pub(super) fn take(&mut self, length: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        Some(taken)
    }

    pub(super) fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (taken, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*taken)
    }

    pub(super) fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    pub(super) fn sized(&mut self) -> Option<&'a [u8]> {
        let length = self.u32()?;
        self.take(usize::try_from(length).ok()?)
    }

    pub(super) fn text(&mut self) -> Option<&'a str> {
        std::str::from_utf8(self.sized()?).ok()
    }

    pub(super) fn texts(&mut self) -> Option<BTreeMap<String, String>> {
        let mut entries = Cursor(self.sized()?);
        let mut map = BTreeMap::new();
        while !entries.0.is_empty() {
            map.insert(entries.text()?.to_owned(), entries.text()?.to_owned());
        }
        Some(map)
    }

    pub(super) fn numbers(&mut self) -> Option<BTreeMap<u16, u64>> {
        let mut entries = Cursor(self.sized()?);
        let mut map = BTreeMap::new();
        while !entries.0.is_empty() {
            map.insert(entries.u16()?, entries.u64()?);
        }
        Some(map)
    }
}
