//! Parts of a request that is too large for the receiver, or for the link within the timeout.
//!
//! A request that timed out repeatedly is divided, and so is one that the receiver calls too large.
//! Its halves follow each other, down to a single item. A request may time out for other reasons.
//! So a single item is dropped only if the receiver refuses its size, or if its length alone delays
//! the answer.

use std::cell::Cell;
use std::collections::VecDeque;

use super::delivery::{Attempt, Delivery, Pauses, Persist};
use super::kept::KeptRequest;

/// Timeouts in a row before a request is divided.
const TIMEOUTS: u32 = 2;
/// Times in a row that the length of an item must delay the answer before the item is dropped.
const PROOFS: u32 = 2;
/// Requests that must fit before longer ones are tried.
const SUCCESSES: u32 = 16;
/// Size of requests in bytes from which on they are not divided before they are offered.
const USUAL_SIZE: usize = 1 << 20;

/// What is left of a request, the oldest items first.
pub(super) struct Parts {
    left: VecDeque<KeptRequest>,
    /// Whether this process offered these items before.
    pub(super) is_offered: bool,
    /// Pauses between offers of one part.
    pub(super) pauses: Pauses,
    timeouts: u32,
    proofs: u32,
}

/// Result of one offer of the first part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// The receiver accepted or refused its items.
    Settled,
    /// It must be offered again after a pause.
    Failed,
    /// It must be divided. A single item must be dropped.
    TooLarge,
}

/// The size of requests that fit, from the outcomes of earlier ones.
pub(super) struct Fit {
    /// Size in bytes.
    size: Cell<usize>,
    /// Requests that fitted since the size changed.
    successes: Cell<u32>,
}

impl Default for Fit {
    fn default() -> Self {
        Self {
            size: Cell::new(usize::MAX),
            successes: Cell::new(0),
        }
    }
}

impl Fit {
    /// Returns the size in bytes up to which a request is offered.
    pub(super) fn size(&self) -> usize {
        self.size.get()
    }

    /// Returns whether requests of a usual size did not fit.
    pub(super) fn is_limited(&self) -> bool {
        self.size() < usize::MAX
    }

    /// Notes that a request of this size does not fit.
    pub(super) fn shrink(&self, size: usize) {
        self.size.set(self.size().min(size / 2));
        self.successes.set(0);
    }

    /// Notes that a request fits.
    fn succeed(&self) {
        let successes = self.successes.get() + 1;
        if !self.is_limited() || successes < SUCCESSES {
            self.successes.set(successes % SUCCESSES);
            return;
        }
        self.successes.set(0);
        self.size.set(match self.size().max(1).saturating_mul(2) {
            USUAL_SIZE.. => usize::MAX,
            size => size,
        });
    }
}

impl Parts {
    /// Returns the items of a request that are not settled.
    pub(super) fn of<E: Persist>(mut request: KeptRequest) -> Self {
        if request.settled > 0
            && let Some([_, rest]) = E::divided(&request.encoded, request.settled)
        {
            request.encoded = rest;
        }
        request.settled = 0;
        Self {
            left: VecDeque::from([request]),
            is_offered: false,
            pauses: Pauses::default(),
            timeouts: 0,
            proofs: 0,
        }
    }

    /// Returns whether nothing is left.
    pub(super) fn is_empty(&self) -> bool {
        self.left.is_empty()
    }

    /// Returns the number of items that are left.
    pub(super) fn items(&self) -> u64 {
        self.left.iter().map(|part| part.items).sum()
    }

    /// Returns the size of the first part in bytes.
    pub(super) fn size(&self) -> usize {
        self.left.front().map_or(0, |part| part.encoded.len())
    }

    /// Returns what is left as one request; `None` if nothing is.
    pub(super) fn rest(&self) -> Option<KeptRequest> {
        let parts = self.left.iter().cloned();
        parts.reduce(|mut all, part| {
            all.append(part);
            all
        })
    }

    /// Offers the first part once. A part that is longer than `fit` is divided before.
    pub(super) async fn step<E: Persist>(&mut self, delivery: &Delivery<E>, fit: &Fit) -> Step {
        while self.size() > fit.size() && self.divide::<E>() {}
        let Some(part) = self.left.front() else {
            return Step::Settled;
        };
        let attempt = delivery.offer_encoded(part, self.is_offered).await;
        self.is_offered = true;
        match attempt {
            Attempt::Settled => {
                fit.succeed();
                self.left.pop_front();
                self.begin_part();
                Step::Settled
            }
            Attempt::TooLarge => Step::TooLarge,
            Attempt::Unsettled => {
                (self.timeouts, self.proofs) = (0, 0);
                Step::Failed
            }
            Attempt::TimedOut => {
                self.timeouts += 1;
                if self.timeouts < TIMEOUTS {
                    return Step::Failed;
                }
                if part.items > 1 {
                    return Step::TooLarge;
                }
                self.proofs = match delivery.is_too_long(part).await {
                    true => self.proofs + 1,
                    false => 0,
                };
                match self.proofs {
                    PROOFS.. => Step::TooLarge,
                    _ => Step::Failed,
                }
            }
        }
    }

    /// Divides the first part, or drops it if it is a single item.
    pub(super) fn divide_or_drop<E: Persist>(&mut self, delivery: &Delivery<E>, fit: &Fit) {
        let size = self.size();
        if self.divide::<E>() {
            fit.shrink(size);
        } else if let Some(part) = self.left.pop_front() {
            delivery.drop_too_large(&part);
        }
        self.begin_part();
    }

    /// Divides the first part. Returns whether it has more than one item.
    fn divide<E: Persist>(&mut self) -> bool {
        let Some(part) = self.left.front().filter(|part| part.items > 1) else {
            return false;
        };
        let (items, all) = (part.items / 2, part.items);
        let Some([first, second]) = E::divided(&part.encoded, items) else {
            return false;
        };
        self.left.pop_front();
        for (items, encoded) in [(all - items, second), (items, first)] {
            self.left.push_front(KeptRequest {
                items,
                encoded,
                settled: 0,
            });
        }
        true
    }

    fn begin_part(&mut self) {
        (self.timeouts, self.proofs) = (0, 0);
        self.pauses = Pauses::default();
    }
}
