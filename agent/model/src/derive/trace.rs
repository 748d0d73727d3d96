//! Spans of traced messages: when each was on the network, and when its reliable readers
//! acknowledged it.
//!
//! Spans contain only what was observed, not when a message was published or processed. Whether a
//! message is traced follows from its identity, so all agents that see it decide alike without
//! communication. The number of open messages is bounded, and dropped ones are counted.

pub mod share;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use foldhash::HashMap;
use ros2probe_wire::rtps::StatusInfo;
use ros2probe_wire::{DomainId, Guid, RtpsTime, SequenceNumber, Timestamp};

use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, Counted, Sum};
use crate::facts::identity::Identity;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{TopicName, TypeName};
use crate::facts::observation::{AckNack, Content, Head, Observation, Path, Sample};
use crate::facts::route::Destination;
use crate::facts::tables::{
    FinishedMessages, FinishedSpans, MessagesUnderWay, OpenMessages, OpenSpans, SettledReaders,
    TracedWriters,
};
use crate::facts::wall_clock::WallClock;
use crate::measure::samples::{Budget, Progress, Samples};
use share::Share;

/// Memory for bitmaps of fragments in bytes.
const BITMAP_BYTES: usize = 1 << 18;
/// Acknowledgements after this time have no span.
const ACKNACK_TIMEOUT: Duration = Duration::from_secs(10);
/// An arriving message is from another host if no observation shows within this time that it was
/// sent from this host.
const LOCAL_COPY_DELAY: Duration = Duration::from_millis(500);

/// The stage that a span covers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SpanStage {
    /// The message leaves this host, or is on the wire if the direction is unknown: from the first
    /// to the last fragment. On a gateway with a wire source, forwarded messages leave, too. In
    /// shared memory, the span is the time at which the agent sees the message.
    Send,
    /// The message arrives from another host: from the first to the last fragment.
    Receive,
    /// From the message's last fragment to the first ACKNACK of this reader that covers it.
    Settle(Guid),
}

/// A span. Its times are of type [`ModelTime`] until [`Tracer::take`] converts them.
#[derive(Clone, Debug, PartialEq)]
pub struct Span<T = Timestamp> {
    /// The stage.
    pub stage: SpanStage,
    /// The message.
    pub message: Message,
    /// Begin of the span.
    pub begin: T,
    /// End of the span.
    pub end: T,
}

/// A traced message.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// GUID of its writer.
    pub writer: Guid,
    /// Its sequence number.
    pub sequence_number: SequenceNumber,
    /// Trace id, derived from the writer and the sequence number.
    pub trace_id: u128,
    /// Its topic and type.
    pub description: Arc<WriterDescription>,
    /// Source timestamp, by the writer's clock.
    pub source: RtpsTime,
    /// Size of the payload in bytes.
    pub size: u32,
    /// Number of fragments; 1 for an unfragmented message.
    pub fragments: u32,
    /// Destination of its first datagram.
    pub destination: Destination,
}

/// Properties shared by all messages of a writer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WriterDescription {
    /// Domain.
    pub domain_id: DomainId,
    /// ROS name.
    pub topic: TopicName,
    /// Type.
    pub message_type: TypeName,
    /// Whether its readers may acknowledge.
    pub reliable: bool,
}

/// Spans completed since the last call.
#[derive(Debug, Default)]
pub struct Spans {
    /// Spans in the order in which they ended.
    pub spans: Bounded<FinishedSpans, Vec<Span>>,
    /// Number of spans dropped because the list was full.
    pub lost: u64,
}

/// State of all traced writers.
#[derive(Debug)]
pub struct Tracer {
    wanted: bool,
    directed: bool,
    /// Known writers; `None` for a writer that is not traced.
    writers: Bounded<TracedWriters, HashMap<Guid, Option<Box<WriterTrace>>>>,
    shared: Shared,
}

/// Budgets that all writers share.
#[derive(Debug)]
struct Shared {
    budget: Budget,
    open: Sum<Counted<OpenSpans>>,
    finished: Bounded<FinishedSpans, Vec<Span<ModelTime>>>,
    /// Finished spans dropped because there were too many.
    lost: u64,
}

/// A writer that is traced.
#[derive(Debug)]
struct WriterTrace {
    description: Arc<WriterDescription>,
    /// Identity of its messages, before the sequence number is added.
    identity: Identity,
    share: Share,
    samples: Samples,
    /// Whether it sends from this host. The kernel reports the local copies of a multicast before
    /// its departure, so the first message arrives before this is known.
    is_local: bool,
    in_transit: Bounded<MessagesUnderWay, VecDeque<Message>>,
    /// Spans of arrivals, until it is certain that they were not sent from this host.
    arrived: Bounded<OpenMessages, VecDeque<Span<ModelTime>>>,
    waiting: Bounded<OpenMessages, VecDeque<Unacknowledged>>,
    finished: Bounded<FinishedMessages, VecDeque<SequenceNumber>>,
}

/// A message that was sent and that some readers have not acknowledged.
#[derive(Debug)]
struct Unacknowledged {
    message: Message,
    at: ModelTime,
    readers: Bounded<SettledReaders, Vec<Guid>>,
}

