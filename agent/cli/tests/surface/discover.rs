//! The conversation of `rp discover`, without a network. The answers are those of real
//! participants, or answers that are lost, late, duplicated, truncated or forged.

use std::collections::BTreeSet;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::Path;

use proptest::prelude::*;
use ros2probe::discover::Refusal;
use ros2probe::discover::message::{LocalParticipant, Message};
use ros2probe::discover::session::{MAX_PACKETS, Outgoing, Session, Target};
use ros2probe_model::facts::bounded::ledger;
use ros2probe_model::facts::model_time::ModelTime;
use ros2probe_model::graph::discovery::{Addresses, hexadecimal};
use ros2probe_model::report::snapshot::{ParticipantFacts, ProcessFacts};
use ros2probe_testing::model::forge::{self, SEDP_WRITERS};
use ros2probe_wire::discovery::Role;
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::time::MILLISECOND;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, Timestamp};

const START: u64 = 5_000 * MILLISECOND;
/// Maximum duration of a conversation, and one tick, in nanoseconds.
const LIMIT: u64 = 3_100 * MILLISECOND;
/// Addresses of the participant for discovery and for its other endpoints in these tests.
const METATRAFFIC: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 99, 0, 1), 7410);
const DEFAULT: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 99, 0, 1), 7411);

/// A recorded conversation.
struct Recording {
    speaker: LocalParticipant,
    target: Target,
    /// Time since the first packet, in nanoseconds, and the datagram.
    sent: Vec<(u64, Vec<u8>)>,
    received: Vec<(u64, Vec<u8>)>,
}

impl Recording {
    fn read(name: &str) -> Self {
        let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/discover");
        let text = std::fs::read_to_string(directory.join(name)).unwrap();
        let (mut sent, mut received) = (Vec::new(), Vec::new());
        for line in text.lines() {
            let mut words = line.split(' ');
            let mut word = || words.next().unwrap();
            let (time, way, digits) = (word(), word(), word());
            let pairs = digits.as_bytes().chunks(2);
            let bytes = pairs.map(|pair| hexadecimal::<1>(str::from_utf8(pair).unwrap()).unwrap());
            let bytes: Vec<u8> = bytes.flatten().collect();
            let time = time.parse::<u64>().unwrap() * 1000;
            match way {
                ">" => sent.push((time, bytes)),
                _ => received.push((time, bytes)),
            }
        }
        // The introduction has the GUID prefix of the sender, and its address in
        // PID_METATRAFFIC_UNICAST_LOCATOR.
        let introduction = &sent[0].1;
        let locator = [0x32, 0, 24, 0, 1, 0, 0, 0];
        let place = introduction
            .windows(8)
            .position(|it| it == locator)
            .unwrap()
            + 8;
        let port = u16::from_le_bytes([introduction[place], introduction[place + 1]]);
        let address: [u8; 4] = introduction[place + 16..place + 20].try_into().unwrap();
        let prefix = |at: usize| GuidPrefix(introduction[at..at + 12].try_into().unwrap());
        Self {
            speaker: LocalParticipant {
                prefix: prefix(8),
                address: SocketAddrV4::new(address.into(), port),
                domain_id: 0,
            },
            target: Target {
                prefix: prefix(24),
                metatraffic: METATRAFFIC,
                default: DEFAULT,
            },
            sent,
            received,
        }
    }

    fn both() -> [Self; 2] {
        ["cyclonedds.txt", "fastdds.txt"].map(Self::read)
    }

    fn session(&self) -> Session {
        Session::new(self.speaker, self.target, true)
    }

