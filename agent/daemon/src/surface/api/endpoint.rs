//! Writers and readers as answers show them, with what they offer or ask for.

use std::borrow::Cow;

use super::index::Index;
use super::measured::measurement;
use ros2probe_api::endpoints::{Endpoint, Process, Qos};
use ros2probe_model::snapshot::{EndpointFacts, ProcessFacts};

/// One writer or reader.
pub(super) fn endpoint<'a>(facts: &'a EndpointFacts, index: &Index<'a>) -> Endpoint<'a> {
    let participant = index.participant(facts.guid);
    let enclave = participant.and_then(|participant| participant.enclave.as_deref());
    Endpoint {
        guid: facts.guid.to_string(),
        node: facts.node.as_deref().map(Cow::Borrowed),
        enclave: enclave.map(Cow::Borrowed),
        message_type: Cow::Borrowed(&facts.message_type),
        type_hash: facts.type_hash.as_deref().map(Cow::Borrowed),
        vendor: participant.map(|participant| Cow::Borrowed(&*participant.vendor)),
        qos: Qos {
            reliability: Cow::Borrowed(&facts.reliability),
            durability: Cow::Borrowed(&facts.durability),
            history: Cow::Borrowed(&facts.history),
            deadline_seconds: seconds(facts.deadline_nanoseconds),
            lifespan_seconds: seconds(facts.lifespan_nanoseconds),
            liveliness: Cow::Borrowed(&facts.liveliness),
            liveliness_lease_seconds: seconds(facts.liveliness_lease_nanoseconds),
            ownership: Cow::Borrowed(facts.ownership),
            partitions: texts(&facts.partitions),
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

/// Nanoseconds as seconds.
#[expect(clippy::cast_precision_loss, reason = "microseconds survive")]
pub(super) fn seconds(nanoseconds: Option<u64>) -> Option<f64> {
    nanoseconds.map(|nanoseconds| nanoseconds as f64 / 1e9)
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
