//! Spans of sampled messages: when each was on the wire, and when its reliable readers acknowledged
//! it.
//!
//! Only what was seen is told: nothing here guesses when a message was published or processed.
//! Which messages are sampled follows from their identity, so that every agent that sees a message
//! decides alike, without a word between them. What is under way or waits for acknowledgements is
//! bounded; what is given up for that is counted.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use ros2probe_wire::record::{AckNack, Body, Sample, flag};
use ros2probe_wire::rtps::StatusInfo;
use ros2probe_wire::time::{MILLISECOND, SECOND};
use ros2probe_wire::{DomainId, Guid, Record, RtpsTime, SequenceNumber, Timestamp};

use super::identity::Identity;
use super::names::{TopicName, TypeName};
use super::route::Destination;
use super::samples::{Budget, Progress, Samples};
use super::size::{Size, largest};

/// Writers whose messages may be sampled.
const MAX_WRITERS: usize = 4096;
/// Messages under way or waiting, of all writers and of one.
const MAX_OPEN: usize = 4096;
const MAX_OPEN_OF_WRITER: usize = 256;
/// Fragmented messages of one writer under way.
const MAX_UNDER_WAY: usize = 16;
/// Readers of one message that are told of.
const MAX_READERS: usize = 32;
/// Last messages of a writer, which may come again.
const REMEMBERED: usize = 128;
/// Spans kept until they are taken.
const MAX_FINISHED: usize = 2048;
/// For bitmaps of fragments.
const BITMAP_BYTES: usize = 1 << 18;
/// Acknowledgements that come later are of no interest.
const PATIENCE: u64 = 10 * SECOND;
/// What arrives may turn out to be a copy of what is sent from here.
const LOCAL_COPY_DELAY: u64 = 500 * MILLISECOND;
/// The loopback interface, in every network namespace.
const LOOPBACK: u32 = 1;
/// The part of a trace's identity that decides, as in OpenTelemetry's samplers.
const RANDOM: u64 = (1 << 56) - 1;

/// What a span tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SpanStage {
    /// Leaving this host, or on the wire where that is not told apart: first to last fragment. A
    /// gateway that looks at its wire sees what it forwards leaving, too.
    Send,
    /// Reaching this host from another: first to last fragment.
    Receive,
    /// From its last fragment to the first ACKNACK of this reader that covers it.
    Settle(Guid),
}

/// One span.
#[derive(Clone, Debug, PartialEq)]
pub struct Span {
    /// What it tells.
    pub stage: SpanStage,
    /// Of which message.
    pub message: Message,
    /// Begin.
    pub begin: Timestamp,
    /// End.
    pub end: Timestamp,
}

/// One sampled message.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// Who wrote it.
    pub writer: Guid,
    /// Its number.
    pub sequence_number: SequenceNumber,
    /// Out of both.
    pub trace_id: u128,
    /// On which topic.
    pub description: Arc<WriterDescription>,
    /// The writer's own time.
    pub source: RtpsTime,
    /// Size of the payload in bytes.
    pub size: u32,
    /// In so many fragments; 1 for a whole one.
    pub fragments: u32,
    /// Where its first datagram went.
    pub destination: Destination,
}

/// What all messages of a writer have in common.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WriterDescription {
    /// Domain.
    pub domain_id: DomainId,
    /// ROS name.
    pub topic: TopicName,
    /// Type.
    pub message_type: TypeName,
    /// Its readers may acknowledge.
    pub reliable: bool,
}

/// What was finished since the last call.
#[derive(Debug, Default)]
pub struct Spans {
    /// In the order in which they ended.
    pub spans: Vec<Span>,
    /// For which there was no room.
    pub lost: u64,
}

/// All of it.
#[derive(Debug)]
pub struct Tracer {
    wanted: bool,
    directed: bool,
    /// `None` = none of its messages is wanted.
    writers: HashMap<Guid, Option<Box<WriterTrace>>>,
    shared: Shared,
}

/// What all writers draw on.
#[derive(Debug)]
struct Shared {
    budget: Budget,
    open: usize,
    evictions: u64,
    finished: Spans,
}