    /// Delivers each answer to a session at its time. Returns the sent packets with their times.
    fn play(&self, session: &mut Session, answers: &[(u64, Vec<u8>)]) -> Vec<(u64, Outgoing)> {
        let mut answers = answers.to_vec();
        answers.sort_by_key(|(time, _)| *time);
        let mut answers = answers.into_iter().peekable();
        let mut outgoing = Vec::new();
        let mut time = 0;
        while !session.is_over() {
            assert!(time < LIMIT, "it goes on and on");
            let now = Timestamp(START + time);
            outgoing.extend(session.advance(now).into_iter().map(|sent| (time, sent)));
            while let Some((_, bytes)) = answers.next_if(|(at, _)| *at <= time) {
                session.datagram(now, &bytes);
                outgoing.extend(session.advance(now).into_iter().map(|sent| (time, sent)));
            }
            time += MILLISECOND;
        }
        outgoing
    }
}

/// Checks the rules of every conversation.
fn assert_conversation_rules(
    session: &Session,
    recording: &Recording,
    outgoing: &[(u64, Outgoing)],
) {
    let (sent, _) = session.cost();
    assert!(sent.packets <= MAX_PACKETS, "{} packets", sent.packets);
    assert_eq!(sent.packets as usize, outgoing.len());
    let bytes: usize = outgoing.iter().map(|(_, packet)| packet.bytes.len()).sum();
    assert_eq!(sent.bytes, bytes as u64);
    let message = || Message::new(recording.speaker, recording.target.prefix);
    let introduction = message().announce(recording.speaker).bytes();
    let goodbye = message().goodbye(recording.speaker).bytes();
    assert_eq!(outgoing[0].1.bytes, introduction);
    let goodbyes = outgoing.iter().filter(|(_, it)| it.bytes == goodbye);
    assert_eq!(goodbyes.count(), 1);
    assert_eq!(outgoing.last().unwrap().1.bytes, goodbye);
    for (_, packet) in outgoing {
        let to = if packet.what == "goodbye" || packet.what == "introduction" {
            vec![METATRAFFIC]
        } else {
            vec![METATRAFFIC, DEFAULT]
        };
        assert!(to.contains(&packet.to));
        // INFO_DST makes other participants at that address ignore the message.
        assert_eq!(packet.bytes[24..36], recording.target.prefix.0);
    }
}

fn names(session: &Session) -> BTreeSet<String> {
    let nodes = session.nodes().unwrap_or_default().iter();
    nodes.map(|node| node.fully_qualified_name()).collect()
}

#[test]
fn real_participants_get_the_recorded_packets_and_announce_all_endpoints() {
    for recording in Recording::both() {
        let mut session = recording.session();
        let outgoing = recording.play(&mut session, &recording.received);
        let sent: Vec<_> = outgoing.iter().map(|(_, packet)| &packet.bytes).collect();
        let recorded: Vec<_> = recording.sent.iter().map(|(_, bytes)| bytes).collect();
        assert_eq!(sent, recorded);
        assert_conversation_rules(&session, &recording, &outgoing);
        let expected = (0..24).map(|n| format!("/robot/sensors/camera_{n}"));
        assert_eq!(names(&session), expected.collect());
        let writers = session
            .endpoints()
            .values()
            .filter(|it| it.role == Role::Writer);
        let topics: BTreeSet<_> = writers.map(|it| it.topic.as_str().to_owned()).collect();
        let further = (1..24).map(|n| format!("rt/imu_{n}"));
        let all = further.chain(["ros_discovery_info", "rt/imu"].map(str::to_owned));
        assert_eq!(topics, all.collect());
        assert_eq!(session.endpoints().len(), 26);
        assert_eq!((session.missing(), session.was_answered()), (0, true));
    }
}

#[test]
fn without_nodes_one_packet_less_is_sent_and_no_reader_is_announced() {
    for recording in Recording::both() {
        let mut session = Session::new(recording.speaker, recording.target, false);
        let outgoing = recording.play(&mut session, &recording.received);
        assert_conversation_rules(&session, &recording, &outgoing);
        assert_eq!((outgoing.len(), session.endpoints().len()), (3, 26));
        assert!(session.nodes().is_none() && !session.expects_nodes());
        let reader = |(_, packet): &(u64, Outgoing)| {
            packet
                .bytes
                .windows(18)
                .any(|it| it == b"ros_discovery_info")
        };
        assert!(!outgoing.iter().any(reader));
    }
}

