//! What is counted of a writer, a topic and a delivery, and where samples spent their time. Plain
//! values that add up; the modules that count fill them.

use ros2probe_wire::Timestamp;

use super::histogram::Histogram;
use super::loss::LossCause;

/// What was counted while the topic was watched. Counters never go down while the topic lives.
#[derive(Clone, Debug, Default)]
pub struct Measurement {
    /// Samples received whole, each once.
    pub messages: u64,
    /// Their payload bytes, encapsulation included (as `ros2 topic bw` counts).
    pub bytes: u64,
    /// Samples settled as lost: a sequence gap that nothing excused or filled in time.
    pub lost: u64,
    /// Samples that filled a gap later, by retransmission or reordering.
    pub recovered: u64,
    /// Samples and fragments seen again.
    pub duplicates: u64,
    /// Samples whose fragments never became complete (also counted in `lost` once settled).
    pub incomplete: u64,
    /// Samples excused by GAP, by the ACKNACKs of readers that have them, or because the kernel did
    /// not know their writer yet.
    pub irrelevant: u64,
    /// Time of the last new sample.
    pub last_message: Option<Timestamp>,
    /// Messages a second over the last window; for people, never for rules.
    pub rate_hz: f64,
    /// Payload bytes a second over the same window.
    pub bandwidth: f64,
    /// Seconds between consecutive samples of one writer.
    pub interarrival: Histogram,
    /// Capture time minus INFO_TS, seconds. Needs synchronised clocks across hosts.
    pub source_latency: Histogram,
    /// Capture time minus `std_msgs/Header.stamp`, seconds, where the type begins with a header.
    pub header_latency: Histogram,
    /// Samples whose time lay after their capture time (clocks apart); not in the histograms.
    pub negative_latency: u64,
    /// Samples whose INFO_TS lies more than an hour before or after their capture time (a clock
    /// that was never set, or a forgery); not in the histograms.
    pub implausible_latency: u64,
    /// How often the writer's numbers left their run, and one record did not suffice to believe it.
    pub sequence_jumps: u64,
    /// Present when some of this was read from shared memory, which is a sampled view: messages are
    /// then counted by the span of their numbers, and times are those of the samples that were
    /// seen.
    pub sampled: Option<SampledFacts>,
}

/// How much a sampled view saw.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SampledFacts {
    /// Samples of which at least a part was seen.
    pub seen: u64,
    /// Samples that there were, by their sequence numbers.
    pub span: u64,
    /// How often so much time passed between two looks that something may have gone unnoticed.
    pub uncertain: u64,
}

/// Samples of one delivery, or of several. All but `pending` never go down.
///
/// `messages - history + lost() + irrelevant` are the sequence numbers that were decided since the
/// delivery's first sight; what is still awaited is not in it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Delivered {
    /// Samples that came (or left) whole, each once.
    pub messages: u64,
    /// Their payload bytes, encapsulation included.
    pub bytes: u64,
    /// Of `messages`: samples older than the first sight, as late joiners ask for.
    pub history: u64,
    /// Of `messages`: samples that came by retransmission.
    pub recovered: u64,
    /// Seconds from noticing the gap to its filling, summed over `recovered`.
    pub recovery_seconds: f64,
    /// Samples that arrived where it is known that no reader of the topic is: undelivered, and not
    /// in `messages`.
    pub unmatched: u64,
    /// Samples and fragments that came again; copies of one multicast on its way out do not count.
    pub duplicates: u64,
    /// Samples that the writer left out (GAP), that were written while no reader was here, or that
    /// its readers acknowledged although no copy was seen.
    pub irrelevant: u64,
    /// Samples that never reached this host.
    pub lost_before_host: u64,
    /// Samples that died in IP reassembly on this host.
    pub lost_in_reassembly: u64,
    /// Samples that died in the full receive buffer of the subscriber's socket.
    pub lost_in_socket_buffer: u64,
    /// Lost samples whose cause is not known yet: the kernel may still wait for IP fragments.
    pub pending: u64,
}

/// Where a writer's samples spent their time. Finer buckets than the other histograms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Breakdown {
    /// INFO_TS to the first datagram leaving this host, seconds.
    pub send_delay: Histogram,
    /// The last datagram of a sample leaving this host to its arrival at a socket of this host,
    /// seconds; one value per receiver.
    pub transit: Histogram,
    /// First to last datagram of a sample that came in several, seconds.
    pub transfer: Histogram,
    /// Noticing a gap to its filling by retransmission, seconds; one value per receiver.
    pub retransmission: Histogram,
}

impl Measurement {
    /// Adds all of `other`, as a topic adds up its writers.
    pub fn add(&mut self, other: &Self) {
        self.messages += other.messages;
        self.bytes += other.bytes;
        self.lost += other.lost;
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
        if let Some(other) = &other.sampled {
            let sampled = self.sampled.get_or_insert_default();
            sampled.seen += other.seen;
            sampled.span += other.span;
            sampled.uncertain += other.uncertain;
        }
    }
}

impl SampledFacts {
    /// Seen of those that there were; `None` while there were none.
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
    /// Samples that never came whole, whatever the cause. Never goes down.
    #[must_use]
    pub const fn lost(&self) -> u64 {
        self.lost_before_host + self.lost_in_reassembly + self.lost_in_socket_buffer + self.pending
    }

    /// Samples lost by this cause.
    #[must_use]
    pub const fn lost_by(&self, cause: LossCause) -> u64 {
        match cause {
            LossCause::BeforeHost => self.lost_before_host,
            LossCause::Reassembly => self.lost_in_reassembly,
            LossCause::SocketBuffer => self.lost_in_socket_buffer,
        }
    }

    /// Counts losses by this cause.
    pub const fn lose(&mut self, cause: LossCause, count: u64) {
        match cause {
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
        self.lost_before_host += other.lost_before_host;
        self.lost_in_reassembly += other.lost_in_reassembly;
        self.lost_in_socket_buffer += other.lost_in_socket_buffer;
        self.pending += other.pending;
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
