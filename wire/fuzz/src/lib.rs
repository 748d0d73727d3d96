//! Bodies of the fuzz targets. They are plain functions, so that tests run them too, over the
//! committed seeds and truncations of these (`wire/tests/fuzz_seeds.rs`). To fuzz, run in this
//! directory `cargo +nightly fuzz run datagram corpus/datagram ../tests/data/datagrams`. The
//! targets `discovery`, `entities` and `zenoh` have their directories under `seeds`.
//!
//! Each target reads its bytes as the agent does and asserts what must hold for any bytes: no
//! parser panics, no list exceeds its bound, and no more is kept than the input contains. The
//! kernel filter's walk agrees with the oracle (`wire/tests/oracle`).

use ros2probe_wire::discovery::{self, Discovery, Role};
use ros2probe_wire::entities::ParticipantEntities;
use ros2probe_wire::names::{Demangled, MAX_LEN};
use ros2probe_wire::record::{self, Record, Sample, flag, kind};
use ros2probe_wire::rtps::{InlineQos, Payload, StatusInfo, VendorId};
use ros2probe_wire::walk::{self, Envelope, Step, Walk};
use ros2probe_wire::{EntityId, Guid, SequenceNumber};

#[path = "../../tests/oracle/mod.rs"]
pub mod oracle;
mod zenoh;

use oracle::sets::SequenceNumberSet;
use oracle::{Body, Message, Submessage};

/// Reads a batch of Zenoh with every parser.
pub fn zenoh(bytes: &[u8]) {
    zenoh::read(bytes);
}

/// Reads a UDP payload with every parser.
pub fn datagram(bytes: &[u8]) {
    let Ok(message) = Message::parse(bytes) else {
        return;
    };
    let records = walk(bytes, message.header().prefix.0);
    samples_agree(bytes, message.clone());
    for submessage in message.map_while(Result::ok) {
        let record = records
            .iter()
            .find(|(offset, _)| *offset == submessage.offset);
        agrees(&submessage, record.map(|(_, record)| record));
        match submessage.body {
            Body::Data(data) => {
                let vendor = submessage.receiver.vendor;
                let inline_qos = data
                    .inline_qos
                    .and_then(|list| InlineQos::parse(list, vendor).ok())
                    .unwrap_or_default();
                match data.writer.entity {
                    EntityId::SPDP_WRITER => participant(vendor, data.payload, &inline_qos),
                    EntityId::SEDP_PUBLICATIONS_WRITER => {
                        endpoint(Role::Writer, vendor, data.payload, &inline_qos);
                    }
                    EntityId::SEDP_SUBSCRIPTIONS_WRITER => {
                        endpoint(Role::Reader, vendor, data.payload, &inline_qos);
                    }
                    _ => entities(data.payload.bytes()),
                }
            }
            Body::DataFrag(fragments) => {
                assert!(fragments.bytes.len() <= bytes.len());
                assert_eq!(fragments.fragments().count(), usize::from(fragments.count));
                assert!(fragments.starting <= fragments.total());
            }
            Body::AckNack(acknack) => assert!(acknack.missing.iter().count() <= 256),
            Body::Gap(gap) => assert!(gap.list.iter().all(|number| number >= gap.list.base)),
            Body::NackFrag(nack_frag) => assert!(nack_frag.missing.iter().count() <= 256),
            Body::InfoReply(_)
            | Body::Pad
            | Body::Heartbeat(_)
            | Body::HeartbeatFrag(_)
            | Body::InfoTimestamp
            | Body::InfoSource
            | Body::InfoDestination
            | Body::Secure(_)
            | Body::Unknown(_) => {}
        }
    }
}

/// Reads a discovery sample: the first byte chooses its kind, the rest is its payload.
pub fn discovery(bytes: &[u8]) {
    let Some((choice, bytes)) = bytes.split_first() else {
        return;
    };
    let vendor = if choice & 1 == 0 {
        VendorId::EPROSIMA
    } else {
        VendorId::CYCLONE
    };
    let payload = if choice & 2 == 0 {
        Payload::Data(bytes)
    } else {
        Payload::Key(bytes)
    };
    let status_info = StatusInfo(u32::from(choice >> 2 & 3));
    let inline_qos = InlineQos {
        status_info,
        ..InlineQos::default()
    };
    match choice >> 4 & 3 {
        0 => participant(vendor, payload, &inline_qos),
        1 => endpoint(Role::Writer, vendor, payload, &inline_qos),
        _ => endpoint(Role::Reader, vendor, payload, &inline_qos),
    }
}

