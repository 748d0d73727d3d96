//! `/replay`: how the replay of a capture goes on.

use serde::{Deserialize, Serialize};

/// Position and pace of a replay.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema), schema(as = ReplayState))]
#[serde(default)]
pub struct ReplayState {
    /// Unix time of the first packet; null before it has been read.
    pub begin_timestamp_seconds: Option<f64>,
    /// Unix time that the replay has reached, by the clock of the capture.
    pub timestamp_seconds: f64,
    /// Share of the file that was read, 0 to 1; null if it is unknown.
    pub read_ratio: Option<f64>,
    /// Whether the replay has reached its end.
    pub is_finished: bool,
    /// Whether it stands still.
    pub is_paused: bool,
    /// Multiple of the speed of the capture; 0 = without waiting.
    pub speed: f64,
    /// Whether it goes on without waiting, to a requested time or the next event.
    pub is_jumping: bool,
}

/// A change of the pace. A field that is missing changes nothing.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ReplayRequest {
    /// Whether the replay stands still.
    pub is_paused: Option<bool>,
    /// Multiple of the speed of the capture; 0 = without waiting.
    #[cfg_attr(
        feature = "openapi",
        schema(minimum = 0, maximum = 1000, example = 2.0)
    )]
    pub speed: Option<f64>,
    /// Unix time in the capture to which the replay goes without waiting. It cannot go back.
    #[cfg_attr(feature = "openapi", schema(example = 1_790_000_000))]
    pub to_timestamp_seconds: Option<f64>,
    /// Whether the replay goes to the next event without waiting, and pauses there. Events of
    /// participants and endpoints do not count.
    pub to_next_event: bool,
}
