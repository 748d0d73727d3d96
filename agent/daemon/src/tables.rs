//! Declarations of the daemon's bounded tables, which clients, viewers and robots can fill.

use ros2probe_model::facts::bounded::Rule::Oldest;

ros2probe_model::tables! {
    /// Events kept for streams and export
    KeptEvents { name: "events.kept", entries: 4096, rule: Oldest, reported: "`ros2probe_events_dropped_total`" }
    /// Tokens of pages
    PageTokens { name: "page.tokens", entries: 16, rule: Oldest, effect: "the oldest becomes invalid" }
    /// Connections of the `ros2` command line
    Ros2DaemonClients {
        name: "ros2_daemon.clients", entries: 16, effect: "the longest idle one is closed",
        reported: "`ros2probe_ros2_daemon_refused_total`",
    }
    /// Domains with a port as the ros2 daemon
    Ros2DaemonPorts {
        name: "ros2_daemon.ports", entries: 32, effect: "not answered", reported: "`ros2probe_ros2_daemon_ports`",
    }
    /// Writers that one stream of messages has described
    DescribedWriters { name: "samples.described", entries: 65_536, effect: "further ones are not described" }
    /// Losses of one subscription, by writer and reason, until its client reads them
    QueueLosses { name: "queue.losses", entries: 1024, effect: "counted with the last one" }
    /// Events that one stream has read and not sent
    StreamEvents { name: "events.stream", entries: 65, effect: "read from the log later" }
    /// Topics of one recording
    RecordedTopics { name: "recording.topics", entries: 2048, effect: "not recorded, and counted in the report" }
    /// Bytes of their names and types
    RecordedNames {
        name: "recording.names", entries: 256 << 10, effect: "not recorded, and counted in the report",
    }
    /// Writers of one topic of a recording
    RecordedWriters { name: "recording.topic.writers", entries: 256, effect: "recorded without their QoS" }
    /// Writers of one recording
    RecordingWriters { name: "recording.writers", entries: 2048, effect: "recorded without their QoS" }
    /// Channels for viewers
    ViewerChannels { name: "foxglove.channels", entries: 4096 }
    /// Subscriptions of one viewer
    ViewerSubscriptions { name: "foxglove.subscriptions", entries: 4096, effect: "closed with 1008" }
    /// Manifests of delivered bags, for the view of a fleet
    FleetManifests {
        name: "fleet.manifests", entries: 500, effect: "those of older bags are left out",
        reported: "`/fleet`",
    }
    /// Topics that one viewer's status of losses counts apart
    ViewerLosses { name: "foxglove.losses", entries: 64, effect: "only in the sum" }
}

#[cfg(test)]
pub(crate) mod tests {
    use ros2probe_model::facts::bounded::{Declared, ledger};

    /// Asserts that this test filled a table to its cap, and not beyond.
    pub(crate) fn assert_driven<D: Declared>() {
        let used = ledger()[D::TABLE.name];
        assert!(used.is_driven(), "{}: {used:?}", D::TABLE.name);
    }
}