/// Reads the payload of a `ros_discovery_info` sample.
pub fn entities(bytes: &[u8]) {
    let Ok(entities) = ParticipantEntities::parse(bytes) else {
        return;
    };
    assert_eq!(entities.participant.entity, EntityId::PARTICIPANT);
    let guids: usize = entities
        .nodes
        .iter()
        .map(|node| node.readers.len() + node.writers.len())
        .sum();
    assert!(16 * (guids + entities.nodes.len()) <= bytes.len());
    for node in &entities.nodes {
        assert!(
            node.fully_qualified_name()
                .chars()
                .all(|c| !c.is_control() && c != '"')
        );
    }
}

fn participant(vendor: VendorId, payload: Payload<'_>, inline_qos: &InlineQos) {
    let Ok(Discovery::Alive(participant)) = discovery::participant(vendor, payload, inline_qos)
    else {
        return;
    };
    assert_eq!(participant.guid.entity, EntityId::PARTICIPANT);
    assert!(participant.properties.len() <= 32);
    for locators in [
        &participant.default_unicast,
        &participant.default_multicast,
        &participant.metatraffic_unicast,
        &participant.metatraffic_multicast,
    ] {
        assert!(locators.len() <= 64);
    }
    let text = [&participant.entity_name, &participant.domain_tag];
    assert!(
        text.into_iter()
            .chain(&participant.enclave)
            .all(|text| text.len() <= 256)
    );
}

fn endpoint(role: Role, vendor: VendorId, payload: Payload<'_>, inline_qos: &InlineQos) {
    let Ok(Discovery::Alive(endpoint)) = discovery::endpoint(role, vendor, payload, inline_qos)
    else {
        return;
    };
    assert_eq!(
        endpoint.participant,
        Guid::new(endpoint.guid.prefix, EntityId::PARTICIPANT)
    );
    assert!(endpoint.unicast.len() <= 64 && endpoint.multicast.len() <= 64);
    assert!(endpoint.qos.partitions.len() <= 16);
    let topic = endpoint.topic.as_str();
    assert!(topic.len() <= MAX_LEN && topic.chars().all(|c| !c.is_control() && c != '"'));
    match endpoint.topic.demangle() {
        Demangled::Topic(name) => assert_eq!(topic, format!("rt{name}")),
        Demangled::ServiceRequest(name) => assert_eq!(topic, format!("rq{name}Request")),
        Demangled::ServiceReply(name) => assert_eq!(topic, format!("rr{name}Reply")),
        _ => {}
    }
    assert!(endpoint.type_name.service().as_str().len() <= endpoint.type_name.as_str().len());
}

/// Returns every record of the kernel filter's walk with the offset of its submessage.
fn walk(bytes: &[u8], prefix: [u8; 12]) -> Vec<(usize, Record)> {
    let Ok(length) = u32::try_from(bytes.len()) else {
        return Vec::new();
    };
    let [a, b, c] = [0, 4, 8].map(|at| {
        let mut word = [0; 4];
        word.copy_from_slice(&prefix[at..at + 4]);
        u32::from_ne_bytes(word)
    });
    let mut walk = Walk::default();
    walk.begin([a, b, c], length);
    let mut records = Vec::new();
    loop {
        let offset = walk.offset as usize;
        match walk::step(&mut walk, &bytes, length) {
            Step::Endpoint | Step::LongGap => records.push((offset, walk.record)),
            Step::Passed => {}
            _ => return records,
        }
    }
}

/// Checks that the walk reports each submessage that the oracle reports. The converse need not
/// hold: the walk accepts numbers that the oracle rejects.
fn agrees(submessage: &Submessage<'_>, record: Option<&Record>) {
    let (kind, writer, reader, number) = match submessage.body {
        Body::Data(data) => (kind::DATA, data.writer, data.reader, data.sequence_number),
        Body::DataFrag(data) => (
            kind::DATA_FRAG,
            data.writer,
            data.reader,
            data.sequence_number,
        ),
        Body::Heartbeat(heartbeat) => (
            kind::HEARTBEAT,
            heartbeat.writer,
            heartbeat.reader,
            heartbeat.first,
        ),
        Body::Gap(gap) => (kind::GAP, gap.writer, gap.reader, gap.start),
        Body::AckNack(acknack) => (
            kind::ACKNACK,
            acknack.writer,
            acknack.reader,
            acknack.missing.base,
        ),
        _ => return,
    };
    assert!(record.is_some(), "the walk missed {submessage:?}");
    let Some(record) = record else { return };
    assert_eq!(record.kind, kind, "{submessage:?}");
    assert_eq!(record.submessage_flags, submessage.flags.0);
    assert_eq!(record.sequence_number, number.0);
    if kind == kind::DATA || kind == kind::DATA_FRAG {
        assert_eq!(record.source_timestamp, submessage.receiver.timestamp.0);
    }
    assert_eq!(
        (guid(record.writer), guid(record.reader)),
        (writer, reader),
        "{submessage:?}"
    );
    bodies_agree(submessage, record);
}