/// Where a sample was seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    /// Where it leaves its writer's host, or in that host's shared memory.
    Departure,
    /// At a receiver on its writer's host.
    LocalCopy,
    /// At a receiver; its writer is not known to run on this host.
    Arrival,
}

impl Tracer {
    /// Creates a tracer without writers. In a capture file the direction is unknown: `directed` is
    /// then false, and all messages count as sent.
    #[must_use]
    pub fn new(directed: bool) -> Self {
        Self {
            wanted: false,
            directed,
            writers: Bounded::default(),
            shared: Shared {
                budget: Budget::new(BITMAP_BYTES),
                open: Sum::default(),
                finished: Bounded::default(),
                lost: 0,
            },
        }
    }

    /// Returns whether any topic is traced.
    #[must_use]
    pub const fn is_wanted(&self) -> bool {
        self.wanted
    }

    /// Restarts after a change of the traced topics.
    pub fn restart(&mut self, wanted: bool) {
        self.wanted = wanted;
        self.writers.take();
        self.shared.budget = Budget::new(BITMAP_BYTES);
        self.shared.open.clear();
    }

    /// Removes a writer.
    pub fn forget(&mut self, writer: Guid) {
        if let Some(Some(traced)) = self.writers.remove(&writer) {
            traced.close(&mut self.shared);
        }
    }

    /// Processes an observation. `is_local` states whether the writer is known to run on this host,
    /// so that none of its messages arrives from another host. `about` returns the description and
    /// traced share of a new writer, or `None` if they are not known yet.
    pub fn observe(
        &mut self,
        observation: &Observation,
        is_local: bool,
        about: impl FnOnce() -> Option<(WriterDescription, Option<Share>)>,
    ) {
        let writer = observation.head().writer;
        if !self.writers.contains_key(&writer) {
            let Some((description, share)) = about() else {
                return;
            };
            let traced = share.map(|share| WriterTrace::new(writer, description, share).into());
            if self.writers.insert(writer, traced).is_some() {
                self.shared.open.refuse();
                return;
            }
        }
        let Some(Some(traced)) = self.writers.get_mut(&writer) else {
            return;
        };
        match observation {
            Observation::AckNack(acknack) => traced.acknowledged(acknack, &mut self.shared),
            Observation::Sample(sample)
                if sample.is_delivered() && sample.status_info == StatusInfo::ALIVE =>
            {
                let place = match self.directed {
                    true => Place::of(&sample.head, is_local),
                    false => Some(Place::Departure),
                };
                if let Some(place) = place {
                    traced.sample(sample, place, &mut self.shared);
                }
            }
            _ => {}
        }
    }

    /// Drops messages whose acknowledgements are overdue.
    pub fn advance(&mut self, now: ModelTime) {
        for traced in self.writers.values_mut().flatten() {
            traced.release(now, &mut self.shared);
            while let Some(first) = traced.waiting.front()
                && now - first.at > ACKNACK_TIMEOUT
            {
                traced.waiting.pop_front();
                self.shared.open.sub(1);
            }
        }
    }

    /// Removes and returns the spans completed since the last call, with wall times.
    pub fn take(&mut self, clock: WallClock) -> Spans {
        let finished = self.shared.finished.take().into_iter();
        Spans {
            spans: finished.map(|span| span.at_wall_time(clock)).collect(),
            lost: std::mem::take(&mut self.shared.lost),
        }
    }

    /// Returns the trace id of a message whose writer has been observed, if it is traced.
    #[must_use]
    pub fn trace_of(&self, writer: Guid, number: SequenceNumber) -> Option<u128> {
        let traced = self.writers.get(&writer)?.as_ref()?;
        let trace_id = numbered(traced.identity, number);
        traced.share.takes(trace_id).then_some(trace_id)
    }

    /// Returns the size, limit and evictions of the table of open messages.
    #[must_use]
    pub fn table(&self) -> TableFacts {
        self.shared.open.facts()
    }
}

impl Span<ModelTime> {
    fn at_wall_time(self, clock: WallClock) -> Span {
        Span {
            stage: self.stage,
            message: self.message,
            begin: clock.wall_time(self.begin),
            end: clock.wall_time(self.end),
        }
    }
}

impl Message {
    /// Returns the identity of a message, equal for every agent that sees it.
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
    fn new(writer: Guid, description: WriterDescription, share: Share) -> Self {
        Self {
            description: Arc::new(description),
            identity: of_writer(writer),
            share,
            samples: Samples::default(),
            is_local: false,
            in_transit: Bounded::default(),
            arrived: Bounded::default(),
            waiting: Bounded::default(),
            finished: Bounded::default(),
        }
    }

