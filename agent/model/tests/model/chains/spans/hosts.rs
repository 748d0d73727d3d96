//! The spans of two agents on two hosts, neither of which sees the whole chain.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;

use ros2probe_capture::border::observe;
use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::model::forge::{
    self, AnnouncedNode, Message as Forged, SEDP_READERS, SEDP_WRITERS, SPDP,
};
use ros2probe_testing::model::host::START;
use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Record, Timestamp};

use super::*;

const DISCOVERY_INFO: EntityId = EntityId([0, 0, 0x04, 0x03]);
/// Nodes with input and output.
const NODES: [(&str, Option<&str>, &str); 3] = [
    ("sensor", None, "/points"),
    ("filter", Some("/points"), "/filtered"),
    ("controller", Some("/filtered"), "/cmd"),
];

/// The agent of one host.
struct Agent {
    observer: Observer,
    /// Last digit of the host's address.
    host: u8,
    hosts: Hosts,
    at: u64,
}

/// The host of each node.
type Hosts = [u8; NODES.len()];
/// `/filter` runs on the second host.
const BETWEEN: Hosts = [1, 2, 1];
/// Only `/sensor` runs on the first host.
const BEYOND: Hosts = [1, 2, 2];

fn prefix(node: usize) -> GuidPrefix {
    let mut bytes = *b"\x01\x10host-node0";
    bytes[11] = u8::try_from(node).unwrap();
    GuidPrefix(bytes)
}

fn address(node: usize, hosts: Hosts) -> SocketAddrV4 {
    let port = 7411 + 2 * u16::try_from(node).unwrap();
    SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, hosts[node]), port)
}

const fn writer(node: usize) -> Guid {
    let mut bytes = *b"\x01\x10host-node0";
    bytes[11] = node as u8;
    Guid::new(GuidPrefix(bytes), EntityId([0, 0, 1, 3]))
}

impl Agent {
    fn new(host: u8, hosts: Hosts) -> Self {
        let mut observer = Observer::new(Settings::default());
        let watch = Watch {
            trace: 1.0,
            ..Watch::named("/**").unwrap()
        };
        let watchlist = Watchlist::new(vec![watch]).unwrap();
        observer.input(Input::Watchlist(Arc::new(watchlist)));
        observer.input(Input::Time(Timestamp(START)));
        let mut agent = Self {
            observer,
            host,
            hosts,
            at: START,
        };
        for (node, (name, input, output)) in NODES.into_iter().enumerate() {
            let prefix = prefix(node);
            let reader = Guid::new(prefix, EntityId([0, 0, 2, 4]));
            let from = || Forged::from(prefix);
            let payload =
                forge::participant_at(prefix, 1_000_000, Some(0), &[address(node, hosts)]);
            agent.announce(from().data(SPDP, 1, &payload));
            let message_type = "sensor_msgs::msg::dds_::PointCloud2_";
            let payload = forge::endpoint(writer(node), &format!("rt{output}"), message_type, true);
            agent.announce(from().data(SEDP_WRITERS, 1, &payload));
            if let Some(input) = input {
                let payload = forge::endpoint(reader, &format!("rt{input}"), message_type, true);
                agent.announce(from().data(SEDP_READERS, 1, &payload));
            }
            let node = AnnouncedNode {
                namespace: "/",
                name,
                readers: input.map(|_| reader).into_iter().collect(),
                writers: vec![writer(node)],
            };
            let payload = forge::entities_of(prefix, 24, &[node]);
            agent.announce(from().data(DISCOVERY_INFO, 1, &payload));
        }
        agent.until(START + 2000 * MILLISECOND);
        agent
    }

    fn announce(&mut self, message: Forged) {
        self.observer.input(Input::Datagram {
            envelope: &forge::multicast(START, 0),
            payload: &message.bytes(),
            handover: None,
        });
    }

    fn until(&mut self, at: u64) {
        self.at = self.at.max(at);
        self.observer.input(Input::Time(Timestamp(self.at)));
    }

    /// Passes the records of a message between two nodes that this agent sees. The message leaves
    /// after 100 µs and arrives 300 µs later.
    fn message(&mut self, node: usize, number: u64, at: u64, stamp: u64) {
        let is_read = node + 1 < NODES.len();
        let destination = address(if is_read { node + 1 } else { node }, self.hosts);
        let [a, b] = [0, u32::from_ne_bytes([0, 0, 0xff, 0xff])];
        let record = Record {
            kind: kind::DATA,
            submessage_flags: 5,
            writer: guid_words(writer(node)),
            sequence_number: number,
            source_timestamp: rtps(at),
            destination: [a, a, b, u32::from_ne_bytes(destination.ip().octets())],
            destination_port: destination.port(),
            interface: 2,
            payload_len: 40,
            stamp_seconds: u32::try_from(stamp / 1_000_000_000).unwrap(),
            stamp_nanoseconds: u32::try_from(stamp % 1_000_000_000).unwrap(),
            ..Record::default()
        };
        if self.hosts[node] == self.host {
            observe(
                &mut self.observer,
                &Record {
                    time: at + 100 * MICROSECOND,
                    flags: flag::STAMP | flag::HOST | flag::OUTGOING,
                    socket: 100 + node as u64,
                    ..record
                },
            );
        }
        if is_read && self.hosts[node + 1] == self.host {
            observe(
                &mut self.observer,
                &Record {
                    time: at + 400 * MICROSECOND,
                    flags: flag::STAMP | flag::HOST,
                    socket: 100 + node as u64 + 1,
                    ..record
                },
            );
        }
    }
}

