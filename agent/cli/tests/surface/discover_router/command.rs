//! `rp discover --router` against a server that answers as scripted.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::process::Output;
use std::thread::{self, JoinHandle};

use ros2probe_testing::ports::free_address;
use ros2probe_wire::zenoh::Batch;

use super::answers::{final_, frame, init, open, token};
use super::{publisher, recorded_answers};
use crate::rp;

/// An action of the server after each batch that it receives. The server closes the connection
/// after the last action.
enum Then {
    /// Sends these batches, with their lengths.
    Batches(Vec<Vec<u8>>),
    /// Sends these bytes.
    Bytes(&'static [u8]),
    /// Waits until the client closes the connection.
    Wait,
}

struct Server {
    address: SocketAddr,
    /// The bytes that the server received.
    received: JoinHandle<Vec<u8>>,
}

impl Server {
    fn start(script: Vec<Then>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let received = thread::spawn(move || {
            let (mut client, _) = listener.accept().unwrap();
            let mut received = Vec::new();
            for then in script {
                if !matches!(then, Then::Wait) {
                    received.extend(batch_of(&mut client));
                }
                match then {
                    Then::Batches(batches) => {
                        for batch in batches {
                            client.write_all(&with_length(&batch)).unwrap();
                        }
                    }
                    Then::Bytes(bytes) => client.write_all(bytes).unwrap(),
                    Then::Wait => drop(client.read_to_end(&mut received).unwrap()),
                }
            }
            received
        });
        Self { address, received }
    }

