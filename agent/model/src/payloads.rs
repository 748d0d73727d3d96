//! Samples for those who want them one by one: each once for its writer and sequence number, as
//! soon as the profiler counts it, those of a reliable writer in the order of their numbers
//! ([`super::in_order`]).
//!
//! What waits to be taken is bounded; what finds no room is counted and told. It measures nothing:
//! whether somebody wants samples changes no number.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use ros2probe_wire::time::MILLISECOND;
use ros2probe_wire::{Guid, SequenceNumber, Timestamp, record};

use super::assembly::Assembly;
use super::dispatch::{Dispatch, Missed, MissedReason, Sample, SampleOutcome, Topic};
use super::in_order::{Due, InOrder, MAX_UNANNOUNCED, Progress};
use super::journal::Missing;
use super::selection::RequestIds;
use super::size::{Size, largest};
use super::writer::Counted;

/// Entries that wait to be taken: a round of the capture thread has far fewer.
const WAITING: usize = 65_536;
/// How long the kernel may take to be told that bytes are wanted, and the model to see what it was
/// not told of.
pub const PAYLOAD_DELAY: u64 = 400 * MILLISECOND;

/// What somebody wants of one writer.
#[derive(Debug)]
struct WantedWriter {
    topic: Arc<Topic>,
    /// Ids of the requests, and of those for bytes, and of the others.
    to: Arc<[u64]>,
    payloads: Arc<[u64]>,
    arrivals: Arc<[u64]>,
    /// Each of those ids, and the first number that is for it.
    begins: Vec<(u64, SequenceNumber)>,
    /// Since when bytes are wanted.
    since: Timestamp,
    /// Number of the first sample that was given with its bytes.
    first_whole: Option<SequenceNumber>,
    order: InOrder,
}

/// Numbers of a writer that is not announced yet.
#[derive(Debug, Default)]
struct UnannouncedSamples {
    numbers: BTreeSet<SequenceNumber>,
    /// Ids of the requests, and the first number that was counted while each was there.
    begins: Vec<(u64, SequenceNumber)>,
    /// Lower ones that are not remembered: the first, the last, and how many.
    before: Option<(SequenceNumber, SequenceNumber, u64)>,
}

/// The wanted writers and what waits to be taken.
#[derive(Debug)]
pub struct Payloads {
    writers: HashMap<Guid, WantedWriter>,
    payload_delay: u64,
    /// How many of them are wanted with bytes.
    deep: usize,
    assembly: Assembly,
    /// Of writers that nobody announced yet, what was counted while samples were requested.
    unknown_writers: HashMap<Guid, UnannouncedSamples>,
    dispatches: Vec<Dispatch>,
    dispatch_bytes: usize,
    /// Bytes that wait for lower numbers.
    waiting_bytes: usize,
    refused: u64,
}

impl Payloads {
    /// Nobody wants anything; later at most `limit` bytes at once, which come at the latest
    /// `payload_delay` nanoseconds after they are wanted.
    #[must_use]
    pub fn new(limit: usize, payload_delay: u64) -> Self {
        Self {
            writers: HashMap::new(),
            payload_delay,
            deep: 0,
            assembly: Assembly::new(limit),
            unknown_writers: HashMap::new(),
            dispatches: Vec::new(),
            dispatch_bytes: 0,
            waiting_bytes: 0,
            refused: 0,
        }
    }

