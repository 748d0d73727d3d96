//! Samples that the receiver does not have yet: in memory while it answers, on disk while it is out
//! of reach.
//!
//! Samples leave in the order in which they were collected. Those on disk are older than those in
//! memory. Samples of a request in progress stay here until they are delivered or refused, so that
//! a sudden end loses none that are on disk.

use std::collections::VecDeque;
use std::io;
use std::path::Path;
use std::sync::Arc;

use ros2probe_history::{Queue, Record};

use super::record::{Reader, Writer};
use super::samples::Scrape;

/// Maximum number of scrapes in memory before they are written to disk.
const MAX_IN_MEMORY: usize = 4;
/// Maximum number of samples in memory, if they cannot be written to disk. Each takes 24 bytes.
const MAX_SAMPLES: usize = 500_000;
/// Maximum numbers of scrapes and of samples in a request.
const REQUEST_SCRAPES: usize = 60;
const REQUEST_SAMPLES: usize = 20_000;

/// The waiting samples.
#[derive(Debug, Default)]
pub(super) struct Backlog {
    memory: VecDeque<Arc<Scrape>>,
    disk: Option<Disk>,
    taken: Taken,
}

/// Samples in a request, which wait until [`Backlog::delivered`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Taken {
    #[default]
    Nothing,
    /// The first scrapes of the memory, of this number.
    Memory(usize),
    /// The first records on disk, of this number: scrapes that were taken from memory, and written
    /// to disk since then.
    Written(usize),
    /// The records that were read.
    Disk,
}

#[derive(Debug)]
struct Disk {
    queue: Queue,
    writer: Writer,
    reader: Reader,
    /// Whether the last record was written.
    is_working: bool,
    /// Whether the last record was read.
    can_read: bool,
}

impl Backlog {
    /// Opens a queue on disk of at most `limit` bytes. Without one, samples wait in memory.
    pub(super) fn open(&mut self, directory: &Path, limit: u64) {
        self.disk = match Queue::open(directory, limit) {
            Ok(queue) => Some(Disk::new(queue)),
            Err(error) => {
                let path = directory.display();
                tracing::warn!(%path, %error, "samples for remote write do not survive a restart");
                None
            }
        };
    }

    /// Adds samples. They are written to disk if the receiver is out of reach. Returns the number
    /// of samples that were lost for them.
    pub(super) fn add(&mut self, scrape: Scrape, is_reachable: bool) -> u64 {
        self.memory.push_back(Arc::new(scrape));
        match is_reachable && self.memory.len() <= MAX_IN_MEMORY {
            true => 0,
            false => self.write(),
        }
    }

    /// Writes all samples to disk. Returns the number of those that were lost.
    pub(super) fn write(&mut self) -> u64 {
        let mut lost = 0;
        if let Some(disk) = &mut self.disk {
            let taken = &mut self.taken;
            let mut lose = |samples: usize| match taken {
                // The request in progress still has them.
                Taken::Written(count) if *count > 0 => *count -= 1,
                _ => lost += samples as u64,
            };
            let mut written = 0;
            while let Some(scrape) = self.memory.front()
                && disk.append(scrape, &mut lose)
            {
                self.memory.pop_front();
                written += 1;
            }
            if let Taken::Memory(count) = self.taken
                && written > 0
            {
                // A disk that accepted only some of them is full. The others may be sent twice.
                self.taken = Taken::Written(count.min(written));
            }
        }
        let mut samples: usize = self.memory.iter().map(|scrape| scrape.samples.len()).sum();
        while samples > MAX_SAMPLES
            && let Some(oldest) = self.memory.pop_front()
        {
            samples -= oldest.samples.len();
            match &mut self.taken {
                Taken::Memory(count) if *count > 0 => *count -= 1,
                _ => lost += oldest.samples.len() as u64,
            }
        }
        lost
    }

    /// Drops all samples in memory, and returns their number.
    pub(super) fn clear(&mut self) -> u64 {
        let dropped = self.memory.drain(..);
        dropped.map(|scrape| scrape.samples.len() as u64).sum()
    }