    /// Runs the command, and returns its output and the bytes that the server received.
    fn ask(self, more: &[&str]) -> (Output, Vec<u8>) {
        let output = ask(self.address, more);
        (output, self.received.join().unwrap())
    }
}

/// Reads one batch with its length.
fn batch_of(client: &mut TcpStream) -> Vec<u8> {
    let mut length = [0; 2];
    client.read_exact(&mut length).unwrap();
    let mut batch = vec![0; u16::from_le_bytes(length).into()];
    client.read_exact(&mut batch).unwrap();
    [&length[..], &batch].concat()
}

fn with_length(batch: &[u8]) -> Vec<u8> {
    let length = u16::try_from(batch.len()).unwrap().to_le_bytes();
    [&length[..], batch].concat()
}

fn ask(address: SocketAddr, more: &[&str]) -> Output {
    let mut command = rp();
    command.args(["discover", "--router", &address.to_string()]);
    command.args(more).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Asserts that the command fails with one line that has these words.
fn fails(script: Vec<Then>, words: &[&str]) {
    let (output, _) = Server::start(script).ask(&[]);
    assert_output_contains(&output, words);
}

fn assert_output_contains(output: &Output, words: &[&str]) {
    let errors = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{errors}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
    for word in words {
        assert!(errors.contains(word), "{word}: {errors}");
    }
}

fn introduced() -> Then {
    Then::Batches(vec![init(&[7; 49], 9, &[])])
}

#[test]
fn a_recorded_answer_is_printed_with_its_counts() {
    let [init, open, tokens] = <[_; 3]>::try_from(recorded_answers()).unwrap();
    let script = [init, open, tokens].map(|batch| Then::Batches(vec![batch]));
    let script = script.into_iter().chain([Then::Wait]).collect();
    let (output, received) = Server::start(script).ask(&[]);
    let printed = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    for line in [
        "  router 800766b7bc0c50bbba829b502ea489db",
        "  domain 0: learned 2 nodes, 5 publishers, 2 subscriptions, 13 services and 0 clients",
        "  domain 7: learned 1 node, 2 publishers, 2 subscriptions, 6 services and 0 clients",
        "    node   /robot2/listener",
        "    publisher /chatter std_msgs/msg/String",
        "    subscription /robot2/chatter std_msgs/msg/String",
    ] {
        assert!(printed.lines().any(|it| it == line), "{line}: {printed}");
    }
    // The command sent what it printed. The printed sizes are without the cookie, which has 49
    // bytes here.
    let planned: Vec<usize> = printed
        .lines()
        .filter(|line| line.contains("), "))
        .map(|line| line.split(' ').find_map(|it| it.parse().ok()).unwrap())
        .collect();
    let mut rest = &received[..];
    let mut sent = Vec::new();
    while let Some((batch, behind)) = Batch::split(rest) {
        sent.push(batch.len() + 2);
        rest = behind;
    }
    assert!(rest.is_empty());
    let [init, open, request, goodbye] = planned[..] else {
        panic!("{printed}");
    };
    assert_eq!(sent, [init, open + 49, request, goodbye]);
    let total = format!("sent 4 batches, {} bytes;", received.len());
    assert!(printed.contains(&total), "{printed}");
}

#[test]
fn a_dry_run_prints_the_messages_and_does_not_connect() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    listener.set_nonblocking(true).unwrap();
    let output = ask(listener.local_addr().unwrap(), &["--dry-run"]);
    assert_eq!(output.status.code(), Some(0));
    let printed = text(&output.stdout);
    assert!(
        printed.contains("would open one TCP connection"),
        "{printed}"
    );
    for message in ["INIT", "OPEN", "INTEREST", "CLOSE"] {
        assert!(printed.contains(&format!("({message})")), "{printed}");
    }
    assert_eq!(listener.accept().unwrap_err().kind(), ErrorKind::WouldBlock);
}

#[test]
fn a_closed_port_is_reported_as_no_router() {
    assert_output_contains(
        &ask(free_address(), &[]),
        &[
            "no Zenoh router at 127.0.0.1:",
            "ros2 run rmw_zenoh_cpp rmw_zenohd",
            "--router",
        ],
    );
}

#[test]
fn other_programs_are_recognized_by_their_first_bytes() {
    // TLS alerts of OpenSSL, and of a router with a `tls/` endpoint (Zenoh 1.8, recorded).
    for alert in [
        b"\x15\x03\x01\x00\x02\x02\x46",
        b"\x15\x03\x03\x00\x02\x02\x32",
    ] {
        fails(vec![Then::Bytes(alert)], &["expects TLS", "`tcp/`"]);
    }
    let http = b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n";
    fails(vec![Then::Bytes(http)], &["does not speak Zenoh", "7447"]);
    // The same without the end of the connection.
    let script = vec![Then::Bytes(b"SSH-2.0-OpenSSH_9.2\r\n"), Then::Wait];
    fails(script, &["does not speak Zenoh"]);
}

#[test]
fn another_version_and_a_refusal_are_reported_as_such() {
    let old = Then::Batches(vec![init(&[], 8, &[])]);
    fails(vec![old], &["version 8", "Zenoh 1.x"]);
    // CLOSE of a link from a router without a free session, and CLOSE from a router that rejects
    // the introduction.
    let full = Then::Batches(vec![vec![0x03, 3]]);
    fails(vec![full], &["too many sessions", "max_sessions"]);
    let invalid = Then::Batches(vec![vec![0x03, 2]]);
    fails(
        vec![introduced(), invalid],
        &["invalid message", "password"],
    );
}

#[test]
fn an_end_at_each_step_is_reported_with_the_last_message() {
    let nothing = || Then::Bytes(b"");
    fails(
        vec![nothing()],
        &["closed the connection after the introduction (INIT)"],
    );
    fails(
        vec![Then::Bytes(b"\x4b")],
        &["after the introduction (INIT)"],
    );
    fails(vec![introduced(), nothing()], &["after the opening (OPEN)"]);
    let opened = Then::Batches(vec![open(), frame(&token(&publisher(1)))]);
    let script = vec![introduced(), opened, nothing()];
    fails(script, &["after the request (INTEREST)", "log"]);
}

#[test]
fn a_silent_router_leads_to_a_timeout_and_to_a_goodbye_in_an_open_session() {
    let silent = Server::start(vec![Then::Wait]);
    let (output, received) = silent.ask(&[]);
    assert_output_contains(&output, &["no answer", "introduction (INIT)", "within 3 s"]);
    assert_eq!(received.len(), 24, "{received:x?}");
    let stops = Server::start(vec![introduced(), Then::Batches(vec![open()]), Then::Wait]);
    let (output, received) = stops.ask(&[]);
    assert_output_contains(&output, &["no answer", "request (INTEREST)", "within 3 s"]);
    assert!(received.ends_with(&[2, 0, 0x23, 0]), "{received:x?}");
}

#[test]
fn a_malformed_answer_is_refused_with_the_name_of_its_message() {
    let opened = Then::Batches(vec![open(), frame(&[0x3e, 1, 0x1f])]);
    fails(
        vec![introduced(), opened],
        &["malformed", "declaration", "report"],
    );
}

#[test]
fn an_endless_answer_ends_at_the_cap_with_a_part_of_the_graph() {
    let tokens = |from: usize| {
        let tokens = (from..from + 300).map(|number| token(&publisher(number)));
        frame(&tokens.collect::<Vec<_>>().concat())
    };
    let mut answer = vec![open()];
    answer.extend((0..220).map(|batch| tokens(batch * 300)));
    answer.push(frame(&final_()));
    let script = vec![introduced(), Then::Batches(answer), Then::Wait];
    let (output, received) = Server::start(script).ask(&[]);
    assert_output_contains(&output, &["announces more than rp takes", "--domain"]);
    let printed = text(&output.stdout);
    assert!(
        printed.contains("learned 0 nodes, 65536 publishers"),
        "{}",
        &printed[..600]
    );
    assert!(received.ends_with(&[2, 0, 0x23, 0]), "{received:x?}");
}
