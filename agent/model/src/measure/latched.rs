//! The last message of each transient-local writer, for clients that subscribe later. The agent has
//! no DDS reader, so it cannot request earlier messages from the writer.
//!
//! Kept messages change no measurement. Payloads are captured within an allowance per writer and
//! one for all writers. A writer that exceeds its allowance is paused: the kernel only meters it,
//! which shows whether the kept message is still the last. Messages, their bytes and the writers
//! have caps.

use std::sync::Arc;

use foldhash::HashMap;
use ros2probe_wire::record::Verdict;
use ros2probe_wire::{Guid, GuidPrefix, SequenceNumber, Timestamp};

use crate::facts::bounded::{Bounded, Counted, Sum, TableFacts};
use crate::facts::dispatch::{Missed, MissedReason, Sample, Topic};
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{self, Content};
use crate::facts::tables::{RetainedBytes, RetainedWriters};
use crate::facts::wall_clock::WallClock;
use crate::measure::allowance::{Allowance, CommonAllowance, WriterAllowance};
use crate::measure::assembly::Assembly;

/// State of the last message of a transient-local writer. Sizes are in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LatchedFacts {
    /// No complete message was seen.
    Unseen,
    /// It is kept.
    Kept(u32),
    /// It exceeds the maximum size of a kept message.
    TooLarge(u32),
    /// The writer exceeded its allowance, so its messages are only metered.
    Paused,
    /// It was dropped or refused because the kept messages have reached their cap.
    NoRoom(u32),
}

/// Maximum size of a message that is kept by default, in bytes.
pub const MESSAGE_BYTES: usize = 1 << 20;
/// Maximum size of all unfinished messages, in bytes.
const ASSEMBLY_BYTES: usize = 4 << 20;
/// Bytes of one writer that may be captured in a burst, and per second.
const WRITER_ALLOWANCE: Allowance = Allowance::new(8 << 20, 16 << 10);
/// Bytes of all writers that may be captured in a burst, and per second.
const ALL_WRITERS: Allowance = Allowance::new(64 << 20, 256 << 10);
/// A paused writer is captured again once it is allowed this many bytes: a whole message.
const RESUME_BYTES: u64 = MESSAGE_BYTES as u64;

/// Writers whose last message is kept.
#[derive(Debug)]
pub struct Latched {
    writers: Bounded<Counted<RetainedWriters>, HashMap<Guid, LatchedWriter>>,
    bytes: Sum<Counted<RetainedBytes>>,
    assembly: Assembly,
    allowance: CommonAllowance,
}

/// Properties of a writer that are needed to keep its last message.
#[derive(Clone, Debug)]
pub struct LatchedTopic {
    /// Its topic.
    pub topic: Arc<Topic>,
    /// Whether its type begins with a header.
    pub has_header: bool,
    /// Whether a watch requests its last message, whatever its size.
    pub is_watched: bool,
}

#[derive(Debug)]
struct LatchedWriter {
    topic: LatchedTopic,
    allowance: WriterAllowance,
    /// Number and source timestamp of the last message.
    newest: Option<(SequenceNumber, Option<Timestamp>)>,
    last: LastMessage,
}

/// The last message of a writer.
#[derive(Debug)]
enum LastMessage {
    /// No complete message was seen.
    Unseen,
    /// The message, and the time of its arrival.
    Kept(Arc<Sample>, ModelTime),
    TooLarge(u32),
    /// The writer was paused when it arrived.
    Paused,
    NoRoom(u32),
}

impl Default for Latched {
    fn default() -> Self {
        Self {
            writers: Bounded::default(),
            bytes: Sum::default(),
            assembly: Assembly::new(ASSEMBLY_BYTES),
            allowance: CommonAllowance::new(ALL_WRITERS, RESUME_BYTES),
        }
    }
}

