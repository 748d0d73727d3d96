//! Capacities and times of the model.

use std::time::Duration;

use crate::derive::robot::Parts;
use crate::facts::limits::Limits;
use crate::measure::payloads;

/// Capacities and times of the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Participants.
    pub participants: usize,
    /// Endpoints.
    pub endpoints: usize,
    /// Nodes.
    pub nodes: usize,
    /// Topics that are measured.
    pub topics: usize,
    /// Active writers whose announcement was missed.
    pub unknown_writers: usize,
    /// Receivers and destinations of all measured writers; also the cap for sockets.
    pub deliveries: usize,
    /// Entries of the kernel's interest map.
    pub interest: usize,
    /// Bytes for the bitmaps of fragmented samples.
    pub sample_bytes: usize,
    /// Bytes of samples that are reassembled for subscriptions.
    pub payload_bytes: usize,
    /// Time for which a topic without endpoints stays in snapshots.
    pub topic_grace: Duration,
    /// Maximum time from a request for payloads to the first captured payload.
    pub payload_delay: Duration,
    /// Time without a reply after which a call of a service is reported as hanging.
    pub service_timeout: Duration,
    /// Whether the last message of each transient-local writer is kept even if no watch requests
    /// it.
    pub keeps_latched: bool,
    /// What is read of what the robot itself says.
    pub robot: Parts,
    /// Whether records contain the direction of datagrams; those of a capture file do not.
    pub directed: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            participants: 1024,
            endpoints: 16_384,
            nodes: 4096,
            topics: 1000,
            unknown_writers: 256,
            deliveries: 4096,
            interest: 16_384,
            sample_bytes: 1 << 20,
            payload_bytes: 20 << 20,
            topic_grace: Duration::from_secs(600),
            payload_delay: payloads::PAYLOAD_DELAY,
            service_timeout: Duration::from_secs(5),
            keeps_latched: true,
            robot: Parts::ALL,
            directed: true,
        }
    }
}

impl Settings {
    /// Returns the defaults with these limits of the configuration.
    #[must_use]
    pub fn with_limits(self, limits: &Limits) -> Self {
        Self {
            participants: limits.participants,
            endpoints: limits.endpoints,
            topics: limits.topics,
            unknown_writers: limits.unknown_writers,
            deliveries: limits.flows,
            // The other half is for messages that wait for subscriptions.
            payload_bytes: limits.payload_bytes / 2,
            ..self
        }
    }
}
