//! Writers and readers, with their quality of service.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::latched::Latched;
use crate::measurement::Measurement;

/// A writer or reader.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Endpoint<'a> {
    /// GUID in the form that the metrics use.
    #[cfg_attr(
        feature = "openapi",
        schema(example = "010f2b7d6a474f3300000000.00001103")
    )]
    pub guid: String,
    /// Identity that ROS prints as GID, in hexadecimal: the GUID, or with Zenoh the hash of the
    /// endpoint's liveliness token.
    #[cfg_attr(
        feature = "openapi",
        schema(example = "010f2b7d6a474f330000000000001103")
    )]
    pub gid: String,
    /// Node of the endpoint, as its participant announces it; null when unknown.
    pub node: Option<Cow<'a, str>>,
    /// ROS enclave of the endpoint's participant; null if the participant does not use ROS.
    pub enclave: Option<Cow<'a, str>>,
    /// ROS type.
    pub message_type: Cow<'a, str>,
    /// RIHS01 hash of the type; null if the endpoint does not announce it (Humble).
    pub type_hash: Option<Cow<'a, str>>,
    /// Hash of the complete type in XTypes (`XTYPES_` and 28 digits), which Cyclone DDS 11 and Fast DDS 3
    /// announce; null if the endpoint does not announce it.
    pub equivalence_hash: Option<Cow<'a, str>>,
    /// Middleware of the endpoint's participant: the DDS implementation, or `Eclipse Zenoh`; null
    /// when unknown.
    pub vendor: Option<Cow<'a, str>>,
    /// Quality of service.
    pub qos: Qos<'a>,
    /// Unix time of the first announcement, in seconds.
    pub first_seen_timestamp_seconds: f64,
    /// Backends of buffers that it accepts, from Lyrical on: `cpu`, and others for which messages carry
    /// references, so that their data are not on the wire. Empty if its type has no buffers.
    #[cfg_attr(feature = "openapi", schema(example = json!(["cpu", "cuda"])))]
    pub backends: Vec<Cow<'a, str>>,
    /// Counts and times of this writer; null for readers and for topics that are not watched.
    pub measurement: Option<Measurement>,
    /// Clock of this writer's host, compared with that of the agent. Null for writers of the agent's
    /// host, without a measurement, and if clocks are not compared.
    pub clock: Option<WriterClock<'a>>,
    /// The last message of this writer, if it is transient local and the agent keeps such messages;
    /// null for readers and for other writers.
    pub latched: Option<Latched>,
    /// Figures of this writer at a moment in the past, as the history has them. Absent in the present,
    /// for readers, and for topics that were not watched.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub past_figures: Option<PastFigures>,
}

/// Figures of a writer at a moment in the past, rounded: a steady writer then changes nothing in the
/// history.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct PastFigures {
    /// Messages per second over the last window, with three digits; null if messages could not be
    /// observed.
    pub rate_hertz: Option<f64>,
    /// Payload bytes per second over the same window, with two digits; null if the sizes were unknown.
    pub bandwidth_bytes_per_second: Option<f64>,
    /// Lost messages divided by the messages that were sent, with two digits; null before the first
    /// message.
    pub loss_ratio: Option<f64>,
}

impl PastFigures {
    /// Returns the figures of a measurement that the history keeps.
    #[must_use]
    pub fn of(measured: &Measurement) -> Self {
        let bandwidth = measured.bandwidth_bytes_per_second;
        Self {
            rate_hertz: measured.rate_hertz.map(|rate| rounded(rate, 3)),
            bandwidth_bytes_per_second: bandwidth.map(|bandwidth| rounded(bandwidth, 2)),
            loss_ratio: measured.loss_ratio.map(|ratio| rounded(ratio, 2)),
        }
    }
}

/// Returns the number with this many significant digits that is nearest to `value`.
fn rounded(value: f64, digits: usize) -> f64 {
    let after_first = digits.saturating_sub(1);
    let text = format!("{value:.after_first$e}");
    text.parse().unwrap_or(value)
}

/// The clock of the host of a writer. The agent corrects latencies by it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct WriterClock<'a> {
    /// Name of the host, or its address.
    pub peer: Cow<'a, str>,
    /// Seconds that the agent adds to latencies of this writer: 0 if the clocks may agree, null while
    /// their offset is unknown.
    pub correction_seconds: Option<f64>,
    /// Greatest error of the corrected latencies.
    pub uncertainty_seconds: Option<f64>,
}

impl Endpoint<'_> {
    /// Returns the hash by which a definition of the type is found.
    #[must_use]
    pub fn definition_hash(&self) -> Option<&str> {
        let hash = self.type_hash.as_deref();
        hash.or(self.equivalence_hash.as_deref())
    }
}

/// Quality of service as announced. A null duration is infinite.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(missing_docs, reason = "policies of DDS, by their names")]
pub struct Qos<'a> {
    #[cfg_attr(feature = "openapi", schema(example = "RELIABLE"))]
    pub reliability: Cow<'a, str>,
    #[cfg_attr(feature = "openapi", schema(example = "VOLATILE"))]
    pub durability: Cow<'a, str>,
    /// `UNKNOWN` if the implementation does not announce it.
    #[cfg_attr(feature = "openapi", schema(example = "KEEP_LAST (10)"))]
    pub history: Cow<'a, str>,
    pub deadline_seconds: Option<f64>,
    pub lifespan_seconds: Option<f64>,
    #[cfg_attr(feature = "openapi", schema(example = "AUTOMATIC"))]
    pub liveliness: Cow<'a, str>,
    pub liveliness_lease_seconds: Option<f64>,
    #[cfg_attr(feature = "openapi", schema(example = "SHARED"))]
    pub ownership: Cow<'static, str>,
    /// Strength of a publisher with exclusive ownership; null for other endpoints.
    pub ownership_strength: Option<i32>,
    /// Partitions; empty for the default partition.
    pub partitions: Vec<Cow<'a, str>>,
}

/// Host and process of a participant. A null field is unknown.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Process<'a> {
    /// Host name, if the participant announces it.
    pub host: Option<Cow<'a, str>>,
    /// Id of the process that owns the participant's socket, or else the announced process id.
    pub process_id: Option<u32>,
    /// Process name.
    pub process: Option<Cow<'a, str>>,
    /// Path of the control group below the root; it identifies the container.
    pub cgroup: Option<Cow<'a, str>>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_of_the_past_have_few_digits() {
        for (value, three, two) in [
            (0.0, 0.0, 0.0),
            (9.999_6, 10.0, 10.0),
            (49.87, 49.9, 50.0),
            (123_456.7, 123_000.0, 120_000.0),
            (0.031_26, 0.031_3, 0.031),
        ] {
            let measured = Measurement {
                rate_hertz: Some(value),
                bandwidth_bytes_per_second: Some(value),
                loss_ratio: None,
                ..Measurement::default()
            };
            let expected = PastFigures {
                rate_hertz: Some(three),
                bandwidth_bytes_per_second: Some(two),
                loss_ratio: None,
            };
            assert_eq!(PastFigures::of(&measured), expected);
        }
    }
}
