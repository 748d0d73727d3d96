//! Connections of RTPS: each message is seen where it is sent and where it arrives.

use ros2probe_testing::forged::framed;
use ros2probe_wire::record::Verdict;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

use super::*;

const RECONNECT: &str = "agent/testing/data/fastrtps-tcp/tcp-peers-reconnect-2ns/capture.pcap.gz";
const MTU_296: &str = "agent/testing/data/fastrtps-tcp/tcp-peers-mtu296-2ns/capture.pcap.gz";
const PREFIXES: [GuidPrefix; 2] = [GuidPrefix([1; 12]), GuidPrefix([2; 12])];
/// The number of bytes passed on of a message that is only counted, without the frame's header.
const HEAD: usize = 512 - 14;

/// An RTPS message: its captured bytes, and its length.
type Message = (Vec<u8>, u32);

/// Returns the messages of each direction at each socket since the last call.
fn messages(observed: &mut Observed) -> BTreeMap<(u16, u16, bool), Vec<Message>> {
    let mut messages: BTreeMap<_, Vec<Message>> = BTreeMap::new();
    for (piece, bytes) in observed.chunks() {
        assert_ne!(piece.chunk & chunk::RTPS, 0, "{piece:?}");
        let part = Chunk::of_piece(&piece, &bytes, Timestamp(piece.time));
        observed.streams.chunk(&part, |streamed| {
            let Streamed::Message {
                envelope,
                bytes,
                length,
            } = streamed
            else {
                return;
            };
            assert!(envelope.host && envelope.socket != 0);
            let ports = (envelope.source_port, envelope.destination_port);
            let key = (ports.0, ports.1, envelope.outgoing);
            let entry = messages.entry(key).or_default();
            entry.push((bytes.to_vec(), *length));
        });
    }
    messages
}

/// Returns the frames of each connection of a capture in their order, and whether the side that
/// opened the connection sent them.
fn frames(capture: &str) -> Result<Vec<Vec<Sent>>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .join(capture);
    let mut reader = PcapReader::open(&path, Expansion::Limited)?;
    let mut streams = Streams::default();
    let mut found: Vec<((u16, u16), Vec<Sent>)> = Vec::new();
    while let Some(captured) = reader.next_packet()? {
        let parsed = frame::parse(captured.link, captured.bytes, captured.length)?;
        let Some(packet) = parsed.packet else {
            continue;
        };
        let Payload::Segment(segment) = packet.payload else {
            continue;
        };
        let stream = StreamId {
            flow: flow(&packet, &segment),
            ..StreamId::default()
        };
        let part = Chunk::of_segment(&segment, captured.time, stream);
        streams.chunk(&part, |streamed| {
            let Streamed::Message {
                envelope, bytes, ..
            } = streamed
            else {
                return;
            };
            let (from, to) = (envelope.source_port, envelope.destination_port);
            let known = found
                .iter()
                .rposition(|(ports, _)| [(from, to), (to, from)].contains(ports));
            let index = known.unwrap_or_else(|| {
                found.push(((from, to), Vec::new()));
                found.len() - 1
            });
            let (ports, sent) = &mut found[index];
            sent.push((*ports == (from, to), bytes.to_vec()));
        });
    }
    Ok(found.into_iter().map(|(_, sent)| sent).collect())
}

