//! Which samples of one writer came whole at one place: on this host at all, or at one receiver.
//!
//! Puts sequence numbers and fragments together: a sample in fragments is there when all of them
//! are, a late fragment does not reopen it, and what stays away is decided once. It counts nothing;
//! what it finds is for the caller to count.

use ros2probe_wire::record::{self, DataFrag, Gap, Heartbeat};
use ros2probe_wire::{RtpsTime, SequenceNumber, Timestamp};

use super::samples::{Budget, Facts, Progress, Samples};
use super::sequence::{Arrival, REACH, RepairMode, RunMembership, Sequence, Settled};
use super::size::Size;

/// A fragment that completes its sample this late after the sample's last one was retransmitted.
const REPAIR: i64 = 5_000_000;
/// Numbers below the newest whose fragments a sampled view still waits for.
const UNDER_WAY: u64 = 8;

/// State of one writer's samples at one place.
#[derive(Debug, Default)]
pub struct Reception {
    sequence: Sequence,
    samples: Samples,
}

/// A sample that is complete.
#[derive(Clone, Copy, Debug)]
pub struct Whole {
    /// Its sequence number.
    pub number: SequenceNumber,
    /// Payload bytes, encapsulation included.
    pub bytes: u64,
    /// Not a disposal: those take a sequence number and are no message.
    pub is_message: bool,
    /// It was retransmitted.
    pub recovered: bool,
    /// It is the newest so far, so its delay is a delivery delay and not a repetition's.
    pub newest: bool,
    /// Its number is not believed to be the writer's.
    pub unconfirmed: bool,
    /// INFO_TS.
    pub source: RtpsTime,
    /// What lies where a header's stamp would.
    pub stamp: Option<(i32, u32)>,
    /// Its first datagram.
    pub began: Timestamp,
    /// Its last missing fragment came this long after its last fragment number, nanoseconds.
    pub repaired_after: i64,
}

/// What a record did.
#[derive(Clone, Copy, Debug)]
pub enum Outcome {
    /// It completed a sample.
    Whole(Whole),
    /// It brought nothing that had not come before.
    Duplicate,
    /// Something is missing still, or it was of no use.
    Open,
}

/// What became of samples that stayed away.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Decision {
    /// They never came.
    Lost {
        /// The first.
        first: SequenceNumber,
        /// The last.
        last: SequenceNumber,
        /// Fragments of it came; then it is one sample.
        incomplete: bool,
    },
    /// The writer will not send it.
    Irrelevant(SequenceNumber),
}

impl Reception {
    /// Entries, or bytes, and cap of every list.
    pub fn sizes(&self) -> impl Iterator<Item = Size> {
        // A new list does not compile before it has a place here.
        let Self { sequence, samples } = self;
        sequence.sizes().into_iter().chain(samples.sizes())
    }

    /// The numbers.
    #[must_use]
    pub const fn sequence(&self) -> &Sequence {
        &self.sequence
    }

    /// The numbers.
    pub const fn sequence_mut(&mut self) -> &mut Sequence {
        &mut self.sequence
    }

    /// Whether fragments of this sample came and others are missing.
    #[must_use]
    pub fn is_partial(&self, number: SequenceNumber) -> bool {
        self.samples.is_partial(number)
    }

    /// Takes in a DATA_FRAG of a view in which samples may be missing: whether it completes its
    /// sample. Samples far below it are waited for no longer, unless it is `unconfirmed`.
    pub fn assemble(
        &mut self,
        fragments: DataFrag<'_>,
        unconfirmed: bool,
        budget: &mut Budget,
    ) -> bool {
        if !unconfirmed {
            let oldest = fragments.sequence_number().saturating_sub(UNDER_WAY);
            self.samples.forget_below(oldest, budget);
        }
        let now = Timestamp(fragments.record().time);
        let progress = self.samples.fragment(fragments, now, budget);
        matches!(progress, Progress::Complete(_))
    }

    /// Moves what the unfinished samples take from one budget to another.
    pub fn transfer(&self, from: &mut Budget, to: &mut Budget) {
        self.samples.transfer(from, to);
    }

    /// Samples in fragments that begin before this are no loss when they stay incomplete: the
    /// kernel did not know the writer yet, and what it hands over of unknown writers is limited.
    pub const fn allow_incomplete(&mut self, until: Timestamp) {
        self.samples.allow_incomplete(until);
    }

