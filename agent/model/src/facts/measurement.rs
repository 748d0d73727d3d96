//! Counts of a writer, a topic and a delivery, and the time that samples spent in each stage. All
//! are plain values that can be added; the measuring modules fill them.

use crate::facts::histogram::Histogram;
use crate::facts::loss::LossCause;
use crate::facts::loss_share::LossShare;
use crate::facts::model_time::ModelTime;

/// Counts and times while the topic was watched. Counters never decrease while the topic exists.
#[derive(Clone, Debug, Default)]
pub struct Measurement {
    /// Samples received whole, without duplicates.
    pub messages: u64,
    /// Payload bytes of all messages, including encapsulation (as `ros2 topic bw` counts).
    pub bytes: u64,
    /// Samples settled as lost: a gap that was neither irrelevant nor filled in time.
    pub lost: u64,
    /// Samples that the worst subscriber expected and lost; for a writer, those that did not reach
    /// this host.
    pub loss: LossShare,
    /// Samples that filled a gap late, by retransmission or reordering.
    pub recovered: u64,
    /// Samples and fragments received more than once.
    pub duplicates: u64,
    /// Samples whose fragments never became complete (also in `lost` once settled).
    pub incomplete: u64,
    /// Samples irrelevant by GAP, by ACKNACKs of readers that have them, or because the kernel did
    /// not know their writer yet.
    pub irrelevant: u64,
    /// Time of the last new sample.
    pub last_message: Option<ModelTime>,
    /// Messages per second over the last window, for display only; rules use counters.
    pub rate_hz: f64,
    /// Payload bytes per second over the same window.
    pub bandwidth: f64,
    /// Seconds between consecutive samples of one writer.
    pub interarrival: Histogram,
    /// Capture time minus INFO_TS in seconds, corrected by the known offset between the clocks of
    /// both hosts.
    pub source_latency: Histogram,
    /// Capture time minus `std_msgs/Header.stamp` in seconds, if the type begins with a header.
    pub header_latency: Histogram,
    /// Samples with a timestamp after their capture (clocks differ); not in the histograms.
    pub negative_latency: u64,
    /// Samples with an INFO_TS more than an hour before or after their capture (a clock that was
    /// never set, or a forgery); not in the histograms.
    pub implausible_latency: u64,
    /// Jumps of the sequence number that a single record suggests but does not prove.
    pub sequence_jumps: u64,
    /// Part of `messages`, `bytes` and `lost` that belongs to seconds before the one in which it
    /// was added. Figures per second omit it.
    pub earlier: EarlierCounts,
    /// Present if some samples were read from shared memory. Messages are then counted by the span
    /// of their numbers, and times come from the samples that were read.
    pub sampled: Option<SampledFacts>,
}

/// Counts that were added late: those from before a writer's announcement, and samples in shared
/// memory that were sent while it was not polled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EarlierCounts {
    /// Messages.
    pub messages: u64,
    /// Their payload bytes.
    pub bytes: u64,
    /// Samples settled as lost.
    pub lost: u64,
}

/// Coverage of shared-memory sampling.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SampledFacts {
    /// Samples of which at least a part was read.
    pub seen: u64,
    /// Samples that were written, by their sequence numbers.
    pub span: u64,
    /// Number of polling gaps so long that a sample may have been missed unnoticed.
    pub uncertain: u64,
}

/// Samples of one or several deliveries. No field except `pending` and `awaited` ever decreases.
///
/// `messages - history + lost() + irrelevant` is the number of samples that were decided since the
/// delivery began. `awaited` is the number of samples that are not yet decided.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Delivered {
    /// Samples that arrived (or left) whole, without duplicates.
    pub messages: u64,
    /// Payload bytes of all messages, including encapsulation.
    pub bytes: u64,
    /// Part of `messages`: samples older than the delivery, as late joiners request them.
    pub history: u64,
    /// Part of `messages`: samples that arrived by retransmission.
    pub recovered: u64,
    /// Time from detecting a gap to filling it in seconds, summed over `recovered`.
    pub recovery_seconds: f64,
    /// Samples that arrived at a process known to have no reader of the topic. They are not
    /// delivered and not in `messages`.
    pub unmatched: u64,
    /// Samples and fragments that arrived more than once, without copies of an outgoing multicast.
    pub duplicates: u64,
    /// Samples that the writer skipped (GAP), that were written while this receiver had no reader,
    /// or that its readers acknowledged although no copy was seen. Also missing samples that the
    /// writer may have rejected by the readers' content filters.
    pub irrelevant: u64,
    /// Samples that the sender dropped before its TCP connection.
    pub lost_at_sender: u64,
    /// Samples that never reached this host.
    pub lost_before_host: u64,
    /// Samples that failed IP reassembly on this host.
    pub lost_in_reassembly: u64,
    /// Samples that the full receive buffer of the subscriber's socket dropped.
    pub lost_in_socket_buffer: u64,
    /// Lost samples whose cause is unknown so far: the kernel may still wait for IP fragments.
    pub pending: u64,
    /// Missing samples that may still arrive, and are not in any other count.
    pub awaited: u64,
}

