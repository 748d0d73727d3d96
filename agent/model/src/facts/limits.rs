//! Limits that an operator can set (`limits:`), each declared once: key, default, range, size of an
//! entry, effect when reached. The configuration's keys and schema, the documented table and the
//! metrics `ros2probe_limit*` derive from it. Caps that protect a parser or the kernel's memory are
//! constants in their modules and are listed in `docs/limits-*.md`.
//!
//! The defaults fit a Raspberry Pi 4 and `MemoryMax=` of the systemd unit. A test adds up the
//! memory that all limits together allow.

/// A limit of the configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Limit {
    /// DDS participants.
    Participants,
    /// Writers and readers.
    Endpoints,
    /// Topics that are measured.
    Topics,
    /// Watches of every origin.
    Watches,
    /// Active writers whose announcement was missed.
    UnknownWriters,
    /// Pairs of a writer and a receiver or destination.
    Flows,
    /// Bytes of datagrams that are being reassembled.
    ReassemblyBytes,
    /// Message streams and recordings.
    Subscriptions,
    /// Bytes of samples that are being reassembled or wait for subscriptions.
    PayloadBytes,
    /// Bags that the agent writes on request.
    Recordings,
    /// Connections to each listener of the API.
    ApiClients,
    /// Connections to the metrics listener.
    MetricsClients,
    /// Connections to the listener for viewers.
    FoxgloveClients,
}

/// Description of a limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Row {
    /// Its key below `limits`, and the label `limit`.
    pub key: &'static str,
    /// Default value.
    pub default: usize,
    /// Smallest and largest accepted value.
    pub range: (usize, usize),
    /// Unit of the entries.
    pub what: &'static str,
    /// Effect on further entries.
    pub reached: &'static str,
    /// Metric with more details than `ros2probe_limit_reached_total`; empty without one.
    pub metric: &'static str,
    /// Maximum memory per entry in bytes, for names of usual length, including two snapshots and
    /// two metrics pages; 1 if the limit counts bytes.
    pub bytes: usize,
}

/// The values of all limits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// DDS participants.
    pub participants: usize,
    /// Writers and readers.
    pub endpoints: usize,
    /// Topics that are measured.
    pub topics: usize,
    /// Watches of every origin.
    pub watches: usize,
    /// Active writers whose announcement was missed.
    pub unknown_writers: usize,
    /// Pairs of a writer and a receiver or destination.
    pub flows: usize,
    /// Bytes of datagrams that are being reassembled.
    pub reassembly_bytes: usize,
    /// Message streams and recordings.
    pub subscriptions: usize,
    /// Bytes of samples that are being reassembled or wait for subscriptions.
    pub payload_bytes: usize,
    /// Bags that the agent writes on request.
    pub recordings: usize,
    /// Connections to each listener of the API.
    pub api_clients: usize,
    /// Connections to the metrics listener.
    pub metrics_clients: usize,
    /// Connections to the listener for viewers.
    pub foxglove_clients: usize,
}

