//! Fast DDS participants that use only TCP. Needs root.

use std::io::Write as _;
use std::net::{Ipv4Addr, SocketAddrV4, TcpListener, TcpStream};
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use crate::browser::PAGE;
use crate::browser::player::watch;
use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_capture::netns;
use ros2probe_testing::forged::{Carrier, Talker, framed, introduce, send_sizes};
use ros2probe_testing::harness::agent::{Agent, Scrape, datagrams_alone_of};
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::{INTERFACE, Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::snmp::Snmp;
use ros2probe_testing::harness::{run, wait_until};
use tempfile::TempDir;

const PATIENCE: Duration = Duration::from_secs(60);
/// Time in which two participants match on a busy machine, usually 3 s.
const MATCHED_WITHIN: Duration = Duration::from_secs(25);
const ATTEMPTS: usize = 5;
/// A port that nothing else uses in the namespaces of a test.
const PORT: u16 = 5100;

/// An agent that watches everything.
struct Observer<'a> {
    agent: Agent<'a>,
    _directory: TempDir,
}

impl<'a> Observer<'a> {
    fn start(host: &'a Namespace, configuration: &str) -> Result<Self> {
        let directory = tempfile::tempdir()?;
        let file = directory.path().join("ros2probe.yaml");
        std::fs::write(&file, format!("watch: [/**]\n{configuration}"))?;
        let agent = Agent::start(host, env!("CARGO_BIN_EXE_rp"), &file)?;
        Ok(Self {
            agent,
            _directory: directory,
        })
    }
}

/// Small messages at 200 Hz, and point clouds in several frames each.
fn streams(address: Ipv4Addr) -> [Stream; 3] {
    let tcp = Some(SocketAddrV4::new(address, PORT));
    let reliable = Stream {
        reliable: true,
        ..Stream::point_cloud(700_000, 40)
    };
    [
        Stream::small(400),
        Stream::point_cloud(700_000, 40),
        reliable,
    ]
    .map(|stream| Stream { tcp, ..stream })
}

/// Starts a publisher, then a subscriber that connects to it, and waits until they are matched.
/// Rarely, Fast DDS 2.9 exchanges the first control messages and nothing more: then both start
/// again.
fn pair(from: &Namespace, to: &Namespace, stream: &Stream) -> Result<(Peer, Peer)> {
    for _ in 0..ATTEMPTS {
        let mut publisher = Peer::start(from, Stack::Fast, Role::Publisher, stream, &["/sensor"])?;
        let mut subscriber =
            Peer::start(to, Stack::Fast, Role::Subscriber, stream, &["/listener"])?;
        let matched = |peer: &mut Peer| peer.process.wait_for("matched", MATCHED_WITHIN);
        if matched(&mut publisher)
            .and_then(|()| matched(&mut subscriber))
            .is_ok()
        {
            return Ok((publisher, subscriber));
        }
    }
    bail!("two Fast DDS participants do not match over TCP")
}

/// Returns the numbers of messages that both logs have.
fn logged(publisher: &Peer, subscriber: &Peer) -> Result<(u64, u64)> {
    let sent = publisher.log()?.sequences("pub").len() as u64;
    let received = subscriber.log()?.sequences("sub").len() as u64;
    Ok((sent, received))
}

fn count(page: &Scrape, what: &str, topic: &str) -> u64 {
    let name = format!("ros2_topic_{what}_total");
    page.sum(&name, &[("topic", topic)]) as u64
}

fn knows(page: &Scrape, topic: &str) -> bool {
    page.value("ros2_topic_subscriptions", &[("topic", topic)]) == Some(1.0)
        && page.value("ros2_topic_publishers", &[("topic", topic)]) == Some(1.0)
}

fn check_no_drops(page: &Scrape) -> Result<()> {
    let lost = [("event", "rtps_tcp_chunks_lost")];
    let lost = page.sum("ros2probe_filter_events_total", &lost);
    ensure!(lost == 0.0, "{lost} chunks");
    let errors = page.sum("ros2probe_decode_errors_total", &[]);
    ensure!(errors == 0.0, "{errors} decode errors");
    Ok(())
}

