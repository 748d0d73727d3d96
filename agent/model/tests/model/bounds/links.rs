//! A storm of links, and of writers of references to buffers.

use ros2probe_model::facts::link::LinkProtocol;
use ros2probe_model::facts::route::Destination;
use ros2probe_model::graph::zenoh::Flow;
use ros2probe_model::measure::links::LinkReport;
use ros2probe_wire::host;

use super::*;

const CUDA: &[u8] = b"\x0d\0\0\0bufbe.cuda=0;\0\0\0";

/// Passes a report about a link, and announces an endpoint of one topic with buffers, or sends a
/// reference.
pub(super) fn reports(observer: &mut Observer, dice: &mut Dice, now: u64) {
    let place = |number: u64| Destination {
        address: [number as u8; 16],
        port: (number >> 8) as u16,
    };
    let flow = Flow {
        source: place(dice.roll() % (1 << 20)),
        destination: place(dice.roll() % (1 << 20)),
    };
    observer.input(Input::ClientHello(flow));
    observer.input(Input::Link(&LinkReport {
        socket: dice.roll() % 6000,
        flow,
        protocol: LinkProtocol::Zenoh,
        state: host::Link {
            sent: dice.roll() as u32,
            ..host::Link::default()
        },
    }));
    let prefix = GuidPrefix([7; 12]);
    let number = dice.roll() % 200;
    let guid = |number: u64, kind| Guid::new(prefix, EntityId([0, 0x10, number as u8, kind]));
    let (publisher, writer) = (guid(0, 0x03), guid(1 + number, 0x03));
    let hexadecimal: String = publisher
        .to_bytes()
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect();
    let mut named = CUDA[4..17].to_vec();
    named.extend(b"PGID:");
    named.extend(hexadecimal.as_bytes());
    let named = [&(named.len() as u32).to_le_bytes()[..], &named].concat();
    let plain = [&13_u32.to_le_bytes()[..], &CUDA[4..17]].concat();
    let suffix = format!("rt/image/_buf/{number:032x}");
    let announced = [
        (SEDP_WRITERS, publisher, "rt/image", &plain),
        (SEDP_READERS, guid(0, 0x04), "rt/image", &plain),
        (SEDP_WRITERS, writer, suffix.as_str(), &named),
    ];
    let message =
        Message::from_fast(prefix).data(SPDP, 1, &forge::participant(prefix, 1000, Some(0)));
    let mut messages = vec![message];
    for (announcer, guid, topic, user_data) in announced {
        let payload = forge::endpoint_with(guid, topic, "a::msg::dds_::B_", &[(0x2c, user_data)]);
        messages.push(Message::from_fast(prefix).data(announcer, 1 + number, &payload));
    }
    for message in messages {
        observer.input(Input::Datagram {
            envelope: &forge::multicast(now, 0),
            payload: &message.bytes(),
            handover: None,
        });
    }
    observe(
        observer,
        &Record {
            kind: kind::DATA,
            submessage_flags: 5,
            writer: guid_words(writer),
            time: now,
            sequence_number: 1 + now / 1_000_000,
            payload_len: 100,
            ..Record::default()
        },
    );
}