    /// Entries, or bytes, and cap of every table: so many writers may be requested, so many be
    /// unknown writers, and there are so many sample requests.
    #[must_use]
    pub fn sizes(
        &self,
        endpoints: usize,
        unknown_writers: usize,
        sample_requests: usize,
    ) -> Vec<Size> {
        // A new table does not compile before it has a place here.
        let Self {
            writers,
            payload_delay: _,
            deep: _,
            assembly,
            unknown_writers: known,
            dispatches,
            dispatch_bytes,
            waiting_bytes,
            refused: _,
        } = self;
        let (bytes, limit, _) = assembly.size();
        let interested = |interested: &WantedWriter| {
            let WantedWriter {
                topic: _,
                to: _,
                payloads: _,
                arrivals: _,
                begins,
                since: _,
                first_whole: _,
                order,
            } = interested;
            let begins = Size::new("payloads.writers.begins", begins.len(), sample_requests);
            order.sizes().into_iter().chain([begins])
        };
        let earlier = |earlier: &UnannouncedSamples| {
            let UnannouncedSamples {
                numbers,
                begins,
                before: _,
            } = earlier;
            [
                Size::new(
                    "payloads.unknown_writers.numbers",
                    numbers.len(),
                    MAX_UNANNOUNCED,
                ),
                Size::new(
                    "payloads.unknown_writers.begins",
                    begins.len(),
                    sample_requests,
                ),
            ]
        };
        let mut sizes = largest(writers.values().flat_map(interested));
        sizes.extend(largest(known.values().flat_map(earlier)));
        sizes.extend(assembly.sizes());
        sizes.extend([
            Size::new("payloads.writers", writers.len(), endpoints),
            Size::new("payloads.unknown_writers", known.len(), unknown_writers),
            Size::new("payloads.dispatches", dispatches.len(), 2 * WAITING),
            Size::new(
                "payloads.bytes",
                bytes + dispatch_bytes + waiting_bytes,
                limit,
            ),
        ]);
        sizes
    }

    /// Bytes held, their cap, and what found no room.
    #[must_use]
    pub const fn size(&self) -> (usize, usize, u64) {
        let (bytes, limit, evictions) = self.assembly.size();
        let bytes = bytes + self.dispatch_bytes + self.waiting_bytes;
        (bytes, limit, evictions + self.refused)
    }

    /// Whether the bytes of anybody's samples are wanted.
    #[must_use]
    pub const fn wants_any_bytes(&self) -> bool {
        self.deep > 0
    }

    /// Whether the bytes of this writer's samples are wanted.
    #[must_use]
    pub fn wants_bytes(&self, writer: Guid) -> bool {
        let is_deep = |interested: &WantedWriter| !interested.payloads.is_empty();
        self.deep > 0 && self.writers.get(&writer).is_some_and(is_deep)
    }

    /// The writers whose samples are given.
    pub fn wanted(&self) -> impl Iterator<Item = &Guid> {
        self.writers.keys()
    }

    /// Gives the samples of this writer from `now` on; the next one has number `next`.
    pub fn want(
        &mut self,
        writer: Guid,
        topic: Topic,
        requested: &RequestIds,
        (next, now): (SequenceNumber, Timestamp),
    ) {
        let before = self.writers.remove(&writer);
        let known = before.as_ref().filter(|known| *known.topic == topic);
        let topic = known.map_or_else(|| Arc::new(topic), |known| Arc::clone(&known.topic));
        let begins = |id: &u64| {
            let earlier = self
                .unknown_writers
                .get(&writer)
                .map(|earlier| &earlier.begins);
            let known = before.iter().map(|before| &before.begins);
            let known = known.chain(earlier).flatten();
            let known = known.copied().find(|(known, _)| known == id);
            known.unwrap_or((*id, next))
        };
        let begins = requested.ids.iter().map(begins).collect();
        let was_deep = before.as_ref().filter(|before| !before.payloads.is_empty());
        self.deep -= usize::from(was_deep.is_some());
        self.deep += usize::from(!requested.payloads.is_empty());
        let since = was_deep.map_or(now, |before| before.since);
        let first_whole = was_deep.and_then(|before| before.first_whole);
        if was_deep.is_some() && requested.payloads.is_empty() {
            self.assembly.release(writer);
        }
        let arrivals = requested.ids.iter();
        let arrivals = arrivals.filter(|id| !requested.payloads.contains(id));
        let interested = WantedWriter {
            topic,
            to: Arc::clone(&requested.ids),
            payloads: Arc::clone(&requested.payloads),
            arrivals: arrivals.copied().collect(),
            begins,
            since,
            first_whole,
            order: before.map_or_else(InOrder::default, |before| before.order),
        };
        self.writers.insert(writer, interested);
        self.announced(writer, now);
    }

