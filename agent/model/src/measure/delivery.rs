//! Samples of one writer that arrived at one receiver, or that left for one destination.
//!
//! A delivery begins with the first sample that the receiver sees. A gap counts as lost if it is
//! below the highest number that the receiver knows from a sample or HEARTBEAT. A sample that left
//! this host for the receiver's address and did not arrive counts as lost, too. A receiver
//! therefore loses nothing before it joins or after it leaves. Each loss has one cause, which never
//! changes. Outgoing deliveries have no losses: samples that were never sent belong to no receiver.

mod accounting;
mod departed;
mod shares;
mod withheld;

use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

use ros2probe_wire::{Guid, GuidPrefix, RtpsTime, SequenceNumber, Timestamp};

use crate::facts::bounded::Bounded;
use crate::facts::journal::Journal;
use crate::facts::loss::{DeliveryLoss, LossCause};
use crate::facts::loss_share::RecentLoss;
use crate::facts::measurement::Delivered;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{AckNack, Content, Gap, Heartbeat, Sample};
use crate::facts::route::Direction;
use crate::facts::route::{Receiver, Route};
use crate::facts::tables::WithheldLosses;
use crate::measure::loss_causes::{LossCauses, reassembly_timeout};
use crate::measure::reception::{CompleteSample, Outcome, Reception};
use crate::measure::samples::Budget;
use crate::measure::sequence::{MAX_IRRELEVANT_AT_START, MAX_TRUSTED_JUMP};
use crate::measure::undelivered::Undelivered;
use crate::measure::writer::{BEST_EFFORT_WINDOW, settle_window};
use accounting::Accounting;
pub use accounting::Totals;

/// Samples that left this host less than this ago may still arrive.
const MAX_TRANSIT_TIME: Duration = Duration::from_secs(1);
/// After this time without a sign of life, the samples that left for the receiver in its first
/// [`START_GRACE`] count as lost. Socket diagnostics report a closed socket earlier.
const SILENCE: Duration = Duration::from_secs(18);
const START_GRACE: Duration = Duration::from_secs(5);
/// A run of pending losses longer than this is settled when two deliveries merge.
const MIN_LONG_RUN: u64 = 256;

/// State outside the delivery that an observation changes.
#[derive(Debug)]
pub struct DeliveryContext<'a> {
    /// Time of the observation, or of the tick.
    pub now: ModelTime,
    /// Writer of the samples.
    pub writer: Guid,
    /// Whether the writer is reliable and retransmits samples.
    pub reliable: bool,
    /// Whether the writer's datagrams may need IP reassembly on this host.
    pub reassembled: bool,
    /// Memory budget for fragmented samples.
    pub budget: &'a mut Budget,
    /// Journal that receives the losses.
    pub journal: &'a mut Journal,
    /// Sums over all deliveries of the writer.
    pub totals: &'a mut Totals,
}

/// A TCP connection that carries RTPS: the source port, and the route to the receiver.
type Connection = (u16, Route);

/// One delivery.
#[derive(Debug)]
pub struct Delivery {
    receiver: Receiver,
    /// Route by which new samples arrive.
    main: Route,
    reception: Reception,
    tally: Delivered,
    undelivered: Undelivered,
    loss_causes: LossCauses,
    first_seen: ModelTime,
    last_seen: ModelTime,
    /// Time at which a matching reader last appeared or capture missed bytes; earlier gaps are
    /// irrelevant.
    opened: ModelTime,
    /// Time at which the oldest sample that has not arrived left this host for the receiver.
    waiting: Option<ModelTime>,
    /// Whether samples that left after `waiting` are already counted as lost.
    presumed_lost: bool,
    /// Number of samples that left this host for the receiver at least [`MAX_TRANSIT_TIME`] ago and
    /// have not arrived.
    overdue: u64,
    /// Losses of the last seconds.
    recent: RecentLoss,
    /// Whether all readers are best effort: they get no retransmissions and no HEARTBEATs.
    best_effort: bool,
    /// Whether the writer applies a content filter of each reader.
    is_filtered: bool,
    /// Whether samples use the network, at least for some readers, rather than only shared memory.
    uses_network: bool,
    /// The latest losses, while the delivery is withheld.
    withheld: Option<Bounded<WithheldLosses, VecDeque<DeliveryLoss>>>,
    /// The TCP connection of the newest sample, and the first number that only it carries.
    connection: Option<(Connection, SequenceNumber)>,
    /// Number of samples that the writer's totals contain twice. Totals never decrease, so this
    /// many further samples are not added to them.
    counted_twice: u64,
}