/// One writer some of whose messages are wanted.
#[derive(Debug)]
struct WriterTrace {
    description: Arc<WriterDescription>,
    /// Of its messages, before their numbers.
    identity: Identity,
    threshold: u64,
    samples: Samples,
    /// It sends from here. The kernel shows a multicast's local copies before its sending, so this
    /// is learned when the first message has arrived already.
    is_local: bool,
    under_way: VecDeque<Message>,
    /// Spans of messages that arrived, until it is sure that they were not sent from here.
    arrived: VecDeque<Span>,
    waiting: VecDeque<Unacknowledged>,
    done: VecDeque<SequenceNumber>,
}

/// A message that was sent and not acknowledged by everybody.
#[derive(Debug)]
struct Unacknowledged {
    message: Message,
    at: Timestamp,
    readers: Vec<Guid>,
}

impl Tracer {
    /// Nothing is wanted yet. A capture file does not say who sent: `directed` is false, and all of
    /// it is taken for sent.
    #[must_use]
    pub fn new(directed: bool) -> Self {
        Self {
            wanted: false,
            directed,
            writers: HashMap::new(),
            shared: Shared {
                budget: Budget::new(BITMAP_BYTES),
                open: 0,
                evictions: 0,
                finished: Spans::default(),
            },
        }
    }

    /// Whether anything is wanted at all.
    #[must_use]
    pub const fn is_wanted(&self) -> bool {
        self.wanted
    }

    /// What is wanted has changed.
    pub fn restart(&mut self, wanted: bool) {
        self.wanted = wanted;
        self.writers = HashMap::new();
        self.shared.budget = Budget::new(BITMAP_BYTES);
        self.shared.open = 0;
    }

    /// A writer has gone.
    pub fn forget(&mut self, writer: Guid) {
        if let Some(Some(traced)) = self.writers.remove(&writer) {
            traced.close(&mut self.shared);
        }
    }

    /// Takes in a record. `about` says of a writer that was not heard before what it writes and
    /// which part of it is wanted; `None` = not known yet.
    pub fn record(
        &mut self,
        record: &Record,
        about: impl FnOnce() -> Option<(WriterDescription, f64)>,
    ) {
        const UNDELIVERED: u16 = flag::NO_ROOM | flag::NOT_REASSEMBLED;
        let writer = record.writer();
        if !self.writers.contains_key(&writer) {
            let Some((description, ratio)) = about() else {
                return;
            };
            if self.writers.len() >= MAX_WRITERS {
                self.shared.evictions += 1;
                return;
            }
            let traced = WriterTrace::new(writer, description, ratio).map(Box::new);
            self.writers.insert(writer, traced);
        }
        let Some(Some(traced)) = self.writers.get_mut(&writer) else {
            return;
        };
        match record.body() {
            Body::AckNack(acknack) => traced.acknowledged(acknack, &mut self.shared),
            Body::Sample(sample)
                if record.flags & UNDELIVERED == 0 && sample.status_info() == StatusInfo::ALIVE =>
            {
                traced.sample(sample, self.directed, &mut self.shared);
            }
            _ => {}
        }
    }

    /// Waits for no acknowledgement that is long overdue.
    pub fn advance(&mut self, now: Timestamp) {
        for traced in self.writers.values_mut().flatten() {
            traced.release(now, &mut self.shared);
            while let Some(first) = traced.waiting.front()
                && now.0.saturating_sub(first.at.0) > PATIENCE
            {
                traced.waiting.pop_front();
                self.shared.open = self.shared.open.saturating_sub(1);
            }
        }
    }

    /// What was finished since the last call.
    pub fn take(&mut self) -> Spans {
        std::mem::take(&mut self.shared.finished)
    }

    /// Entries, or bytes, and cap of every table.
    #[must_use]
    pub fn sizes(&self) -> Vec<Size> {
        // A new table does not compile before it has a place here.
        let Self {
            wanted: _,
            directed: _,
            writers,
            shared,
        } = self;
        let Shared {
            budget,
            open,
            evictions: _,
            finished,
        } = shared;
        let Spans { spans, lost: _ } = finished;
        let mut sizes = largest(writers.values().flatten().flat_map(|each| each.sizes()));
        sizes.extend([
            Size::new("trace.writers", writers.len(), MAX_WRITERS),
            Size::new("trace.bytes", budget.bytes, budget.limit),
            Size::new("trace.open", *open, MAX_OPEN),
            Size::new("trace.finished", spans.len(), MAX_FINISHED),
        ]);
        sizes
    }

