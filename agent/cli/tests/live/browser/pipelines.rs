//! A capture of chains of nodes with hostile names of topics and nodes.

use std::time::Duration;

use ros2probe_testing::model::forge::{self, AnnouncedNode, Message};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

use super::crowd::{HARM, START, put};

/// Number of messages through each chain. Five are enough for a chain to be shown.
const MESSAGES: u64 = 20;
/// Time from the publication of a hop's input to that of its output.
const HOP: Duration = Duration::from_millis(3);
const WRITER: EntityId = EntityId([0, 0, 1, 3]);
const READER: EntityId = EntityId([0, 0, 2, 4]);
const NODES: EntityId = EntityId([0, 2, 0, 3]);

/// Returns a capture (pcap) of chains with these numbers of hops. Their nodes publish each message
/// that they read with its stamp.
pub(crate) fn capture(lengths: &[usize]) -> Vec<u8> {
    let mut file = vec![0xd4, 0xc3, 0xb2, 0xa1, 2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    file.extend_from_slice(&[0xff, 0xff, 0, 0, 1, 0, 0, 0]);
    for (chain, hops) in lengths.iter().enumerate() {
        for stage in 0..=*hops {
            announce(&mut file, chain, stage);
        }
    }
    for number in 1..=MESSAGES {
        for (chain, hops) in lengths.iter().enumerate() {
            // Chains follow each other, so that their messages do not mix.
            let begin = Duration::from_secs(2 + number * 10)
                + Duration::from_millis(100 * u64::try_from(chain).unwrap());
            // The stamp is not a multiple of 100 us, which could be a coincidence.
            let stamp = after(begin) - 1_234_567;
            for stage in 0..=*hops {
                let at = begin + HOP * u32::try_from(stage).unwrap();
                let message = Message::from(prefix(chain, stage)).info_ts(after(at) - 40_000);
                put(
                    &mut file,
                    at,
                    &message.data(WRITER, number, &stamped(stamp)).bytes(),
                );
            }
        }
    }
    // Leaves time to evaluate the last messages.
    let end = Duration::from_secs(2 + MESSAGES * 10 + 20);
    let payload = forge::participant(prefix(0, 0), 600, None);
    put(
        &mut file,
        end,
        &Message::from(prefix(0, 0))
            .data(forge::SPDP, 2, &payload)
            .bytes(),
    );
    file
}

/// Announces a participant with one node, which publishes its topic and reads that of the stage
/// before. Each topic has a subscription.
fn announce(file: &mut Vec<u8>, chain: usize, stage: usize) {
    let prefix = prefix(chain, stage);
    let mut say = |message: Message| put(file, Duration::ZERO, &message.bytes());
    say(Message::from(prefix).data(forge::SPDP, 1, &forge::participant(prefix, 600, None)));
    let endpoint = |entity, stage| {
        let name = format!("rt/{}", name(chain, stage));
        let guid = Guid::new(prefix, entity);
        forge::endpoint(guid, &name, "sensor_msgs::msg::dds_::PointCloud2_", true)
    };
    say(Message::from(prefix).data(forge::SEDP_WRITERS, 1, &endpoint(WRITER, stage)));
    let readers = stage.checked_sub(1).map(|before| {
        say(Message::from(prefix).data(forge::SEDP_READERS, 1, &endpoint(READER, before)));
        Guid::new(prefix, READER)
    });
    let node = AnnouncedNode {
        namespace: "/",
        name: &format!("{}{chain}_{stage}", HARM[(stage + chain + 5) % HARM.len()]),
        readers: readers.into_iter().collect(),
        writers: vec![Guid::new(prefix, WRITER)],
    };
    say(Message::from(prefix).data(NODES, 1, &forge::entities_of(prefix, 24, &[node])));
}

fn prefix(chain: usize, stage: usize) -> GuidPrefix {
    let mut bytes = *b"\x01\x10pipeline..";
    bytes[10] = u8::try_from(chain).unwrap();
    bytes[11] = u8::try_from(stage).unwrap();
    GuidPrefix(bytes)
}

fn name(chain: usize, stage: usize) -> String {
    let harm = HARM[(stage + chain) % HARM.len()];
    // A hidden topic is in no chain.
    let visible = if harm.starts_with('_') { "own" } else { "" };
    format!("{visible}{harm}{chain}_{stage}")
}

/// Returns the nanoseconds since the epoch.
fn after(time: Duration) -> u64 {
    START * 1_000_000_000 + u64::try_from(time.as_nanos()).unwrap()
}

/// Returns a message that begins with a `std_msgs/Header`.
fn stamped(stamp: u64) -> Vec<u8> {
    let mut payload = vec![0, 1, 0, 0];
    payload.extend_from_slice(&u32::try_from(stamp / 1_000_000_000).unwrap().to_le_bytes());
    payload.extend_from_slice(&u32::try_from(stamp % 1_000_000_000).unwrap().to_le_bytes());
    payload.extend_from_slice(&1_u32.to_le_bytes());
    payload.extend_from_slice(&[0; 44]);
    payload
}