    /// Takes the oldest samples for a request; returns nothing if none waits.
    pub(super) fn take(&mut self) -> Vec<Arc<Scrape>> {
        let mut batch = Vec::new();
        let mut samples = 0;
        let mut is_full = |scrape: &Scrape| {
            samples += scrape.samples.len();
            samples >= REQUEST_SAMPLES
        };
        if let Some(disk) = &mut self.disk {
            while batch.len() < REQUEST_SCRAPES {
                let scrape = match disk.read() {
                    Ok(Some(scrape)) => scrape,
                    Ok(None) => break,
                    // The samples in memory are newer, and wait as well.
                    Err(_) if batch.is_empty() => return batch,
                    Err(_) => break,
                };
                let is_last = is_full(&scrape);
                batch.push(Arc::new(scrape));
                if is_last {
                    break;
                }
            }
            if !batch.is_empty() {
                self.taken = Taken::Disk;
                return batch;
            }
            // No record that is left can be read.
            if !disk.queue.is_empty() {
                disk.queue.remove();
            }
        }
        for scrape in self.memory.iter().take(REQUEST_SCRAPES) {
            batch.push(Arc::clone(scrape));
            if is_full(scrape) {
                break;
            }
        }
        self.taken = Taken::Memory(batch.len());
        batch
    }

    /// Removes the samples that were taken.
    pub(super) fn delivered(&mut self) {
        match std::mem::take(&mut self.taken) {
            Taken::Nothing => {}
            Taken::Memory(count) => drop(self.memory.drain(..count.min(self.memory.len()))),
            Taken::Written(count) => {
                if let Some(disk) = &mut self.disk {
                    // Records that cannot be read now are delivered again.
                    let mut left = count;
                    while left > 0 && matches!(disk.read(), Ok(Some(_))) {
                        left -= 1;
                    }
                    disk.queue.remove();
                }
            }
            Taken::Disk => {
                if let Some(disk) = &mut self.disk {
                    disk.queue.remove();
                }
            }
        }
    }

    /// Returns the size of the queue on disk, in bytes.
    pub(super) fn disk_bytes(&self) -> u64 {
        self.disk.as_ref().map_or(0, |disk| disk.queue.bytes())
    }

    /// Returns the time of the oldest samples in memory.
    pub(super) fn oldest_in_memory(&self) -> Option<i64> {
        self.memory.front().map(|scrape| scrape.at)
    }
}

impl Disk {
    fn new(queue: Queue) -> Self {
        Self {
            queue,
            writer: Writer::default(),
            reader: Reader::default(),
            is_working: true,
            can_read: true,
        }
    }

    /// Appends a scrape. Calls `lose` with the number of samples of each scrape that is lost for
    /// it. Returns whether it is on disk.
    fn append(&mut self, scrape: &Scrape, lose: &mut dyn FnMut(usize)) -> bool {
        if self.queue.begins_file() || self.writer.is_full() || !self.is_working {
            self.queue.begin_file();
            self.writer = Writer::default();
        }
        let record = self.writer.record(scrape);
        let at = u32::try_from(scrape.at / 1_000).unwrap_or(0);
        let mut of_file = Reader::default();
        let appended = self.queue.append(
            at,
            record,
            &mut |Record {
                      content,
                      is_first,
                      is_waiting,
                      ..
                  }| {
                if is_first {
                    of_file = Reader::default();
                }
                let scrape = of_file.scrape(&content).filter(|_| is_waiting);
                scrape
                    .into_iter()
                    .for_each(|scrape| lose(scrape.samples.len()));
            },
        );
        match appended {
            Ok(()) => self.is_working = true,
            Err(error) => {
                if std::mem::replace(&mut self.is_working, false) {
                    tracing::warn!(%error, "cannot write samples for remote write to disk");
                }
            }
        }
        self.is_working
    }