impl Delivery {
    /// Creates a delivery without observations.
    #[must_use]
    pub fn new(receiver: Receiver, main: Route, now: ModelTime) -> Self {
        Self {
            receiver,
            main,
            reception: Reception::default(),
            tally: Delivered::default(),
            undelivered: Undelivered::default(),
            loss_causes: LossCauses::default(),
            first_seen: now,
            last_seen: now,
            opened: ModelTime::ZERO,
            waiting: None,
            presumed_lost: false,
            overdue: 0,
            recent: RecentLoss::default(),
            best_effort: false,
            is_filtered: false,
            uses_network: false,
            withheld: None,
            connection: None,
            counted_twice: 0,
        }
    }

    /// Allows fragmented samples that begin before `until` to be incomplete without a loss.
    pub const fn allow_incomplete(&mut self, until: ModelTime) {
        self.reception.allow_incomplete(until);
    }

    /// Returns the receiver of the samples.
    #[must_use]
    pub const fn receiver(&self) -> Receiver {
        self.receiver
    }

    /// Sets the participant of the receiver, once it is known.
    pub const fn identify(&mut self, prefix: GuidPrefix) {
        self.receiver = Receiver::Participant(prefix);
    }

    /// Sets the route of a receiver whose socket was unknown.
    pub const fn set_route(&mut self, route: Route) {
        self.receiver = Receiver::Route(route);
    }

    /// Returns the route by which new samples arrive.
    #[must_use]
    pub const fn main_route(&self) -> Route {
        self.main
    }

    /// Changes the route by which new samples arrive.
    pub const fn move_to(&mut self, route: Route) {
        self.main = route;
    }

    /// Returns the direction, outgoing or incoming.
    #[must_use]
    pub const fn direction(&self) -> Direction {
        self.main.direction
    }

    /// Returns the counts of samples.
    #[must_use]
    pub const fn tally(&self) -> &Delivered {
        &self.tally
    }

    /// Returns the times of the first and last observation.
    #[must_use]
    pub const fn seen(&self) -> (ModelTime, ModelTime) {
        (self.first_seen, self.last_seen)
    }

    /// Returns the highest sequence number known to exist, plus one.
    #[must_use]
    pub const fn next(&self) -> SequenceNumber {
        self.reception.sequence().next()
    }

    /// Returns whether this sample is known to exist but has not arrived.
    #[must_use]
    pub fn is_missing(&self, number: SequenceNumber) -> bool {
        let sequence = self.reception.sequence();
        sequence.started()
            && number >= sequence.first()
            && number < sequence.next()
            && !sequence.has(number)
    }

    /// Returns whether this sample has arrived.
    #[must_use]
    pub fn has(&self, number: SequenceNumber) -> bool {
        self.reception.sequence().has(number)
    }

    /// Records that this sample arrived by another route that may lead to the same receiver.
    pub fn know(&mut self, number: SequenceNumber, totals: &mut Totals) {
        self.reception.sequence_mut().know(number);
        if self.loss_causes.resolve(number) {
            self.tally.pending = self.tally.pending.saturating_sub(1);
            if self.withheld.is_none() {
                totals.received.pending = totals.received.pending.saturating_sub(1);
            }
        }
    }

