//! Caps and times of the model.

use ros2probe_wire::time::SECOND;

use crate::limits::Limits;
use crate::payloads;

/// Caps and times.
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
    /// Writers that send without a known announcement.
    pub unknown_writers: usize,
    /// Receivers and destinations of all measured writers; likewise sockets.
    pub deliveries: usize,
    /// Entries of the kernel's interest map.
    pub interest: usize,
    /// Bytes for the bitmaps of fragmented samples.
    pub sample_bytes: usize,
    /// Bytes of samples that are put together for those who want them whole.
    pub payload_bytes: usize,
    /// Nanoseconds for which a topic without endpoints is still reported.
    pub topic_grace: u64,
    /// Nanoseconds after which the bytes of samples come at the latest once they are wanted.
    pub payload_delay: u64,
    /// Records say who sent: not so those of a capture file.
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
            topic_grace: 600 * SECOND,
            payload_delay: payloads::PAYLOAD_DELAY,
            directed: true,
        }
    }
}

impl Settings {
    /// With the caps of the configuration.
    #[must_use]
    pub fn with_limits(self, limits: &Limits) -> Self {
        Self {
            participants: limits.participants,
            endpoints: limits.endpoints,
            topics: limits.topics,
            unknown_writers: limits.unknown_writers,
            deliveries: limits.flows,
            // The other half is for what waits to be read.
            payload_bytes: limits.payload_bytes / 2,
            ..self
        }
    }
}
