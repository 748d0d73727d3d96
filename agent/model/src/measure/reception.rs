//! Samples of one writer that arrived whole at one point: this host, or one receiver.
//!
//! Combines sequence numbers and fragments: a fragmented sample is complete with its last fragment,
//! a late fragment does not reopen it, and each missing sample is decided once. The caller counts
//! the results.

use std::time::Duration;

use ros2probe_wire::{RtpsTime, SequenceNumber};

use crate::facts::model_time::ModelTime;
use crate::facts::observation::{Content, DataFrag, Gap, Heartbeat, Sample};
use crate::measure::samples::{Budget, Facts, Progress, Samples};
use crate::measure::sequence::{
    Arrival, MAX_TRUSTED_JUMP, RepairMode, RunMembership, Sequence, Settled,
};

/// Minimum nanoseconds from the last fragment number to the completing fragment that indicate a
/// retransmission.
const MIN_REPAIR_DELAY: i64 = 5_000_000;
/// Number of samples before the newest one for whose fragments a sampled view still waits.
const PENDING_SAMPLES: u64 = 8;

/// State of one writer's samples at one point.
#[derive(Debug, Default)]
pub struct Reception {
    sequence: Sequence,
    samples: Samples,
}

/// A complete sample.
#[derive(Clone, Copy, Debug)]
pub struct CompleteSample {
    /// Its sequence number.
    pub number: SequenceNumber,
    /// Payload bytes, including encapsulation.
    pub bytes: u64,
    /// False for a disposal, which has a sequence number but is not a message.
    pub is_message: bool,
    /// Whether it was retransmitted.
    pub recovered: bool,
    /// Whether it is the newest so far; otherwise its delay may include a retransmission.
    pub newest: bool,
    /// Whether its number is not confirmed as the writer's.
    pub unconfirmed: bool,
    /// INFO_TS of the sample.
    pub source: RtpsTime,
    /// The bytes at the position of a header's stamp.
    pub stamp: Option<(i32, u32)>,
    /// Time of its first datagram.
    pub began: ModelTime,
    /// Nanoseconds from the arrival of the last fragment number to that of the last missing
    /// fragment.
    pub repaired_after: i64,
}

/// Result of an observation.
#[derive(Clone, Copy, Debug)]
pub enum Outcome {
    /// It completed a sample.
    Complete(CompleteSample),
    /// It is a duplicate.
    Duplicate,
    /// The sample is still incomplete, or the observation was not usable.
    Open,
}

/// A decision about missing samples.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Decision {
    /// The samples never arrived.
    Lost {
        /// First sequence number.
        first: SequenceNumber,
        /// Last sequence number.
        last: SequenceNumber,
        /// Whether some fragments arrived; the run is then a single sample.
        incomplete: bool,
    },
    /// The writer will not send the sample.
    Irrelevant(SequenceNumber),
}

impl Reception {
    /// Returns the sequence numbers.
    #[must_use]
    pub const fn sequence(&self) -> &Sequence {
        &self.sequence
    }

    /// Returns the sequence numbers.
    pub const fn sequence_mut(&mut self) -> &mut Sequence {
        &mut self.sequence
    }

    /// Returns whether this sample has some but not all of its fragments.
    #[must_use]
    pub fn is_partial(&self, number: SequenceNumber) -> bool {
        self.samples.is_partial(number)
    }

    /// Adds a DATA_FRAG of a sampled view. Returns whether it completes its sample. The wait for
    /// samples far below it ends, unless it is `unconfirmed`.
    pub fn assemble(
        &mut self,
        sample: &Sample,
        fragments: DataFrag,
        unconfirmed: bool,
        budget: &mut Budget,
    ) -> bool {
        if !unconfirmed {
            let oldest = sample.sequence_number.saturating_sub(PENDING_SAMPLES);
            self.samples.forget_below(oldest, budget);
        }
        let progress = self.samples.fragment(sample, fragments, budget);
        matches!(progress, Progress::Complete(_))
    }

    /// Moves the memory of unfinished samples from one budget to another.
    pub fn transfer(&self, from: &mut Budget, to: &mut Budget) {
        self.samples.transfer(from, to);
    }