// Coverage: TCP | Fast DDS 2.9 | - | exact
#[test]
fn counts_and_deliveries_on_one_host_equal_the_logs() -> Result<()> {
    for stream in streams(Ipv4Addr::LOCALHOST) {
        let host = Namespace::isolated()?;
        let observer = Observer::start(&host, &datagrams_alone_of(&host))?;
        let (mut publisher, mut subscriber) = pair(&host, &host, &stream)?;
        let agent = &observer.agent;
        let page = agent.scrape_until("both endpoints", |page| knows(page, &stream.topic))?;
        let by_tcp = [("topic", stream.topic.as_str()), ("passage", "tcp")];
        assert_eq!(page.value("ros2_topic_pairs", &by_tcp), Some(1.0));
        publisher.start_sending()?;
        publisher.wait_sent(PATIENCE)?;
        let page = agent.settled_scrape(&stream.topic, stream.count)?;
        subscriber.wait_received(stream.count)?;
        subscriber.process.terminate()?;
        let (sent, received) = logged(&publisher, &subscriber)?;
        assert_eq!((sent, received), (stream.count, stream.count));
        let topic = &stream.topic;
        let counted = ["messages", "delivered_messages", "lost_messages"];
        let counted = counted.map(|what| count(&page, what, topic));
        assert_eq!(counted, [sent, received, 0], "{} B", stream.size);
        assert_eq!(count(&page, "bytes", topic), sent * stream.size as u64);
        check_no_drops(&page)?;
    }
    Ok(())
}

#[test]
fn counts_on_two_hosts_equal_the_logs_at_either_end() -> Result<()> {
    let link = Link::new()?;
    for stream in streams(link.robot.address()) {
        let robot = Observer::start(&link.robot, &datagrams_alone_of(&link.robot))?;
        let monitor = Observer::start(&link.monitor, &datagrams_alone_of(&link.monitor))?;
        let (mut publisher, mut subscriber) = pair(&link.robot, &link.monitor, &stream)?;
        for observer in [&robot, &monitor] {
            let agent = &observer.agent;
            agent.scrape_until("both endpoints", |page| knows(page, &stream.topic))?;
        }
        publisher.start_sending()?;
        publisher.wait_sent(PATIENCE)?;
        let pages = [&robot, &monitor].map(|observer| {
            let agent = &observer.agent;
            agent.settled_scrape(&stream.topic, stream.count)
        });
        subscriber.wait_received(stream.count)?;
        subscriber.process.terminate()?;
        let (sent, received) = logged(&publisher, &subscriber)?;
        assert_eq!((sent, received), (stream.count, stream.count));
        for (page, delivered) in pages.into_iter().zip([0, received]) {
            let page = page?;
            let counted = ["messages", "delivered_messages", "lost_messages"];
            let counted = counted.map(|what| count(&page, what, &stream.topic));
            check_no_drops(&page)?;
            let expected = [sent, delivered, 0];
            assert_eq!(counted, expected, "{} B: {}", stream.size, page.0);
        }
    }
    Ok(())
}

#[test]
fn segments_retransmitted_by_tcp_lose_no_message() -> Result<()> {
    let mut all_dropped = 0;
    // Packets of up to 64 KB, and packets of one segment.
    for most_segments in [64, 1] {
        let link = Link::new()?;
        let outside = link.robot.outside().join(" ");
        run(&format!(
            "{outside} ip link set {INTERFACE} gso_max_segs {most_segments}"
        ))?;
        let [small, _, large] = streams(link.robot.address());
        // One frame of this size is in a packet, and only its beginning leaves the kernel.
        let medium = Stream {
            size: 5000,
            reliable: true,
            ..small.clone()
        };
        for stream in [small, medium, large] {
            let monitor = Observer::start(&link.monitor, &datagrams_alone_of(&link.monitor))?;
            let (mut publisher, mut subscriber) = pair(&link.robot, &link.monitor, &stream)?;
            let agent = &monitor.agent;
            agent.scrape_until("both endpoints", |page| knows(page, &stream.topic))?;
            let packets = format!("ip daddr {} tcp sport {PORT}", link.monitor.address());
            let loss = Loss::of(&link.robot, &packets, 30)?;
            publisher.start_sending()?;
            publisher.wait_sent(PATIENCE)?;
            let page = agent.settled_scrape(&stream.topic, stream.count)?;
            all_dropped += loss.counts()?.dropped;
            drop(loss);
            subscriber.wait_settled(stream.count)?;
            subscriber.process.terminate()?;
            let (sent, received) = logged(&publisher, &subscriber)?;
            let counted = ["messages", "delivered_messages", "lost_messages"];
            let counted = counted.map(|what| count(&page, what, &stream.topic));
            let expected = [sent, received, 0];
            assert_eq!(counted, expected, "{} B: {}", stream.size, page.0);
        }
    }
    ensure!(all_dropped > 0, "nothing was dropped");
    Ok(())
}