fn rtps(at: u64) -> u64 {
    let fraction = (u128::from(at % 1_000_000_000) << 32).div_ceil(1_000_000_000);
    (at / 1_000_000_000) << 32 | u64::try_from(fraction).unwrap()
}

/// Plays the chain to the agents of both hosts, with stamps of this granularity.
fn play(granularity: u64, hosts: Hosts) -> [Vec<ChainSpan>; 2] {
    let mut agents = [Agent::new(1, hosts), Agent::new(2, hosts)];
    for agent in &mut agents {
        for index in 0..60 {
            let at = START + 3000 * MILLISECOND + index * 50 * MILLISECOND + 137 * index;
            agent.until(at);
            let stamp = (at - 777) / granularity * granularity;
            for (node, after) in [0, 12, 15].into_iter().enumerate() {
                agent.message(node, index + 1, at + after * MILLISECOND, stamp);
            }
        }
        agent.until(START + 15_000 * MILLISECOND);
    }
    agents.map(|mut agent| agent.observer.drain().chain_spans.spans.to_vec())
}

/// Asserts that each span comes from one agent, and that one of the agents exports its parent.
fn is_whole([one, two]: [&[ChainSpan]; 2]) {
    let ids = |spans: &[ChainSpan]| spans.iter().map(|span| span.id).collect::<BTreeSet<_>>();
    let (first, second) = (ids(one), ids(two));
    assert_eq!((first.len(), second.len()), (one.len(), two.len()));
    assert!(first.is_disjoint(&second));
    for span in one.iter().chain(two) {
        let has_parent = |parent| first.contains(&parent) || second.contains(&parent);
        assert!(span.parent.is_none_or(has_parent), "{span:#?}");
        assert!(!span.id.is_of_host);
    }
}

/// Before the fix, each agent had its own span for a node of the other host, and backends showed
/// both.
#[test]
fn two_agents_report_one_trace_in_which_each_hop_occurs_once() {
    let [one, two] = play(1, BETWEEN);
    is_whole([&one, &two]);
    let (first, second) = (by_trace(&one), by_trace(&two));
    let (trace, of_one) = first.last_key_value().unwrap();
    let of_two = &second[trace];
    let expected = [
        "publish /points (/sensor) 100",
        "transit /filtered (/controller) 0",
        "node /filtered -> /cmd (/controller) 2600",
        "  publish /cmd (/controller) 100",
    ];
    assert_eq!(tree(of_one), expected);
    let expected = [
        "transit /points (/filter) 0",
        "node /points -> /filtered (/filter) 11600",
        "  publish /filtered (/filter) 100",
    ];
    assert_eq!(tree(of_two), expected);
    let together: Vec<_> = of_one.iter().chain(of_two).copied().collect();
    let expected = [
        "publish /points (/sensor) 100",
        "  transit /points (/filter) 0",
        "  node /points -> /filtered (/filter) 11600",
        "    publish /filtered (/filter) 100",
        "      transit /filtered (/controller) 0",
        "      node /filtered -> /cmd (/controller) 2600",
        "        publish /cmd (/controller) 100",
    ];
    assert_eq!(tree(&together), expected);
    let common = first.keys().filter(|trace| second.contains_key(trace));
    assert!(common.count() > 40);
}

#[test]
fn agents_that_see_the_first_message_share_traces_with_rounded_stamps() {
    let [one, two] = play(50_000, BETWEEN);
    is_whole([&one, &two]);
    let (first, second) = (by_trace(&one), by_trace(&two));
    let common = first.keys().filter(|trace| second.contains_key(trace));
    assert!(common.count() > 20, "{} {}", first.len(), second.len());
}

/// Before the fix, the sensor's host exported nothing, because its agent sees no continuation
/// there.
#[test]
fn the_first_publication_is_exported_if_the_chain_continues_on_another_host() {
    let [one, two] = play(1, BEYOND);
    is_whole([&one, &two]);
    let (first, second) = (by_trace(&one), by_trace(&two));
    let (trace, of_two) = second.last_key_value().unwrap();
    let together: Vec<_> = first[trace].iter().chain(of_two).copied().collect();
    let lines = tree(&together);
    assert_eq!(lines.len(), 7, "{lines:#?}");
    assert_eq!(lines[0], "publish /points (/sensor) 100");
    assert!(first.values().all(|trace| trace.len() == 1));
}
