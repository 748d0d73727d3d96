//! Slots for streams, of which some are reserved for clients with a token.
//!
//! A client without a token can use a slot for an unlimited time. It cannot use a reserved slot, so
//! the owner of the robot can still open a stream.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// A fixed number of slots.
#[derive(Debug)]
pub(super) struct Places {
    all: usize,
    open: Arc<Semaphore>,
    reserved: Arc<Semaphore>,
}

impl Places {
    /// Creates `all` slots, a quarter of them reserved for clients with a token.
    pub(super) fn new(all: usize) -> Self {
        let reserved = all / 4;
        Self {
            all,
            open: Arc::new(Semaphore::new(all - reserved)),
            reserved: Arc::new(Semaphore::new(reserved)),
        }
    }

    /// Returns whether all slots are free.
    pub(super) fn is_unused(&self) -> bool {
        self.open.available_permits() + self.reserved.available_permits() == self.all
    }

    /// Returns a slot, which is free again after it is dropped. Returns `None` if no slot is free
    /// for the client.
    pub(super) fn take(&self, is_holder: bool) -> Option<OwnedSemaphorePermit> {
        let open = Arc::clone(&self.open).try_acquire_owned();
        let reserved = || Arc::clone(&self.reserved).try_acquire_owned();
        match open {
            Err(_) if is_holder => reserved().ok(),
            open => open.ok(),
        }
    }

    /// Returns why [`Self::take`] returned no slot for one of these `streams`.
    pub(super) fn refusal(&self, streams: &str, is_holder: bool) -> String {
        let all = self.all;
        if is_holder {
            return format!("{all} {streams} are open, which is the limit");
        }
        let reserved = all / 4;
        format!(
            "all {streams} without a token are taken; {reserved} of {all} are for clients with a \
             token"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clients_without_a_token_cannot_take_the_reserved_quarter_of_the_slots() {
        let places = Places::new(16);
        let strangers: Vec<_> = std::iter::from_fn(|| places.take(false)).collect();
        assert_eq!(strangers.len(), 12);
        let refusal = places.refusal("streams", false);
        assert!(refusal.ends_with("4 of 16 are for clients with a token"));
        let owners: Vec<_> = std::iter::from_fn(|| places.take(true)).collect();
        assert_eq!(owners.len(), 4);
        let refusal = places.refusal("streams", true);
        assert_eq!(refusal, "16 streams are open, which is the limit");
        drop(strangers);
        // Clients with a token can also take the slots that are not reserved.
        let others: Vec<_> = std::iter::from_fn(|| places.take(true)).collect();
        assert_eq!(others.len(), 12);
    }

    #[test]
    fn a_slot_is_free_again_after_its_permit_is_dropped() {
        let places = Places::new(4);
        let held: Vec<_> = std::iter::from_fn(|| places.take(true)).collect();
        assert_eq!((held.len(), places.take(true).is_some()), (4, false));
        assert!(!places.is_unused());
        drop(held);
        assert!(places.is_unused() && places.take(false).is_some());
    }
}
