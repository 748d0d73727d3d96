//! Large answers, such as a page of metrics or all topics: megabytes on a large robot. Few of them
//! are created at a time, and they are kept compressed within a budget until they are read. A new
//! answer beyond the budget revokes the memory of the oldest answers.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::body::{Body, Bytes};
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use super::compressed_text::{CompressedText, Encoding, TextCompressor};

/// Maximum number of large answers of one surface that are created simultaneously.
const MAX_CONCURRENT: usize = 2;
/// Budget in bytes for compressed answers of one surface that are being read.
const MAX_RETAINED_BYTES: usize = 4 << 20;
/// Minimum size of a large answer, in bytes.
const MIN_LARGE_BYTES: usize = 256 << 10;
/// Maximum time that a request waits for a permit.
const PERMIT_TIMEOUT: Duration = Duration::from_secs(2);

/// Large answers of one surface.
#[derive(Debug)]
pub(super) struct LargeResponses {
    permits: Semaphore,
    longest: Duration,
    kept: Mutex<Vec<Pending>>,
}

/// An answer that is being read.
#[derive(Debug)]
struct Pending {
    bytes: usize,
    /// Revokes the answer: its reader receives no further data.
    revoked: CancellationToken,
}

/// Permission to create one answer.
#[derive(Debug)]
pub(super) struct RenderPermit {
    of: &'static LargeResponses,
    _making: SemaphorePermit<'static>,
}

/// Reserved memory of one answer, until the answer is read.
#[derive(Debug)]
pub(super) struct Reservation {
    of: &'static LargeResponses,
    given_up: CancellationToken,
}

impl LargeResponses {
    /// Creates the state without any answers.
    pub(super) const fn new() -> Self {
        Self {
            permits: Semaphore::const_new(MAX_CONCURRENT),
            longest: PERMIT_TIMEOUT,
            kept: Mutex::new(Vec::new()),
        }
    }

    /// Returns a permit, or `None` after a timeout.
    pub(super) async fn permit(&'static self) -> Option<RenderPermit> {
        let making = timeout(self.longest, self.permits.acquire()).await;
        let making = making.ok()?.ok()?;
        Some(RenderPermit {
            of: self,
            _making: making,
        })
    }

    /// Reserves memory for an answer of this size, revoking the oldest answers if necessary.
    fn reserve(&'static self, bytes: usize) -> Reservation {
        let given_up = CancellationToken::new();
        let mut kept = self.lock();
        let mut sum: usize = kept.iter().map(|each| each.bytes).sum();
        kept.retain(|each| {
            let stays = sum + bytes <= MAX_RETAINED_BYTES;
            if !stays {
                each.revoked.cancel();
                sum -= each.bytes;
            }
            stays
        });
        kept.push(Pending {
            bytes,
            revoked: given_up.clone(),
        });
        Reservation { of: self, given_up }
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Pending>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl RenderPermit {
    /// Returns the text as a response body.
    pub(super) fn compressed_body(self, text: CompressedText) -> Body {
        if text.len() < MIN_LARGE_BYTES {
            return text.into_body(None);
        }
        let room = self.of.reserve(text.kept());
        text.into_body(Some(room))
    }

    /// Returns the bytes as a response body of the same length.
    pub(super) fn body(self, bytes: Bytes) -> Body {
        if bytes.len() < MIN_LARGE_BYTES {
            return bytes.into();
        }
        let mut packer = TextCompressor::new(Encoding::Identity);
        let packed = packer.write(&bytes).and_then(|()| packer.finish());
        match packed {
            Ok(packed) => self.compressed_body(packed),
            // Writing to memory cannot fail.
            Err(_) => Body::empty(),
        }
    }
}

impl Reservation {
    /// Returns whether the memory is revoked.
    pub(super) fn is_revoked(&self) -> bool {
        self.given_up.is_cancelled()
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        self.given_up.cancel();
        self.of.lock().retain(|each| !each.revoked.is_cancelled());
    }
}

#[cfg(test)]
mod tests {
    use axum::body::to_bytes;

    use super::*;

    /// Returns bytes that cannot be compressed.
    fn noise(length: usize) -> Bytes {
        let mut state = 1_u64;
        let mut next = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (state >> 56) as u8
        };
        (0..length).map(|_| next()).collect::<Vec<u8>>().into()
    }

    #[tokio::test]
    async fn slow_readers_of_large_answers_do_not_block_others() {
        static ANSWERS: LargeResponses = LargeResponses {
            permits: Semaphore::const_new(MAX_CONCURRENT),
            longest: Duration::ZERO,
            kept: Mutex::new(Vec::new()),
        };
        let bytes = noise(1 << 20);
        let mut bodies = Vec::new();
        for _ in 0..12 {
            let turn = ANSWERS.permit().await.unwrap();
            bodies.push(turn.body(bytes.clone()));
        }
        let held: usize = ANSWERS.lock().iter().map(|kept| kept.bytes).sum();
        assert!(held <= MAX_RETAINED_BYTES, "{held}");
        // The last answers are complete, and the first answers end early.
        let mut whole = 0;
        for body in bodies {
            match to_bytes(body, usize::MAX).await {
                Ok(read) => {
                    assert_eq!(read, bytes);
                    whole += 1;
                }
                Err(_) => assert_eq!(whole, 0),
            }
        }
        assert_eq!(whole, 3);
        assert!(ANSWERS.lock().is_empty());
    }

    #[tokio::test]
    async fn a_third_answer_gets_no_permit_until_one_of_two_is_created() {
        static ANSWERS: LargeResponses = LargeResponses {
            permits: Semaphore::const_new(MAX_CONCURRENT),
            longest: Duration::ZERO,
            kept: Mutex::new(Vec::new()),
        };
        let one = ANSWERS.permit().await.unwrap();
        let _two = ANSWERS.permit().await.unwrap();
        assert!(ANSWERS.permit().await.is_none());
        let _small = one.body(noise(MIN_LARGE_BYTES - 1));
        assert!(ANSWERS.permit().await.is_some());
        assert!(ANSWERS.lock().is_empty(), "small answers take no room");
    }
}
