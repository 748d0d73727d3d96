//! Samples for subscriptions: one per writer and sequence number, as soon as the profiler counts
//! it. Samples of a reliable writer are dispatched in the order of their numbers
//! ([`crate::measure::in_order`]).
//!
//! The output queue is bounded; samples that exceed it are counted and reported. Requests for
//! samples never change a measurement.

mod request_begin;

use std::sync::Arc;
use std::time::Duration;

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::{Guid, SequenceNumber};

use crate::facts::bounded::Bounded;
use crate::facts::dispatch::{
    Dispatch, Missed, MissedReason, QueuedDispatch, Sample, SampleOutcome, Topic,
};
use crate::facts::journal::Missing;
use crate::facts::model_time::ModelTime;
use crate::facts::observation;
use crate::facts::selection::RequestIds;
use crate::facts::tables::WaitingDispatches;
use crate::facts::wall_clock::WallClock;
use crate::measure::assembly::Assembly;
use crate::measure::in_order::{InOrder, Progress, QueuedSample, UnannouncedNumbers};
use crate::measure::writer::Counted;
use request_begin::RequestBegin;

/// Maximum time until the kernel captures payloads after a request and the model has processed
/// earlier captures.
pub const PAYLOAD_DELAY: Duration = Duration::from_millis(400);

/// Requests for the samples of one writer.
#[derive(Debug)]
struct WantedWriter {
    topic: Arc<Topic>,
    /// Ids of all requests, of those for payloads, and of the others.
    to: Arc<[u64]>,
    payloads: Arc<[u64]>,
    arrivals: Arc<[u64]>,
    /// Start of each request.
    begins: Vec<RequestBegin>,
    /// Time when the requests for payloads began.
    since: ModelTime,
    /// Number of the first sample that was dispatched with its payload.
    first_whole: Option<SequenceNumber>,
    order: InOrder,
}

/// Numbers of a writer that is not announced yet.
#[derive(Debug, Default)]
struct UnannouncedSamples {
    numbers: UnannouncedNumbers,
    /// Ids of the requests, and the first number that was counted during each.
    begins: Vec<(u64, SequenceNumber)>,
    /// Lower numbers that are not remembered: the first, the last, and their count.
    before: Option<(SequenceNumber, SequenceNumber, u64)>,
}

/// Requested writers and the output queue.
#[derive(Debug)]
pub struct Payloads {
    writers: HashMap<Guid, WantedWriter>,
    payload_delay: Duration,
    /// Number of writers whose payloads are requested.
    deep: usize,
    assembly: Assembly,
    /// Counted samples of writers without an announcement, while samples are requested.
    unknown_writers: HashMap<Guid, UnannouncedSamples>,
    dispatches: Bounded<WaitingDispatches, Vec<QueuedDispatch>>,
    dispatch_bytes: usize,
    /// Bytes of samples that wait for lower numbers.
    waiting_bytes: usize,
    refused: u64,
}

impl Payloads {
    /// Creates the state without requests. At most `limit` bytes are held; payloads arrive at most
    /// `payload_delay` after they are requested.
    #[must_use]
    pub fn new(limit: usize, payload_delay: Duration) -> Self {
        Self {
            writers: HashMap::new(),
            payload_delay,
            deep: 0,
            assembly: Assembly::new(limit),
            unknown_writers: HashMap::new(),
            dispatches: Bounded::default(),
            dispatch_bytes: 0,
            waiting_bytes: 0,
            refused: 0,
        }
    }

    /// Returns the bytes held, their cap, and the number of samples dropped because of it.
    #[must_use]
    pub const fn size(&self) -> (usize, usize, u64) {
        let (bytes, limit, evictions) = self.assembly.size();
        let bytes = bytes + self.dispatch_bytes + self.waiting_bytes;
        (bytes, limit, evictions + self.refused)
    }

    /// Returns whether payloads of any writer are requested.
    #[must_use]
    pub const fn needs_any_payload(&self) -> bool {
        self.deep > 0
    }