    /// Messages under way or waiting, their cap, and those given up for it.
    #[must_use]
    pub const fn size(&self) -> (usize, usize, u64) {
        (self.shared.open, MAX_OPEN, self.shared.evictions)
    }
}

impl Message {
    /// The identity of a message for every agent that sees it.
    #[must_use]
    pub fn identity(writer: Guid, sequence_number: SequenceNumber) -> u128 {
        numbered(of_writer(writer), sequence_number)
    }
}

fn of_writer(writer: Guid) -> Identity {
    let mut identity = Identity::of(b"ros2 message");
    identity.add(&writer.to_bytes());
    identity
}

fn numbered(mut identity: Identity, sequence_number: SequenceNumber) -> u128 {
    identity.add(&sequence_number.0.to_be_bytes());
    identity.bits()
}

impl WriterTrace {
    fn sizes(&self) -> impl Iterator<Item = Size> {
        // A new list does not compile before it has a place here.
        let Self {
            description: _,
            identity: _,
            threshold: _,
            samples,
            is_local: _,
            under_way,
            arrived,
            waiting,
            done,
        } = self;
        let readers = |each: &Unacknowledged| {
            let Unacknowledged {
                message: _,
                at: _,
                readers,
            } = each;
            readers.len()
        };
        let of_one = waiting.iter().map(readers).max().unwrap_or(0);
        let own = [
            Size::new("trace.writer.under_way", under_way.len(), MAX_UNDER_WAY),
            Size::new(
                "trace.writer.open",
                arrived.len() + waiting.len(),
                MAX_OPEN_OF_WRITER,
            ),
            Size::new("trace.writer.done", done.len(), REMEMBERED),
            Size::new("trace.message.readers", of_one, MAX_READERS),
        ];
        own.into_iter().chain(samples.sizes())
    }