impl Latched {
    /// Begins to keep the last message of this writer, unless the table of writers is full.
    pub fn follow(&mut self, writer: Guid, about: LatchedTopic) {
        let new = || LatchedWriter {
            topic: about.clone(),
            allowance: WriterAllowance::new(WRITER_ALLOWANCE),
            newest: None,
            last: LastMessage::Unseen,
        };
        let Some(known) = self.writers.get_or_insert_with(writer, new) else {
            return;
        };
        known.topic = about;
        // A message that was kept for a watch may be too large without the watch.
        if let LastMessage::Kept(sample, _) = &known.last
            && size(sample) > known.most()
        {
            let last = LastMessage::TooLarge(saturated_size(size(sample)));
            self.replace(writer, last);
        }
    }

    /// Drops a writer and its message.
    pub fn forget(&mut self, writer: Guid) {
        self.replace(writer, LastMessage::Unseen);
        if let Some(known) = self.writers.remove(&writer) {
            self.allowance.forget(&known.allowance);
            self.assembly.release(writer);
        }
    }

    /// Returns the verdict that the kernel needs for this writer; `None` if its messages are not
    /// kept.
    #[must_use]
    pub fn verdict(&self, writer: Guid) -> Option<Verdict> {
        let known = self.writers.get(&writer)?;
        Some(match known.allowance.is_paused() {
            true => Verdict::Meter,
            false => Verdict::Capture,
        })
    }

    /// Returns whether messages of any writer are kept.
    #[must_use]
    pub fn is_used(&self) -> bool {
        !self.writers.is_empty()
    }

    /// Adds a DATA or DATA_FRAG that no client requests. Returns whether the verdict has changed.
    pub fn put(
        &mut self,
        sample: &observation::Sample,
        wall_clock: WallClock,
        payload: &[u8],
    ) -> bool {
        let (writer, now) = (sample.head.writer, sample.head.at);
        let Some(known) = self.writers.get_mut(&writer) else {
            return false;
        };
        // Until the kernel knows of a pause, it captures more.
        let is_allowed = self
            .allowance
            .spend(&mut known.allowance, payload.len(), now);
        if known.allowance.is_paused() || !sample.is_message() {
            return false;
        }
        let bytes = usize::try_from(sample.size()).unwrap_or(usize::MAX);
        if bytes > known.most() {
            // Its next message may be as large.
            known.allowance.allowance.exhaust();
        }
        if !is_allowed || bytes > known.most() {
            self.pause(writer);
            self.seen(sample);
            return true;
        }
        let number = sample.sequence_number;
        let source = sample.source_timestamp.timestamp();
        if !known.is_newer_or_incomplete((number, source)) {
            return false;
        }
        if known.newest.is_none_or(|(newest, _)| newest != number) {
            known.newest = Some((number, source));
            self.assembly.release(writer);
            // The kept message is no longer the last.
            self.replace(writer, LastMessage::Unseen);
        }
        self.assembly.put(sample, payload, 0);
        if !self.assembly.is_whole(writer, number) {
            return false;
        }
        let payload = self.assembly.take(writer, number);
        let Some(known) = self.writers.get(&writer).filter(|_| payload.is_some()) else {
            return false;
        };
        let is_whole = matches!(sample.content, Content::Data { .. });
        let has_stamp = known.topic.has_header && is_whole;
        let sample = Sample {
            topic: Arc::clone(&known.topic.topic),
            time: wall_clock.wall_time(now),
            writer,
            sequence_number: number,
            source_timestamp: source,
            header_stamp: sample.header_stamp.filter(|_| has_stamp),
            size: sample.size(),
            sampled: false,
            payload,
        };
        self.keep(Arc::new(sample), now);
        false
    }

    /// Keeps a message that was dispatched to a client and arrived at `at`.
    pub fn dispatched(&mut self, sample: &Arc<Sample>, at: ModelTime) {
        let Some(known) = self.writers.get_mut(&sample.writer) else {
            return;
        };
        let about = (sample.sequence_number, sample.source_timestamp);
        if sample.payload.is_none() || !known.is_newer_or_incomplete(about) {
            return;
        }
        known.newest = Some(about);
        self.assembly.release(sample.writer);
        if size(sample) > known.most() {
            let last = LastMessage::TooLarge(saturated_size(size(sample)));
            self.replace(sample.writer, last);
        } else {
            self.keep(Arc::clone(sample), at);
        }
    }