    /// Takes in a DATA or DATA_FRAG of a writer that retransmits, or does not.
    pub fn sample(
        &mut self,
        sample: record::Sample<'_>,
        reliable: bool,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) -> Outcome {
        if !self.recognise(sample, budget, decide) {
            return self.unconfirmed(sample, budget);
        }
        match sample {
            record::Sample::Data(_) => self.data(sample, reliable, budget, decide),
            record::Sample::DataFrag(fragments) => {
                self.fragment(fragments, reliable, budget, decide)
            }
        }
    }

    /// Whether the number of this DATA or DATA_FRAG is believed to be the writer's.
    pub fn recognise(
        &mut self,
        sample: record::Sample<'_>,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) -> bool {
        let number = sample.sequence_number();
        let now = Timestamp(sample.record().time);
        let source = sample.source_timestamp().timestamp();
        let Self { sequence, samples } = self;
        match sequence.recognise(number, source, REACH, now) {
            RunMembership::Live => true,
            RunMembership::Unconfirmed { .. } => false,
            RunMembership::Confirmed(run) => {
                sequence.accept(&run, now, &mut |settled| {
                    decide(decision(settled, samples, budget));
                });
                true
            }
        }
    }

    /// Takes in a HEARTBEAT.
    pub fn heartbeat(
        &mut self,
        heartbeat: Heartbeat<'_>,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) {
        let (first, last) = (heartbeat.first(), heartbeat.last());
        let now = Timestamp(heartbeat.record().time);
        let Self { sequence, samples } = self;
        sequence.heartbeat(first, last, now, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
    }

    /// Takes in a GAP.
    pub fn gap(&mut self, gap: Gap<'_>, budget: &mut Budget, decide: &mut impl FnMut(Decision)) {
        let (start, list) = (gap.start(), gap.list());
        let now = Timestamp(gap.record().time);
        let Self { sequence, samples } = self;
        sequence.gap(start, list.base, list.iter(), now, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
    }

    /// This sample exists, whether it came or not.
    pub fn exists(
        &mut self,
        number: SequenceNumber,
        now: Timestamp,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) {
        let Self { sequence, samples } = self;
        sequence.exists(number, now, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
    }

    /// Takes over what `other` received; `other`'s unfinished samples are given up.
    pub fn absorb(
        &mut self,
        mut other: Self,
        now: Timestamp,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) {
        other.samples.clear(budget);
        let Self { sequence, samples } = self;
        sequence.absorb(&other.sequence, now, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
    }

    /// Another view takes over: samples of which a part came are its, and no losses. Their numbers.
    pub fn abandon(&mut self) -> Vec<SequenceNumber> {
        let mut partial = Vec::new();
        for number in self.sequence.settled().until(self.sequence.next()) {
            if self.samples.is_partial(number) && !self.sequence.has(number) {
                self.sequence.know(number);
                partial.push(number);
            }
        }
        partial
    }

    /// Nobody is there any more for what has not come since the last sample that came.
    pub fn close(&mut self, budget: &mut Budget) {
        let sequence = &mut self.sequence;
        for number in sequence.settled().until(sequence.next()).rev() {
            if sequence.has(number) {
                return;
            }
            self.samples.forget(number, budget);
            sequence.excuse(number, number.next());
        }
    }

    /// Decides what has been open for `window` nanoseconds, and what the writer withdrew `grace`
    /// nanoseconds ago.
    pub fn advance(
        &mut self,
        now: Timestamp,
        (window, grace): (u64, u64),
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) {
        let Self { sequence, samples } = self;
        let hold = samples.growing(now, window, sequence.settled());
        sequence.advance(now, (window, grace), hold, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
        samples.expire(now, 2 * window, budget);
    }

    /// Decides everything: nothing more will come.
    pub fn settle(&mut self, budget: &mut Budget, decide: &mut impl FnMut(Decision)) {
        let Self { sequence, samples } = self;
        sequence.settle_all(&mut |settled| decide(decision(settled, samples, budget)));
        samples.clear(budget);
    }

    fn data(
        &mut self,
        sample: record::Sample<'_>,
        reliable: bool,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) -> Outcome {
        let number = sample.sequence_number();
        let repair_mode = if reliable {
            RepairMode::Reliable
        } else {
            RepairMode::BestEffort
        };
        let now = Timestamp(sample.record().time);
        let Self { sequence, samples } = self;
        let arrival = sequence.receive(number, repair_mode, now, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
        samples.forget(number, budget);
        let Arrival::New { recovered, newest } = arrival else {
            return Outcome::Duplicate;
        };
        Outcome::Whole(Whole {
            recovered,
            newest,
            ..whole_data(sample)
        })
    }

    /// Takes in a DATA or DATA_FRAG whose number is not believed.
    fn unconfirmed(&mut self, sample: record::Sample<'_>, budget: &mut Budget) -> Outcome {
        let number = sample.sequence_number();
        let now = Timestamp(sample.record().time);
        if self.sequence.has_unconfirmed(number) {
            return Outcome::Duplicate;
        }
        let whole = match sample {
            record::Sample::DataFrag(fragments) => {
                match self.samples.fragment(fragments, now, budget) {
                    Progress::Complete(facts) => whole_fragments(sample, &facts),
                    Progress::Duplicate => return Outcome::Duplicate,
                    _ => return Outcome::Open,
                }
            }
            record::Sample::Data(_) => whole_data(sample),
        };
        self.sequence.complete_unconfirmed(number);
        Outcome::Whole(Whole {
            newest: false,
            unconfirmed: true,
            ..whole
        })
    }

    fn fragment(
        &mut self,
        fragments: DataFrag<'_>,
        reliable: bool,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) -> Outcome {
        let number = fragments.sequence_number();
        let now = Timestamp(fragments.record().time);
        // Sequence numbers are signed (RTPS 2.5, 9.3.2): beyond is none.
        if self.sequence.has(number) || number > SequenceNumber::MAX {
            return Outcome::Duplicate;
        }
        let progress = self.samples.fragment(fragments, now, budget);
        match progress {
            Progress::Rejected => return Outcome::Open,
            Progress::Duplicate => return Outcome::Duplicate,
            Progress::TooMany => {
                self.sequence.begin(number);
                self.exists(number, now, budget, decide);
                self.sequence.excuse(number, number.next());
                return Outcome::Open;
            }
            Progress::Partial | Progress::Complete(_) => {}
        }
        // A sample that is joined in the middle does not count as one that was sent; the writer's
        // first one cannot be.
        let joined = u64::from(fragments.starting() != 1 && number.0 > 1);
        self.sequence.begin(number.saturating_add(joined));
        self.exists(number, now, budget, decide);
        let Progress::Complete(facts) = progress else {
            return Outcome::Open;
        };
        let repair_mode = if reliable {
            RepairMode::ReliableFragments
        } else {
            RepairMode::BestEffort
        };
        let Self { sequence, samples } = self;
        let arrival = sequence.receive(number, repair_mode, now, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
        let Arrival::New { recovered, .. } = arrival else {
            return Outcome::Open;
        };
        let repaired = reliable && facts.repaired_after >= REPAIR;
        Outcome::Whole(Whole {
            recovered: recovered || repaired,
            ..whole_fragments(record::Sample::DataFrag(fragments), &facts)
        })
    }
}

const fn whole_data(sample: record::Sample<'_>) -> Whole {
    Whole {
        number: sample.sequence_number(),
        bytes: sample.size() as u64,
        is_message: sample.is_message(),
        recovered: false,
        newest: true,
        unconfirmed: false,
        source: sample.source_timestamp(),
        stamp: sample.header_stamp(),
        began: Timestamp(sample.record().time),
        repaired_after: 0,
    }
}

const fn whole_fragments(sample: record::Sample<'_>, facts: &Facts) -> Whole {
    Whole {
        bytes: facts.size as u64,
        source: facts.source,
        stamp: facts.stamp,
        began: facts.began,
        repaired_after: facts.repaired_after,
        ..whole_data(sample)
    }
}

fn decision(settled: Settled, samples: &mut Samples, budget: &mut Budget) -> Decision {
    let (first, last) = match settled {
        Settled::Lost(number) | Settled::Irrelevant(number) if samples.is_doubtful(number) => {
            samples.forget(number, budget);
            return Decision::Irrelevant(number);
        }
        Settled::Lost(number) => (number, number),
        Settled::LostRun(start, end) => (start, end.previous()),
        // A sample of which fragments came was sent: no excuse holds.
        Settled::Irrelevant(number) if samples.is_partial(number) => (number, number),
        Settled::Irrelevant(number) => return Decision::Irrelevant(number),
    };
    Decision::Lost {
        first,
        last,
        incomplete: samples.forget(first, budget),
    }
}