/// Fast DDS overwrites samples that a slow connection has not taken.
#[test]
fn samples_that_the_sender_drops_are_lost_at_the_sender() -> Result<()> {
    const SLOW: &str = "rate 40mbit burst 64kb latency 100ms";
    let link = Link::new()?;
    let outside = link.robot.outside().join(" ");
    let [_, cloud, _] = streams(link.robot.address());
    let stream = Stream {
        size: 200_000,
        rate: 100.0,
        count: 300,
        depth: 1,
        asynchronous: true,
        // The publisher stays while a browser shows it.
        linger: 300.0,
        ..cloud
    };
    let monitor = Observer::start(&link.monitor, &datagrams_alone_of(&link.monitor))?;
    let (mut publisher, subscriber) = pair(&link.robot, &link.monitor, &stream)?;
    let agent = &monitor.agent;
    agent.scrape_until("both endpoints", |page| knows(page, &stream.topic))?;
    run(&format!(
        "{outside} tc qdisc add dev {INTERFACE} root tbf {SLOW}"
    ))?;
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    let page = agent.settled_scrape(&stream.topic, 1)?;
    subscriber.wait_settled(count(&page, "delivered_messages", &stream.topic))?;
    let log = subscriber.log()?;
    let (received, missing) = (log.sequences("sub").len() as u64, log.missing());
    ensure!(missing > 50, "only {missing} are missing");
    let lost = |cause| {
        let labels = [("topic", stream.topic.as_str()), ("cause", cause)];
        page.sum("ros2_topic_delivery_lost_messages_total", &labels)
    };
    assert_eq!(count(&page, "delivered_messages", &stream.topic), received);
    assert_eq!((lost("sender"), lost("before_host")), (missing as f64, 0.0));
    check_no_drops(&page)?;
    watch(
        &link.monitor.outside(),
        "sender",
        &[PAGE, &missing.to_string()],
    )
}

#[test]
fn retransmitted_segments_of_a_link_equal_those_of_the_kernel_and_are_a_finding() -> Result<()> {
    let link = Link::new()?;
    let [small, ..] = streams(link.robot.address());
    let stream = Stream {
        count: 3000,
        reliable: true,
        linger: 300.0,
        ..small
    };
    let robot = Observer::start(&link.robot, &datagrams_alone_of(&link.robot))?;
    let (mut publisher, _subscriber) = pair(&link.robot, &link.monitor, &stream)?;
    let (source, destination) = (link.robot.address(), link.monitor.address());
    let labels = [
        ("protocol", "rtps"),
        ("source", &*source.to_string()),
        ("destination", &*destination.to_string()),
    ]
    .map(|(name, value)| (name, value.to_owned()));
    let labels: Vec<_> = labels
        .iter()
        .map(|(name, value)| (*name, value.as_str()))
        .collect();
    let agent = &robot.agent;
    agent.scrape_until("the link", |page| {
        page.value("ros2_link_connections", &labels)
            .is_some_and(|count| count >= 1.0)
    })?;
    let retransmitted = || Snmp::of(publisher.process.pid())?.retransmitted();
    let before = retransmitted()?;
    let packets = format!("ip daddr {destination} tcp sport {PORT}");
    let loss = Loss::of_arriving(&link.monitor, &packets, 100)?;
    publisher.process.write_line("go")?;
    let page = agent.scrape_until("the finding", |page| {
        page.sum("ros2_diagnoses", &[("kind", "lossy_link")]) == 1.0
    })?;
    let unsent = page.value("ros2_link_unsent_bytes", &labels);
    assert!(unsent.is_some(), "{}", page.0);
    let round_trip = page.value("ros2_link_round_trip_seconds", &labels);
    ensure!(
        round_trip.is_some_and(|time| time > 0.0 && time < 10.0),
        "{round_trip:?}"
    );
    publisher.wait_sent(PATIENCE)?;
    drop(loss);
    let [from, to] = [source, destination].map(|address| address.to_string());
    watch(&link.robot.outside(), "links", &[PAGE, &from, &to])?;
    // Segments may be under way, and heartbeats follow.
    wait_until("all retransmissions are counted", || {
        let all = Snmp::of(publisher.process.pid())?.retransmitted()? - before;
        let page = agent.scrape()?;
        let counted = page.value("ros2_link_retransmitted_segments_total", &labels);
        let missing = all as f64 - counted.unwrap_or(0.0);
        // The kernel also counts segments without data, such as those of the end of a connection.
        Ok(all > 20 && (0.0..=all as f64 / 20.0).contains(&missing))
    })
}

