//! Requests of one signal that wait on disk while the receiver is out of reach.

use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use ros2probe_history::{Queue, Record};

use super::exports::{Exports, Reason, Signal};

/// Requests below this size are sent together, in bytes.
pub(super) const REQUEST_BYTES: usize = 64 << 10;
/// Length of the number of items, which precedes each request on disk, in bytes.
const ITEMS_LEN: usize = size_of::<u32>();

/// A queue of requests on disk.
#[derive(Debug)]
pub(super) struct Kept {
    queue: Queue,
    signal: Signal,
    exports: Arc<Exports>,
    /// Whether the last record was written, and whether the last one was read.
    can_write: bool,
    can_read: bool,
    /// File of the oldest request that was read.
    file: u32,
    /// Number of items in the request that was read, and whether it is one record of the queue.
    items: u64,
    is_single: bool,
}

/// A request that waits.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct KeptRequest {
    /// Number of records or spans.
    pub(super) items: u64,
    /// The request in the form of the protocol.
    pub(super) encoded: Vec<u8>,
    /// Number of its first items that are settled: they are not part of `items`.
    pub(super) settled: u64,
}

impl Kept {
    /// Opens a queue of at most `limit` bytes. Without one, items wait in memory.
    pub(super) fn open(
        directory: &Path,
        limit: u64,
        signal: Signal,
        exports: &Arc<Exports>,
    ) -> Option<Self> {
        let directory = directory.join(format!("otlp_{}", signal.label()));
        let queue = match Queue::open(&directory, limit) {
            Ok(queue) => queue,
            Err(error) => {
                let (path, signal) = (directory.display(), signal.label());
                tracing::warn!(%path, signal, %error, "items for OTLP do not survive a restart");
                return None;
            }
        };
        let kept = Self {
            queue,
            signal,
            exports: Arc::clone(exports),
            can_write: true,
            can_read: true,
            file: 0,
            items: 0,
            is_single: false,
        };
        kept.show_size();
        Some(kept)
    }

    /// Returns whether no request waits.
    pub(super) fn is_empty(&self) -> bool {
        self.queue.is_empty()
    }

    /// Appends a request. A full queue loses its oldest ones, which are counted. Returns whether
    /// the request is on disk; logs the first failure until one is written again.
    pub(super) fn append(&mut self, request: &KeptRequest) -> bool {
        let items = u32::try_from(request.items).unwrap_or(u32::MAX);
        let content = [&items.to_le_bytes(), request.encoded.as_slice()].concat();
        let mut lost = 0;
        let appended = self.queue.append(now(), content, &mut |record| {
            if let Some(request) = KeptRequest::of(&record) {
                lost += request.items;
            }
        });
        if lost > 0 {
            self.exports
                .count_dropped(self.signal, Reason::Overflow, lost);
        }
        self.show_size();
        let could_write = std::mem::replace(&mut self.can_write, appended.is_ok());
        if let (Err(error), true) = (&appended, could_write) {
            let signal = self.signal.label();
            tracing::warn!(signal, %error, "cannot write items for OTLP to disk");
        }
        appended.is_ok()
    }

    /// Returns the next requests as one of about this size; `None` after the last one, or if it
    /// cannot be read now.
    pub(super) fn read(&mut self, size: usize) -> Option<KeptRequest> {
        let Some(mut all) = self.read_one() else {
            // No record that is left can be read. Later ones must not follow it.
            if self.can_read && !self.queue.is_empty() {
                self.remove();
                self.queue.begin_file();
            }
            return None;
        };
        self.file = self.queue.file_of_read();
        self.is_single = true;
        while all.encoded.len() < size
            && all.settled == 0
            && let Some(more) = self.read_one()
        {
            self.is_single = false;
            all.append(more);
        }
        self.items = all.settled + all.items;
        Some(all)
    }

    /// Returns whether the request that was read is one record. Only parts of such a one can be
    /// noted as settled.
    pub(super) const fn is_single(&self) -> bool {
        self.is_single
    }

    /// Reads the requests that were read once more.
    pub(super) fn rewind(&mut self) {
        self.queue.rewind();
    }

