//! Writers and readers in answers, with the QoS that they offer or request.

use std::borrow::Cow;

use super::index::Index;
use super::measured::measurement;
use crate::latched::latched;
use ros2probe_api::endpoints::{Endpoint, Process, Qos};
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::report::snapshot::{EndpointFacts, ProcessFacts};
use ros2probe_wire::qos::Ownership;
use ros2probe_wire::rtps::VendorId;

/// Returns the API representation of a writer or reader.
pub(super) fn endpoint<'a>(
    facts: &'a EndpointFacts,
    index: &Index<'a>,
    clock: WallClock,
) -> Endpoint<'a> {
    let (qos, measured) = (&facts.qos, facts.measurement.as_deref());
    let participant = index.participant(facts.guid);
    let enclave = participant.and_then(|participant| participant.enclave.as_deref());
    Endpoint {
        guid: facts.guid.to_string(),
        gid: facts.gid.iter().map(|byte| format!("{byte:02x}")).collect(),
        node: facts.node.as_deref().map(Cow::Borrowed),
        enclave: enclave.map(Cow::Borrowed),
        message_type: Cow::Borrowed(&facts.message_type),
        type_hash: facts.type_hash.map(|hash| Cow::Owned(hash.to_string())),
        equivalence_hash: facts
            .equivalence_hash
            .map(|hash| Cow::Owned(hash.to_string())),
        vendor: participant.map(|participant| vendor(participant.vendor)),
        qos: Qos {
            reliability: Cow::Borrowed(qos.reliability.label()),
            durability: Cow::Borrowed(qos.durability.label()),
            history: Cow::Owned(facts.history()),
            deadline_seconds: qos.deadline.seconds(),
            lifespan_seconds: qos.lifespan.seconds(),
            liveliness: Cow::Borrowed(qos.liveliness.label()),
            liveliness_lease_seconds: qos.liveliness_lease.seconds(),
            ownership: Cow::Borrowed(qos.ownership.label()),
            ownership_strength: (qos.ownership == Ownership::EXCLUSIVE
                && facts.guid.entity.is_writer())
            .then_some(qos.ownership_strength),
            partitions: texts(&qos.partitions),
        },
        backends: facts
            .backends
            .iter()
            .flat_map(|backends| backends.names())
            .map(Cow::Borrowed)
            .collect(),
        first_seen_timestamp_seconds: clock.wall_time(facts.first_seen).seconds(),
        measurement: measured.map(|facts| measurement(facts, clock)),
        clock: None,
        latched: facts.latched.map(latched),
        past_figures: None,
    }
}

/// Returns the known host and process of a participant.
pub(super) fn process(facts: &ProcessFacts) -> Process<'_> {
    Process {
        host: facts.host.as_deref().map(Cow::Borrowed),
        process_id: facts.id,
        process: facts.name.as_deref().map(Cow::Borrowed),
        cgroup: facts.cgroup.as_deref().map(Cow::Borrowed),
    }
}

/// Returns the name of a vendor, or its two bytes in hexadecimal.
pub(super) fn vendor(vendor: VendorId) -> Cow<'static, str> {
    match vendor.name() {
        Some(name) => Cow::Borrowed(name),
        None => Cow::Owned(vendor.to_string()),
    }
}

/// Borrows each text.
pub(super) fn texts<T: AsRef<str>>(texts: &[T]) -> Vec<Cow<'_, str>> {
    texts
        .iter()
        .map(|text| Cow::Borrowed(text.as_ref()))
        .collect()
}

/// Formats each value.
pub(super) fn printed<T: ToString>(values: &[T]) -> Vec<String> {
    values.iter().map(ToString::to_string).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ros2probe_testing::sample_robot;

    use super::*;

    #[test]
    fn only_publishers_with_exclusive_ownership_have_a_strength() {
        let snapshot = sample_robot::snapshot(["/points"]);
        let index = Index::new(&snapshot);
        let strength = |ownership: Ownership, kind: u8| {
            let mut facts = snapshot.topics[0].publishers[0].clone();
            facts.guid.entity.0[3] = kind;
            let qos = Arc::make_mut(&mut facts.qos);
            (qos.ownership, qos.ownership_strength) = (ownership, 8);
            let shown = endpoint(&facts, &index, WallClock::default());
            shown.qos.ownership_strength
        };
        assert_eq!(strength(Ownership::EXCLUSIVE, 3), Some(8));
        assert_eq!(strength(Ownership::SHARED, 3), None);
        assert_eq!(strength(Ownership::EXCLUSIVE, 4), None);
    }
}