#[test]
fn counts_on_an_interface_equal_the_logs() -> Result<()> {
    let link = Link::new()?;
    let [small, ..] = streams(link.robot.address());
    let observer = Observer::start(&link.robot, "capture: {source: wire}")?;
    let (mut publisher, mut subscriber) = pair(&link.robot, &link.monitor, &small)?;
    let agent = &observer.agent;
    agent.scrape_until("both endpoints", |page| knows(page, &small.topic))?;
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    let page = agent.settled_scrape(&small.topic, small.count)?;
    subscriber.process.terminate()?;
    let (sent, _) = logged(&publisher, &subscriber)?;
    let counted = ["messages", "lost_messages"].map(|what| count(&page, what, &small.topic));
    assert_eq!(counted, [sent, 0]);
    Ok(())
}

/// Returns the locator of a participant that accepts TCP connections at the loopback address.
fn tcp_locator(port: u16) -> [u8; 24] {
    const LOGICAL_PORT: u32 = 7411;
    let mut locator = [0; 24];
    locator[0] = 4;
    locator[4..8].copy_from_slice(&(LOGICAL_PORT << 16 | u32::from(port)).to_le_bytes());
    locator[20..].copy_from_slice(&[127, 0, 0, 1]);
    locator
}

/// Runs OpenSSL on a host.
fn openssl(host: &Namespace, arguments: &str) -> Result<Process> {
    let arguments = arguments.split(' ');
    Process::start_with(&host.on_network(), "openssl", arguments, Stdio::null())
}

/// Connects a client of OpenSSL to a server.
fn connect_encrypted(host: &Namespace, port: u16) -> Result<Process> {
    let mut client = openssl(host, &format!("s_client -connect 127.0.0.1:{port}"))?;
    client.line_with_end("(self-signed certificate)", MATCHED_WITHIN)?;
    Ok(client)
}

/// Starts a server of OpenSSL, and connects a client to it.
fn encrypted_connection(host: &Namespace, directory: &Path, port: u16) -> Result<[Process; 2]> {
    let [key, certificate] = ["key.pem", "certificate.pem"].map(|name| directory.join(name));
    run(&format!(
        "openssl req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=robot -keyout {} -out {}",
        key.display(),
        certificate.display()
    ))?;
    let (key, certificate) = (key.display(), certificate.display());
    let arguments = format!("s_server -accept 127.0.0.1:{port} -key {key} -cert {certificate}");
    let server = openssl(host, &arguments)?;
    let mut connected = None;
    wait_until("a connection with TLS", || {
        connected = connect_encrypted(host, port).ok();
        Ok(connected.is_some())
    })?;
    Ok([server, connected.context("no client")?])
}

// Coverage: TCP, with TLS | Fast DDS | - | named
#[test]
fn a_connection_with_tls_to_an_announced_port_is_counted_and_a_plain_one_is_not() -> Result<()> {
    const ENCRYPTED: &str = "ros2probe_rtps_tcp_tls_connections_total";
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let socket = directory.path().join("api.sock");
    let api = format!("api: {{socket: {}}}\n", socket.display());
    let observer = Observer::start(&host, &format!("{api}{}", datagrams_alone_of(&host)))?;
    let agent = &observer.agent;

    // A plain connection of RTPS, and one with TLS at a port that no participant announces.
    let mut connections = Connections::open(&host, 1)?;
    let talker = Talker::new(1, "/plain");
    let plain = connections.ends[0][1].local_addr()?.port();
    introduce(&talker, &mut connections)?;
    agent.scrape_until("the writer", |page| {
        page.value("ros2_topic_publishers", &[("topic", "/plain")]) == Some(1.0)
    })?;
    let _other = encrypted_connection(&host, directory.path(), PORT + 1)?;
    let [_server, first] = encrypted_connection(&host, directory.path(), PORT)?;
    let locators = [tcp_locator(plain), tcp_locator(PORT)];
    connections.send(&talker.participant_at(&locators))?;
    let page = agent.scrape_until("the encrypted connection", |page| {
        page.value(ENCRYPTED, &[]).is_some_and(|count| count > 0.0)
    })?;
    assert_eq!(page.value(ENCRYPTED, &[]), Some(1.0), "{}", page.0);
    // With the participant still known, another connection counts, too.
    connections.send(&talker.participant_at(&locators))?;
    // The server has one client at a time.
    drop(first);
    let second = connect_encrypted(&host, PORT)?;
    agent.scrape_until("the second connection", |page| {
        page.value(ENCRYPTED, &[]) == Some(2.0)
    })?;
    drop(second);
    let doctor = crate::rp()
        .args(["doctor", "--socket"])
        .arg(&socket)
        .output()?;
    let doctor = String::from_utf8_lossy(&doctor.stdout).into_owned();
    ensure!(
        doctor.contains("2 connections of RTPS over TCP are encrypted with TLS"),
        "{doctor}"
    );
    Ok(())
}