    /// No longer, after what waits of it.
    pub fn release(&mut self, writer: Guid, now: Timestamp) {
        self.unknown_writers.remove(&writer);
        self.give_all(writer, now);
        let before = self.writers.remove(&writer);
        if before.is_some_and(|before| !before.payloads.is_empty()) {
            self.deep -= 1;
            self.assembly.release(writer);
        }
    }

    /// Keeps what a DATA or DATA_FRAG brings of a sample that has not been counted yet.
    pub fn keep(&mut self, sample: record::Sample<'_>, payload: &[u8]) {
        let other_bytes = self.dispatch_bytes + self.waiting_bytes;
        self.assembly.put(sample, payload, other_bytes);
    }

    /// Whether samples of this writer are given.
    #[must_use]
    pub fn wants(&self, writer: Guid) -> bool {
        self.writers.contains_key(&writer)
    }

    /// A sample of this writer was counted. Returns as [`Self::turn`] does.
    pub fn counted(
        &mut self,
        writer: Guid,
        counted: &Counted,
        progress: &Progress,
    ) -> Option<SequenceNumber> {
        let interested = self.writers.get_mut(&writer)?;
        let payload = match interested.payloads.is_empty() {
            true => None,
            false => self.assembly.take(writer, counted.number),
        };
        // What was under way when bytes were first wanted has not come whole.
        let is_expected = counted.began.0 >= interested.since.0.saturating_add(self.payload_delay)
            || interested
                .first_whole
                .is_some_and(|first| first < counted.number);
        if payload.is_some() {
            let first = interested.first_whole.get_or_insert(counted.number);
            *first = counted.number.min(*first);
        }
        let missed = (payload.is_none() && is_expected && !interested.payloads.is_empty())
            .then(|| interested.not_captured(writer, counted.number));
        let to = match &payload {
            Some(_) => &interested.to,
            None => &interested.arrivals,
        };
        let due = Due {
            to: Arc::clone(to),
            sample: Sample {
                topic: Arc::clone(&interested.topic),
                time: counted.at,
                writer,
                sequence_number: counted.number,
                source_timestamp: counted.source.timestamp(),
                header_stamp: counted.stamp,
                size: u32::try_from(counted.bytes).unwrap_or(u32::MAX),
                sampled: counted.sampled,
                payload,
            },
            missed,
        };
        let mut before = Vec::new();
        let order = &mut interested.order;
        order.begin(progress.incarnation, counted.at, &mut |due| {
            before.push(due);
        });
        self.waiting_bytes += due.cost();
        if counted.unconfirmed || order.is_idle() && counted.number < progress.complete {
            let due = order.pass(due, counted.at);
            before.push(due);
            before.into_iter().for_each(|due| self.give_due(due));
            return None;
        }
        order.put(due);
        before.into_iter().for_each(|due| self.give_due(due));
        self.turn(writer, progress, counted.at)
    }

    /// A sample from before the announcement came again. Returns as [`Self::turn`] does.
    pub fn came_again(
        &mut self,
        writer: Guid,
        counted: &Counted,
        progress: &Progress,
    ) -> Option<SequenceNumber> {
        let is_whole = self.assembly.is_whole(writer, counted.number);
        if self.wants_bytes(writer) && !is_whole {
            return None;
        }
        self.counted(writer, counted, progress)
    }

    /// Whether this sample was counted before its writer was announced, and is to be given if it
    /// comes again.
    #[must_use]
    pub fn lacks(&self, writer: Guid, number: SequenceNumber) -> bool {
        let interested = self.writers.get(&writer);
        interested.is_some_and(|interested| interested.order.lacks(number))
    }

