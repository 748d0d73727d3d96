//! A capture of a large robot with hostile or harmless names: topics, types, nodes and messages.

use std::time::Duration;

use ros2probe_wire::{EntityId, Guid, GuidPrefix};

use ros2probe_testing::model::forge::{self, Message};

/// Start of the capture: 2026-11-21, in Unix seconds.
pub(super) const START: u64 = 1_795_219_200;
/// Number of topics of one participant, each with its own node.
const TOPICS: usize = 20;
/// Maximum length of a name in DDS.
const LONGEST: usize = 255;

/// Hostile names that the agent shows. They harm a page that treats text as markup, code or a
/// file's path. The agent refuses quotation marks, control characters and changes of the text's
/// direction.
pub(super) const HARM: [&str; 16] = [
    "<img src=x onerror=harmed=1>",
    "><script>globalThis.harmed=1</script>",
    "&quot; onmouseover=harmed=1",
    "&lt;b&gt;&amp;&#x41;",
    "evil\u{200f}gnp.exe\u{61c}",
    "zero\u{200b}width\u{200d}\u{2060}",
    "__proto__/polluted",
    "javascript:harmed=1//",
    "soft\u{ad}hyphen\u{3000}wide\u{180e}",
    "%2F..%2F..%00?domain=7#/agent",
    "${harmed=1}{{7*7}}",
    "u{202e} written out",
    "مرحبا/שלום",
    "z\u{300}\u{301}\u{302}\u{303}\u{304}\u{305}algo",
    "]]><!--<svg/onload=harmed=1>-->",
    "constructor/toString",
];

/// Names that the agent refuses, so that no surface ever shows them.
const REFUSED: [&str; 6] = [
    "refused\"><script>harmed=1</script>",
    "refused' onmouseover='harmed=1",
    "refused\u{202e}gnp.exe",
    "refused\u{2066}isolate\u{2069}",
    "refused\nline\u{7}bell\u{1b}[31m",
    "refused\\u{41}",
];