/// A DATA of a writer, with an INFO_TS before and a HEARTBEAT after it.
pub(super) fn data(prefix: GuidPrefix, writer: EntityId, payload: &[u8]) -> Vec<u8> {
    let mut message = b"RTPS\x02\x03\x01\x0f".to_vec();
    message.extend(prefix.0);
    message.extend([9, 1, 8, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    let length = 20 + payload.len();
    message.extend([0x15, 5]);
    message.extend((length as u16).to_le_bytes());
    message.extend([0, 0, 16, 0, 0, 0, 0, 0]);
    message.extend(writer.0);
    message.extend([0, 0, 0, 0, 1, 0, 0, 0]);
    message.extend(payload);
    message.extend([7, 1, 28, 0]);
    message.extend([0; 28]);
    message
}

fn ports(connection: &[TcpStream; 2], by_client: bool) -> Result<(u16, u16)> {
    let [client, server] = connection;
    let (client, server) = (client.local_addr()?.port(), server.local_addr()?.port());
    Ok(if by_client {
        (client, server)
    } else {
        (server, client)
    })
}

/// Checks that these messages were seen, in their order, whole or from their beginning on.
fn compare(seen: Option<&Vec<Message>>, sent: &[&Vec<u8>], case: &str) -> Result<()> {
    let none = Vec::new();
    let seen = seen.unwrap_or(&none);
    ensure!(
        seen.len() == sent.len(),
        "{case}: {} of {}",
        seen.len(),
        sent.len()
    );
    for (index, ((bytes, length), sent)) in seen.iter().zip(sent).enumerate() {
        ensure!(
            *length as usize == sent.len() && sent.starts_with(bytes),
            "{case}: message {index} is {} of {length} bytes, not of {}",
            bytes.len(),
            sent.len()
        );
        ensure!(
            bytes.len() == sent.len() || bytes.len() >= HEAD,
            "{case}: of message {index} only {} bytes",
            bytes.len()
        );
    }
    Ok(())
}

// Coverage: TCP, at the sockets | Fast DDS 2.6 | Humble | exact
// Coverage: TCP over IPv6, at the sockets | Fast DDS 2.6 | Humble | exact
#[test]
fn each_message_of_a_recorded_system_is_seen_at_its_sender_and_its_receiver() -> Result<()> {
    for (capture, address) in [
        (RECONNECT, "127.0.0.1:0"),
        (RECONNECT, "[::1]:0"),
        (MTU_296, "127.0.0.1:0"),
    ] {
        let mut observed = Observed::new()?;
        let mut total = 0;
        for (number, sent) in frames(capture)?.into_iter().enumerate() {
            let mut connection = observed.connect(address)?;
            for (by_client, message) in &sent {
                pass(&mut connection, *by_client, &framed(message))?;
            }
            total += sent.len() as u64;
            let seen = messages(&mut observed);
            for by_client in [true, false] {
                let (from, to) = ports(&connection, by_client)?;
                let sent = sent.iter().filter(|(it, _)| *it == by_client);
                let sent: Vec<_> = sent.map(|(_, message)| message).collect();
                for outgoing in [true, false] {
                    let case = format!("{capture} {number} {by_client} {outgoing}");
                    compare(seen.get(&(from, to, outgoing)), &sent, &case)?;
                }
            }
        }
        assert!(total > 500, "{total}");
        assert_eq!(observed.counter(Counter::TcpFrames)?, 2 * total);
        assert_eq!(observed.counter(Counter::TcpGaps)?, 0);
        assert_eq!(observed.counter(Counter::TcpChunksLost)?, 0);
        assert_eq!(observed.counter(Counter::ZenohChunks)?, 0);
    }
    Ok(())
}

#[test]
fn packets_that_split_and_join_frames_yield_the_same_messages() -> Result<()> {
    let mut observed = Observed::new()?;
    let connections = frames(RECONNECT)?;
    let longest = connections.iter().max_by_key(|sent| sent.len()).unwrap();
    let sent: Vec<_> = longest.iter().filter(|(it, _)| !*it).collect();
    let wire: Vec<_> = sent.iter().map(|(_, message)| framed(message)).collect();
    let (first, rest) = (wire[0].clone(), wire[1..].concat());
    for size in [1, 7, 13, 17, 18, 282, 1448, 65_160, 200_000] {
        let rest = &rest[..rest.len().min(size * 3000)];
        let mut connection = observed.connect("127.0.0.1:0")?;
        pass(&mut connection, false, &first)?;
        for part in rest.chunks(size) {
            pass(&mut connection, false, part)?;
        }
        let seen = messages(&mut observed);
        let (from, to) = ports(&connection, false)?;
        let mut end = 0;
        let whole = sent.iter().zip(&wire).map_while(|((_, message), bytes)| {
            end += bytes.len();
            (end <= first.len() + rest.len()).then_some(message)
        });
        let whole: Vec<_> = whole.collect();
        for outgoing in [true, false] {
            let case = format!("parts of {size}, {outgoing}");
            compare(seen.get(&(from, to, outgoing)), &whole, &case)?;
        }
    }
    Ok(())
}

#[test]
fn a_connection_older_than_the_programs_is_followed_from_the_next_frame_on() -> Result<()> {
    let mut observed = Observed::new()?;
    let message = data(PREFIXES[0], EntityId([0, 0, 1, 3]), &[5; 300]);
    let mut connection = observed.connect("127.0.0.1:0")?;
    // The beginning of a frame was sent before.
    pass(&mut connection, true, &framed(&message)[100..])?;
    pass(&mut connection, true, &framed(&message))?;
    pass(&mut connection, true, &framed(&message))?;
    let seen = messages(&mut observed);
    let (from, to) = ports(&connection, true)?;
    for outgoing in [true, false] {
        let case = format!("{outgoing}");
        compare(
            seen.get(&(from, to, outgoing)),
            &[&message, &message],
            &case,
        )?;
    }
    Ok(())
}

#[test]
fn verdicts_on_writers_decide_which_bytes_of_messages_are_passed_on() -> Result<()> {
    let mut observed = Observed::new()?;
    let writers = [1, 2, 3, 4].map(|number| EntityId([0, 0, number, 3]));
    let verdicts = [Verdict::Ignore, Verdict::Meter, Verdict::Capture];
    for (writer, verdict) in writers.iter().zip(verdicts) {
        let guid = Guid {
            prefix: PREFIXES[0],
            entity: *writer,
        };
        observed.filter.set_interest(guid, Some(verdict))?;
    }
    let mut connection = observed.connect("127.0.0.1:0")?;
    let announcement = data(PREFIXES[0], EntityId([0, 1, 0, 0xc2]), &[1; 5000]);
    pass(&mut connection, true, &framed(&announcement))?;
    let large = writers.map(|writer| data(PREFIXES[0], writer, &[7; 60_000]));
    for message in &large {
        pass(&mut connection, true, &framed(message))?;
    }
    // A message of two samples is needed as a whole.
    let sample = data(PREFIXES[0], writers[1], &[8; 3000]);
    let two = [&sample[..], &sample[20..]].concat();
    pass(&mut connection, true, &framed(&two))?;
    let seen = messages(&mut observed);
    let (from, to) = ports(&connection, true)?;
    let lengths = |outgoing| {
        let seen = &seen[&(from, to, outgoing)];
        let lengths = seen.iter().map(|(bytes, length)| {
            assert!(bytes.len() <= *length as usize);
            (bytes.len(), *length as usize)
        });
        lengths.collect::<Vec<_>>()
    };
    let [_, metered, captured, unknown] = large.map(|message| message.len());
    // Of the ignored writer, the beginning shows once a second that its participant is alive.
    let (whole, heads) = (announcement.len(), two.len());
    assert_eq!(
        lengths(true),
        [
            (whole, whole),
            (HEAD, metered),
            (captured, captured),
            // Its announcement may still come.
            (unknown, unknown),
            (heads, heads),
        ]
    );
    // At the receiver of the same host, payloads are not copied again.
    assert_eq!(
        lengths(false),
        [
            (whole, whole),
            (HEAD, metered),
            (HEAD, captured),
            (HEAD, unknown),
            (heads, heads),
        ]
    );
    Ok(())
}

/// An ACKNACK of a reader.
fn acknack(prefix: GuidPrefix, reader: EntityId) -> Vec<u8> {
    let mut message = b"RTPS\x02\x03\x01\x0f".to_vec();
    message.extend(prefix.0);
    message.extend([6, 1, 24, 0]);
    message.extend(reader.0);
    message.extend([0, 0, 1, 3]);
    message.extend([0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]);
    message
}

#[test]
fn small_frames_of_unknown_readers_are_charged_and_those_of_known_readers_are_not() -> Result<()> {
    const BUDGET: usize = 5_000;
    const FRAMES: u8 = 100;
    let mut observed = Observed::new()?;
    let reader = EntityId([0, 0, 9, 4]);
    let guid = Guid::new(PREFIXES[0], reader);
    observed.filter.set_interest(guid, Some(Verdict::Meter))?;
    let mut connection = observed.connect("127.0.0.1:0")?;
    pass(
        &mut connection,
        true,
        &framed(&acknack(PREFIXES[0], reader)),
    )?;
    assert_eq!(messages(&mut observed).len(), 2);
    observed
        .filter
        .set_unknown_budget(Budget::CaptureBytes, BUDGET as u32)?;
    for number in 0..FRAMES {
        let stranger = EntityId([1, 0, number, 4]);
        pass(
            &mut connection,
            true,
            &framed(&acknack(PREFIXES[0], stranger)),
        )?;
        let writer = EntityId([1, 0, number, 3]);
        pass(
            &mut connection,
            true,
            &framed(&data(PREFIXES[0], writer, &[1; 300])),
        )?;
        pass(
            &mut connection,
            true,
            &framed(&acknack(PREFIXES[0], reader)),
        )?;
    }
    let known = acknack(PREFIXES[0], reader);
    let (mut ours, mut of_strangers) = (0, 0);
    for (bytes, length) in messages(&mut observed).into_values().flatten() {
        match bytes == known {
            true => ours += 1,
            false => of_strangers += bytes.len(),
        }
        assert!(bytes.len() <= length as usize);
    }
    // Each frame is seen at both sockets. The last one may exceed the budget.
    assert_eq!(ours, 2 * usize::from(FRAMES));
    assert!(
        (BUDGET / 2..BUDGET + 1000).contains(&of_strangers),
        "{of_strangers}"
    );
    let refused = observed.counter(Counter::UnknownOverBudget)?;
    assert!(refused > 300, "{refused}");
    Ok(())
}

#[test]
fn zenoh_is_still_read_only_at_its_sender_after_a_connection_of_rtps() -> Result<()> {
    let mut observed = Observed::new()?;
    let message = data(PREFIXES[0], EntityId([0, 0, 1, 3]), &[5; 300]);
    let mut rtps = observed.connect("127.0.0.1:0")?;
    pass(&mut rtps, true, &framed(&message))?;
    assert_eq!(messages(&mut observed).len(), 2);
    let mut zenoh = observed.connect("127.0.0.1:0")?;
    pass(&mut zenoh, true, &with_prefix(INIT))?;
    let seen = observed.seen();
    let [out, arrived, ..] = directions(&seen, &zenoh)?;
    assert!(out.is_some() && arrived.is_none(), "{seen:?}");
    Ok(())
}

#[test]
fn hostile_frames_cause_bounded_copies_and_are_delivered() -> Result<()> {
    let mut observed = Observed::new()?;
    let mut connection = observed.connect("127.0.0.1:0")?;
    pass(
        &mut connection,
        true,
        &framed(&data(PREFIXES[1], EntityId([0, 0, 1, 3]), &[1; 64])),
    )?;
    for seed in 0..200_u64 {
        let mut frame = framed(&data(
            PREFIXES[1],
            EntityId([0, 0, 1, 3]),
            &random(seed, 2000),
        ));
        match seed % 5 {
            // Lengths that contradict the bytes, and submessages beyond their frame.
            0 => frame[4..8].copy_from_slice(&(u32::MAX - seed as u32).to_le_bytes()),
            1 => frame[4..8].copy_from_slice(&(30 + seed as u32).to_le_bytes()),
            2 => frame[36..38].copy_from_slice(&[0xff, 0xff]),
            3 => frame.truncate(14 + seed as usize % 17),
            _ => frame = random(seed, 3000),
        }
        pass(&mut connection, true, &frame)?;
    }
    let copied: usize = observed.chunks().iter().map(|(_, bytes)| bytes.len()).sum();
    assert!(copied < 2 * 200 * 3000 + 10_000, "{copied}");
    Ok(())
}
