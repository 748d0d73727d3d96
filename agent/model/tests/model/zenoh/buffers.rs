//! Topics whose messages have buffers (rmw_zenoh of Lyrical, `rmw_publisher_data.cpp`): the
//! publisher numbers what it sends to all its keys together.

use super::*;

const CPU: &str = "backends:cpu:";
const CUDA: &str = "backends:cuda:v;cpu:";
/// Aliases of the topic's key, of `_buf_cpu`, and of the keys of two subscriptions.
const BASE: u16 = 3;
const WHOLE: u16 = 4;
const REFERENCES: [u16; 2] = [5, 6];
const PAYLOAD: &[u8] = b"\0\x01\0\0";

/// A publisher of images with subscriptions of these backends, `None` for one that has no buffers.
/// Each subscription has a connection of its own.
struct Robot {
    observer: Observer,
    gid: [u8; 16],
    number: u64,
    now: u64,
}

fn token(session: [u8; 16], kind: &str, backends: Option<&str>) -> String {
    let token = publisher(session, 11, "/chatter").replace("/MP/", kind);
    match backends {
        Some(backends) => format!("{token}/{backends}"),
        None => token,
    }
}

impl Robot {
    fn new(subscriptions: &[Option<&str>]) -> Self {
        let mut observer = observer();
        let talker = token(TALKER, "/MP/", Some(CUDA));
        let mut gids = Vec::new();
        for (place, backends) in subscriptions.iter().enumerate() {
            let port = 1001 + place as u16;
            let session = [0x51 + place as u8; 16];
            connect(&mut observer, port, TALKER, (session, Role::Peer));
            let [there, back] = connection(port);
            let subscription = token(session, "/MS/", *backends);
            let declared = [declare_token(1, &subscription)];
            send(&mut observer, &back, START, &frame(7, &declared));
            let digits = Gid::of_token(&subscription).to_string();
            gids.push(digits);
            let mut declared = vec![
                declare_token(1, &talker),
                declare_key(BASE, KEY),
                declare_key(WHOLE, &format!("{KEY}/_buf_cpu")),
            ];
            for (alias, gid) in REFERENCES.iter().zip(&gids) {
                declared.push(declare_key(*alias, &format!("{KEY}/_buf/{gid}")));
            }
            send(&mut observer, &there, START, &frame(7, &declared));
        }
        Self {
            observer,
            gid: Gid::of_token(&talker).0,
            number: 0,
            now: START,
        }
    }

    /// Sends the next sample with this alias to the subscription with this number.
    fn put(&mut self, alias: u16, to: usize) {
        self.number += 1;
        self.now += SECOND / 10;
        let [there, _] = connection(1001 + to as u16);
        let batch = frame(8, &[push(alias, self.gid, self.number, PAYLOAD)]);
        send(&mut self.observer, &there, self.now, &batch);
    }

    /// Returns messages, losses of the topic, and losses of its receivers.
    fn counts(&mut self) -> (u64, u64, u64) {
        self.now += 20 * SECOND;
        let at = Timestamp(self.now);
        self.observer.input(Input::Time(at));
        let snapshot = self.observer.snapshot(at);
        let topic = chatter(&snapshot).unwrap();
        let [publisher] = &topic.publishers[..] else {
            panic!("{:?}", topic.publishers);
        };
        let own = publisher.measurement.as_deref().unwrap();
        assert_eq!(own.messages, topic.measurement.as_deref().unwrap().messages);
        let received = topic.received.as_deref();
        (
            own.messages,
            own.loss.lost,
            received.map_or(0, |sum| sum.lost()),
        )
    }
}

#[test]
fn messages_of_the_cpu_key_are_those_of_the_publisher() {
    let mut robot = Robot::new(&[Some(CPU)]);
    for _ in 0..10 {
        robot.put(WHOLE, 0);
    }
    assert_eq!(robot.counts(), (10, 0, 0));
    let snapshot = robot.observer.snapshot(Timestamp(robot.now));
    let topic = chatter(&snapshot).unwrap();
    let backends = |list: &[EndpointFacts]| -> Vec<String> {
        let backends = list[0].backends.as_deref().unwrap();
        backends.names().map(str::to_owned).collect()
    };
    assert_eq!(backends(&topic.publishers), ["cpu", "cuda"]);
    assert_eq!(backends(&topic.subscriptions), ["cpu"]);
}

#[test]
fn a_sequence_gap_on_the_cpu_topic_is_a_loss() {
    let mut robot = Robot::new(&[Some(CPU)]);
    for number in 0..20 {
        match number {
            10 => robot.number += 1,
            _ => robot.put(WHOLE, 0),
        }
    }
    assert_eq!(robot.counts(), (19, 1, 1));
}

#[test]
fn a_publisher_that_changes_to_the_base_key_loses_no_message() {
    let mut robot = Robot::new(&[Some(CPU), None]);
    for number in 0..20 {
        robot.put(if number < 10 { WHOLE } else { BASE }, 0);
    }
    assert_eq!(robot.counts(), (20, 0, 0));
}

#[test]
fn references_beside_messages_count_neither_as_messages_nor_as_losses() {
    let mut robot = Robot::new(&[Some(CPU), Some(CUDA)]);
    for _ in 0..10 {
        robot.put(WHOLE, 0);
        robot.put(REFERENCES[1], 1);
    }
    assert_eq!(robot.counts(), (10, 0, 0));
}

#[test]
fn references_to_one_subscription_count_if_no_message_is_sent_as_a_whole() {
    let mut robot = Robot::new(&[Some(CUDA), Some(CUDA)]);
    for _ in 0..10 {
        robot.put(REFERENCES[0], 0);
        robot.put(REFERENCES[1], 1);
    }
    assert_eq!(robot.counts(), (10, 0, 0));
}
