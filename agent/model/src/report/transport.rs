//! Transports between a writer and a reader, as far as both announce them: the network, or a
//! transport within their host that the network does not show.
//!
//! The result is the transport that they would use if they match.

use std::time::Duration;

use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{Guid, GuidPrefix};

use crate::facts::model_time::ModelTime;
use crate::graph::discovery::{Discovery, Endpoint};
use crate::report::snapshot::{EndpointFacts, Transport, TransportCount};

/// Maximum number of pairs examined per topic; the others are assumed to be alike.
const MAX_PAIRS: usize = 1024;
/// Time in which a participant that uses ROS announces its nodes, and the node of an endpoint.
const NODES_WITHIN: Duration = Duration::from_secs(30);
const NODE_WITHIN: Duration = Duration::from_secs(10);

/// Counts the pairs of these writers and readers by transport: all pairs, and those with both ends
/// in observed processes. Sets the transports of each endpoint.
pub(crate) fn transports(
    discovery: &Discovery,
    writers: &mut [EndpointFacts],
    readers: &mut [EndpointFacts],
    is_observed: impl Fn(Guid) -> bool,
) -> (Vec<TransportCount>, Vec<TransportCount>) {
    let none = Transport::ALL.map(|transport| TransportCount {
        transport,
        pairs: 0,
    });
    let (mut counts, mut observed) = (none, none);
    let mut left = MAX_PAIRS;
    for writer in writers.iter_mut() {
        for reader in readers.iter_mut().take(left) {
            left -= 1;
            let Some(transport) = transport(discovery, writer.guid, reader.guid) else {
                continue;
            };
            writer.transports |= transport.bit();
            reader.transports |= transport.bit();
            let both = is_observed(writer.guid) && is_observed(reader.guid);
            for (list, counts_here) in [(&mut counts, true), (&mut observed, both)] {
                let count = list.iter_mut().find(|count| count.transport == transport);
                if let Some(count) = count.filter(|_| counts_here) {
                    count.pairs += 1;
                }
            }
        }
    }
    if left == 0 {
        let all = readers
            .iter()
            .fold(0, |all, reader| all | reader.transports);
        let unseen = writers.iter_mut().chain(readers);
        for endpoint in unseen.filter(|endpoint| endpoint.transports == 0) {
            endpoint.transports = all;
        }
    }
    let shown =
        |counts: [TransportCount; 6]| counts.into_iter().filter(|count| count.pairs > 0).collect();
    (shown(counts), shown(observed))
}

/// Returns whether a participant on this writer's host may receive its samples through Fast DDS's
/// shared memory. The participant need not be a known reader.
pub(crate) fn may_share_memory(discovery: &Discovery, writer: Guid) -> bool {
    let participants = discovery.participants();
    let own = participants.get(&writer.prefix);
    if vendor(discovery, writer.prefix) != VendorId::EPROSIMA {
        return false;
    }
    own.is_none_or(|own| own.proxy.shared_memory)
        && participants.iter().any(|(prefix, other)| {
            *prefix != writer.prefix
                && other.proxy.shared_memory
                && is_one_host(discovery, VendorId::EPROSIMA, *prefix, writer.prefix)
        })
}

/// Returns whether all samples of this writer pass through Fast DDS's shared memory, which is
/// polled. Some of these readers then receive there, and none on the network.
pub(crate) fn is_polled(discovery: &Discovery, writer: Guid, readers: &[Guid]) -> bool {
    let mut is_shared = false;
    for reader in readers.iter().take(MAX_PAIRS) {
        match transport(discovery, writer, *reader) {
            Some(Transport::SharedMemory) => is_shared = true,
            Some(transport) if transport.is_network() => return false,
            _ => {}
        }
    }
    is_shared
}

/// Returns whether names are missing that shared memory may contain at present: nodes of a
/// participant, or the node of an endpoint.
pub(crate) fn has_missing_names(discovery: &Discovery, now: ModelTime) -> bool {
    let is_new = |first_seen: ModelTime, within: Duration| first_seen + within > now;
    let participants = discovery.participants();
    participants.values().any(|participant| {
        participant.proxy.shared_memory
            && participant.nodes.is_empty()
            && is_new(participant.first_seen, NODES_WITHIN)
    }) || discovery.endpoints().iter().any(|(guid, endpoint)| {
        is_new(endpoint.first_seen, NODE_WITHIN)
            && participants
                .get(&guid.prefix)
                .is_some_and(|participant| participant.proxy.shared_memory)
    })
}