    /// Allows fragmented samples that begin before `until` to be incomplete without a loss: the
    /// kernel did not know the writer yet and limits captures of unknown writers.
    pub const fn allow_incomplete(&mut self, until: ModelTime) {
        self.samples.allow_incomplete(until);
    }

    /// Records that bytes between fragments were not captured.
    pub fn interrupt(&mut self) {
        self.samples.interrupt();
    }

    /// Processes a DATA or DATA_FRAG. `reliable` states whether the writer retransmits.
    pub fn sample(
        &mut self,
        sample: &Sample,
        reliable: bool,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) -> Outcome {
        if !self.recognise(sample, budget, decide) {
            return self.unconfirmed(sample, budget);
        }
        match sample.content {
            Content::Data { .. } => self.data(sample, reliable, budget, decide),
            Content::DataFrag(fragments) => {
                self.fragment(sample, fragments, reliable, budget, decide)
            }
        }
    }

    /// Returns whether the number of this DATA or DATA_FRAG is confirmed as the writer's.
    pub fn recognise(
        &mut self,
        sample: &Sample,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) -> bool {
        let (number, now) = (sample.sequence_number, sample.head.at);
        let source = sample.source_timestamp.timestamp();
        let Self { sequence, samples } = self;
        match sequence.recognise(number, source, MAX_TRUSTED_JUMP, now) {
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

    /// Processes a HEARTBEAT.
    pub fn heartbeat(
        &mut self,
        heartbeat: &Heartbeat,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) {
        let Heartbeat { head, first, last } = *heartbeat;
        let Self { sequence, samples } = self;
        sequence.heartbeat(first, last, head.at, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
    }

    /// Processes a GAP.
    pub fn gap(&mut self, gap: &Gap, budget: &mut Budget, decide: &mut impl FnMut(Decision)) {
        let Gap { head, start, list } = *gap;
        let Self { sequence, samples } = self;
        sequence.gap(start, list.base, list.iter(), head.at, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
    }

    /// Records that this sample exists, whether it arrived or not.
    pub fn exists(
        &mut self,
        number: SequenceNumber,
        now: ModelTime,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) {
        let Self { sequence, samples } = self;
        sequence.exists(number, now, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
    }

    /// Merges the samples that `other` received. The unfinished samples of `other` are dropped.
    pub fn absorb(
        &mut self,
        mut other: Self,
        now: ModelTime,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) {
        other.samples.clear(budget);
        let Self { sequence, samples } = self;
        sequence.absorb(&other.sequence, now, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
    }

    /// Hands over to another view. Returns the numbers of unfinished samples, which do not count as
    /// lost here.
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

    /// Drops all unfinished samples.
    pub fn discard(&mut self, budget: &mut Budget) {
        self.samples.clear(budget);
    }

    /// Marks all samples after the last one that arrived irrelevant, because the receiver is gone.
    pub fn close(&mut self, budget: &mut Budget) {
        let sequence = &mut self.sequence;
        for number in sequence.settled().until(sequence.next()).rev() {
            if sequence.has(number) {
                return;
            }
            self.samples.forget(number, budget);
            sequence.mark_irrelevant(number, number.next());
        }
    }

    /// Decides samples that have been open for `window`, and samples that the writer withdrew
    /// `grace` ago.
    pub fn advance(
        &mut self,
        now: ModelTime,
        (window, grace): (Duration, Duration),
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) {
        let Self { sequence, samples } = self;
        let hold = samples.lowest_growing(now, window, sequence.settled());
        sequence.advance(now, (window, grace), hold, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
        samples.expire(now, 2 * window, budget);
    }

    /// Returns the time from which [`Self::advance`] has an effect without an observation;
    /// [`ModelTime::MAX`] if never.
    #[must_use]
    pub fn next_due(&self, (window, grace): (Duration, Duration)) -> ModelTime {
        let numbers = self.sequence.next_due((window, grace));
        numbers.min(self.samples.next_expiry(2 * window))
    }

    /// Decides all samples up to the highest number known to exist.
    pub fn settle_known(&mut self, budget: &mut Budget, decide: &mut impl FnMut(Decision)) {
        let Self { sequence, samples } = self;
        sequence.settle_all(&mut |settled| decide(decision(settled, samples, budget)));
    }

    /// Decides all samples at the end of the input.
    pub fn settle(&mut self, budget: &mut Budget, decide: &mut impl FnMut(Decision)) {
        self.settle_known(budget, decide);
        self.samples.clear(budget);
    }

    fn data(
        &mut self,
        sample: &Sample,
        reliable: bool,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) -> Outcome {
        let (number, now) = (sample.sequence_number, sample.head.at);
        let repair_mode = if reliable {
            RepairMode::Reliable
        } else {
            RepairMode::BestEffort
        };
        let Self { sequence, samples } = self;
        let arrival = sequence.receive(number, repair_mode, now, &mut |settled| {
            decide(decision(settled, samples, budget));
        });
        samples.forget(number, budget);
        let Arrival::New { recovered, newest } = arrival else {
            return Outcome::Duplicate;
        };
        Outcome::Complete(CompleteSample {
            recovered,
            newest,
            ..whole_data(sample)
        })
    }

    /// Processes a DATA or DATA_FRAG whose number is not confirmed.
    fn unconfirmed(&mut self, sample: &Sample, budget: &mut Budget) -> Outcome {
        let number = sample.sequence_number;
        if self.sequence.has_unconfirmed(number) {
            return Outcome::Duplicate;
        }
        let whole = match sample.content {
            Content::DataFrag(fragments) => {
                match self.samples.fragment(sample, fragments, budget) {
                    Progress::Complete(facts) => whole_fragments(sample, &facts),
                    Progress::Duplicate => return Outcome::Duplicate,
                    _ => return Outcome::Open,
                }
            }
            Content::Data { .. } => whole_data(sample),
        };
        self.sequence.complete_unconfirmed(number);
        Outcome::Complete(CompleteSample {
            newest: false,
            unconfirmed: true,
            ..whole
        })
    }

    fn fragment(
        &mut self,
        sample: &Sample,
        fragments: DataFrag,
        reliable: bool,
        budget: &mut Budget,
        decide: &mut impl FnMut(Decision),
    ) -> Outcome {
        let (number, now) = (sample.sequence_number, sample.head.at);
        // Sequence numbers are signed (RTPS 2.5, 9.3.2), so larger values are invalid.
        if self.sequence.has(number) || number > SequenceNumber::MAX {
            return Outcome::Duplicate;
        }
        let progress = self.samples.fragment(sample, fragments, budget);
        match progress {
            Progress::Rejected => return Outcome::Open,
            Progress::Duplicate => return Outcome::Duplicate,
            Progress::TooMany => {
                self.sequence.begin(number);
                self.exists(number, now, budget, decide);
                self.sequence.mark_irrelevant(number, number.next());
                return Outcome::Open;
            }
            Progress::Partial | Progress::Complete(_) => {}
        }
        // The first captured sample does not count as sent if its first fragments were missed,
        // except for number 1.
        let joined = u64::from(fragments.starting != 1 && number.0 > 1);
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
        let repaired = reliable && facts.repaired_after >= MIN_REPAIR_DELAY;
        Outcome::Complete(CompleteSample {
            recovered: recovered || repaired,
            ..whole_fragments(sample, &facts)
        })
    }
}

fn whole_data(sample: &Sample) -> CompleteSample {
    CompleteSample {
        number: sample.sequence_number,
        bytes: sample.size().into(),
        is_message: sample.is_message(),
        recovered: false,
        newest: true,
        unconfirmed: false,
        source: sample.source_timestamp,
        stamp: sample.header_stamp,
        began: sample.head.began(),
        repaired_after: 0,
    }
}

fn whole_fragments(sample: &Sample, facts: &Facts) -> CompleteSample {
    CompleteSample {
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
        // A sample with fragments was sent, so it is not irrelevant.
        Settled::Irrelevant(number) if samples.is_partial(number) => (number, number),
        Settled::Irrelevant(number) => return Decision::Irrelevant(number),
    };
    Decision::Lost {
        first,
        last,
        incomplete: samples.forget(first, budget),
    }
}