    /// Records that a reader appeared, or that capture missed bytes. Gaps from before `at` are
    /// irrelevant.
    pub fn open(&mut self, at: ModelTime) {
        self.opened = self.opened.max(at);
    }

    /// Records that bytes for the receiver were not captured: samples missing before `at` are
    /// irrelevant, also those of which some fragments arrived.
    pub fn interrupt(&mut self, at: ModelTime) {
        self.open(at);
        self.reception.interrupt();
    }

    /// Sets whether all readers are best effort, and whether the writer applies a content filter of
    /// each. A missing sample without a known cause is then irrelevant, because the filter may have
    /// rejected it.
    pub const fn learn(&mut self, best_effort: bool, is_filtered: bool) {
        (self.best_effort, self.is_filtered) = (best_effort, is_filtered);
    }

    /// Returns whether the writer applies a content filter of each reader.
    #[must_use]
    pub const fn is_filtered(&self) -> bool {
        self.is_filtered
    }

    /// Records that the last reader is gone: samples after the last received one do not count as
    /// lost.
    pub fn close(&mut self, budget: &mut Budget) {
        (self.waiting, self.presumed_lost, self.overdue) = (None, false, 0);
        self.reception.close(budget);
    }

    /// Counts a sample that arrived although the receiver has no reader.
    pub const fn ignore(&mut self, totals: &mut Totals) {
        self.tally.unmatched += 1;
        totals.received.unmatched += 1;
    }

    /// Records a DATA or DATA_FRAG. Returns whether it is a duplicate, and the sample it completes.
    pub fn sample(
        &mut self,
        sample: &Sample,
        context: &mut DeliveryContext<'_>,
    ) -> (bool, Option<CompleteSample>) {
        self.note_seen(context.now);
        (self.waiting, self.presumed_lost, self.uses_network) = (None, false, true);
        self.connect(sample);
        if self.undelivered.is_empty() {
            return self.take(sample, context);
        }
        let (mut again, mut whole) = (false, None);
        let parts = self
            .undelivered
            .delivered(sample, &mut context.budget.evictions);
        for part in parts {
            let (came_again, completed) = self.take(&part, context);
            again |= came_again;
            whole = completed.or(whole);
        }
        (again, whole)
    }

    /// Records that the socket's buffer was full for this DATA or DATA_FRAG.
    pub fn socket_full(&mut self, sample: &Sample, context: &mut DeliveryContext<'_>) {
        self.note_seen(context.now);
        (self.waiting, self.presumed_lost, self.uses_network) = (None, false, true);
        if self.undelivered.note(sample) {
            context.budget.evictions += 1;
        }
        let number = sample.sequence_number;
        let is_tail = !sample.is_start() && number.0 > 1;
        let (reception, budget, mut accounting) = self.split(context);
        let is_confirmed = reception.recognise(sample, budget, &mut |decision| {
            accounting.take(decision);
        });
        if !is_confirmed {
            // The cause is kept in case later records confirm the number.
            let is_full = self
                .loss_causes
                .note(number, LossCause::SocketBuffer, context.now);
            context.budget.evictions += u64::from(is_full);
            return;
        }
        let sequence = self.reception.sequence_mut();
        sequence.begin(number.saturating_add(u64::from(is_tail)));
        self.record_cause(number, LossCause::SocketBuffer, context);
    }

    /// Records that the kernel failed to reassemble some IP fragments of this sample.
    pub fn not_reassembled(&mut self, number: SequenceNumber, context: &mut DeliveryContext<'_>) {
        self.uses_network = true;
        let sequence = self.reception.sequence();
        if !sequence.started() || number > sequence.next().saturating_add(MAX_TRUSTED_JUMP) {
            return;
        }
        if self.loss_causes.resolve(number) {
            self.split(context)
                .2
                .set_cause(LossCause::Reassembly, number);
            return;
        }
        self.record_cause(number, LossCause::Reassembly, context);
    }

