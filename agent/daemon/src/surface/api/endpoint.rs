//! Writers and readers as answers show them, with what they offer or ask for.

use std::borrow::Cow;

use super::index::Index;
use super::measured::measurement;
use ros2probe_api::endpoints::{Endpoint, Process, Qos};
use ros2probe_model::snapshot::{EndpointFacts, ProcessFacts};
use ros2probe_wire::Duration;
use ros2probe_wire::rtps::VendorId;

/// One writer or reader.
pub(super) fn endpoint<'a>(facts: &'a EndpointFacts, index: &Index<'a>) -> Endpoint<'a> {
    let qos = &facts.qos;
    let participant = index.participant(facts.guid);
    let enclave = participant.and_then(|participant| participant.enclave.as_deref());
    Endpoint {
        guid: facts.guid.to_string(),
        node: facts.node.as_deref().map(Cow::Borrowed),
        enclave: enclave.map(Cow::Borrowed),
        message_type: Cow::Borrowed(&facts.message_type),
        type_hash: facts.type_hash.map(|hash| Cow::Owned(hash.to_string())),
        vendor: participant.map(|participant| vendor(participant.vendor)),
        qos: Qos {
            reliability: Cow::Borrowed(qos.reliability.label()),
            durability: Cow::Borrowed(qos.durability.label()),
            history: Cow::Owned(facts.history()),
            deadline_seconds: seconds(qos.deadline),
            lifespan_seconds: seconds(qos.lifespan),
            liveliness: Cow::Borrowed(qos.liveliness.label()),
            liveliness_lease_seconds: seconds(qos.liveliness_lease),
            ownership: Cow::Borrowed(qos.ownership.label()),
            partitions: texts(&qos.partitions),
        },
        first_seen_timestamp_seconds: facts.first_seen.seconds(),
        measurement: facts.measurement.as_deref().map(measurement),
    }
}

/// Where something lives, as far as it is known.
pub(super) fn process(facts: &ProcessFacts) -> Process<'_> {
    Process {
        host: facts.host.as_deref().map(Cow::Borrowed),
        process_id: facts.id,
        process: facts.name.as_deref().map(Cow::Borrowed),
        cgroup: facts.cgroup.as_deref().map(Cow::Borrowed),
    }
}

/// A vendor in words, or its two bytes in hex.
pub(super) fn vendor(vendor: VendorId) -> Cow<'static, str> {
    match vendor.name() {
        Some(name) => Cow::Borrowed(name),
        None => Cow::Owned(vendor.to_string()),
    }
}

/// A duration in seconds; `None` if it never ends.
#[expect(clippy::cast_precision_loss, reason = "microseconds survive")]
pub(super) fn seconds(duration: Duration) -> Option<f64> {
    duration
        .nanoseconds()
        .map(|nanoseconds| nanoseconds as f64 / 1e9)
}

/// Texts of the snapshot, borrowed.
pub(super) fn texts<T: AsRef<str>>(texts: &[T]) -> Vec<Cow<'_, str>> {
    texts
        .iter()
        .map(|text| Cow::Borrowed(text.as_ref()))
        .collect()
}

/// Each as it is printed.
pub(super) fn printed<T: ToString>(values: &[T]) -> Vec<String> {
    values.iter().map(ToString::to_string).collect()
}
