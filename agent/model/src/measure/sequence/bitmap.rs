//! Bitmap that is addressed by sequence number.

use ros2probe_wire::SequenceNumber;

/// A ring of bits, addressed by sequence number. Its length is a power of two.
#[derive(Debug, Default)]
pub(super) struct Bitmap {
    pub(super) words: Box<[u64]>,
}

impl Bitmap {
    pub(super) fn with_len(bits: u64) -> Self {
        Self {
            words: vec![0; usize::try_from(bits / 64).unwrap_or(0)].into(),
        }
    }

    pub(super) fn len(&self) -> u64 {
        self.words.len() as u64 * 64
    }

    fn place(&self, number: SequenceNumber) -> (usize, u64) {
        let bit = number.0 & self.len().wrapping_sub(1);
        (
            usize::try_from(bit / 64).unwrap_or(usize::MAX),
            1 << (bit % 64),
        )
    }

    pub(super) fn get(&self, number: SequenceNumber) -> bool {
        let (word, mask) = self.place(number);
        self.words.get(word).is_some_and(|word| word & mask != 0)
    }

    /// Returns the word that holds the bit of this number, at bit position `number % 64`.
    pub(super) fn word(&self, number: SequenceNumber) -> u64 {
        let (word, _) = self.place(number);
        self.words.get(word).copied().unwrap_or(u64::MAX)
    }

    pub(super) fn set(&mut self, number: SequenceNumber) {
        let (word, mask) = self.place(number);
        if let Some(word) = self.words.get_mut(word) {
            *word |= mask;
        }
    }

    pub(super) fn set_all(&mut self, start: SequenceNumber, end: SequenceNumber) {
        self.for_each_word(start, end, |word, mask| *word |= mask);
    }

    pub(super) fn clear(&mut self, start: SequenceNumber, end: SequenceNumber) {
        self.for_each_word(start, end, |word, mask| *word &= !mask);
    }

    /// Changes whole words, because one ACKNACK or GAP may make thousands of numbers irrelevant.
    fn for_each_word(
        &mut self,
        start: SequenceNumber,
        end: SequenceNumber,
        change: impl Fn(&mut u64, u64),
    ) {
        let end = end.min(start.saturating_add(self.len()));
        let mut number = start;
        while number < end {
            let (word, _) = self.place(number);
            let (first, left) = (number.0 % 64, end - number);
            let bits = left.min(64 - first);
            if let Some(word) = self.words.get_mut(word) {
                change(word, (u64::MAX >> (64 - bits)) << first);
            }
            number += bits;
        }
    }

    pub(super) fn grow(&mut self, bits: u64, start: SequenceNumber, end: SequenceNumber) {
        let mut wider = Self::with_len(bits);
        for number in start.until(end) {
            if self.get(number) {
                wider.set(number);
            }
        }
        *self = wider;
    }
}