#[test]
fn silence_leads_to_one_more_introduction_and_a_goodbye() {
    let [recording, _] = Recording::both();
    let mut session = recording.session();
    let outgoing = recording.play(&mut session, &[]);
    assert_conversation_rules(&session, &recording, &outgoing);
    let printed: Vec<_> = outgoing.iter().map(|(_, packet)| packet.what).collect();
    assert_eq!(printed, ["introduction", "introduction", "goodbye"]);
    let (last, _) = outgoing.last().unwrap();
    assert!(*last <= 1_010 * MILLISECOND);
    assert!(!session.was_answered());
}

#[test]
fn a_participant_with_endless_announcements_gets_no_more_packets() {
    for recording in Recording::both() {
        // HEARTBEATs announce more and more samples, but no sample follows.
        let heartbeat = |last: u32| {
            let mut bytes = [b"RTPS\x02\x03\x01\x10", &recording.target.prefix.0[..]].concat();
            for writer in [
                EntityId::SEDP_PUBLICATIONS_WRITER,
                EntityId::SEDP_SUBSCRIPTIONS_WRITER,
            ] {
                bytes.extend([0x07, 0x03, 28, 0, 0, 0, 0, 0]);
                bytes.extend(writer.0);
                for word in [0, 1, last >> 16, last, last] {
                    bytes.extend(word.to_le_bytes());
                }
            }
            bytes
        };
        let answers: Vec<_> = (0..300)
            .map(|n| (u64::from(n) * 10 * MILLISECOND, heartbeat(n << 20)))
            .collect();
        let mut session = recording.session();
        let outgoing = recording.play(&mut session, &answers);
        assert_conversation_rules(&session, &recording, &outgoing);
        assert!(session.missing() > 0 && session.missing() <= 2 * 4096);
    }
}

#[test]
fn endless_announcements_fill_no_table_beyond_its_cap() {
    let recording = Recording::read("fastdds.txt");
    let mut session = recording.session();
    let now = Timestamp(START);
    session.advance(now);
    let prefix = recording.target.prefix;
    let message = || forge::Message::from(prefix);
    let mut put = |message: forge::Message| session.datagram(now, &message.bytes());
    for number in 1..=10_000_u32 {
        let [_, a, b, c] = number.to_be_bytes();
        let entity = EntityId([a, b, c, 3]);
        let endpoint = forge::endpoint(Guid::new(prefix, entity), "rt/a", "a::msg::dds_::B_", true);
        put(message().data(SEDP_WRITERS, number.into(), &endpoint));
        let (sample, payload) = (u64::from(20_000 + number), [5; 1000]);
        put(message().fragment(SEDP_WRITERS, sample, 1, 64, &payload));
        let range = [0, 0, 0, 0, 1, 0, 0, 0].repeat(2);
        let heartbeat = [&[0; 4][..], &entity.0, &range, &[1, 0, 0, 0]].concat();
        put(message().submessage(0x07, 1, &heartbeat));
    }
    let ledger = ledger();
    for table in ["received", "endpoints", "partial", "writers"] {
        let used = ledger[&*format!("discover.{table}")];
        assert!(used.is_driven(), "{table}: {used:?}");
    }
}

#[test]
fn packets_of_other_participants_are_ignored() {
    for recording in Recording::both() {
        let mut forged = recording.received.clone();
        for (_, bytes) in &mut forged {
            bytes[8..20].copy_from_slice(b"someone-else");
        }
        let mut session = recording.session();
        recording.play(&mut session, &forged);
        assert!(session.endpoints().is_empty() && !session.was_answered());
        let mut misdirected = recording.received.clone();
        for (_, bytes) in &mut misdirected {
            let own = recording.speaker.prefix.0;
            while let Some(place) = bytes.windows(12).position(|it| it == own) {
                bytes[place..place + 12].copy_from_slice(b"another-one!");
            }
        }
        let mut session = recording.session();
        recording.play(&mut session, &misdirected);
        assert!(
            session.endpoints().is_empty(),
            "meant for another participant"
        );
    }
}