    fn sample(&mut self, sample: &Sample, place: Place, shared: &mut Shared) {
        let (at, number) = (sample.head.at, sample.sequence_number);
        let trace_id = numbered(self.identity, number);
        if !self.share.takes(trace_id) {
            return;
        }
        if place != Place::Arrival && !self.is_local {
            self.forget_arrivals(shared);
        }
        // Copies that arrive do not belong to the departure.
        let is_copy = place == Place::LocalCopy || self.is_local && place == Place::Arrival;
        if is_copy || self.finished.contains(&number) {
            return;
        }
        let known = |message: &Message| message.sequence_number == number;
        let index = match self.in_transit.iter().position(known) {
            // The wire shows the fragments of this message.
            Some(_) if sample.head.is_in_shared_memory() => return,
            Some(index) => index,
            None => match self.begin(self.message(sample, trace_id), shared) {
                Some(index) => index,
                None => return,
            },
        };
        let (begin, source) = match sample.content {
            Content::Data { .. } => (sample.head.began(), sample.source_timestamp),
            Content::DataFrag(fragments) => {
                match self.samples.fragment(sample, fragments, &mut shared.budget) {
                    Progress::Partial | Progress::Duplicate => return,
                    Progress::Complete(facts) => (facts.began, facts.source),
                    Progress::Rejected | Progress::TooMany => {
                        self.in_transit.remove(index);
                        shared.drop_oldest();
                        return;
                    }
                }
            }
        };
        let Some(mut message) = self.in_transit.remove(index) else {
            return;
        };
        message.source = source;
        self.finished.push_back(number);
        self.whole(message, begin, at, shared);
    }

    /// Processes a message that was observed completely.
    fn whole(&mut self, message: Message, begin: ModelTime, at: ModelTime, shared: &mut Shared) {
        if self.waiting.len() + self.arrived.len() >= OpenMessages::CAP {
            self.waiting.refuse();
            self.arrived
                .pop_front()
                .map_or_else(|| drop(self.waiting.pop_front()), drop);
            shared.drop_oldest();
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
            shared.open.sub(1);
            return;
        }
        self.waiting.push_back(Unacknowledged {
            message,
            at,
            readers: Bounded::default(),
        });
    }

    /// Completes the spans of arrivals that are old enough to be attributed to another host.
    fn release(&mut self, now: ModelTime, shared: &mut Shared) {
        while let Some(first) = self.arrived.front()
            && now - first.end > LOCAL_COPY_DELAY
            && let Some(span) = self.arrived.pop_front()
        {
            shared.open.sub(1);
            shared.finish(span);
        }
    }

    /// Drops the spans of arrivals, because the writer sends from this host.
    fn forget_arrivals(&mut self, shared: &mut Shared) {
        self.is_local = true;
        let open = self.in_transit.len() + self.arrived.len();
        shared.open.sub(open);
        self.in_transit.clear();
        self.arrived.clear();
        self.finished.clear();
        self.samples.clear(&mut shared.budget);
    }

    /// Adds a message, dropping another if necessary, and returns its index.
    fn begin(&mut self, message: Message, shared: &mut Shared) -> Option<usize> {
        if self.in_transit.is_full() {
            self.in_transit.pop_front();
            self.in_transit.refuse();
            shared.drop_oldest();
        }
        if shared.open.is_full() {
            if self.waiting.pop_front().is_none() {
                shared.open.refuse();
                return None;
            }
            shared.drop_oldest();
        }
        shared.open.add(1);
        self.in_transit.push_back(message);
        self.in_transit.len().checked_sub(1)
    }

    fn message(&self, sample: &Sample, trace_id: u128) -> Message {
        Message {
            writer: sample.head.writer,
            sequence_number: sample.sequence_number,
            trace_id,
            description: Arc::clone(&self.description),
            source: sample.source_timestamp,
            size: sample.size(),
            fragments: match sample.content {
                Content::Data { .. } => 1,
                Content::DataFrag(fragments) => fragments.total(),
            },
            destination: sample.head.destination,
        }
    }

    fn acknowledged(&mut self, acknack: &AckNack, shared: &mut Shared) {
        let Head { at, reader, .. } = acknack.head;
        let covered = |waiting: &&mut Unacknowledged| {
            waiting.message.sequence_number < acknack.base()
                && !waiting.readers.contains(&reader)
                && !waiting.readers.is_full()
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
        self.release(ModelTime::MAX, shared);
        let open = self.in_transit.len() + self.waiting.len();
        shared.open.sub(open);
        self.samples.clear(&mut shared.budget);
    }
}

impl Place {
    /// Returns where a datagram was seen; `None` for a message that a router of this host forwards.
    fn of(head: &Head, is_local: bool) -> Option<Self> {
        let is_stream = matches!(head.path, Path::Stream { .. });
        let by_router = is_stream && head.is_at_socket() && !is_local;
        match (head.is_outgoing(), is_local) {
            (true, _) if by_router => None,
            (true, _) => Some(Self::Departure),
            (false, true) => Some(Self::LocalCopy),
            (false, false) => Some(Self::Arrival),
        }
    }
}

impl Shared {
    fn finish(&mut self, span: Span<ModelTime>) {
        self.lost += u64::from(self.finished.push(span).is_some());
    }

    fn drop_oldest(&mut self) {
        self.open.sub(1);
        self.open.refuse();
    }
}

#[cfg(test)]
mod tests;