    /// Notes that all items but the last `left` of the record that was read are settled.
    pub(super) fn settle_but(&mut self, left: u64) {
        self.queue.settle(self.items.saturating_sub(left));
    }

    /// Returns whether the requests that were read are still on disk: a full queue may lose them.
    pub(super) fn has_read(&self) -> bool {
        self.queue.has_file(self.file)
    }

    fn read_one(&mut self) -> Option<KeptRequest> {
        loop {
            let record = self.queue.read();
            let could_read = std::mem::replace(&mut self.can_read, record.is_ok());
            if let (Err(error), true) = (&record, could_read) {
                let signal = self.signal.label();
                tracing::warn!(signal, %error, "cannot read items for OTLP from disk");
            }
            let record = record.ok()??;
            if let Some(request) = KeptRequest::of(&record) {
                return Some(request);
            }
        }
    }

    /// Removes the requests that were read.
    pub(super) fn remove(&mut self) {
        self.queue.remove();
        self.show_size();
    }

    fn show_size(&self) {
        self.exports
            .set_queue_bytes(self.signal, self.queue.bytes());
    }
}

impl KeptRequest {
    /// Adds the items of a request. A concatenation of encoded messages has the elements of all
    /// (Protocol Buffers, "Last One Wins").
    pub(super) fn append(&mut self, mut more: Self) {
        self.items += more.items;
        self.encoded.append(&mut more.encoded);
    }

    /// Returns the request of a record; `None` for one that was delivered, or of another form.
    fn of(record: &Record) -> Option<Self> {
        if !record.is_waiting {
            return None;
        }
        let (items, encoded) = record.content.split_at_checked(ITEMS_LEN)?;
        let items: u64 = u32::from_le_bytes(items.try_into().ok()?).into();
        let settled = record.settled.min(items);
        Some(Self {
            items: items - settled,
            encoded: encoded.to_vec(),
            settled,
        })
    }
}