    /// Returns the next waiting scrape; `None` after the last one. Logs the first failure until a
    /// record is read again.
    fn read(&mut self) -> io::Result<Option<Scrape>> {
        loop {
            let record = self.queue.read();
            let could_read = std::mem::replace(&mut self.can_read, record.is_ok());
            if let (Err(error), true) = (&record, could_read) {
                tracing::warn!(%error, "cannot read samples for remote write from disk");
            }
            let Some(record) = record? else {
                return Ok(None);
            };
            if record.is_first {
                self.reader = Reader::default();
            }
            // A damaged record, and those that depend on it, are skipped.
            if let Some(scrape) = self.reader.scrape(&record.content)
                && record.is_waiting
            {
                return Ok(Some(scrape));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use proptest::prelude::*;

    use super::super::samples::Key;
    use super::*;

    const LIMIT: u64 = 4 << 20;

    fn scrape(at: i64) -> Scrape {
        let key: Key = vec![b'g', b'a', 0xff].into();
        #[expect(clippy::cast_precision_loss, reason = "small numbers")]
        let samples = vec![(key, at as f64)];
        Scrape { at, samples }
    }

    fn times(batch: &[Arc<Scrape>]) -> Vec<i64> {
        batch.iter().map(|scrape| scrape.at).collect()
    }

    fn opened(directory: &Path) -> Backlog {
        let mut backlog = Backlog::default();
        backlog.open(directory, LIMIT);
        backlog
    }

    /// Returns the times of all waiting samples.
    fn drained(backlog: &mut Backlog) -> Vec<i64> {
        let mut all = Vec::new();
        loop {
            let batch = backlog.take();
            if batch.is_empty() {
                return all;
            }
            all.extend(times(&batch));
            backlog.delivered();
        }
    }

    #[test]
    fn samples_reach_the_disk_only_while_the_receiver_is_out_of_reach() {
        let directory = tempfile::tempdir().unwrap();
        let mut backlog = opened(directory.path());
        backlog.add(scrape(1), true);
        assert_eq!(times(&backlog.take()), [1]);
        assert_eq!(backlog.disk_bytes(), 0);
        // The request fails, and the next collection comes.
        backlog.write();
        backlog.add(scrape(2), false);
        assert!(backlog.disk_bytes() > 0 && backlog.oldest_in_memory().is_none());
        backlog.delivered();
        assert_eq!(drained(&mut backlog), [2]);
        assert_eq!(backlog.disk_bytes(), 0);
    }

    #[test]
    fn more_samples_than_the_memory_keeps_are_on_disk() {
        let directory = tempfile::tempdir().unwrap();
        let mut backlog = opened(directory.path());
        (0..4).for_each(|at| assert_eq!(backlog.add(scrape(at), true), 0));
        assert_eq!(backlog.disk_bytes(), 0);
        backlog.add(scrape(4), true);
        assert!(backlog.disk_bytes() > 0 && backlog.oldest_in_memory().is_none());
        assert_eq!(drained(&mut backlog), [0, 1, 2, 3, 4]);
    }

    #[test]
    fn a_request_has_as_many_samples_as_its_caps_permit() {
        let mut backlog = Backlog::default();
        let wide = |at| Scrape {
            at,
            samples: vec![(vec![b'g', 0xff].into(), 0.0); 6_000],
        };
        (0..10).for_each(|at| assert_eq!(backlog.add(wide(at), true), 0));
        assert_eq!(times(&backlog.take()), [0, 1, 2, 3]);
        backlog.delivered();
        assert_eq!(times(&backlog.take()), [4, 5, 6, 7]);
    }

    #[test]
    fn samples_survive_a_sudden_end_while_a_request_is_in_progress() {
        let directory = tempfile::tempdir().unwrap();
        let mut backlog = opened(directory.path());
        (1..=70).for_each(|at| assert_eq!(backlog.add(scrape(at), false), 0));
        assert_eq!(times(&backlog.take()), (1..=60).collect::<Vec<_>>());
        let mut backlog = opened(directory.path());
        (71..=72).for_each(|at| assert_eq!(backlog.add(scrape(at), false), 0));
        assert_eq!(drained(&mut backlog), (1..=72).collect::<Vec<_>>());
    }

    /// Returns a scrape of 2,000 samples whose values do not compress.
    fn incompressible(at: i64) -> Scrape {
        let mut scrape = scrape(at);
        let mut random = at.cast_unsigned() + 1;
        let samples = (0..2_000_u32).map(|series| {
            random = random.wrapping_mul(0x5851_f42d_4c95_7f2d).wrapping_add(1);
            let key: Key = series.to_le_bytes().into();
            (key, f64::from_bits(random >> 2))
        });
        scrape.samples = samples.collect();
        scrape
    }

    #[test]
    fn a_full_queue_counts_what_it_loses_once() {
        let directory = tempfile::tempdir().unwrap();
        let mut backlog = Backlog::default();
        backlog.open(directory.path(), 1 << 20);
        backlog.add(incompressible(0), true);
        let taken = backlog.take();
        let lost: u64 = (1..200)
            .map(|at| backlog.add(incompressible(at), false))
            .sum();
        assert!(backlog.disk_bytes() <= 1 << 20);
        // The receiver answers at last: the request has what was first.
        assert_eq!(times(&taken), [0]);
        backlog.delivered();
        let left = drained(&mut backlog);
        let missing = 199 - left.len() as u64;
        assert_eq!(lost, missing * 2_000);
        assert!(missing > 50);
        let expected = 199 - i64::try_from(left.len()).unwrap()..199;
        assert_eq!(left, expected.map(|at| at + 1).collect::<Vec<_>>());
    }

    #[test]
    fn a_smaller_limit_after_a_restart_counts_each_sample_that_is_lost() {
        let directory = tempfile::tempdir().unwrap();
        let mut backlog = Backlog::default();
        backlog.open(directory.path(), 1 << 20);
        let numbers = 0..100;
        let lost: u64 = numbers
            .map(|at| backlog.add(incompressible(at), false))
            .sum();
        let mut backlog = Backlog::default();
        backlog.open(directory.path(), 1 << 17);
        let lost = lost + backlog.add(incompressible(100), false);
        let left = drained(&mut backlog).len() as u64;
        assert!(left > 0 && lost > 0, "{left} {lost}");
        assert_eq!(lost, (101 - left) * 2_000);
    }

    #[test]
    fn samples_wait_in_memory_while_the_disk_cannot_be_written() {
        let place = tempfile::tempdir().unwrap();
        let directory = place.path().join("queue");
        std::fs::write(&directory, "").unwrap();
        let mut backlog = Backlog::default();
        backlog.open(&place.path().join("missing"), LIMIT);
        (1..=3).for_each(|at| assert_eq!(backlog.add(scrape(at), false), 0));
        assert!(backlog.disk_bytes() > 0);
        // A file replaces the directory, so that writes fail.
        std::fs::remove_dir_all(place.path().join("missing")).unwrap();
        std::fs::rename(&directory, place.path().join("missing")).unwrap();
        (4..=9).for_each(|at| assert_eq!(backlog.add(scrape(at), false), 0));
        assert_eq!(backlog.oldest_in_memory(), Some(4));
        std::fs::remove_file(place.path().join("missing")).unwrap();
        assert_eq!(backlog.add(scrape(10), false), 0);
        assert_eq!(backlog.oldest_in_memory(), None);
        assert_eq!(drained(&mut backlog), (4..=10).collect::<Vec<_>>());
    }

    #[test]
    fn changing_series_begin_a_new_file() {
        let directory = tempfile::tempdir().unwrap();
        let mut backlog = opened(directory.path());
        for at in 0..4_u32 {
            let series = at * 60_000..(at + 1) * 60_000;
            let samples = series.map(|series| (Key::from(series.to_le_bytes()), 0.0));
            let scrape = Scrape {
                at: at.into(),
                samples: samples.collect(),
            };
            assert_eq!(backlog.add(scrape, false), 0);
        }
        let files = std::fs::read_dir(directory.path()).unwrap();
        assert_eq!(files.count(), 2);
        assert_eq!(drained(&mut backlog), [0, 1, 2, 3]);
    }

    #[test]
    fn without_a_disk_the_oldest_samples_are_lost_and_counted() {
        let mut backlog = Backlog::default();
        let wide = |at| Scrape {
            at,
            samples: vec![(vec![b'g', 0xff].into(), 0.0); 100_000],
        };
        let lost: u64 = (0..7).map(|at| backlog.add(wide(at), false)).sum();
        assert_eq!(lost, 200_000);
        assert_eq!(drained(&mut backlog), [2, 3, 4, 5, 6]);
        backlog.add(wide(7), true);
        assert_eq!(backlog.clear(), 100_000);
    }

    #[derive(Clone, Copy, Debug)]
    enum Step {
        Add(bool),
        Fail,
        Take,
        Deliver,
        Crash,
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn samples_leave_in_order_and_once(
            steps in prop::collection::vec(
                prop_oneof![
                    6 => any::<bool>().prop_map(Step::Add),
                    1 => Just(Step::Fail),
                    4 => Just(Step::Take),
                    4 => Just(Step::Deliver),
                    1 => Just(Step::Crash),
                ],
                1..80,
            ),
        ) {
            let directory = tempfile::tempdir().unwrap();
            let mut backlog = opened(directory.path());
            let mut waiting = VecDeque::new();
            let (mut next, mut taken) = (0, Vec::new());
            for step in steps {
                match step {
                    Step::Add(is_reachable) => {
                        prop_assert_eq!(backlog.add(scrape(next), is_reachable), 0);
                        waiting.push_back(next);
                        next += 1;
                    }
                    Step::Fail => prop_assert_eq!(backlog.write(), 0),
                    Step::Take if taken.is_empty() => {
                        taken = times(&backlog.take());
                        let first: Vec<_> = waiting.iter().copied().take(taken.len()).collect();
                        prop_assert_eq!(&taken, &first);
                        prop_assert_eq!(taken.is_empty(), waiting.is_empty());
                    }
                    Step::Take => {}
                    Step::Deliver => {
                        backlog.delivered();
                        waiting.drain(..taken.len());
                        taken.clear();
                    }
                    Step::Crash => {
                        // Samples that were only in memory are lost. The rest is in order.
                        let left = drained(&mut opened(directory.path()));
                        let kept: Vec<_> = waiting.iter().copied().take(left.len()).collect();
                        prop_assert_eq!(&left, &kept);
                        prop_assert!(waiting.len() - left.len() <= MAX_IN_MEMORY);
                        backlog = opened(directory.path());
                        (taken, waiting) = (Vec::new(), VecDeque::new());
                    }
                }
            }
        }
    }
}