    /// `None`: nothing of it is wanted.
    fn new(writer: Guid, description: WriterDescription, ratio: f64) -> Option<Self> {
        if ratio.is_nan() || ratio <= 0.0 {
            return None;
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            clippy::cast_precision_loss,
            reason = "a part of 2^56"
        )]
        let threshold = ((1.0 - ratio.min(1.0)) * RANDOM as f64) as u64;
        Some(Self {
            description: Arc::new(description),
            identity: of_writer(writer),
            threshold,
            samples: Samples::default(),
            is_local: false,
            under_way: VecDeque::new(),
            arrived: VecDeque::new(),
            waiting: VecDeque::new(),
            done: VecDeque::new(),
        })
    }

    fn sample(&mut self, sample: Sample<'_>, directed: bool, shared: &mut Shared) {
        let (record, number) = (sample.record(), sample.sequence_number());
        let trace_id = numbered(self.identity, number);
        if (trace_id as u64 & RANDOM) < self.threshold {
            return;
        }
        let on_wire = record.flags & flag::HOST == 0;
        let leaves = record.flags & flag::OUTGOING != 0
            || !directed
            || on_wire && record.interface == LOOPBACK;
        if leaves && !self.is_local {
            self.forget_arrivals(shared);
        }
        // Copies that arrive are no part of how it left.
        if leaves != self.is_local || self.done.contains(&number) {
            return;
        }
        let known = |message: &Message| message.sequence_number == number;
        let index = match self.under_way.iter().position(known) {
            Some(index) => index,
            None => match self.begin(self.message(sample, trace_id), shared) {
                Some(index) => index,
                None => return,
            },
        };
        let at = Timestamp(record.time);
        let (begin, source) = match sample {
            Sample::Data(_) => (record.began(), sample.source_timestamp()),
            Sample::DataFrag(fragments) => {
                match self.samples.fragment(fragments, at, &mut shared.budget) {
                    Progress::Partial | Progress::Duplicate => return,
                    Progress::Complete(facts) => (facts.began, facts.source),
                    Progress::Rejected | Progress::TooMany => {
                        self.under_way.remove(index);
                        shared.give_up();
                        return;
                    }
                }
            }
        };
        let Some(mut message) = self.under_way.remove(index) else {
            return;
        };
        message.source = source;
        if self.done.len() >= REMEMBERED {
            self.done.pop_front();
        }
        self.done.push_back(number);
        self.whole(message, begin, at, shared);
    }

    /// A message has been seen whole.
    fn whole(&mut self, message: Message, begin: Timestamp, at: Timestamp, shared: &mut Shared) {
        if self.waiting.len() + self.arrived.len() >= MAX_OPEN_OF_WRITER {
            self.arrived
                .pop_front()
                .map_or_else(|| drop(self.waiting.pop_front()), drop);
            shared.give_up();
        }
        let mut span = Span {
            stage: SpanStage::Receive,
            message,
            begin,
            end: at,
        };
        if !self.is_local {
            self.arrived.push_back(span);
            return self.release(at, shared);
        }
        span.stage = SpanStage::Send;
        let message = span.message.clone();
        shared.finish(span);
        if !self.description.reliable {
            shared.open = shared.open.saturating_sub(1);
            return;
        }
        self.waiting.push_back(Unacknowledged {
            message,
            at,
            readers: Vec::new(),
        });
    }

    /// Tells of what arrived so long ago that it was not sent from here.
    fn release(&mut self, now: Timestamp, shared: &mut Shared) {
        while let Some(first) = self.arrived.front()
            && now.0.saturating_sub(first.end.0) > LOCAL_COPY_DELAY
            && let Some(span) = self.arrived.pop_front()
        {
            shared.open = shared.open.saturating_sub(1);
            shared.finish(span);
        }
    }

    /// It turns out to send from here.
    fn forget_arrivals(&mut self, shared: &mut Shared) {
        self.is_local = true;
        let open = self.under_way.len() + self.arrived.len();
        shared.open = shared.open.saturating_sub(open);
        self.under_way.clear();
        self.arrived.clear();
        self.done.clear();
        self.samples.clear(&mut shared.budget);
    }

    /// Makes room for a message and gives its place.
    fn begin(&mut self, message: Message, shared: &mut Shared) -> Option<usize> {
        if self.under_way.len() >= MAX_UNDER_WAY {
            self.under_way.pop_front();
            shared.give_up();
        }
        if shared.open >= MAX_OPEN {
            if self.waiting.pop_front().is_none() {
                shared.evictions += 1;
                return None;
            }
            shared.give_up();
        }
        shared.open += 1;
        self.under_way.push_back(message);
        self.under_way.len().checked_sub(1)
    }

    fn message(&self, sample: Sample<'_>, trace_id: u128) -> Message {
        let record = sample.record();
        Message {
            writer: record.writer(),
            sequence_number: sample.sequence_number(),
            trace_id,
            description: Arc::clone(&self.description),
            source: sample.source_timestamp(),
            size: sample.size(),
            fragments: match sample {
                Sample::Data(_) => 1,
                Sample::DataFrag(fragments) => fragments.total(),
            },
            destination: Destination::of(record),
        }
    }

    fn acknowledged(&mut self, acknack: AckNack<'_>, shared: &mut Shared) {
        let record = acknack.record();
        let (reader, at) = (record.reader(), Timestamp(record.time));
        let covered = |waiting: &&mut Unacknowledged| {
            waiting.message.sequence_number < acknack.base()
                && !waiting.readers.contains(&reader)
                && waiting.readers.len() < MAX_READERS
        };
        for waiting in self.waiting.iter_mut().filter(covered) {
            waiting.readers.push(reader);
            shared.finish(Span {
                stage: SpanStage::Settle(reader),
                message: waiting.message.clone(),
                begin: waiting.at,
                end: at.max(waiting.at),
            });
        }
    }

    fn close(mut self, shared: &mut Shared) {
        self.release(Timestamp(u64::MAX), shared);
        let open = self.under_way.len() + self.waiting.len();
        shared.open = shared.open.saturating_sub(open);
        self.samples.clear(&mut shared.budget);
    }
}

impl Shared {
    fn finish(&mut self, span: Span) {
        if self.finished.spans.len() < MAX_FINISHED {
            self.finished.spans.push(span);
        } else {
            self.finished.lost += 1;
        }
    }

    fn give_up(&mut self) {
        self.open = self.open.saturating_sub(1);
        self.evictions += 1;
    }
}

#[cfg(test)]
mod tests;