    /// Records a HEARTBEAT for this receiver. A delivery without samples begins with it. While no
    /// sample arrives and none is requested, the samples may use shared memory.
    pub fn heartbeat(&mut self, heartbeat: &Heartbeat, context: &mut DeliveryContext<'_>) {
        self.note_seen(context.now);
        let end = heartbeat.last.next();
        let sequence = self.reception.sequence_mut();
        sequence.begin(end);
        sequence.expect_history(heartbeat.first);
        if !self.uses_network {
            return;
        }
        let sequence = self.reception.sequence();
        let before = (sequence.next(), sequence.last_advance());
        let known = sequence.available();
        let (reception, budget, mut accounting) = self.split(context);
        reception.heartbeat(heartbeat, budget, &mut |decision| {
            accounting.take(decision);
        });
        self.mark_unread_irrelevant(before);
        let sequence = self.reception.sequence();
        let source = sequence.source_around(known, sequence.available());
        self.note_given_up(source, context);
    }

    /// Records a GAP for this receiver.
    pub fn gap(&mut self, gap: &Gap, context: &mut DeliveryContext<'_>) {
        self.note_seen(context.now);
        self.note_given_up(self.source_around(gap), context);
        let (reception, budget, mut accounting) = self.split(context);
        reception.gap(gap, budget, &mut |decision| accounting.take(decision));
    }

    /// Records an ACKNACK in which a reader requests samples again.
    pub fn requested(&mut self, acknack: &AckNack) {
        let missing = acknack.missing;
        let sequence = self.reception.sequence_mut();
        let first = sequence.first();
        self.uses_network |= sequence.started() && missing.iter().any(|number| number >= first);
        sequence.requested(missing.iter());
    }

    /// Records that all readers have every sample below `base`.
    pub fn acknowledged(&mut self, base: SequenceNumber) {
        self.reception.sequence_mut().acknowledged(base);
    }

    /// Settles the samples for which the settle window is over.
    pub fn advance(&mut self, context: &mut DeliveryContext<'_>) {
        let (now, window) = (context.now, settle_window(self.is_reliable(context)));
        let (reception, budget, mut accounting) = self.split(context);
        // A sample that the writer withdrew is not retransmitted.
        let windows = (window, BEST_EFFORT_WINDOW);
        reception.advance(now, windows, budget, &mut |decision| {
            accounting.take(decision);
        });
        self.conclude(now, context);
        self.loss_causes
            .settled(self.reception.sequence().settled());
        self.undelivered.expire(now);
    }

    /// Returns the time from which [`Self::advance`] or [`Self::expect`] has an effect without an
    /// observation; [`ModelTime::MAX`] if never. `reliable` is that of the context.
    #[must_use]
    pub fn next_due(&self, reliable: bool) -> ModelTime {
        if self.waiting.is_some() {
            // Signs of life of the receiver decide.
            return ModelTime::ZERO;
        }
        let window = settle_window(reliable && !self.best_effort);
        let reception = self.reception.next_due((window, BEST_EFFORT_WINDOW));
        let causes = self.loss_causes.next_due();
        reception.min(causes).min(self.undelivered.next_expiry())
    }

    /// Settles all samples, including pending ones: the input has ended.
    pub fn settle(&mut self, context: &mut DeliveryContext<'_>) {
        let (reception, budget, mut accounting) = self.split(context);
        reception.settle(budget, &mut |decision| accounting.take(decision));
        self.conclude(ModelTime::MAX, context);
    }