const PARTICIPANTS: Row = Row {
    key: "participants",
    default: 1_000,
    range: (1, 100_000),
    what: "DDS participants",
    reached: "a silent one makes room (silent for 5 s if it lived less than 2 s, else for 90 s), \
              or the one with the lowest priority for a newcomer with a higher one; otherwise \
              the newcomer is rejected",
    metric: "ros2probe_table_evictions_total",
    bytes: 2 << 10,
};
const ENDPOINTS: Row = Row {
    key: "endpoints",
    default: 8_192,
    range: (1, 1_000_000),
    what: "Writers and readers",
    reached: "a silent participant makes room with all its entries, or the entry with the lowest \
              priority for a newcomer with a higher one; otherwise the newcomer waits for a free \
              entry",
    metric: "ros2probe_table_evictions_total",
    bytes: 5_696,
};
const TOPICS: Row = Row {
    key: "topics",
    default: 1_000,
    range: (1, 100_000),
    what: "Measured topics with their own series",
    reached: "a vanished one makes room, or the latest one not watched by its exact name for one \
              that is; otherwise the newcomer is listed but not measured until an entry is free",
    metric: "ros2probe_topics_rejected_total",
    bytes: 16 << 10,
};
const WATCHES: Row = Row {
    key: "watches",
    default: 1_000,
    range: (1, 10_000),
    what: "Watches from the configuration, the command line and clients together",
    reached: "a client's watch is refused (409), and so is a configuration with more",
    metric: "",
    bytes: 1 << 10,
};
const UNKNOWN_WRITERS: Row = Row {
    key: "unknown_writers",
    default: 256,
    range: (1, 100_000),
    what: "Writers whose announcement was missed",
    reached: "one with fewer than 10 messages and none for 3 s makes room; otherwise the \
              newcomer is not tracked",
    metric: "ros2probe_table_evictions_total",
    bytes: 4 << 10,
};
const FLOWS: Row = Row {
    key: "flows",
    default: 4_096,
    range: (1, 1_000_000),
    what: "Pairs of a measured writer and one receiver, or one destination, of its \
           messages",
    reached: "pairs that were silent for 10 s make room; until then the newcomer is not tracked, \
              and its topic's own counts stay correct",
    metric: "ros2probe_table_evictions_total",
    bytes: 2 << 10,
};
const REASSEMBLY_BYTES: Row = Row {
    key: "reassembly_bytes",
    default: 4 << 20,
    range: (65_536, 1 << 30),
    what: "Bytes of captured datagrams with missing fragments",
    reached: "the oldest datagram is dropped",
    metric: "ros2probe_incomplete_datagrams_total",
    bytes: 1,
};
const SUBSCRIPTIONS: Row = Row {
    key: "subscriptions",
    default: 32,
    range: (1, 1_000),
    what: "Clients that receive single messages, recordings and snapshots",
    reached: "the next one is refused (503)",
    metric: "ros2probe_subscriptions_refused_total",
    bytes: 8 << 10,
};
const PAYLOAD_BYTES: Row = Row {
    key: "payload_bytes",
    default: 40 << 20,
    range: (1 << 20, 16 << 30),
    what: "Bytes of messages being assembled for them (one half), or waiting to be read (the \
           other)",
    reached: "the oldest message of the longest queue is dropped, or the least \
        complete one, and reported to its readers",
    metric: "ros2probe_missed_messages_total",
    bytes: 1,
};
const RECORDINGS: Row = Row {
    key: "recordings",
    default: 4,
    range: (1, 100),
    what: "Requested bags that the agent writes at the same time",
    reached: "the next one is refused (409)",
    metric: "",
    bytes: 6 << 20,
};
const API_CLIENTS: Row = Row {
    key: "api_clients",
    default: 64,
    range: (1, 10_000),
    what: "Connections to each listener of the control API",
    reached: "the connection that has been idle longest makes room; if none is idle, the next \
              one is answered 503 and closed",
    metric: "",
    bytes: 32 << 10,
};
const METRICS_CLIENTS: Row = Row {
    key: "metrics_clients",
    default: 32,
    range: (1, 10_000),
    what: "Connections to the metrics listener",
    reached: "the connection that has been idle longest makes room; if none is idle, the next \
              one is answered 503 and closed; with TLS it is closed",
    metric: "",
    bytes: 32 << 10,
};
const FOXGLOVE_CLIENTS: Row = Row {
    key: "foxglove_clients",
    default: 16,
    range: (1, 1_000),
    what: "Viewers connected over the Foxglove protocol",
    reached: "the next one is answered 503 and closed",
    metric: "ros2probe_foxglove_clients",
    bytes: 512 << 10,
};

impl Limit {
    /// All limits, in the order of their documentation.
    pub const ALL: [Self; 13] = [
        Self::Participants,
        Self::Endpoints,
        Self::Topics,
        Self::Watches,
        Self::UnknownWriters,
        Self::Flows,
        Self::ReassemblyBytes,
        Self::Subscriptions,
        Self::PayloadBytes,
        Self::Recordings,
        Self::ApiClients,
        Self::MetricsClients,
        Self::FoxgloveClients,
    ];

    /// Returns the description.
    #[must_use]
    pub const fn row(self) -> Row {
        match self {
            Self::Participants => PARTICIPANTS,
            Self::Endpoints => ENDPOINTS,
            Self::Topics => TOPICS,
            Self::Watches => WATCHES,
            Self::UnknownWriters => UNKNOWN_WRITERS,
            Self::Flows => FLOWS,
            Self::ReassemblyBytes => REASSEMBLY_BYTES,
            Self::Subscriptions => SUBSCRIPTIONS,
            Self::PayloadBytes => PAYLOAD_BYTES,
            Self::Recordings => RECORDINGS,
            Self::ApiClients => API_CLIENTS,
            Self::MetricsClients => METRICS_CLIENTS,
            Self::FoxgloveClients => FOXGLOVE_CLIENTS,
        }
    }