/// Returns the transport between this writer and this reader; `None` if one is unknown, or if they
/// have no protocol in common.
pub(crate) fn transport(discovery: &Discovery, writer: Guid, reader: Guid) -> Option<Transport> {
    let endpoints = discovery.endpoints();
    let (of_writer, of_reader) = (endpoints.get(&writer)?, endpoints.get(&reader)?);
    if writer.prefix.is_zenoh() != reader.prefix.is_zenoh() {
        return None;
    }
    if is_one_process(discovery, writer.prefix, reader.prefix) {
        return Some(Transport::SameProcess);
    }
    let (vendor, other) = (
        vendor(discovery, writer.prefix),
        vendor(discovery, reader.prefix),
    );
    let participants = discovery.participants();
    let receives_by_tcp = || {
        let participant = participants.get(&reader.prefix);
        let default = participant.is_some_and(|known| known.proxy.tcp);
        of_reader.tcp.unwrap_or(default)
    };
    let network = || match receives_by_tcp() {
        true => Transport::Tcp,
        false => Transport::Network,
    };
    if vendor != other {
        return Some(network());
    }
    let shared_memory = |guid: Guid, endpoint: &Endpoint| {
        let participant = participants.get(&guid.prefix);
        let default = participant.is_some_and(|known| known.proxy.shared_memory);
        endpoint.shared_memory.unwrap_or(default)
    };
    let within_host = if of_writer.data_sharing && of_reader.data_sharing {
        Transport::DataSharing
    } else if !(shared_memory(writer, of_writer) && shared_memory(reader, of_reader)) {
        return Some(network());
    } else if vendor == VendorId::EPROSIMA {
        if is_another_generation(discovery, writer.prefix, reader.prefix) {
            return Some(network());
        }
        Transport::SharedMemory
    } else {
        Transport::Iceoryx
    };
    match is_one_host(discovery, vendor, writer.prefix, reader.prefix) {
        true => Some(within_host),
        false => Some(network()),
    }
}

/// Returns the implementation of a participant.
pub(crate) fn vendor(discovery: &Discovery, prefix: GuidPrefix) -> VendorId {
    let participant = discovery.participants().get(&prefix);
    let [first, second, ..] = prefix.0;
    participant.map_or(VendorId([first, second]), |known| known.proxy.vendor)
}

/// Returns whether both prefixes belong to one participant or process. Fast DDS stores vendor, host
/// and process in the first eight bytes. The fifth and sixth contain the process id, the next two
/// random bits.
fn is_one_process(discovery: &Discovery, one: GuidPrefix, other: GuidPrefix) -> bool {
    one == other
        || vendor(discovery, one) == VendorId::EPROSIMA
            && vendor(discovery, other) == VendorId::EPROSIMA
            && one.0.first_chunk::<8>() == other.0.first_chunk::<8>()
}

/// Returns whether the shared memory of both participants of Fast DDS has different formats: the
/// kind of its locator contains the major version, so that 2 and 3 use the network. Versions before
/// 3.0 are not announced.
fn is_another_generation(discovery: &Discovery, one: GuidPrefix, other: GuidPrefix) -> bool {
    let participants = discovery.participants();
    let generation = |prefix| {
        let version = &participants.get(&prefix)?.proxy.product_version;
        version.as_deref().unwrap_or("2").split('.').next()
    };
    let known = generation(one).zip(generation(other));
    known.is_some_and(|(one, other)| one != other)
}

/// Returns whether both participants consider each other to be on one host. Fast DDS compares the
/// host's part of its locators of shared memory, which is that of the prefixes, too: the first four
/// bytes hold vendor and host. It announces an id of the machine since 3.2, and does not compare it
/// for this. Others announce no host, so participants without a common address are on two, unless
/// both send from this host. Only participants that announce shared memory are compared.
fn is_one_host(
    discovery: &Discovery,
    vendor: VendorId,
    one: GuidPrefix,
    other: GuidPrefix,
) -> bool {
    let participants = discovery.participants();
    if vendor != VendorId::EPROSIMA {
        let ends = participants.get(&one).zip(participants.get(&other));
        return ends.is_none_or(|(one, other)| {
            one.local && other.local || !one.addresses.are_apart(&other.addresses)
        });
    }
    one.0.first_chunk::<4>() == other.0.first_chunk::<4>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::graph::discovery::Caps;

    fn prefix(bytes: [u8; 12]) -> GuidPrefix {
        GuidPrefix(bytes)
    }

    #[test]
    fn a_fast_dds_prefix_contains_host_and_process_and_others_do_not() {
        let discovery = Discovery::new(Caps {
            participants: 1,
            endpoints: 1,
            nodes: 1,
        });
        let one = prefix([1, 15, 13, 4, 9, 9, 7, 7, 0, 0, 0, 0]);
        let sibling = prefix([1, 15, 13, 4, 9, 9, 7, 7, 1, 0, 0, 0]);
        let neighbour = prefix([1, 15, 13, 4, 8, 9, 7, 7, 0, 0, 0, 0]);
        let unknown_writer = prefix([1, 15, 14, 4, 9, 9, 7, 7, 0, 0, 0, 0]);
        assert!(is_one_process(&discovery, one, one));
        assert!(is_one_process(&discovery, one, sibling));
        assert!(!is_one_process(&discovery, one, neighbour));
        let is_one_host = |one, other| is_one_host(&discovery, VendorId::EPROSIMA, one, other);
        assert!(is_one_host(one, neighbour));
        assert!(!is_one_host(one, unknown_writer));
        let (cyclone, other) = (
            prefix([1, 16, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1]),
            prefix([1, 16, 0, 0, 1, 1, 1, 1, 2, 1, 1, 1]),
        );
        assert!(is_one_process(&discovery, cyclone, cyclone));
        assert!(!is_one_process(&discovery, cyclone, other));
    }

    #[test]
    fn unknown_endpoints_have_no_transport() {
        let discovery = Discovery::new(Caps {
            participants: 1,
            endpoints: 1,
            nodes: 1,
        });
        let guid = Guid::default();
        assert_eq!(transport(&discovery, guid, guid), None);
    }
}