    /// Merges `other`, which turned out to have the same receiver.
    pub fn absorb(&mut self, mut other: Self, context: &mut DeliveryContext<'_>) {
        let mut runs = self.loss_causes.due(ModelTime::MAX);
        runs.extend(other.loss_causes.due(ModelTime::MAX));
        // Long runs are not caused by single fragments, and no retransmission repairs them.
        let (long, short): (Vec<_>, Vec<_>) = runs
            .into_iter()
            .partition(|(first, last)| *last - *first > MIN_LONG_RUN);
        let pending: BTreeSet<SequenceNumber> = short
            .into_iter()
            .flat_map(|(first, last)| first.until(last.next()))
            .filter(|number| !self.has(*number) && !other.has(*number))
            .collect();
        self.counted_twice += other.counted_twice;
        self.tally.add(&other.tally);
        self.recent.absorb(&other.recent);
        let total = &mut context.totals.received.pending;
        *total = total.saturating_sub(std::mem::take(&mut self.tally.pending));
        self.loss_causes.absorb(other.loss_causes);
        self.first_seen = self.first_seen.min(other.first_seen);
        self.last_seen = self.last_seen.max(other.last_seen);
        self.opened = self.opened.max(other.opened);
        self.uses_network |= other.uses_network;
        let now = context.now;
        let settled = other.reception.sequence().settled();
        let (reception, budget, mut accounting) = self.split(context);
        for (first, last) in long {
            accounting.add_loss(LossCause::BeforeHost, first, last);
        }
        for number in pending {
            accounting.wait(number, number);
        }
        reception.absorb(other.reception, now, budget, &mut |decision| {
            accounting.take(decision);
        });
        // Decisions of the other delivery are final.
        let sequence = self.reception.sequence_mut();
        let settled = settled.min(sequence.next());
        sequence
            .settled()
            .until(settled)
            .for_each(|number| sequence.know(number));
    }

    /// Returns how many remembered samples have arrived both here and at `other`.
    #[must_use]
    pub fn count_common(&self, other: &Self) -> u64 {
        let sequence = self.reception.sequence();
        sequence.count_common(other.reception.sequence())
    }

    /// Counts this many messages as duplicates, because another delivery of the same receiver
    /// contains them.
    pub fn count_common_as_duplicates(&mut self, common: u64, context: &mut DeliveryContext<'_>) {
        let tally = &mut self.tally;
        let common = common.min(tally.messages);
        if common == 0 {
            return;
        }
        // The sizes of single samples are not kept.
        tally.bytes -= tally.bytes / tally.messages * common;
        tally.messages -= common;
        tally.recovered = tally.recovered.min(tally.messages);
        tally.history = tally.history.min(tally.messages);
        self.count(context, |tally| tally.duplicates += common);
        if self.withheld.is_none() {
            self.counted_twice += common;
        }
    }

    /// Notes the TCP connection of this sample, if it has one. Samples of an earlier connection may
    /// have been under way when it ended.
    fn connect(&mut self, sample: &Sample) {
        let head = &sample.head;
        let connection = (head.tcp_source_port, head.route());
        if head.tcp_source_port == 0 {
            self.connection = None;
        } else if self.connection.is_none_or(|(known, _)| known != connection) {
            let from = self.next().max(sample.sequence_number);
            self.connection = Some((connection, from));
        }
    }

    const fn is_reliable(&self, context: &DeliveryContext<'_>) -> bool {
        context.reliable && !self.best_effort
    }

    fn note_seen(&mut self, now: ModelTime) {
        self.last_seen = self.last_seen.max(now);
    }

    fn take(
        &mut self,
        sample: &Sample,
        context: &mut DeliveryContext<'_>,
    ) -> (bool, Option<CompleteSample>) {
        let (number, reliable) = (sample.sequence_number, self.is_reliable(context));
        self.restart(number, context);
        let sequence = self.reception.sequence();
        let is_sent = self.direction() == Direction::Sent;
        let source = sample.source_timestamp.timestamp();
        let is_late = self.is_missing(number) && number < sequence.settled();
        if !is_sent && is_late && !sequence.is_unconfirmed(number, source, MAX_TRUSTED_JUMP) {
            return self.late(sample, context);
        }
        let before = (sequence.next(), sequence.last_advance());
        let (reception, budget, mut accounting) = self.split(context);
        let outcome = reception.sample(sample, reliable, budget, &mut |decision| {
            accounting.take(decision);
        });
        self.mark_unread_irrelevant(before);
        match outcome {
            Outcome::Open => (false, None),
            Outcome::Duplicate => {
                // Several interfaces may show the same outgoing multicast.
                if !is_sent || !self.main.destination.is_multicast() {
                    self.count(context, |tally| tally.duplicates += 1);
                }
                (true, None)
            }
            Outcome::Complete(whole) => {
                self.whole(&whole, context);
                (false, Some(whole))
            }
        }
    }