    /// A sample of a writer that nobody announced yet was counted, while there were these requests.
    pub fn counted_of_unknown_writer(
        &mut self,
        writer: Guid,
        number: SequenceNumber,
        sample_requests: impl Iterator<Item = u64>,
    ) {
        let earlier = self.unknown_writers.entry(writer).or_default();
        let ids: Vec<_> = sample_requests.collect();
        earlier.begins.retain(|(known, _)| ids.contains(known));
        for id in ids {
            if !earlier.begins.iter().any(|(known, _)| *known == id) {
                earlier.begins.push((id, number));
            }
        }
        earlier.numbers.insert(number);
        if earlier.numbers.len() > MAX_UNANNOUNCED
            && let Some(lowest) = earlier.numbers.pop_first()
        {
            let (first, _, count) = earlier.before.unwrap_or((lowest, lowest, 0));
            earlier.before = Some((first.min(lowest), lowest, count + 1));
        }
    }

    /// Unknown writers remembered.
    #[must_use]
    pub fn unknown_writers(&self) -> usize {
        self.unknown_writers.len()
    }

    /// Forgets unannounced writers that are no more.
    pub fn retain_unknown_writers(&mut self, is_there: impl Fn(Guid) -> bool) {
        self.unknown_writers.retain(|writer, _| is_there(*writer));
    }

    /// Writers of which something waits, or may come again, in the order of their GUIDs.
    #[must_use]
    pub fn unsettled(&self) -> Vec<Guid> {
        let is_unsettled = |interested: &WantedWriter| !interested.order.is_idle();
        let writers = self.writers.iter();
        let mut writers: Vec<_> = writers
            .filter(|(_, interested)| is_unsettled(interested))
            .map(|(writer, _)| *writer)
            .collect();
        writers.sort_unstable();
        writers
    }

    /// Whether something of this writer waits, or may come again.
    #[must_use]
    pub fn is_unsettled(&self, writer: Guid) -> bool {
        let interested = self.writers.get(&writer);
        interested.is_some_and(|interested| !interested.order.is_idle())
    }

    /// Gives the samples of this writer whose turn it is. Returns the number below which nothing is
    /// waited for any more, if the order was given up.
    pub fn turn(
        &mut self,
        writer: Guid,
        progress: &Progress,
        now: Timestamp,
    ) -> Option<SequenceNumber> {
        let (_, limit, _) = self.assembly.size();
        let room = (limit / 2).saturating_sub(self.waiting_bytes);
        let interested = self.writers.get_mut(&writer)?;
        let order = &mut interested.order;
        let room = room + order.bytes();
        let forgone = order.forgone(progress, now);
        let mut due = Vec::new();
        let skip = order.turn(progress, now, room, &mut |each| due.push(each));
        self.unannounced(writer, &forgone);
        due.into_iter().for_each(|due| self.give_due(due));
        skip
    }

    /// Nothing more will come of this writer: gives what waits, and tells what never came again.
    pub fn give_all(&mut self, writer: Guid, now: Timestamp) {
        let nothing_awaited = Progress::default();
        let Some(interested) = self.writers.get_mut(&writer) else {
            return;
        };
        let forgone = interested.order.forgone(&nothing_awaited, now);
        let mut due = Vec::new();
        interested.order.give_all(now, &mut |each| due.push(each));
        self.unannounced(writer, &forgone);
        due.into_iter().for_each(|due| self.give_due(due));
    }

    /// These samples will not come.
    pub fn missing(&mut self, missing: &Missing) {
        let Missing {
            writer,
            first,
            last,
            reason,
        } = *missing;
        let Some(interested) = self.writers.get(&writer) else {
            return;
        };
        if reason == MissedReason::Incomplete {
            self.assembly.forget(writer, first);
        }
        for missed in interested.missed(writer, (first, last), reason) {
            self.give(missed, 0);
        }
    }

    /// Forgets what will not be complete.
    pub fn expire(&mut self, now: Timestamp) {
        self.assembly.expire(now);
    }

    /// Takes what is to be given.
    pub fn take(&mut self) -> Vec<Dispatch> {
        self.dispatch_bytes = 0;
        std::mem::take(&mut self.dispatches)
    }

    /// So much waits that whoever feeds the model should let it be taken first.
    #[must_use]
    pub const fn is_full(&self) -> bool {
        let (_, limit, _) = self.assembly.size();
        self.dispatches.len() >= WAITING / 2 || self.dispatch_bytes > limit / 4
    }

