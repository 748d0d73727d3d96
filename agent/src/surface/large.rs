//! Answers that tell everything, as a page of metrics or all topics: megabytes on a large robot, kept
//! for as long as the reader takes. So only a few are made and kept at a time; who comes meanwhile
//! waits for a moment and is then told to come again. Small answers wait for nobody.

use std::time::Duration;

use axum::body::{Body, Bytes};
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio::time::timeout;

use super::packed::Packed;

/// Large answers of one surface at once.
const AT_ONCE: usize = 2;
/// From here on an answer is large.
const LARGE: usize = 256 << 10;
/// How long a place is waited for: reading an answer takes a moment, unless somebody is slow.
const PATIENCE: Duration = Duration::from_secs(2);

/// Places for large answers.
#[derive(Debug)]
pub(super) struct Answers {
    places: Semaphore,
    patience: Duration,
}

/// The place of one answer, from before it is made.
#[derive(Debug)]
pub(super) struct Turn {
    _place: SemaphorePermit<'static>,
}

/// Bytes that keep their place until the last of them is sent.
struct Kept {
    bytes: Bytes,
    _turn: Turn,
}

impl Answers {
    /// All free.
    pub(super) const fn new() -> Self {
        Self {
            places: Semaphore::const_new(AT_ONCE),
            patience: PATIENCE,
        }
    }

    /// A place, within a moment.
    pub(super) async fn turn(&'static self) -> Option<Turn> {
        let place = timeout(self.patience, self.places.acquire()).await;
        place.ok()?.ok().map(|place| Turn { _place: place })
    }
}

impl Turn {
    /// The text as an answer, which keeps the place if it is large.
    pub(super) fn keep_packed(self, text: Packed) -> Body {
        if text.len() < LARGE {
            return text.into_body(());
        }
        text.into_body(self)
    }

    /// The answer, which keeps the place if it is large.
    pub(super) fn keep(self, bytes: Bytes) -> Bytes {
        if bytes.len() < LARGE {
            return bytes;
        }
        Bytes::from_owner(Kept { bytes, _turn: self })
    }
}

impl AsRef<[u8]> for Kept {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn large_answers_keep_their_places_until_they_are_sent_and_small_ones_do_not() {
        static ANSWERS: Answers = Answers {
            places: Semaphore::const_new(AT_ONCE),
            patience: Duration::ZERO,
        };
        let answer = |length: usize| Bytes::from(vec![7; length]);
        for _ in 0..3 * AT_ONCE {
            let small = ANSWERS.turn().await.unwrap().keep(answer(LARGE - 1));
            assert_eq!(small.len(), LARGE - 1);
        }
        let mut large = Vec::new();
        for _ in 0..AT_ONCE {
            large.push(ANSWERS.turn().await.unwrap().keep(answer(LARGE)));
        }
        assert!(ANSWERS.turn().await.is_none());
        // The last part of it is still to be sent.
        let rest = large.pop().map(|mut sent| sent.split_off(LARGE - 1));
        assert!(ANSWERS.turn().await.is_none());
        drop(rest);
        assert!(ANSWERS.turn().await.is_some());
    }
}