/// Connections that carry the messages of one participant in turn, as frames of RTPS.
struct Connections {
    /// Both ends of each. The test reads no end: the bytes fit the buffers.
    ends: Vec<[TcpStream; 2]>,
    turn: usize,
}

impl Connections {
    fn open(host: &Namespace, count: usize) -> Result<Self> {
        let connect = || -> Result<_> {
            let listener = TcpListener::bind("127.0.0.1:0")?;
            let pair = |_| {
                let client = TcpStream::connect(listener.local_addr()?)?;
                client.set_nodelay(true)?;
                Ok([client, listener.accept()?.0])
            };
            (0..count).map(pair).collect()
        };
        let ends = host.hold(|| netns::within(&host.network(), connect))???;
        Ok(Self { ends, turn: 0 })
    }
}

impl Carrier for Connections {
    fn send(&mut self, payload: &[u8]) -> Result<()> {
        self.turn = (self.turn + 1) % self.ends.len();
        let [client, _] = &mut self.ends[self.turn];
        client.write_all(&framed(payload))?;
        Ok(())
    }
}

#[test]
fn a_thousand_connections_are_read() -> Result<()> {
    const CONNECTIONS: usize = 1000;
    const ROUNDS: usize = 5;
    let host = Namespace::isolated()?;
    let observer = Observer::start(&host, &datagrams_alone_of(&host))?;
    let mut connections = Connections::open(&host, CONNECTIONS)?;
    let mut talker = Talker::new(1, "/crowd");
    introduce(&talker, &mut connections)?;
    let agent = &observer.agent;
    agent.scrape_until("the writer", |page| {
        page.value("ros2_topic_publishers", &[("topic", "/crowd")]) == Some(1.0)
    })?;
    let sent = CONNECTIONS * ROUNDS;
    send_sizes(&mut talker, &mut connections, vec![100; sent])?;
    let page = agent.settled_scrape("/crowd", sent as u64)?;
    let counted = ["messages", "lost_messages", "duplicate_messages"];
    let counted = counted.map(|what| count(&page, what, "/crowd"));
    // Each one is seen where it is sent and where it arrives.
    assert_eq!(counted, [sent as u64, 0, 0], "{}", page.0);
    check_no_drops(&page)
}

#[test]
fn a_late_agent_discovers_the_topics_when_another_participant_joins() -> Result<()> {
    let host = Namespace::isolated()?;
    let [small, ..] = streams(Ipv4Addr::LOCALHOST);
    let stream = Stream {
        count: 100_000,
        ..small
    };
    let (mut publisher, _subscriber) = pair(&host, &host, &stream)?;
    publisher.start_sending()?;
    let socket = tempfile::tempdir()?;
    let socket = socket.path().join("api.sock");
    let api = format!("api: {{socket: {}}}\n", socket.display());
    let configuration = format!("{api}{}", datagrams_alone_of(&host));
    let observer = Observer::start(&host, &configuration)?;
    let agent = &observer.agent;
    agent.scrape_until("both participants and a writer", |page| {
        page.sum("ros2_participants", &[]) == 2.0 && page.sum("ros2_unknown_writers", &[]) == 1.0
    })?;
    let doctor = crate::rp()
        .args(["doctor", "--socket"])
        .arg(&socket)
        .output()?;
    let doctor = String::from_utf8_lossy(&doctor.stdout).into_owned();
    ensure!(!doctor.contains("rp discover"), "{doctor}");
    ensure!(doctor.contains("ros2 node list --no-daemon"), "{doctor}");
    let newcomer = Stream {
        topic: "/other".to_owned(),
        ..stream.clone()
    };
    let _newcomer = Peer::start(&host, Stack::Fast, Role::Subscriber, &newcomer, &["/late"])?;
    let publishers = [("topic", stream.topic.as_str())];
    let page = agent
        .scrape_until("the topic", |page| {
            page.value("ros2_topic_publishers", &publishers) == Some(1.0)
        })
        .context("announced to the newcomer")?;
    assert_eq!(page.sum("ros2_unknown_writers", &[]), 0.0, "{}", page.0);
    let before = count(&page, "messages", &stream.topic);
    agent.scrape_until("messages of the topic", |page| {
        count(page, "messages", &stream.topic) > before + 100
    })?;
    Ok(())
}