    fn whole(&mut self, whole: &CompleteSample, context: &mut DeliveryContext<'_>) {
        let sequence = self.reception.sequence();
        let is_history = whole.number < sequence.first() && !whole.unconfirmed;
        let missed = sequence.missed_since(whole.number);
        let known_loss = self.loss_causes.forget(whole.number);
        let recovered = (whole.recovered || known_loss.is_some()) && !is_history;
        if !whole.is_message {
            return;
        }
        let mut waited = 0.0;
        let is_received = self.direction() == Direction::Received;
        // The last fragments of a sample may be lost without a gap.
        if is_received && !is_history && (recovered || !whole.newest) {
            self.note_repair(whole.source, context);
        }
        if recovered && is_received {
            let noticed = known_loss.map(|known_loss| known_loss.at).or(missed);
            let waited_for = noticed.map_or(whole.repaired_after, |noticed| {
                context.now.nanoseconds_since(noticed)
            });
            waited = seconds(waited_for);
            if self.withheld.is_none() {
                let breakdown = context.totals.breakdown.get_or_insert_default();
                breakdown.retransmission.observe(waited);
            }
        }
        let is_in_totals = self.counted_twice > 0;
        self.counted_twice = self.counted_twice.saturating_sub(1);
        let add = |tally: &mut Delivered| {
            tally.messages += 1;
            tally.bytes += whole.bytes;
            tally.history += u64::from(is_history);
            tally.recovered += u64::from(recovered);
            tally.recovery_seconds += waited;
        };
        match is_in_totals {
            true => add(&mut self.tally),
            false => self.count(context, add),
        }
    }

    /// Returns a time between those of the samples before and after one that the GAP withdraws and
    /// that the receiver misses. Returns `None` if it misses none of them.
    fn source_around(&self, gap: &Gap) -> Option<Timestamp> {
        let sequence = self.reception.sequence();
        let before_base = sequence.source_around(gap.start, gap.list.base);
        before_base.or_else(|| {
            let mut listed = gap.list.iter();
            listed.find_map(|number| sequence.source_around(number, number.next()))
        })
    }

    /// Returns the writer and the receiving participant, if the former sends samples again.
    fn repaired_pair(&self, context: &DeliveryContext<'_>) -> Option<(Guid, GuidPrefix)> {
        let is_repaired = self.direction() == Direction::Received && self.is_reliable(context);
        match self.receiver {
            Receiver::Participant(receiver) if is_repaired => Some((context.writer, receiver)),
            _ => None,
        }
    }

    /// Notes that the writer gave up a missed sample with about this source timestamp: the samples
    /// behind it waited until now.
    fn note_given_up(&self, source: Option<Timestamp>, context: &mut DeliveryContext<'_>) {
        if let Some(source) = source
            && let Some(pair) = self.repaired_pair(context)
        {
            let repairs = &mut context.journal.repairs;
            repairs.push_given_up(pair, source, context.now);
        }
    }

    /// Notes a retransmission of a message with this source timestamp.
    fn note_repair(&self, source: RtpsTime, context: &mut DeliveryContext<'_>) {
        if let Some(pair) = self.repaired_pair(context) {
            context.journal.repairs.push(pair, source, context.now);
        }
    }