    /// Returns whether payloads of this writer are requested.
    #[must_use]
    pub fn needs_payload(&self, writer: Guid) -> bool {
        let is_deep = |interested: &WantedWriter| !interested.payloads.is_empty();
        self.deep > 0 && self.writers.get(&writer).is_some_and(is_deep)
    }

    /// Returns the writers whose samples are requested.
    pub fn requested_writers(&self) -> impl Iterator<Item = &Guid> {
        self.writers.keys()
    }

    /// Returns whether any writer's samples are dispatched for this request.
    #[must_use]
    pub fn has_request(&self, request: u64) -> bool {
        self.writers
            .values()
            .any(|known| known.to.contains(&request))
    }

    /// Begins to dispatch the samples of this writer at `now`; the next sample has the number
    /// `next`, or is the first one. `is_new`: the requests are older than the writer.
    pub fn start_writer(
        &mut self,
        writer: Guid,
        topic: Topic,
        requested: &RequestIds,
        (next, now): (SequenceNumber, ModelTime),
        is_new: bool,
    ) {
        let before = self.writers.remove(&writer);
        let known = before.as_ref().filter(|known| *known.topic == topic);
        let topic = known.map_or_else(|| Arc::new(topic), |known| Arc::clone(&known.topic));
        let begins = |id: &u64| {
            let known = before.iter().flat_map(|before| &before.begins);
            let known = known.copied().find(|known| known.id == *id);
            let earlier = self.unknown_writers.get(&writer);
            let mut earlier = earlier.iter().flat_map(|earlier| &earlier.begins);
            let earlier = earlier.find(|(known, _)| known == id);
            let number = earlier.map_or(next, |(_, number)| *number);
            let mut begin = known.unwrap_or_else(|| RequestBegin::new(*id, number, now));
            if is_new && next == SequenceNumber::ZERO {
                begin.precedes_writer(now);
            }
            begin
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

    /// Dispatches the waiting samples of this writer, and then stops dispatching its samples.
    pub fn release(&mut self, writer: Guid, now: ModelTime) {
        self.unknown_writers.remove(&writer);
        self.dispatch_all(writer, now);
        let before = self.writers.remove(&writer);
        if before.is_some_and(|before| !before.payloads.is_empty()) {
            self.deep -= 1;
            self.assembly.release(writer);
        }
    }

    /// Keeps the payload of a DATA or DATA_FRAG whose sample is not counted yet.
    pub fn keep(&mut self, sample: &observation::Sample, payload: &[u8]) {
        let other_bytes = self.dispatch_bytes + self.waiting_bytes;
        self.assembly.put(sample, payload, other_bytes);
    }

    /// Returns whether samples of this writer are requested.
    #[must_use]
    pub fn is_requested(&self, writer: Guid) -> bool {
        self.writers.contains_key(&writer)
    }

    /// Dispatches a counted sample. Returns the same as [`Self::dispatch_ready`].
    pub fn counted(
        &mut self,
        writer: Guid,
        counted: &Counted,
        progress: &Progress,
    ) -> Option<SequenceNumber> {
        let interested = self.writers.get_mut(&writer)?;
        let mut before = Vec::new();
        interested.begin(progress, counted.at, &mut |queued| before.push(queued));
        let payload = match interested.payloads.is_empty() {
            true => None,
            false => self.assembly.take(writer, counted.number),
        };
        // A sample that began before the request is incomplete.
        let is_expected = counted.began >= interested.since + self.payload_delay
            || interested
                .first_whole
                .is_some_and(|first| first < counted.number)
            || interested.begins.iter().all(|begin| begin.is_older);
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
        // An unconfirmed number may be that of a new incarnation.
        let is_complete = interested.order.is_idle() && counted.number < progress.complete;
        let is_known = is_complete && !counted.unconfirmed;
        let to = interested.without(to, |begin| {
            begin.before == Some(counted.number) && !counted.unconfirmed
                || is_known && begin.starts_after(counted.number)
        });
        for begin in &mut interested.begins {
            begin.concerns(&to, counted.number);
            if missed.is_some() {
                begin.concerns(&interested.payloads, counted.number);
            }
        }
        let queued = QueuedSample {
            to,
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
        let order = &mut interested.order;
        self.waiting_bytes += queued.cost();
        if counted.unconfirmed || is_complete {
            let queued = order.pass(queued, counted.at);
            before.push(queued);
            before.into_iter().for_each(|queued| self.enqueue(queued));
            return None;
        }
        order.put(queued);
        before.into_iter().for_each(|queued| self.enqueue(queued));
        self.dispatch_ready(writer, progress, counted.at)
    }

    /// Returns whether a request receives this sample from before its start. The sample is then not
    /// dispatched when the writer repeats it. A recent sample may already have been dispatched.
    pub fn dispatch_latched(
        &mut self,
        writer: Guid,
        (id, number): (u64, SequenceNumber),
        is_recent: bool,
    ) -> bool {
        let interested = self.writers.get_mut(&writer);
        let mut begins = interested.into_iter().flat_map(|known| &mut known.begins);
        let Some(begin) = begins.find(|begin| begin.id == id) else {
            return true;
        };
        if is_recent && begin.has(number) {
            return false;
        }
        begin.before = Some(number);
        true
    }

    /// Dispatches a retransmitted sample from before the announcement. Returns the same as
    /// [`Self::dispatch_ready`].
    pub fn dispatch_retransmitted(
        &mut self,
        writer: Guid,
        counted: &Counted,
        progress: &Progress,
    ) -> Option<SequenceNumber> {
        let is_whole = self.assembly.is_whole(writer, counted.number);
        if self.needs_payload(writer) && !is_whole {
            return None;
        }
        self.counted(writer, counted, progress)
    }

    /// Returns whether this sample was counted before its writer's announcement and is dispatched
    /// if it is retransmitted.
    #[must_use]
    pub fn is_undispatched(&self, writer: Guid, number: SequenceNumber) -> bool {
        let interested = self.writers.get(&writer);
        interested.is_some_and(|interested| interested.order.is_undispatched(number))
    }

    /// Records a counted sample of a writer without an announcement, with the current requests.
    pub fn note_unknown_writer(
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
        if let Some(lowest) = earlier.numbers.add(number) {
            let (first, _, count) = earlier.before.unwrap_or((lowest, lowest, 0));
            earlier.before = Some((first.min(lowest), lowest, count + 1));
        }
    }

    /// Replaces the GUID of an unknown writer by the announced one.
    pub fn rename_unknown_writer(&mut self, before: Guid, guid: Guid) {
        if let Some(samples) = self.unknown_writers.remove(&before) {
            self.unknown_writers.insert(guid, samples);
        }
    }

    /// Returns the number of unknown writers remembered.
    #[must_use]
    pub fn unknown_writers(&self) -> usize {
        self.unknown_writers.len()
    }

    /// Removes unknown writers for which `is_there` returns false.
    pub fn retain_unknown_writers(&mut self, is_there: impl Fn(Guid) -> bool) {
        self.unknown_writers.retain(|writer, _| is_there(*writer));
    }

    /// Returns the writers with waiting or possibly retransmitted samples, sorted by GUID.
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

    /// Returns the earliest time of a sample that waits for lower numbers; `None` if none waits.
    #[must_use]
    pub fn waiting_since(&self) -> Option<ModelTime> {
        let writers = self.writers.values();
        writers
            .filter_map(|interested| interested.order.waiting_since())
            .min()
    }

    /// Returns whether this writer has waiting or possibly retransmitted samples.
    #[must_use]
    pub fn is_unsettled(&self, writer: Guid) -> bool {
        let interested = self.writers.get(&writer);
        interested.is_some_and(|interested| !interested.order.is_idle())
    }

    /// Dispatches the samples of this writer that need not wait. If a bound ended the wait, returns
    /// the number below which no sample is awaited.
    pub fn dispatch_ready(
        &mut self,
        writer: Guid,
        progress: &Progress,
        now: ModelTime,
    ) -> Option<SequenceNumber> {
        let (_, limit, _) = self.assembly.size();
        let room = (limit / 2).saturating_sub(self.waiting_bytes);
        let interested = self.writers.get_mut(&writer)?;
        let mut queued = Vec::new();
        let room = room + interested.order.bytes();
        interested.begin(progress, now, &mut |each| queued.push(each));
        let order = &mut interested.order;
        let forgone = order.take_expired(progress, now);
        let skip = order.turn(progress, now, room, &mut |each| queued.push(each));
        self.unannounced(writer, &forgone, now);
        queued.into_iter().for_each(|queued| self.enqueue(queued));
        skip
    }

    /// Dispatches all waiting samples of a writer that has ended, and reports the samples that were
    /// not retransmitted.
    pub fn dispatch_all(&mut self, writer: Guid, now: ModelTime) {
        let nothing_awaited = Progress::default();
        let Some(interested) = self.writers.get_mut(&writer) else {
            return;
        };
        let forgone = interested.order.take_expired(&nothing_awaited, now);
        let mut queued = Vec::new();
        interested
            .order
            .dispatch_all(now, &mut |each| queued.push(each));
        self.unannounced(writer, &forgone, now);
        queued.into_iter().for_each(|queued| self.enqueue(queued));
    }

    /// Reports samples that will not arrive, at `now`.
    pub fn missing(&mut self, missing: &Missing, now: ModelTime) {
        let Missing {
            writer,
            first,
            last,
            reason,
        } = *missing;
        let Some(interested) = self.writers.get_mut(&writer) else {
            return;
        };
        if reason == MissedReason::Incomplete {
            self.assembly.forget(writer, first);
        }
        for missed in interested.missed(writer, (first, last), (reason, now), self.payload_delay) {
            self.push_dispatch(missed, 0);
        }
    }

    /// Drops samples that will not become complete.
    pub fn expire(&mut self, now: ModelTime) {
        self.assembly.expire(now);
    }

    /// Removes and returns the output queue, with wall times.
    pub fn take(&mut self, clock: WallClock) -> Vec<Dispatch> {
        self.dispatch_bytes = 0;
        let dispatches = self.dispatches.take().into_iter();
        dispatches.map(|each| each.at_wall_time(clock)).collect()
    }

    /// Returns whether the output queue should be taken before further input.
    #[must_use]
    pub fn is_full(&self) -> bool {
        let (_, limit, _) = self.assembly.size();
        self.dispatches.len() >= WaitingDispatches::CAP / 4 || self.dispatch_bytes > limit / 4
    }

    /// Prepares samples counted before the announcement for dispatch if they are retransmitted.
    fn announced(&mut self, writer: Guid, now: ModelTime) {
        let Some(earlier) = self.unknown_writers.remove(&writer) else {
            return;
        };
        let Some(interested) = self.writers.get_mut(&writer) else {
            return;
        };
        interested.order.announced(earlier.numbers, now);
        if let Some((first, last, samples)) = earlier.before {
            let reason = (MissedReason::Unannounced, now);
            let mut missed = interested.missed(writer, (first, last), reason, self.payload_delay);
            for dispatches in &mut missed {
                if let SampleOutcome::Missed(missed) = &mut dispatches.outcome {
                    missed.samples = missed.samples.min(samples);
                }
            }
            missed
                .into_iter()
                .for_each(|missed| self.push_dispatch(missed, 0));
        }
    }

    /// Reports samples that will not be retransmitted.
    fn unannounced(&mut self, writer: Guid, numbers: &[SequenceNumber], now: ModelTime) {
        let Some(interested) = self.writers.get_mut(&writer) else {
            return;
        };
        let (reason, delay) = ((MissedReason::Unannounced, now), self.payload_delay);
        let runs = numbers.chunk_by(|before, after| before.precedes(*after));
        let missed: Vec<_> = runs
            .filter_map(|run| Some((*run.first()?, *run.last()?)))
            .flat_map(|run| interested.missed(writer, run, reason, delay))
            .collect();
        missed
            .into_iter()
            .for_each(|missed| self.push_dispatch(missed, 0));
    }

    fn enqueue(&mut self, queued: QueuedSample) {
        let bytes = queued.bytes();
        self.waiting_bytes -= queued.cost();
        if !queued.to.is_empty() {
            let sample = Dispatch {
                to: queued.to,
                outcome: SampleOutcome::Sample(queued.sample),
            };
            self.push_dispatch(sample, bytes);
        }
        if let Some(missed) = queued.missed {
            self.push_dispatch(missed, 0);
        }
    }

    /// Queues an outcome, `bytes` of which are a payload. A sample beyond the bounds is reported as
    /// missing; the other half of the queue is for such reports.
    fn push_dispatch(&mut self, dispatches: QueuedDispatch, bytes: usize) {
        let (used, limit, _) = self.size();
        let has_room = self.dispatches.len() < WaitingDispatches::CAP / 2
            && (bytes == 0 || used + bytes <= limit);
        let SampleOutcome::Sample(sample) = &dispatches.outcome else {
            self.dispatches.push(dispatches);
            return;
        };
        if has_room {
            self.dispatch_bytes += bytes;
            self.dispatches.push(dispatches);
            return;
        }
        self.refused += 1;
        if let Some(interested) = self.writers.get(&sample.writer) {
            let (writer, number) = (sample.writer, sample.sequence_number);
            let mut missed = interested.not_captured(writer, number);
            missed.to = dispatches.to;
            self.dispatches.push(missed);
        }
    }
}

impl WantedWriter {
    /// Begins a new incarnation of the writer, if it has restarted.
    fn begin(&mut self, progress: &Progress, now: ModelTime, give: &mut impl FnMut(QueuedSample)) {
        if self.order.begin(progress.incarnation, now, give) {
            self.begins.iter_mut().for_each(RequestBegin::restart);
        }
    }

    /// Reports missing samples to each subscription, limited to the numbers that concern it.
    fn missed(
        &mut self,
        writer: Guid,
        (first, last): (SequenceNumber, SequenceNumber),
        (reason, now): (MissedReason, ModelTime),
        payload_delay: Duration,
    ) -> Vec<QueuedDispatch> {
        let mut missed: Vec<(SequenceNumber, Vec<u64>)> = Vec::new();
        for begin in &mut self.begins {
            let Some(from) = begin.first_missed(reason, now, payload_delay) else {
                continue;
            };
            let first = first.max(from);
            if first > last {
                continue;
            }
            begin.concerns(&[begin.id], first);
            match missed.iter_mut().find(|(known, _)| *known == first) {
                Some((_, to)) => to.push(begin.id),
                None => missed.push((first, vec![begin.id])),
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

    /// Returns these ids of requests, without the requests for which `is_left` returns true: those
    /// that a sample does not concern. Either the request has received this sample already, as the
    /// one from before its start. Or its first sample is a later one, and polling noticed this one
    /// late.
    fn without(&self, to: &Arc<[u64]>, is_left: impl Fn(&RequestBegin) -> bool) -> Arc<[u64]> {
        let is_left = |begin: &&RequestBegin| is_left(begin);
        if !self.begins.iter().any(|begin| is_left(&begin)) {
            return Arc::clone(to);
        }
        let left = self.begins.iter().filter(is_left);
        let left: Vec<u64> = left.map(|begin| begin.id).collect();
        to.iter().copied().filter(|id| !left.contains(id)).collect()
    }

    /// Returns the report that a counted sample is missing for requests of its payload.
    fn not_captured(&self, writer: Guid, number: SequenceNumber) -> QueuedDispatch {
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