/// Returns the Unix time in seconds.
fn now() -> u32 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    u32::try_from(since.unwrap_or_default().as_secs()).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: u64 = 1 << 20;

    fn opened(directory: &Path, limit: u64) -> (Kept, Arc<Exports>) {
        let exports = Arc::<Exports>::default();
        let kept = Kept::open(directory, limit, Signal::Events, &exports).unwrap();
        (kept, exports)
    }

    /// Returns a request of `items` items whose content does not compress.
    fn request(items: u64, length: usize) -> KeptRequest {
        let mut random = items + 1;
        let bytes = (0..length).map(|_| {
            random = random.wrapping_mul(0x5851_f42d_4c95_7f2d).wrapping_add(1);
            random.to_le_bytes()[5]
        });
        KeptRequest {
            items,
            encoded: bytes.collect(),
            settled: 0,
        }
    }

    #[test]
    fn requests_wait_in_order_across_a_restart_until_they_are_removed() {
        let directory = tempfile::tempdir().unwrap();
        let (mut kept, exports) = opened(directory.path(), LIMIT);
        for items in 1..=3 {
            assert!(kept.append(&request(items, REQUEST_BYTES)));
        }
        assert_eq!(kept.read(REQUEST_BYTES), Some(request(1, REQUEST_BYTES)));
        kept.remove();
        assert_eq!(kept.read(REQUEST_BYTES), Some(request(2, REQUEST_BYTES)));
        assert!(exports.queue_bytes(Signal::Events) > 100_000);
        let (mut kept, exports) = opened(directory.path(), LIMIT);
        assert!(exports.queue_bytes(Signal::Events) > 100_000);
        assert_eq!(kept.read(REQUEST_BYTES), Some(request(2, REQUEST_BYTES)));
        assert_eq!(kept.read(REQUEST_BYTES), Some(request(3, REQUEST_BYTES)));
        assert_eq!(kept.read(REQUEST_BYTES), None);
        kept.remove();
        assert!(kept.is_empty());
        assert_eq!(exports.queue_bytes(Signal::Events), 0);
    }

    #[test]
    fn small_requests_are_sent_together_up_to_a_size() {
        let directory = tempfile::tempdir().unwrap();
        let (mut kept, _) = opened(directory.path(), LIMIT);
        for items in 1..=3 {
            assert!(kept.append(&request(items, REQUEST_BYTES / 2)));
        }
        let mut first = request(1, REQUEST_BYTES / 2);
        first.append(request(2, REQUEST_BYTES / 2));
        assert_eq!(kept.read(REQUEST_BYTES), Some(first));
        kept.remove();
        assert_eq!(
            kept.read(REQUEST_BYTES),
            Some(request(3, REQUEST_BYTES / 2))
        );
    }

    #[test]
    fn the_settled_part_of_a_request_is_neither_sent_with_others_nor_counted_as_lost() {
        let directory = tempfile::tempdir().unwrap();
        let (mut kept, _) = opened(directory.path(), LIMIT);
        for items in [9, 2] {
            assert!(kept.append(&request(items, 1_000)));
        }
        assert_eq!(kept.read(REQUEST_BYTES).unwrap().items, 11);
        assert!(!kept.is_single());
        kept.rewind();
        assert_eq!(kept.read(500), Some(request(9, 1_000)));
        assert!(kept.is_single());
        kept.settle_but(5);
        let (mut kept, _) = opened(directory.path(), LIMIT);
        let rest = kept.read(REQUEST_BYTES).unwrap();
        assert_eq!((rest.items, rest.settled), (5, 4));
        let (mut kept, exports) = opened(directory.path(), LIMIT);
        for _ in 0..200 {
            assert!(kept.append(&request(0, 10_000)));
        }
        assert_eq!(exports.dropped(Signal::Events, Reason::Overflow), 5 + 2);
    }

    #[test]
    fn a_full_queue_loses_and_counts_the_oldest_requests_only() {
        let directory = tempfile::tempdir().unwrap();
        let (mut kept, exports) = opened(directory.path(), LIMIT);
        let in_flight = {
            assert!(kept.append(&request(9, REQUEST_BYTES)));
            kept.read(REQUEST_BYTES).unwrap()
        };
        assert!(kept.has_read());
        for _ in 0..200 {
            assert!(kept.append(&request(7, 10_000)));
        }
        assert!(exports.queue_bytes(Signal::Events) <= LIMIT);
        // The request in flight is lost, too, and its delivery counts it.
        assert!(in_flight.items == 9 && !kept.has_read());
        let left: u64 = std::iter::from_fn(|| kept.read(REQUEST_BYTES))
            .map(|request| request.items)
            .sum();
        let lost = exports.dropped(Signal::Events, Reason::Overflow);
        assert!(left > 300 && lost > 0);
        assert_eq!(lost + left, 200 * 7);
    }

    #[test]
    fn a_damaged_file_does_not_keep_later_requests() {
        let directory = tempfile::tempdir().unwrap();
        let (mut kept, _) = opened(directory.path(), LIMIT);
        assert!(kept.append(&request(1, 1_000)));
        let file = directory.path().join("otlp_events/0000000000.queue");
        let mut bytes = std::fs::read(&file).unwrap();
        bytes[30..40].fill(0xff);
        std::fs::write(&file, bytes).unwrap();
        assert_eq!(kept.read(REQUEST_BYTES), None);
        assert!(kept.append(&request(2, 1_000)));
        assert_eq!(kept.read(REQUEST_BYTES), Some(request(2, 1_000)));
        kept.remove();
        assert!(kept.is_empty());
    }

    #[test]
    fn a_directory_that_cannot_be_written_keeps_nothing_and_loses_nothing() {
        let directory = tempfile::tempdir().unwrap();
        std::fs::write(directory.path().join("otlp_events"), "").unwrap();
        let exports = Arc::<Exports>::default();
        assert!(Kept::open(directory.path(), LIMIT, Signal::Events, &exports).is_none());
        let (mut kept, exports) = opened(&directory.path().join("file"), LIMIT);
        std::fs::write(directory.path().join("file"), "").unwrap();
        assert!(!kept.append(&request(3, 10)));
        assert!(kept.is_empty() && kept.read(REQUEST_BYTES).is_none());
        assert_eq!(exports.dropped(Signal::Events, Reason::Overflow), 0);
    }
}
