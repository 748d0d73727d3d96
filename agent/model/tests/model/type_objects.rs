//! Hashes of XTypes in discovery, and replies of the TypeLookup service, which the model passes on
//! as a whole.

use std::sync::Arc;

use ros2probe_model::derive::type_descriptions::TypeSource;
use ros2probe_model::facts::bounded::{Declared as _, ledger};
use ros2probe_model::facts::tables::WaitingDescriptions;
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::EndpointFacts;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const TALKER: GuidPrefix = GuidPrefix([1, 0x10, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1]);
const WRITER: Guid = Guid {
    prefix: TALKER,
    entity: EntityId([0, 0, 1, 3]),
};
const REPLIES: EntityId = EntityId::TYPE_LOOKUP_REPLY_WRITER;

/// Returns TypeInformation with this hash of the complete type.
fn type_information(hash: [u8; 14]) -> Vec<u8> {
    // Sizes of the structure, the member, and of two structures in it; then a size of zero.
    let [mut outer, mut member] = [Vec::new(), Vec::new()];
    for size in [28_u32, 20] {
        member.extend(size.to_le_bytes());
    }
    member.push(0xf2);
    member.extend(hash);
    member.extend([0; 9]);
    outer.extend((member.len() as u32 + 8).to_le_bytes());
    outer.extend([0x02, 0x10, 0x00, 0x40]);
    outer.extend((member.len() as u32).to_le_bytes());
    outer.extend(member);
    outer
}

fn domain() -> VirtualDomain {
    let mut domain = VirtualDomain::new(&["/**"], Settings::default());
    domain.participant(TALKER, 100);
    domain
}

fn announce(domain: &mut VirtualDomain, number: u64, type_information: &[u8]) {
    let parameters = [(0x75, type_information)];
    let payload = forge::endpoint_with(WRITER, "rt/things", "a::msg::dds_::B_", &parameters);
    domain.put(Message::from(TALKER).data(SEDP_WRITERS, number, &payload));
}

fn publisher(domain: &VirtualDomain) -> EndpointFacts {
    let snapshot = domain.snapshot();
    let topic = snapshot
        .topics
        .iter()
        .find(|topic| &*topic.name == "/things");
    topic.unwrap().publishers[0].clone()
}

fn taken(domain: &mut VirtualDomain) -> Vec<TypeSource> {
    domain.observer.drain().type_sources
}

fn objects(payload: &[u8]) -> TypeSource {
    TypeSource::TypeObjects(Arc::from(payload))
}

#[test]
fn an_endpoint_has_the_hash_that_it_announces_last() {
    let mut domain = domain();
    for number in 1..=2 {
        announce(&mut domain, number.into(), &type_information([number; 14]));
        let hash = publisher(&domain).definition_hash();
        let digits = format!("{number:02x}").repeat(14);
        assert_eq!(hash, Some(format!("XTYPES_{digits}")));
    }
}

#[test]
fn damaged_type_information_is_counted_and_the_endpoint_is_known() {
    let mut domain = domain();
    announce(&mut domain, 1, &type_information([1; 14])[..16]);
    assert_eq!(publisher(&domain).equivalence_hash, None);
    let snapshot = domain.snapshot();
    let errors = snapshot.decode_errors.iter();
    let errors: Vec<_> = errors
        .map(|each| (each.stage, each.reason, each.count))
        .collect();
    assert_eq!(errors, [("type_information", "truncated", 1)]);
}

#[test]
fn a_reply_is_passed_on_once_and_requests_are_not() {
    let mut domain = domain();
    let reply = [&[0, 7, 0, 0], &[9; 60][..]].concat();
    for _ in 0..3 {
        domain.put(Message::from(TALKER).data(REPLIES, 1, &reply));
    }
    assert_eq!(taken(&mut domain), [objects(&reply)]);
    let requests = EntityId([0, 3, 0, 0xc3]);
    domain.put(Message::from(TALKER).data(requests, 1, &reply));
    assert_eq!(taken(&mut domain), []);
}

#[test]
fn the_fragments_of_a_reply_are_joined_in_any_order() {
    let mut domain = domain();
    let reply: Vec<u8> = (0..4_000_u32).map(|number| number as u8).collect();
    for start in [4, 2, 1, 3, 2] {
        domain.put(Message::from(TALKER).fragment(REPLIES, 1, start, 1_000, &reply));
    }
    assert_eq!(taken(&mut domain), [objects(&reply)]);
}

#[test]
fn only_the_latest_replies_wait_and_large_ones_are_left_out() {
    let mut domain = domain();
    let most = WaitingDescriptions::CAP as u64;
    let reply = |number: u64| [&[0, 7, 0, 0], &number.to_le_bytes()[..]].concat();
    for number in 1..=most + 4 {
        domain.put(Message::from(TALKER).data(REPLIES, number, &reply(number)));
        assert_eq!(domain.observer.has_much_output(), number * 2 >= most);
    }
    let large = vec![0; (256 << 10) + 4];
    for start in 1..=5 {
        let message = Message::from(TALKER).fragment(REPLIES, 99, start, 60_000, &large);
        domain.put(message);
    }
    let taken = taken(&mut domain);
    assert_eq!(taken.len() as u64, most);
    assert_eq!(taken.first(), Some(&objects(&reply(5))));
    assert!(ledger()[WaitingDescriptions::TABLE.name].is_driven());
}