/// Checks that the record's body, interpreted by its kind, matches the oracle's.
fn bodies_agree(submessage: &Submessage<'_>, record: &Record) {
    match (submessage.body, record.body()) {
        (Body::Data(data), record::Body::Sample(Sample::Data(ours))) => {
            let length = data.payload.bytes().len();
            let is_read = record.flags & flag::INLINE_QOS_UNREAD == 0;
            assert!(!is_read || ours.payload_len() as usize == length);
        }
        (Body::DataFrag(theirs), record::Body::Sample(Sample::DataFrag(ours))) => {
            assert_eq!(
                (ours.starting(), ours.count(), ours.fragment_size()),
                (
                    theirs.starting,
                    theirs.count.into(),
                    theirs.fragment_size.into()
                )
            );
            assert_eq!(
                (ours.sample_size(), ours.total(), ours.is_key()),
                (theirs.sample_size, theirs.total(), theirs.is_key)
            );
        }
        (Body::Heartbeat(theirs), record::Body::Heartbeat(ours)) => assert_eq!(
            (ours.first(), ours.last(), ours.count()),
            (theirs.first, theirs.last, theirs.count)
        ),
        (Body::Gap(theirs), record::Body::Gap(ours)) => {
            assert_eq!(ours.start(), theirs.start);
            sets_agree(&ours.list(), &theirs.list);
        }
        (Body::AckNack(theirs), record::Body::AckNack(ours)) => {
            sets_agree(&ours.missing(), &theirs.missing);
        }
        (theirs, ours) => unreachable!("{theirs:?} has the kind of {ours:?}"),
    }
}

/// Checks that the sets agree. A record holds only the first numbers of a long set.
fn sets_agree(ours: &record::SequenceNumberSet, theirs: &SequenceNumberSet<'_>) {
    assert_eq!(ours.base, theirs.base);
    assert_eq!(ours.num_bits, theirs.num_bits());
    let end = ours.base.saturating_add(Record::BITMAP_BITS.into());
    // The oracle yields no numbers beyond the largest sequence number.
    assert!(
        ours.iter()
            .take_while(|number| *number <= SequenceNumber::MAX)
            .eq(theirs.iter().take_while(|number| *number < end))
    );
}

/// Checks that the payload and inline QoS of each DATA are where the oracle finds them.
fn samples_agree(bytes: &[u8], message: Message<'_>) {
    let mut found = Vec::new();
    walk::datagram(bytes, &Envelope::default(), None, |each| {
        if each.record.kind == kind::DATA {
            found.push(each);
        }
    });
    let theirs = message
        .map_while(Result::ok)
        .filter_map(|each| match each.body {
            Body::Data(data) => Some((each.receiver.vendor, data)),
            _ => None,
        });
    for (index, (vendor, data)) in theirs.enumerate() {
        let ours = &found[index];
        let list = data.inline_qos.map(|list| InlineQos::parse(list, vendor));
        let inline_qos = list.unwrap_or(Ok(InlineQos::default()));
        // The oracle's offsets count from the start of the datagram, the walk's from that of the
        // submessage.
        assert_eq!(
            ours.inline_qos(vendor).map_err(|error| error.reason),
            inline_qos.map_err(|error| error.reason)
        );
        if ours.record.flags & flag::INLINE_QOS_UNREAD == 0 {
            assert_eq!(ours.payload(), data.payload);
        }
    }
}

fn guid(words: [u32; 4]) -> Guid {
    let mut bytes = [0; 16];
    for (chunk, word) in bytes.chunks_exact_mut(4).zip(words) {
        chunk.copy_from_slice(&word.to_ne_bytes());
    }
    Guid::from_bytes(bytes)
}
