//! What to watch and what to expect of it: plain data, already checked.

/// One watchlist entry.
#[derive(Clone, Debug, PartialEq)]
pub struct Watch {
    /// Exact ROS name (`/points`) or glob: `*` within one token, `**` across tokens.
    pub pattern: String,
    /// Only this domain; `None` = every domain.
    pub domain_id: Option<u32>,
    /// What should hold.
    pub expectations: Expectations,
}

/// Limits on a topic; `None` = no opinion.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Expectations {
    /// At least this many messages a second.
    pub min_rate_hz: Option<f64>,
    /// At most this many messages a second.
    pub max_rate_hz: Option<f64>,
    /// Lost / (received + lost), 0 to 1.
    pub max_loss_ratio: Option<f64>,
    /// INFO_TS to capture, milliseconds.
    pub max_latency_ms: Option<f64>,
    /// Longest time without a message, seconds.
    pub max_silence_s: Option<f64>,
}