    /// Drops the kept message of a writer if a later one was sent whose bytes are missing.
    pub fn missed(&mut self, missed: &Missed) {
        let known = self.writers.get_mut(&missed.writer);
        let Some(known) = known.filter(|_| missed.reason == MissedReason::NotCaptured) else {
            return;
        };
        if matches!(known.last, LastMessage::Kept(..))
            && let Some((newest, source)) = known.newest
            && newest < missed.last
        {
            known.newest = Some((missed.last, source));
            self.replace(missed.writer, LastMessage::Unseen);
        }
    }

    /// Drops the kept message of a paused writer if `sample` shows that it is no longer the last.
    pub fn seen(&mut self, sample: &observation::Sample) {
        if !self.allowance.has_paused() || !sample.is_message() {
            return;
        }
        let writer = sample.head.writer;
        let known = self.writers.get_mut(&writer);
        let Some(known) = known.filter(|known| known.allowance.is_paused()) else {
            return;
        };
        let source = sample.source_timestamp.timestamp();
        let about = (sample.sequence_number, source);
        if !known.is_newer_or_incomplete(about) {
            return;
        }
        known.newest = Some(about);
        let bytes = usize::try_from(sample.size()).unwrap_or(usize::MAX);
        let last = match bytes > known.most() {
            true => LastMessage::TooLarge(sample.size()),
            false => LastMessage::Paused,
        };
        self.replace(writer, last);
    }

    /// Drops unfinished messages that wait for too long. Returns the writers that are captured
    /// again.
    pub fn advance(&mut self, now: ModelTime) -> Vec<Guid> {
        self.assembly.expire(now);
        let writers = self.writers.iter_mut();
        let writers = writers.map(|(writer, known)| (writer, &mut known.allowance));
        self.allowance.resume(writers, now)
    }

    /// Returns the kept messages with the times of their arrival, oldest first.
    #[must_use]
    pub fn samples(&self) -> Vec<(ModelTime, Arc<Sample>)> {
        let kept = self.writers.values().filter_map(|known| match &known.last {
            LastMessage::Kept(sample, at) => Some((*at, Arc::clone(sample))),
            _ => None,
        });
        let mut kept: Vec<_> = kept.collect();
        kept.sort_by_key(|(at, sample)| (*at, sample.writer));
        kept
    }

    /// Returns the state of the last message of this writer; `None` if its messages are not kept.
    #[must_use]
    pub fn facts(&self, writer: Guid) -> Option<LatchedFacts> {
        let known = self.writers.get(&writer)?;
        Some(match &known.last {
            LastMessage::Unseen => LatchedFacts::Unseen,
            LastMessage::Kept(sample, _) => LatchedFacts::Kept(saturated_size(size(sample))),
            LastMessage::TooLarge(bytes) => LatchedFacts::TooLarge(*bytes),
            LastMessage::Paused => LatchedFacts::Paused,
            LastMessage::NoRoom(bytes) => LatchedFacts::NoRoom(*bytes),
        })
    }

    /// Returns the bytes of kept messages.
    #[must_use]
    pub const fn bytes(&self) -> usize {
        self.bytes.used()
    }

    /// Returns the sizes and limits of the tables of writers and of bytes.
    #[must_use]
    pub fn tables(&self) -> [TableFacts; 2] {
        [self.writers.facts(), self.bytes.facts()]
    }

    fn pause(&mut self, writer: Guid) {
        if let Some(known) = self.writers.get_mut(&writer) {
            self.allowance.pause(&mut known.allowance);
            self.assembly.release(writer);
        }
    }