    /// What was counted of this writer before it was announced is to be given if it comes again.
    fn announced(&mut self, writer: Guid, now: Timestamp) {
        let Some(earlier) = self.unknown_writers.remove(&writer) else {
            return;
        };
        let Some(interested) = self.writers.get_mut(&writer) else {
            return;
        };
        interested.order.announced(earlier.numbers, now);
        if let Some((first, last, samples)) = earlier.before {
            let reason = MissedReason::Unannounced;
            let mut missed = interested.missed(writer, (first, last), reason);
            for dispatches in &mut missed {
                if let SampleOutcome::Missed(missed) = &mut dispatches.outcome {
                    missed.samples = missed.samples.min(samples);
                }
            }
            missed.into_iter().for_each(|missed| self.give(missed, 0));
        }
    }

    /// These will not come again.
    fn unannounced(&mut self, writer: Guid, numbers: &[SequenceNumber]) {
        let Some(interested) = self.writers.get(&writer) else {
            return;
        };
        let runs = numbers.chunk_by(|before, after| before.precedes(*after));
        let missed: Vec<_> = runs
            .filter_map(|run| Some((*run.first()?, *run.last()?)))
            .flat_map(|run| interested.missed(writer, run, MissedReason::Unannounced))
            .collect();
        missed.into_iter().for_each(|missed| self.give(missed, 0));
    }

    fn give_due(&mut self, due: Due) {
        let bytes = due.bytes();
        self.waiting_bytes -= due.cost();
        if !due.to.is_empty() {
            let sample = Dispatch {
                to: due.to,
                outcome: SampleOutcome::Sample(Arc::new(due.sample)),
            };
            self.give(sample, bytes);
        }
        if let Some(missed) = due.missed {
            self.give(missed, 0);
        }
    }

    fn give(&mut self, dispatches: Dispatch, bytes: usize) {
        let (used, limit, _) = self.size();
        if self.dispatches.len() < WAITING && (bytes == 0 || used + bytes <= limit) {
            self.dispatch_bytes += bytes;
            self.dispatches.push(dispatches);
            return;
        }
        self.refused += 1;
        if let SampleOutcome::Sample(sample) = &dispatches.outcome
            && let Some(interested) = self.writers.get(&sample.writer)
            && self.dispatches.len() < 2 * WAITING
        {
            let (writer, number) = (sample.writer, sample.sequence_number);
            let mut missed = interested.not_captured(writer, number);
            missed.to = dispatches.to;
            self.dispatches.push(missed);
        }
    }
}

impl WantedWriter {
    /// That these samples will not come, to each subscription those that are for it.
    fn missed(
        &self,
        writer: Guid,
        (first, last): (SequenceNumber, SequenceNumber),
        reason: MissedReason,
    ) -> Vec<Dispatch> {
        let mut missed: Vec<(SequenceNumber, Vec<u64>)> = Vec::new();
        for (id, begin) in &self.begins {
            let first = first.max(*begin);
            match missed.iter_mut().find(|(known, _)| *known == first) {
                Some((_, to)) => to.push(*id),
                None if first <= last => missed.push((first, vec![*id])),
                None => {}
            }
        }
        let dispatches = |(first, to): (SequenceNumber, Vec<u64>)| Dispatch {
            to: to.into(),
            outcome: SampleOutcome::Missed(Missed {
                topic: Arc::clone(&self.topic),
                writer,
                first,
                last,
                samples: last - first + 1,
                reason,
            }),
        };
        missed.into_iter().map(dispatches).collect()
    }

    /// That a counted sample is missed by the subscriptions that want its bytes.
    fn not_captured(&self, writer: Guid, number: SequenceNumber) -> Dispatch {
        Dispatch {
            to: Arc::clone(&self.payloads),
            outcome: SampleOutcome::Missed(Missed {
                topic: Arc::clone(&self.topic),
                writer,
                first: number,
                last: number,
                samples: 1,
                reason: MissedReason::NotCaptured,
            }),
        }
    }
}
