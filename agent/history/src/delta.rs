//! Differences between two versions of a JSON text, in pieces that end with a comma.

use crate::bytes::{Get, Put, unzigzag, zigzag};

/// Maximum length of a text that [`apply`] makes, in bytes. A damaged difference cannot take more
/// memory.
const MAX_TEXT: usize = 16 << 20;

/// Minimum length of a piece that is copied from another place than the expected one, in bytes. The
/// place of a shorter one takes more than its content.
const MIN_MOVED: usize = 12;

/// A text as pieces.
struct Pieces<'a> {
    text: &'a [u8],
    /// Place at which each piece begins, in bytes.
    starts: Vec<u32>,
    /// Numbers of the pieces in the order of their content.
    sorted: Vec<u32>,
}

/// Steps under construction: parts to copy, each with bytes that follow.
#[derive(Default)]
struct Steps {
    bytes: Vec<u8>,
    /// Place after the last copied byte.
    end: usize,
    /// Length and jump of the last copy, and the bytes after it.
    copied: usize,
    jump: i64,
    other: Vec<u8>,
}

/// Returns whether the pieces of a text are so few that finding them takes little memory: each takes
/// eight bytes.
pub(crate) fn is_comparable(text: &[u8]) -> bool {
    let pieces = text.iter().filter(|byte| **byte == b',').count();
    pieces <= text.len() / 8
}

/// Returns how `new` differs from `base`.
pub(crate) fn difference(base: &[u8], new: &[u8]) -> Vec<u8> {
    let base = Pieces::of(base);
    let mut steps = Steps::default();
    let mut next = 0;
    for piece in new.split_inclusive(|byte| *byte == b',') {
        let found = match base.get(next) {
            Some(expected) if expected == piece => Some(next),
            _ if piece.len() >= MIN_MOVED => base.only(piece),
            _ => None,
        };
        match found {
            Some(found) => {
                steps.copy(base.start(found), piece.len());
                next = found + 1;
            }
            // Most often, one piece replaces another one.
            None => {
                steps.other.extend_from_slice(piece);
                next += 1;
            }
        }
    }
    steps.finish();
    steps.bytes
}

/// Returns the text that differs like this from `base`; `None` if the difference is damaged.
pub(crate) fn apply(base: &[u8], difference: &[u8]) -> Option<Vec<u8>> {
    let mut steps = Get(difference);
    let (mut text, mut end) = (Vec::new(), 0_usize);
    while !steps.is_empty() {
        let copied = usize::try_from(steps.number()?).ok()?;
        let start = end.checked_add_signed(unzigzag(steps.number()?).try_into().ok()?)?;
        end = start.checked_add(copied)?;
        text.extend_from_slice(base.get(start..end)?);
        text.extend_from_slice(steps.bytes()?);
        if text.len() > MAX_TEXT {
            return None;
        }
    }
    Some(text)
}

impl<'a> Pieces<'a> {
    fn of(text: &'a [u8]) -> Self {
        let mut place = 0;
        let starts = text.split_inclusive(|byte| *byte == b',').map(|piece| {
            let start = place;
            place += piece.len() as u32;
            start
        });
        let mut pieces = Self {
            text,
            starts: starts.collect(),
            sorted: Vec::new(),
        };
        let mut sorted: Vec<_> = (0..pieces.starts.len() as u32).collect();
        sorted.sort_unstable_by_key(|piece| pieces.get(*piece as usize));
        pieces.sorted = sorted;
        pieces
    }

    fn start(&self, piece: usize) -> usize {
        self.starts
            .get(piece)
            .map_or(self.text.len(), |start| *start as usize)
    }

    fn get(&self, piece: usize) -> Option<&'a [u8]> {
        self.starts.get(piece)?;
        self.text.get(self.start(piece)..self.start(piece + 1))
    }

    /// Returns the number of the piece with this content; `None` unless it is the only one.
    fn only(&self, content: &[u8]) -> Option<usize> {
        let at = |place: usize| self.get(*self.sorted.get(place)? as usize);
        let first = self
            .sorted
            .partition_point(|piece| self.get(*piece as usize) < Some(content));
        let is_only = at(first) == Some(content) && at(first + 1) != Some(content);
        let found = self.sorted.get(first).filter(|_| is_only)?;
        Some(*found as usize)
    }
}

impl Steps {
    fn copy(&mut self, start: usize, length: usize) {
        if !self.other.is_empty() || start != self.end {
            self.finish();
            self.jump = start as i64 - self.end as i64;
        }
        self.copied += length;
        self.end = start + length;
    }

    /// Writes the last copy.
    fn finish(&mut self) {
        self.bytes.put(self.copied as u64);
        self.bytes.put(zigzag(self.jump));
        self.bytes.put_bytes(&self.other);
        (self.copied, self.jump) = (0, 0);
        self.other.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(rows: impl Iterator<Item = u32>) -> Vec<u8> {
        let rows: Vec<_> = rows
            .map(|row| format!(r#"{{"name":"part {row}","level":"ok","count":{row}00}}"#))
            .collect();
        format!(r#"{{"time":1,"rows":[{}]}}"#, rows.join(",")).into_bytes()
    }

    #[test]
    fn a_changed_number_costs_some_bytes_and_a_moved_list_too() {
        let base = list(0..100);
        let text = String::from_utf8(base.clone()).unwrap();
        let new = text.replace("7700}", "7701}").into_bytes();
        for (new, most) in [
            (new, 60),
            (base.clone(), 6),
            (list(30..100), 80),
            (list((0..50).chain(90..120)), 1_300),
        ] {
            let difference = difference(&base, &new);
            assert!(difference.len() <= most, "{}", difference.len());
            assert_eq!(apply(&base, &difference), Some(new));
        }
    }

    #[test]
    fn a_damaged_difference_takes_no_memory() {
        // Copies all of the base again and again.
        let base = vec![b'x'; 1 << 20];
        let mut steps = Steps::default();
        for _ in 0..1_000 {
            steps.copy(0, 1 << 20);
        }
        steps.finish();
        assert_eq!(apply(&base, &steps.bytes), None);
        assert_eq!(apply(b"abc", &[4, 0, 0]), None);
        assert_eq!(apply(b"abc", &[1, 1, 0]), None);
        assert_eq!(apply(b"abc", &[3, 0, 5]), None);
    }
}