    /// Returns the key, which is also the label value.
    #[must_use]
    pub const fn key(self) -> &'static str {
        self.row().key
    }

    /// Returns whether reaching the limit hides a part of the robot.
    #[must_use]
    pub const fn hides_data(self) -> bool {
        matches!(
            self,
            Self::Participants
                | Self::Endpoints
                | Self::Topics
                | Self::UnknownWriters
                | Self::Flows
                | Self::ReassemblyBytes
        )
    }

    /// Returns the limit with this key.
    #[must_use]
    pub fn find(key: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|limit| limit.key() == key)
    }
}

impl Limits {
    /// Creates the limits from a function that returns the value of each.
    pub fn of(value: impl Fn(Limit) -> usize) -> Self {
        Self {
            participants: value(Limit::Participants),
            endpoints: value(Limit::Endpoints),
            topics: value(Limit::Topics),
            watches: value(Limit::Watches),
            unknown_writers: value(Limit::UnknownWriters),
            flows: value(Limit::Flows),
            reassembly_bytes: value(Limit::ReassemblyBytes),
            subscriptions: value(Limit::Subscriptions),
            payload_bytes: value(Limit::PayloadBytes),
            recordings: value(Limit::Recordings),
            api_clients: value(Limit::ApiClients),
            metrics_clients: value(Limit::MetricsClients),
            foxglove_clients: value(Limit::FoxgloveClients),
        }
    }

    /// Returns the value of one limit.
    #[must_use]
    pub const fn get(&self, limit: Limit) -> usize {
        match limit {
            Limit::Participants => self.participants,
            Limit::Endpoints => self.endpoints,
            Limit::Topics => self.topics,
            Limit::Watches => self.watches,
            Limit::UnknownWriters => self.unknown_writers,
            Limit::Flows => self.flows,
            Limit::ReassemblyBytes => self.reassembly_bytes,
            Limit::Subscriptions => self.subscriptions,
            Limit::PayloadBytes => self.payload_bytes,
            Limit::Recordings => self.recordings,
            Limit::ApiClients => self.api_clients,
            Limit::MetricsClients => self.metrics_clients,
            Limit::FoxgloveClients => self.foxglove_clients,
        }
    }

    /// Memory in addition to the limits, in bytes: the idle agent with its rings and the kernel's
    /// maps (14 MiB), stored events and two views. The history of measured topics and the channels
    /// of viewers are included.
    pub const CONSTANT_BYTES: usize = 33 << 20;

    /// Memory of Zenoh at its caps, in bytes. It consists of tables with a cap in bytes (42 MiB),
    /// messages in FRAGMENTs (20 MiB), and incomplete batches and waiting segments (20 MiB).
    pub const ZENOH_BYTES: usize = 82 << 20;

    /// Memory of the last messages of transient-local writers, in bytes: kept messages (16 MiB),
    /// incomplete ones (4 MiB), and the writers.
    pub const LATCHED_BYTES: usize = 21 << 20;

    /// Memory of calls inside processes at the caps of their tables, in bytes. Processes and
    /// handles, with late calls and copies in snapshots and pages, take 83 MiB, and the kernel's
    /// tables 12 MiB.
    pub const INSIDE_BYTES: usize = 95 << 20;

    /// Memory of types that nodes described, and of TypeObjects, in bytes: their definitions (8 MiB
    /// each), and responses that wait (2 MiB).
    pub const TYPE_BYTES: usize = 18 << 20;

    /// Memory of what the robot itself says, in bytes. Logs take 6 MiB, parameters and their
    /// changes 4 MiB, values of diagnostics and messages with fields 1 MiB each. The rest is for
    /// transforms, frames, stamps and states of nodes.
    pub const ROBOT_BYTES: usize = 14 << 20;

    /// Memory of the history on disk while a minute is written, in bytes: its rows and blocks (6
    /// MiB, ten minutes merged into steps included), and events (4 MiB).
    pub const HISTORY_BYTES: usize = 10 << 20;

    /// Returns the memory in bytes that all limits together allow.
    #[must_use]
    pub fn bytes(&self) -> usize {
        let each = |limit: Limit| self.get(limit).saturating_mul(limit.row().bytes);
        Limit::ALL
            .into_iter()
            .map(each)
            .fold(0, usize::saturating_add)
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self::of(|limit| limit.row().default)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_limit_has_its_key_and_a_default_within_its_range() {
        let numbers = Limits::of(|limit| limit as usize);
        for (place, limit) in Limit::ALL.into_iter().enumerate() {
            assert_eq!((limit as usize, numbers.get(limit)), (place, place));
            assert_eq!(Limit::find(limit.key()), Some(limit));
            let Row { default, range, .. } = limit.row();
            assert!((range.0..=range.1).contains(&default), "{limit:?}");
        }
        assert_eq!(Limit::find("clouds"), None);
    }
}