/// Returns a capture (pcap) of this many topics that send for some seconds.
pub(crate) fn capture(topics: usize, hostile: bool, seconds: u64) -> Vec<u8> {
    let mut file = vec![0xd4, 0xc3, 0xb2, 0xa1, 2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    file.extend_from_slice(&[0xff, 0xff, 0, 0, 1, 0, 0, 0]);
    let robots: Vec<_> = (0..topics.div_ceil(TOPICS)).collect();
    let own = |robot: usize| (robot * TOPICS..topics.min((robot + 1) * TOPICS)).collect::<Vec<_>>();
    for robot in &robots {
        let prefix = prefix(*robot);
        let mut say = |message: Message| put(&mut file, Duration::ZERO, &message.bytes());
        say(Message::from(prefix).data(forge::SPDP, 1, &forge::participant(prefix, 600, None)));
        let mut nodes = Vec::new();
        for (number, topic) in (1..).zip(own(*robot)) {
            let name = format!("rt/{}", name(topic, hostile));
            let kind = type_name(topic, hostile);
            let writer = Guid::new(prefix, EntityId([0, 0, number, 3]));
            // The topic to which the next participant of the ring subscribes.
            let listener = self::prefix((robot + 1) % robots.len());
            let reader = Guid::new(listener, EntityId([0, 1, number, 4]));
            let (writers, readers) = (forge::SEDP_WRITERS, forge::SEDP_READERS);
            let published = forge::endpoint(writer, &name, &kind, true);
            say(Message::from(prefix).data(writers, number.into(), &published));
            let subscribed = forge::endpoint(reader, &name, &kind, topic % 25 != 7);
            say(Message::from(listener).data(readers, number.into(), &subscribed));
            nodes.push((node_name(topic, hostile), writer));
        }
        for (number, name) in (1..).zip(REFUSED.iter().filter(|_| hostile)) {
            let writer = Guid::new(prefix, EntityId([0, 3, number, 3]));
            let refused = forge::endpoint(writer, &format!("rt/{name}"), "std::T_", true);
            say(Message::from(prefix).data(forge::SEDP_WRITERS, 100 + u64::from(number), &refused));
        }
        let nodes = nodes.iter().map(|(name, guid)| ("/", name.as_str(), *guid));
        let entities = forge::entities(prefix, 24, &nodes.collect::<Vec<_>>());
        say(Message::from(prefix).data(EntityId([0, 2, 0, 3]), 1, &entities));
    }
    for second in 0..seconds {
        for robot in &robots {
            let prefix = prefix(*robot);
            for (number, topic) in (1..).zip(own(*robot)) {
                // One topic in fifty loses every fifth message.
                if topic % 50 == 3 && second % 5 == 4 {
                    continue;
                }
                let after = Duration::from_secs(second + 1) + Duration::from_millis(topic as u64);
                let stamp = START * 1_000_000_000 + after.as_nanos() as u64 - 2_000_000;
                let payload = vec![0x33; 40 + topic % 50 * 4];
                let payload = [&[0, 1, 0, 0][..], &payload].concat();
                let writer = EntityId([0, 0, number, 3]);
                let message = Message::from(prefix).info_ts(stamp);
                put(
                    &mut file,
                    after,
                    &message.data(writer, second + 1, &payload).bytes(),
                );
            }
        }
    }
    file
}

fn prefix(robot: usize) -> GuidPrefix {
    let mut bytes = *b"\x01\x10crowd.....";
    bytes[8..].copy_from_slice(&(robot as u32).to_be_bytes());
    GuidPrefix(bytes)
}

fn name(topic: usize, hostile: bool) -> String {
    let harm = HARM[topic % HARM.len()];
    match (hostile, topic % 20) {
        (false, _) => format!("robot_{:02}/sensor_{topic:03}/data", topic / TOPICS),
        // This name has the maximum length of DDS, and characters that no keyboard has.
        (true, 19) => {
            let mut junk = format!("{topic:03}");
            let mut next = (topic as u32).wrapping_mul(2_654_435_761);
            loop {
                next = next.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let unit = char::from_u32((next >> 16) % 0x2fff).unwrap_or('\u{fffd}');
                if junk.len() + unit.len_utf8() > LONGEST - 3 {
                    break junk;
                }
                if is_shown(unit) {
                    junk.push(unit);
                }
            }
        }
        (true, _) => format!("{harm}{topic:03}"),
    }
}

/// Returns whether the agent accepts a name with this character.
fn is_shown(unit: char) -> bool {
    let turns = matches!(unit, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    !unit.is_control() && !turns && !matches!(unit, '"' | '\'' | '`' | '\\')
}

fn type_name(topic: usize, hostile: bool) -> String {
    match hostile {
        true if topic.is_multiple_of(3) => {
            format!("<b>{}</b>::msg::dds_::T_", HARM[topic % HARM.len()])
        }
        _ => "sensor_msgs::msg::dds_::PointCloud2_".to_owned(),
    }
}

pub(super) fn node_name(topic: usize, hostile: bool) -> String {
    match hostile {
        true => format!("{}{topic}", HARM[(topic + 5) % HARM.len()]),
        false => format!("driver_{topic:03}"),
    }
}

/// Adds a UDP payload that is sent to the discovery multicast address of domain 0.
pub(super) fn put(file: &mut Vec<u8>, after: Duration, payload: &[u8]) {
    let length = u16::try_from(payload.len()).unwrap();
    let mut frame = vec![1, 0, 0x5e, 0x7f, 0, 1, 2, 0, 0, 0, 0, 1, 8, 0, 0x45, 0];
    frame.extend_from_slice(&(length + 28).to_be_bytes());
    frame.extend_from_slice(&[0, 1, 0, 0, 64, 17, 0, 0, 10, 0, 0, 1, 239, 255, 0, 1]);
    frame.extend_from_slice(&[0x1c, 0xe9, 0x1c, 0xe8]);
    frame.extend_from_slice(&(length + 8).to_be_bytes());
    frame.extend_from_slice(&[0, 0]);
    frame.extend_from_slice(payload);
    let size = u32::try_from(frame.len()).unwrap();
    let seconds = u32::try_from(START + after.as_secs()).unwrap();
    for number in [seconds, after.subsec_micros(), size, size] {
        file.extend_from_slice(&number.to_le_bytes());
    }
    file.extend_from_slice(&frame);
}