    /// Keeps a message, if the cap on bytes allows.
    fn keep(&mut self, sample: Arc<Sample>, at: ModelTime) {
        let (writer, bytes) = (sample.writer, size(&sample));
        self.replace(writer, LastMessage::Unseen);
        let known = self.writers.get(&writer);
        let is_watched = known.is_some_and(|known| known.topic.is_watched);
        while bytes > self.bytes.remaining() {
            self.bytes.refuse();
            let Some((other, size)) = self.largest(is_watched, (writer.prefix, bytes)) else {
                self.replace(writer, LastMessage::NoRoom(saturated_size(bytes)));
                return;
            };
            self.replace(other, LastMessage::NoRoom(saturated_size(size)));
        }
        self.replace(writer, LastMessage::Kept(sample, at));
    }

    /// Returns the writer whose message is dropped for a new one, and the size of that message. It
    /// is the oldest message of the participant with the most bytes, so that no participant
    /// displaces the others. Messages that a watch requests stay, unless a watch requests the new
    /// one, too.
    fn largest(
        &self,
        is_watched: bool,
        (newcomer, bytes): (GuidPrefix, usize),
    ) -> Option<(Guid, usize)> {
        let kept = || {
            self.writers.iter().filter_map(|(writer, known)| {
                let LastMessage::Kept(sample, at) = &known.last else {
                    return None;
                };
                (is_watched || !known.topic.is_watched).then_some((writer, sample, *at))
            })
        };
        let mut sums: HashMap<_, _> = HashMap::from_iter([(newcomer, bytes)]);
        for (writer, sample, _) in kept() {
            *sums.entry(writer.prefix).or_default() += size(sample);
        }
        let having = |prefix: &GuidPrefix| kept().any(|(writer, ..)| writer.prefix == *prefix);
        let largest = sums.iter().filter(|(prefix, _)| having(prefix));
        let (largest, _) = largest.max_by_key(|(prefix, sum)| (**sum, **prefix))?;
        let own = kept().filter(|(writer, ..)| writer.prefix == *largest);
        let (writer, sample, _) = own.min_by_key(|(writer, _, at)| (*at, **writer))?;
        Some((*writer, size(sample)))
    }

    /// Replaces the state of a writer's last message.
    fn replace(&mut self, writer: Guid, last: LastMessage) {
        let Some(known) = self.writers.get_mut(&writer) else {
            return;
        };
        if let LastMessage::Kept(sample, _) = &last {
            self.bytes.add(size(sample));
        }
        if let LastMessage::Kept(sample, _) = std::mem::replace(&mut known.last, last) {
            self.bytes.sub(size(&sample));
        }
    }
}

impl LatchedWriter {
    /// Returns the maximum size of a message to keep.
    const fn most(&self) -> usize {
        match self.topic.is_watched {
            true => RetainedBytes::CAP,
            false => MESSAGE_BYTES,
        }
    }

    /// Returns whether a message is later than the last one, or is the last one and was not
    /// captured completely.
    fn is_newer_or_incomplete(&self, about: (SequenceNumber, Option<Timestamp>)) -> bool {
        let is_last = self.newest.is_some_and(|(number, _)| number == about.0);
        is_last && matches!(self.last, LastMessage::Unseen | LastMessage::Paused)
            || self.is_newer(about)
    }

    /// Returns whether a message is later than the last one. A lower number is later only if its
    /// source timestamp is, as after a restart of the writer.
    fn is_newer(&self, (number, source): (SequenceNumber, Option<Timestamp>)) -> bool {
        let Some((newest, newest_source)) = self.newest else {
            return true;
        };
        let is_restarted = source
            .zip(newest_source)
            .is_some_and(|(new, old)| new > old);
        number > newest || number < newest && is_restarted
    }
}

fn size(sample: &Sample) -> usize {
    sample.payload.as_ref().map_or(0, bytes::Bytes::len)
}

fn saturated_size(bytes: usize) -> u32 {
    u32::try_from(bytes).unwrap_or(u32::MAX)
}