/// Time that a writer's samples spent in each stage, in histograms with finer buckets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Breakdown {
    /// From INFO_TS to the first datagram leaving this host, in seconds.
    pub send_delay: Histogram,
    /// From the last datagram leaving this host to the sample's arrival at a socket of this host,
    /// in seconds; one value per receiver.
    pub transit: Histogram,
    /// From the first to the last datagram of a sample that needs several, in seconds.
    pub transfer: Histogram,
    /// From detecting a gap to filling it by retransmission, in seconds; one value per receiver.
    pub retransmission: Histogram,
}

impl Measurement {
    /// Adds all of `other`, to sum the writers of a topic.
    pub fn add(&mut self, other: &Self) {
        self.messages += other.messages;
        self.bytes += other.bytes;
        self.lost += other.lost;
        self.loss.add(other.loss);
        self.recovered += other.recovered;
        self.duplicates += other.duplicates;
        self.incomplete += other.incomplete;
        self.irrelevant += other.irrelevant;
        self.last_message = self.last_message.max(other.last_message);
        self.rate_hz += other.rate_hz;
        self.bandwidth += other.bandwidth;
        self.interarrival.merge(&other.interarrival);
        self.source_latency.merge(&other.source_latency);
        self.header_latency.merge(&other.header_latency);
        self.negative_latency += other.negative_latency;
        self.implausible_latency += other.implausible_latency;
        self.sequence_jumps += other.sequence_jumps;
        self.earlier.messages += other.earlier.messages;
        self.earlier.bytes += other.earlier.bytes;
        self.earlier.lost += other.earlier.lost;
        if let Some(other) = &other.sampled {
            let sampled = self.sampled.get_or_insert_default();
            sampled.seen += other.seen;
            sampled.span += other.span;
            sampled.uncertain += other.uncertain;
        }
    }
}

impl SampledFacts {
    /// Returns samples read divided by samples written, or `None` before the first sample.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "a ratio of counts far below 2^52"
    )]
    pub fn coverage(&self) -> Option<f64> {
        (self.span > 0).then(|| self.seen as f64 / self.span as f64)
    }
}

impl Delivered {
    /// Returns the number of samples that never arrived whole, for any cause. Never decreases.
    #[must_use]
    pub const fn lost(&self) -> u64 {
        self.lost_at_sender
            + self.lost_before_host
            + self.lost_in_reassembly
            + self.lost_in_socket_buffer
            + self.pending
    }

    /// Returns the number of lost samples whose cause is known.
    #[must_use]
    pub const fn lost_by_any(&self) -> u64 {
        self.lost() - self.pending
    }

    /// Returns the number of missing samples that may still arrive, or whose cause is unknown.
    #[must_use]
    pub const fn open(&self) -> u64 {
        self.pending + self.awaited
    }

    /// Returns the number of samples lost by this cause.
    #[must_use]
    pub const fn lost_by(&self, cause: LossCause) -> u64 {
        match cause {
            LossCause::Sender => self.lost_at_sender,
            LossCause::BeforeHost => self.lost_before_host,
            LossCause::Reassembly => self.lost_in_reassembly,
            LossCause::SocketBuffer => self.lost_in_socket_buffer,
        }
    }

    /// Adds losses by this cause.
    pub const fn add_lost(&mut self, cause: LossCause, count: u64) {
        match cause {
            LossCause::Sender => self.lost_at_sender += count,
            LossCause::BeforeHost => self.lost_before_host += count,
            LossCause::Reassembly => self.lost_in_reassembly += count,
            LossCause::SocketBuffer => self.lost_in_socket_buffer += count,
        }
    }

    /// Adds all of `other`.
    pub fn add(&mut self, other: &Self) {
        self.messages += other.messages;
        self.bytes += other.bytes;
        self.history += other.history;
        self.recovered += other.recovered;
        self.recovery_seconds += other.recovery_seconds;
        self.unmatched += other.unmatched;
        self.duplicates += other.duplicates;
        self.irrelevant += other.irrelevant;
        self.lost_at_sender += other.lost_at_sender;
        self.lost_before_host += other.lost_before_host;
        self.lost_in_reassembly += other.lost_in_reassembly;
        self.lost_in_socket_buffer += other.lost_in_socket_buffer;
        self.pending += other.pending;
        self.awaited += other.awaited;
    }
}

impl Default for Breakdown {
    fn default() -> Self {
        Self {
            send_delay: Histogram::fine(),
            transit: Histogram::fine(),
            transfer: Histogram::fine(),
            retransmission: Histogram::default(),
        }
    }
}

impl Breakdown {
    /// Adds all of `other`.
    pub fn add(&mut self, other: &Self) {
        self.send_delay.merge(&other.send_delay);
        self.transit.merge(&other.transit);
        self.transfer.merge(&other.transfer);
        self.retransmission.merge(&other.retransmission);
    }
}
