//! Queue from the tap to the worker thread: bounded, with a counter of overflows.

use std::os::fd::BorrowedFd;
use std::sync::{Mutex, MutexGuard, PoisonError};

use ros2probe_model::facts::bounded::{Bounded, Counted, Sum};
use ros2probe_wire::record::{Record, Sample};

use crate::bell::Bell;
use crate::tables::{InboxBytes, InboxItems};

/// Number of waiting bytes that wakes the worker: a camera fills it in a fifth of a second.
const WAKE_BYTES: usize = 1 << 20;

/// One item of the queue.
#[derive(Debug)]
pub enum Item {
    /// A submessage of a measured writer.
    Record(Record),
    /// A whole message.
    Message {
        /// Time of reading, in nanoseconds since the Unix epoch.
        time: u64,
        /// Port that announced the message.
        port: u16,
        /// The message.
        bytes: Vec<u8>,
    },
    /// A ring may have wrapped around unnoticed before this time.
    Uncertain(u64),
}

/// The waiting items.
#[derive(Debug, Default)]
pub struct Inbox {
    waiting: Mutex<Waiting>,
    /// Wakes the worker thread.
    bell: Option<Bell>,
}

#[derive(Debug, Default)]
struct Waiting {
    items: Bounded<Counted<InboxItems>, Vec<Item>>,
    bytes: Sum<InboxBytes>,
}

impl Inbox {
    /// Creates an empty queue with a descriptor that is readable when it fills up.
    #[must_use]
    pub fn with_bell() -> Self {
        Self {
            waiting: Mutex::default(),
            // Without a bell, the worker's own polling empties the queue.
            bell: Bell::new().ok(),
        }
    }

    /// Returns a descriptor that is readable when the queue fills up; `None` without a bell.
    #[must_use]
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        Some(self.bell.as_ref()?.descriptor())
    }

    /// Moves the items of `found` into the queue.
    pub fn add_all(&self, found: &mut Vec<Item>) {
        if found.is_empty() {
            return;
        }
        let waiting = &mut *self.waiting();
        let was_woken = waiting.bytes.used() >= WAKE_BYTES;
        for item in found.drain(..) {
            waiting.put(item);
        }
        if let Some(bell) = self.bell.as_ref()
            && !was_woken
            && waiting.bytes.used() >= WAKE_BYTES
        {
            bell.ring();
        }
    }

    /// Removes and returns all items.
    #[must_use]
    pub fn take(&self) -> Vec<Item> {
        let waiting = &mut *self.waiting();
        if let Some(bell) = self
            .bell
            .as_ref()
            .filter(|_| waiting.bytes.used() >= WAKE_BYTES)
        {
            bell.drain();
        }
        waiting.bytes.clear();
        waiting.items.take()
    }

    /// Returns the number of items that did not fit.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.waiting().items.facts().evictions
    }

    /// Locks the queue; no operation under this lock can panic.
    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Waiting {
    fn put(&mut self, item: Item) {
        if let Item::Record(record) = &item
            && let Some(Item::Record(last)) = self.items.last_mut()
            && matches!(record.sample(), Some(Sample::DataFrag(_)))
            && (last.kind, last.writer) == (record.kind, record.writer)
            && last.extend(record)
        {
            return;
        }
        let length = match &item {
            Item::Message { bytes, .. } => bytes.len(),
            Item::Record(_) | Item::Uncertain(_) => 0,
        };
        if length > self.bytes.remaining() {
            self.items.refuse();
        } else if self.items.push(item).is_none() {
            self.bytes.add(length);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ros2probe_wire::record::kind;

    use super::*;
    use crate::system::wait;
    use crate::tables::tests::assert_driven;

    fn fragment(start: u32) -> Item {
        Item::Record(Record {
            kind: kind::DATA_FRAG,
            sequence_number: 1,
            fragment_start: start,
            fragments: 1 << 16 | 1000,
            sample_size: 10_000,
            payload_len: 1000,
            ..Record::default()
        })
    }

    #[test]
    fn consecutive_fragments_wait_as_one_record() {
        let inbox = Inbox::default();
        let mut found = vec![fragment(1), fragment(2)];
        inbox.add_all(&mut found);
        inbox.add_all(&mut vec![fragment(3), fragment(5)]);
        assert!(found.is_empty());
        let items = inbox.take();
        assert_eq!(items.len(), 2);
        assert!(matches!(&items[0], Item::Record(record) if record.payload_len == 3000));
        assert!(inbox.take().is_empty());
    }

    #[test]
    fn samples_of_one_writer_are_not_merged() {
        let inbox = Inbox::default();
        let sample = |number| {
            Item::Record(Record {
                kind: kind::DATA,
                sequence_number: number,
                ..Record::default()
            })
        };
        inbox.add_all(&mut vec![sample(1), sample(1), sample(2)]);
        assert_eq!(inbox.take().len(), 3);
    }

    #[test]
    fn the_bell_rings_when_enough_bytes_wait_and_is_silent_after_they_are_taken() {
        let inbox = Inbox::with_bell();
        let message = |length| Item::Message {
            time: 0,
            port: 0,
            bytes: vec![0; length],
        };
        let rings = || {
            let listener = inbox.descriptor().unwrap();
            wait(&[listener], Duration::ZERO).unwrap() == Some(0)
        };
        for _ in 0..2 {
            inbox.add_all(&mut vec![message(WAKE_BYTES - 1)]);
            assert!(!rings());
            inbox.add_all(&mut vec![message(1), message(1)]);
            assert!(rings());
            inbox.add_all(&mut vec![message(WAKE_BYTES)]);
            assert_eq!(inbox.take().len(), 4);
            assert!(!rings());
        }
    }

    #[test]
    fn items_beyond_the_cap_are_counted() {
        let inbox = Inbox::default();
        let message = || Item::Message {
            time: 0,
            port: 0,
            bytes: vec![0; 4 << 20],
        };
        inbox.add_all(&mut vec![
            message(),
            message(),
            message(),
            message(),
            message(),
        ]);
        assert_eq!((inbox.take().len(), inbox.refused()), (4, 1));
        inbox.add_all(&mut vec![message()]);
        assert_eq!(inbox.take().len(), 1);
        let cap = InboxItems::CAP;
        let mut flood: Vec<_> = (0..cap as u64 + 3).map(Item::Uncertain).collect();
        inbox.add_all(&mut flood);
        assert_eq!((inbox.take().len(), inbox.refused()), (cap, 4));
        assert_driven::<InboxItems>();
    }

    #[test]
    fn messages_beyond_the_byte_cap_are_refused_and_counted() {
        let inbox = Inbox::default();
        let message = || Item::Message {
            time: 1,
            port: 7400,
            bytes: vec![0; 1 << 20],
        };
        inbox.add_all(&mut (0..20).map(|_| message()).collect());
        assert_eq!((inbox.take().len(), inbox.refused()), (16, 4));
        assert_driven::<InboxBytes>();
        inbox.add_all(&mut vec![message()]);
        assert_eq!((inbox.take().len(), inbox.refused()), (1, 4));
    }
}
