//! `/clocks`: offsets between the clocks of hosts.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// The clocks of hosts.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Clocks<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Whether the agent compares clocks.
    pub is_on: bool,
    /// Hosts whose messages arrive here, sorted by address.
    pub peers: Vec<PeerClock<'a>>,
    /// Pairs of hosts with a known offset.
    pub offsets: Vec<ClockOffset<'a>>,
}

/// The clock of another host, compared with the clock of this host.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct PeerClock<'a> {
    /// Its name, or its address if it has none or another host has the same.
    pub peer: Cow<'a, str>,
    /// Its first announced address.
    #[cfg_attr(feature = "openapi", schema(example = "10.0.0.2"))]
    pub address: String,
    /// Seconds by which it is ahead at least; negative if it may be behind. `null` without recent
    /// messages.
    pub ahead_at_least_seconds: Option<f64>,
    /// Seconds by which it is ahead at most. `null` without evidence: the offset is unknown then.
    pub ahead_at_most_seconds: Option<f64>,
    /// Evidence for the upper bound: `reply` or `round_trip`.
    pub evidence: Option<Cow<'static, str>>,
    /// Steps of its clock, and contradictions in the evidence.
    pub steps: u64,
}

/// The offset between two clocks.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ClockOffset<'a> {
    /// The host whose clock is compared with; `localhost` is the agent's, if its name is unknown.
    pub host: Cow<'a, str>,
    /// The other host.
    pub peer: Cow<'a, str>,
    /// Seconds by which the peer's clock is ahead; negative if it is behind.
    pub offset_seconds: f64,
    /// The offset is wrong by at most this time.
    pub uncertainty_seconds: f64,
}
