//! Calls seen at the sockets of a host, where a reply counts once it reaches its client.

use ros2probe_capture::border::observe;

use super::*;

/// A reply or request at one of the sockets of this host.
struct AtSocket {
    flags: u16,
    socket: u64,
    directed: GuidPrefix,
}

const SERVER_SENDS: u64 = 20;
const CLIENT_RECEIVES: u64 = 11;
const OTHER_RECEIVES: u64 = 12;

impl AtSocket {
    const fn leaving(socket: u64, directed: GuidPrefix) -> Self {
        Self {
            flags: flag::HOST | flag::OUTGOING,
            socket,
            directed,
        }
    }

    const fn arriving(socket: u64, directed: GuidPrefix) -> Self {
        Self {
            flags: flag::HOST,
            socket,
            directed,
        }
    }

    fn dropped(self) -> Self {
        Self {
            flags: self.flags | flag::SOCKET_FULL,
            ..self
        }
    }
}

impl Robot {
    /// Reports a captured datagram at the socket that sends it.
    fn captured(&mut self, message: Message, socket: u64) {
        let envelope = Envelope {
            host: true,
            outgoing: true,
            socket,
            ..forge::multicast(self.domain.now, 0)
        };
        self.domain.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }

    /// Reports a further copy, of which the kernel captures no bytes.
    fn copy(&mut self, from: Party, number: u64, at: &AtSocket) {
        let record = Record {
            kind: kind::DATA,
            submessage_flags: 5,
            writer: guid_words(from.writer),
            reader: guid_words(Guid::new(at.directed, EntityId::UNKNOWN)),
            time: self.domain.now,
            sequence_number: number,
            destination: [0, 0, u32::from_be(0xffff), 0x0100_007f],
            destination_port: 7411,
            payload_len: 24,
            flags: at.flags,
            socket: at.socket,
            ..Record::default()
        };
        observe(&mut self.domain.observer, &record);
    }

    /// A client of this host sends its request.
    fn call(&mut self, client: Party, number: u64) {
        let message = self.message(client, number, (client.identity, number), &[7; 8]);
        self.captured(message, 10);
    }

    fn replies(&mut self, server: Party, number: u64, client: Party, of: u64) {
        let message = self.message(server, number, (client.identity, of), &[7; 8]);
        self.captured(message, SERVER_SENDS);
    }
}

#[test]
fn the_reply_counts_when_it_arrives_at_the_clients_socket() {
    with_each(|mut robot| {
        let [client, other] = [1, 2].map(|number| robot.client(number, ADD));
        let server = robot.server(3, ADD);
        robot.call(client, 1);
        robot.wait(30);
        robot.replies(server, 1, client, 1);
        assert_eq!(robot.counts(), (1, 0, 0, 0));
        robot.wait(1);
        let others = AtSocket::arriving(OTHER_RECEIVES, other.writer.prefix);
        robot.copy(server, 1, &others);
        assert_eq!(robot.counts(), (1, 0, 0, 0));
        robot.wait(1);
        robot.copy(
            server,
            1,
            &AtSocket::arriving(CLIENT_RECEIVES, client.writer.prefix),
        );
        assert_eq!(robot.counts(), (1, 1, 0, 0));
        assert_eq!(robot.service(ADD).unwrap().latency.p50, Some(0.032));
    });
}

#[test]
fn a_lost_reply_is_not_an_answer_until_it_is_retransmitted() {
    with_each(|mut robot| {
        let client = robot.client(1, ADD);
        let server = robot.server(2, ADD);
        robot.call(client, 1);
        robot.wait(10);
        robot.replies(server, 1, client, 1);
        robot.wait(7_000);
        assert_eq!(robot.counts(), (1, 0, 1, 1));
        // The retransmission leaves as a record, since the kernel captures a message once.
        robot.copy(
            server,
            1,
            &AtSocket::leaving(SERVER_SENDS, client.writer.prefix),
        );
        assert_eq!(robot.counts(), (1, 0, 1, 1));
        robot.copy(
            server,
            1,
            &AtSocket::arriving(CLIENT_RECEIVES, client.writer.prefix),
        );
        assert_eq!(robot.counts(), (1, 1, 1, 0));
        assert_eq!(robot.service(ADD).unwrap().latency.p50, Some(7.01));
    });
}

#[test]
fn a_reply_that_a_full_socket_buffer_drops_is_not_an_answer() {
    with_each(|mut robot| {
        let client = robot.client(1, ADD);
        let server = robot.server(2, ADD);
        robot.call(client, 1);
        robot.replies(server, 1, client, 1);
        let arrival = || AtSocket::arriving(CLIENT_RECEIVES, client.writer.prefix);
        robot.copy(server, 1, &arrival().dropped());
        robot.copy(server, 1, &arrival());
        assert_eq!(robot.counts(), (1, 0, 0, 0));
        robot.wait(3);
        robot.copy(server, 1, &arrival());
        assert_eq!(robot.counts(), (1, 1, 0, 0));
    });
}

#[test]
fn a_client_on_another_host_is_answered_when_the_reply_leaves() {
    with_each(|mut robot| {
        let client = robot.client(1, ADD);
        let server = robot.server(2, ADD);
        let message = robot.message(client, 1, (client.identity, 1), &[7; 8]);
        let envelope = Envelope {
            host: true,
            socket: 21,
            ..forge::multicast(robot.domain.now, 0)
        };
        robot.domain.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
        robot.wait(4);
        robot.replies(server, 1, client, 1);
        assert_eq!(robot.counts(), (1, 1, 0, 0));
        assert_eq!(robot.service(ADD).unwrap().latency.p50, Some(0.004));
    });
}

#[test]
fn messages_sampled_in_shared_memory_are_not_counted() {
    with_each(|mut robot| {
        let client = robot.client(1, ADD);
        robot.server(2, ADD);
        let message = robot.message(client, 1, (client.identity, 1), &[7; 8]);
        robot.domain.observer.input(Input::SharedMemory {
            envelope: &forge::multicast(robot.domain.now, 0),
            payload: &message.bytes(),
        });
        robot.wait(10_000);
        assert_eq!((robot.service(ADD), robot.hanging()), (None, vec![]));
    });
}

#[test]
fn a_fragmented_reply_is_an_answer_when_all_fragments_have_arrived() {
    let mut robot = Robot::new(Middleware::Cyclone);
    let client = robot.client(1, ADD);
    let server = robot.server(2, ADD);
    robot.request(client, 1);
    let fragment = |robot: &mut Robot, start| {
        robot.part_of_a_reply(server, client, &[5; 2_500], start, 1_000);
        robot.wait(1);
    };
    for start in [1, 3, 3, 1] {
        fragment(&mut robot, start);
        assert_eq!(robot.counts(), (1, 0, 0, 0));
    }
    fragment(&mut robot, 2);
    assert_eq!(robot.counts(), (1, 1, 0, 0));
    assert_eq!(robot.service(ADD).unwrap().latency.p50, Some(0.004));
}