#[test]
fn leaving_sends_one_goodbye_and_only_to_contacted_participants() {
    let [recording, _] = Recording::both();
    let mut session = recording.session();
    assert!(session.say_goodbye().is_empty());
    session.advance(Timestamp(START));
    assert_eq!(session.say_goodbye().len(), 1);
    assert!(session.is_over() && session.say_goodbye().is_empty());
    assert!(session.advance(Timestamp(START + LIMIT)).is_empty());
}

#[test]
fn participants_with_dds_security_or_without_an_address_are_not_contacted() {
    let participant = |secured, metatraffic: &[&str]| ParticipantFacts {
        guid: Guid::new(GuidPrefix([3; 12]), EntityId::PARTICIPANT),
        domain_id: DomainId(0),
        vendor: VendorId::UNKNOWN,
        product_version: None,
        enclave: None,
        process: ProcessFacts::default(),
        first_seen: ModelTime::ZERO,
        last_seen: ModelTime::ZERO,
        lease: ros2probe_wire::RtpsDuration::Infinite,
        secured,
        announces_by_tcp: false,
        announces_unseen: false,
        discovery_server: false,
        restored: false,
        addresses: Addresses {
            metatraffic: metatraffic.iter().map(|it| it.parse().unwrap()).collect(),
            default: ["127.0.0.1:7411".parse().unwrap()].into(),
            tcp: Box::default(),
        },
    };
    let asked = |secured, addresses: &[&str]| {
        let target = Target::of(&participant(secured, addresses));
        target.map(|target| (target.metatraffic.to_string(), target.default.to_string()))
    };
    let there = "127.0.0.1:7410";
    assert_eq!(asked(true, &[there]), Err(Refusal::Secured));
    for nowhere in [
        &[][..],
        &["[::1]:7410"],
        &["239.255.0.1:7400"],
        &["0.0.0.0:1"],
    ] {
        assert_eq!(asked(false, nowhere), Err(Refusal::NoAddress));
    }
    let by_tcp = ParticipantFacts {
        announces_by_tcp: true,
        ..participant(false, &[])
    };
    assert_eq!(Target::of(&by_tcp), Err(Refusal::UsesTcp));
    let found = asked(false, &["[::1]:9", there]).unwrap();
    assert_eq!(found, (there.to_owned(), "127.0.0.1:7411".to_owned()));
    let mut asking = participant(false, &[there]);
    asking.guid.prefix = GuidPrefix(*b"\x01\x7fabcdefghij");
    assert_eq!(Target::of(&asking), Err(Refusal::OtherDiscover));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Answers are lost, duplicated, delayed, truncated and changed.
    #[test]
    fn any_answers_lead_to_few_packets_and_one_goodbye(
        which in 0usize..2,
        fates in prop::collection::vec(
            (0u8..6, 0u64..1_500, any::<prop::sample::Index>(), any::<u8>()), 15),
    ) {
        let recording = &Recording::both()[which];
        let mut answers = Vec::new();
        for ((time, bytes), (fate, delay, place, byte)) in recording.received.iter().zip(fates) {
            let mut bytes = bytes.clone();
            let place = place.index(bytes.len());
            match fate {
                0 => continue,
                1 => answers.push((*time + delay * MILLISECOND, bytes.clone())),
                2 => bytes.truncate(place),
                3 => bytes[place] = byte,
                _ => {}
            }
            answers.push((*time, bytes));
        }
        let mut session = recording.session();
        let outgoing = recording.play(&mut session, &answers);
        assert_conversation_rules(&session, recording, &outgoing);
    }
}
