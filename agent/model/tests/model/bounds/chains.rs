//! Forged messages with stamps, of which some continue others, and forged publications.

use ros2probe_capture::border::observe;
use ros2probe_model::derive::chain::causality::CausalPublication;
use ros2probe_model::derive::chain::expected::ExpectedChain;
use ros2probe_testing::model::forge::AnnouncedNode;
use ros2probe_wire::DomainId;

use super::*;

const INPUT: EntityId = EntityId([0, 6, 1, 3]);
const OUTPUT: EntityId = EntityId([0, 6, 2, 3]);
const FRESH: EntityId = EntityId([0, 6, 3, 3]);
const READER: EntityId = EntityId([0, 6, 4, 4]);
const ADDRESS: [u8; 4] = [10, 0, 0, 2];
const PORT: u16 = 7411;

/// Announces a sensor, and a filter with an output that keeps the stamp and one that does not.
fn announce(observer: &mut Observer) {
    let address = SocketAddrV4::new(Ipv4Addr::from(ADDRESS), PORT);
    let payload = forge::participant_at(ALICE, 1_000_000, Some(0), &[address]);
    let mut messages = vec![Message::from(ALICE).data(SPDP, 1, &payload)];
    let topics = [
        (INPUT, "rt/in"),
        (OUTPUT, "rt/out"),
        (FRESH, "rt/fresh"),
        (READER, "rt/in"),
    ];
    for (number, (entity, topic)) in (1..).zip(topics) {
        let guid = Guid::new(ALICE, entity);
        let payload = forge::endpoint(guid, topic, "sensor_msgs::msg::dds_::Imu_", true);
        let sedp = if entity == READER {
            SEDP_READERS
        } else {
            SEDP_WRITERS
        };
        messages.push(Message::from(ALICE).data(sedp, number, &payload));
    }
    let guid = |entity| Guid::new(ALICE, entity);
    let node = |name, readers, writers| AnnouncedNode {
        namespace: "/",
        name,
        readers,
        writers,
    };
    let nodes = [
        node("sensor", Vec::new(), vec![guid(INPUT)]),
        node(
            "filter",
            vec![guid(READER)],
            vec![guid(OUTPUT), guid(FRESH)],
        ),
    ];
    let payload = forge::entities_of(ALICE, 24, &nodes);
    messages.push(Message::from(ALICE).data(DISCOVERY_INFO, 1, &payload));
    for message in messages {
        observer.input(Input::Datagram {
            envelope: &forge::multicast(START, 0),
            payload: &message.bytes(),
            handover: None,
        });
    }
    let chain = |to: &str| ExpectedChain {
        domain_id: None,
        from: "/in".into(),
        to: to.into(),
        max_latency: Some(Duration::from_micros(1)),
    };
    let chains = vec![chain("/out"), chain("/fresh")];
    observer.input(Input::ExpectedChains(Arc::new(chains)));
}

fn record(entity: EntityId, (number, at): (u64, u64), stamp: u64, place: u16) -> Record {
    Record {
        kind: kind::DATA,
        submessage_flags: 5,
        time: at,
        writer: guid_words(Guid::new(ALICE, entity)),
        sequence_number: number,
        source_timestamp: (at / 1_000_000_000) << 32,
        destination: [
            0,
            0,
            u32::from_ne_bytes([0, 0, 0xff, 0xff]),
            u32::from_ne_bytes(ADDRESS),
        ],
        destination_port: PORT,
        payload_len: 40,
        flags: flag::STAMP | flag::HOST | place,
        stamp_seconds: u32::try_from(stamp / 1_000_000_000).unwrap(),
        stamp_nanoseconds: u32::try_from(stamp % 1_000_000_000).unwrap(),
        socket: if place == 0 { at % 7000 } else { 0 },
        ..Record::default()
    }
}

/// Sends a message on each topic, and three publications. `/fresh` has a stamp of its own.
pub(super) fn messages(observer: &mut Observer, dice: &mut Dice, now: u64) {
    let step = (now - START) / 1_000_000;
    if step == 1 {
        announce(observer);
    }
    let stamp = match dice.pick(3) {
        0 => dice.pick(1 << 40),
        _ => now - 20_000_000,
    };
    let number = step + 1;
    for record in [
        record(INPUT, (number, now), stamp, flag::OUTGOING),
        record(INPUT, (number, now + 50), stamp, 0),
        record(OUTPUT, (number, now + 100), stamp, flag::OUTGOING),
        record(FRESH, (number, now + 100), now + 90, flag::OUTGOING),
    ] {
        observe(observer, &record);
    }
    for _ in 0..3 {
        publish(observer, dice, now);
    }
}

/// Reports a publication that may continue an earlier one.
fn publish(observer: &mut Observer, dice: &mut Dice, now: u64) {
    // Many publications continue a topic whose chains are traced.
    let input = match dice.pick(3) {
        0 => format!("/topic{}", dice.pick(100)),
        _ => "/in".to_owned(),
    };
    let publication = CausalPublication {
        domain_id: DomainId(dice.pick(3) as u32),
        process: 1,
        node: Some(format!("/node{}", dice.pick(3)).into()),
        input: input.into(),
        input_source: Timestamp(now - dice.pick(1 << 24)),
        taken: Timestamp(now - dice.pick(1 << 10)),
        started: Timestamp(now),
        output: format!("/topic{}", dice.pick(100)).into(),
        published: Timestamp(now + dice.pick(1 << 10)),
    };
    observer.input(Input::CausalPublication(&publication));
}