    /// Handles a sample that arrives after it was settled as lost. A whole sample whose loss cause
    /// is still pending counts as recovered. Any other sample counts as a duplicate.
    fn late(
        &mut self,
        sample: &Sample,
        context: &mut DeliveryContext<'_>,
    ) -> (bool, Option<CompleteSample>) {
        let number = sample.sequence_number;
        let is_whole = matches!(sample.content, Content::Data { .. });
        if is_whole && self.loss_causes.resolve(number) {
            self.count(context, |tally| {
                tally.pending = tally.pending.saturating_sub(1);
                tally.messages += 1;
                tally.bytes += u64::from(sample.size());
                tally.recovered += 1;
            });
            self.reception.sequence_mut().know(number);
            self.note_repair(sample.source_timestamp, context);
            return (false, None);
        }
        if is_whole {
            self.reception.sequence_mut().know(number);
        }
        self.count(context, |tally| tally.duplicates += 1);
        (true, None)
    }

    /// Restarts the delivery after a long range of numbers that were not for this receiver.
    fn restart(&mut self, number: SequenceNumber, context: &mut DeliveryContext<'_>) {
        let sequence = self.reception.sequence();
        let is_far = number.steps_since(sequence.next()) > MAX_IRRELEVANT_AT_START;
        if sequence.started() && is_far && sequence.last_advance() < self.opened {
            let (reception, budget, mut accounting) = self.split(context);
            reception.settle(budget, &mut |decision| accounting.take(decision));
            self.reception = Reception::default();
        }
    }

    fn record_cause(
        &mut self,
        number: SequenceNumber,
        cause: LossCause,
        context: &mut DeliveryContext<'_>,
    ) {
        let sequence = self.reception.sequence();
        if sequence.has(number) || number < sequence.settled().max(sequence.first()) {
            return;
        }
        let now = context.now;
        self.exists(number, context);
        if self.loss_causes.note(number, cause, now) {
            context.budget.evictions += 1;
        }
    }

    fn exists(&mut self, number: SequenceNumber, context: &mut DeliveryContext<'_>) {
        let now = context.now;
        let (reception, budget, mut accounting) = self.split(context);
        reception.exists(number, now, budget, &mut |decision| {
            accounting.take(decision);
        });
    }

    /// Settles samples pending until `now` as lost before this host.
    fn conclude(&mut self, now: ModelTime, context: &mut DeliveryContext<'_>) {
        for (first, last) in self.loss_causes.due(now) {
            let (_, _, mut accounting) = self.split(context);
            accounting.conclude(first, last);
        }
    }

    fn count(&mut self, context: &mut DeliveryContext<'_>, change: impl Fn(&mut Delivered)) {
        change(&mut self.tally);
        if self.withheld.is_none() {
            change(context.totals.of(self.main.direction));
        }
    }

    /// Splits the borrow into the reception, its memory budget, and the accounting of decisions.
    fn split<'a>(
        &'a mut self,
        context: &'a mut DeliveryContext<'_>,
    ) -> (&'a mut Reception, &'a mut Budget, Accounting<'a>) {
        let window = settle_window(self.is_reliable(context));
        let timeout = reassembly_timeout(&self.main.destination);
        let until = context
            .reassembled
            .then(|| context.now + timeout.saturating_sub(window));
        let accounting = Accounting {
            tally: &mut self.tally,
            loss_causes: &mut self.loss_causes,
            totals: &mut context.totals.received,
            journal: context.journal,
            withheld: self.withheld.as_mut(),
            writer: context.writer,
            receiver: self.receiver,
            main: self.main,
            is_filtered: self.is_filtered,
            at: context.now,
            until,
            in_order_from: self
                .connection
                .map_or(SequenceNumber::MAX, |(_, from)| from),
        };
        (&mut self.reception, context.budget, accounting)
    }
}

#[expect(
    clippy::cast_precision_loss,
    reason = "nanoseconds of a delay stay exact to 104 days"
)]
pub(crate) fn seconds(nanoseconds: i64) -> f64 {
    nanoseconds.max(0) as f64 / 1e9
}
