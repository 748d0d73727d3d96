//! Observing leaves the robot unchanged. The agent has no participant and no endpoint, and sends no
//! packet. Its listeners are its only sockets of the network, it joins no multicast group, and no
//! interface is promiscuous.
//!
//! The references are recordings of the link that tshark reads, the kernel's own counters, and the
//! sockets of every process in `/proc`.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, ON_THE_WIRE, Scrape};
use ros2probe_testing::harness::capture::{self, Capture};
use ros2probe_testing::harness::dissection::{Content, Dissection, Frame};
use ros2probe_testing::harness::network::{INTERFACE, Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::wait_until;

/// Traffic of the kernels themselves: address resolution, multicast membership, IPv6 neighbours.
const KERNEL_PROTOCOLS: [&str; 3] = ["arp", "igmp", "icmpv6"];
/// Number of samples of each publisher in a phase: a second on a machine that is not busy.
const PHASE: usize = 50;
/// Time after a phase in which the recording gets its frames.
const RECORDED_TIME: Duration = Duration::from_secs(5);
/// State LISTEN in `/proc/net/tcp`.
const LISTENING: &str = "0A";

#[test]
fn running_nodes_send_the_same_before_during_and_after_an_agent() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let mut nodes = Nodes::start(&link)?;
    nodes.go()?;
    nodes.wait_phase()?;
    let recording = Capture::start(&link.robot, &directory.path().join("link.pcap"))?;
    let mut phases = vec![unix_seconds()];
    nodes.wait_phase()?;
    phases.push(unix_seconds());
    let mut agent = start_agent(&link.robot, directory.path())?;
    nodes.wait_phase()?;
    // The agent started after most announcements, but sees the traffic.
    let messages = |page: &Scrape| {
        page.sum("ros2_topic_messages_total", &[])
            + page.sum("ros2_unknown_writer_messages_total", &[])
    };
    agent.scrape_until("messages", |page| messages(page) > 100.0)?;
    agent.process.terminate()?;
    phases.push(unix_seconds());
    nodes.wait_phase()?;
    std::thread::sleep(capture::SETTLE);
    let ports = nodes.ports()?;
    let (known, writers) = (guids(nodes.all())?, guids(nodes.publishers.iter())?);
    let frames = Dissection::read(&recording.finish()?)?.frames;

    let prefixes: BTreeSet<String> = known.iter().map(|guid| guid[..24].to_owned()).collect();
    let bounds = [
        (phases[0], phases[1]),
        (phases[1], phases[2]),
        (phases[2], f64::MAX),
    ];
    let mut others = BTreeSet::new();
    for (phase, (start, end)) in ["before", "beside", "after"].into_iter().zip(bounds) {
        let frames = || {
            let all = frames.iter();
            all.filter(move |frame| start <= frame.time && frame.time < end)
        };
        for frame in frames() {
            assert_is_of_a_node(frame, &ports, phase);
        }
        let senders: BTreeSet<String> = frames()
            .map(|frame| frame.prefix.clone())
            .filter(|prefix| !prefix.is_empty())
            .collect();
        let strange: Vec<_> = senders.difference(&prefixes).collect();
        assert!(strange.is_empty(), "{phase} the agent {strange:?} send");
        let talking = talking(frames());
        let silent: Vec<_> = writers.difference(&talking).collect();
        assert!(silent.is_empty(), "{phase} the agent {silent:?} are silent");
        others.extend(talking.difference(&known).cloned());
    }
    // Besides the streams, each participant has a writer and a reader of ros_discovery_info.
    assert!(others.len() <= 2 * prefixes.len(), "{others:?}");
    Ok(())
}

#[test]
fn nodes_that_start_beside_an_agent_announce_the_same_as_without_it() -> Result<()> {
    let mut announced = Vec::new();
    for observed in [false, true] {
        let link = Link::new()?;
        let directory = tempfile::tempdir()?;
        let agent = match observed {
            true => Some(start_agent(&link.robot, directory.path())?),
            false => None,
        };
        let recording = Capture::start(&link.robot, &directory.path().join("link.pcap"))?;
        let mut nodes = Nodes::start(&link)?;
        nodes.go()?;
        nodes.wait_phase()?;
        std::thread::sleep(RECORDED_TIME);
        let (ports, known) = (nodes.ports()?, guids(nodes.all())?);
        let frames = Dissection::read(&recording.finish()?)?.frames;
        drop(agent);
        for frame in &frames {
            assert_is_of_a_node(frame, &ports, "with all nodes");
        }
        let talking = talking(frames.iter());
        let silent: Vec<_> = known.difference(&talking).collect();
        assert!(silent.is_empty(), "{silent:?}");
        // Besides the streams, each participant has a writer and a reader of ros_discovery_info.
        assert_eq!(talking.len(), 3 * known.len(), "{talking:?}");
        // The sequence numbers of the announcements show how many endpoints each host announces.
        let announcements = frames.iter().flat_map(|frame| {
            let address = frame.ip_source.rsplit('.').next().unwrap_or_default();
            let writers = frame.submessages.iter().filter_map(move |submessage| {
                let Content::Data(number) = submessage.content else {
                    return None;
                };
                let is_announcement = ["000003c2", "000004c2"].contains(&&*submessage.writer);
                is_announcement.then(|| (address.to_owned(), submessage.writer.clone(), number))
            });
            writers.collect::<Vec<_>>()
        });
        announced.push(announcements.collect::<BTreeSet<_>>());
    }
    assert!(!announced[0].is_empty());
    assert_eq!(announced[1], announced[0]);
    Ok(())
}

#[test]
fn a_host_that_runs_only_the_agent_sends_nothing() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    // With IPv6, the kernel would search for routers and neighbours.
    inside(
        &link.robot,
        &format!("sysctl -qw net.ipv6.conf.{INTERFACE}.disable_ipv6=1"),
    )?;
    let before = sent_frames(&link.robot)?;
    let address = format!("cat /sys/class/net/{INTERFACE}/address");
    let address = inside(&link.robot, &address)?.trim().to_owned();
    let recording = Capture::start(&link.monitor, &directory.path().join("link.pcap"))?;
    let agent = start_agent(&link.robot, directory.path())?;
    let mut peers = Vec::new();
    for stack in Stack::ALL {
        let stream = stream_of(stack);
        for role in [Role::Subscriber, Role::Publisher] {
            peers.push(Peer::start(
                &link.monitor,
                stack,
                role,
                &stream,
                &["/node"],
            )?);
        }
    }
    let appeared = [("entity", "participant"), ("event", "appeared")];
    agent.scrape_until("six participants", |page| {
        page.sum("ros2_discovery_events_total", &appeared) >= 6.0
    })?;
    drop(agent);
    std::thread::sleep(capture::SETTLE);
    let frames = Dissection::read(&recording.finish()?)?.frames;
    assert!(!frames.is_empty());
    let own: Vec<_> = frames
        .iter()
        .filter(|frame| frame.ethernet_source == address)
        .map(|frame| &frame.protocols)
        .collect();
    assert!(own.is_empty(), "{own:?}");
    assert_eq!(sent_frames(&link.robot)?, before);
    Ok(())
}

#[test]
fn the_listeners_are_the_only_network_sockets_of_the_agent() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let before = memberships(&link.robot)?;
    let agent = start_agent(&link.robot, directory.path())?;
    assert_eq!(memberships(&link.robot)?, before);
    let mut nodes = Nodes::start(&link)?;
    nodes.go()?;
    agent.scrape_until("six participants", |page| {
        page.sum("ros2_participants", &[]) == 6.0
    })?;
    let joined = memberships(&link.robot)?;
    drop(nodes);

    let mut sockets = sockets_of(agent.process.pid())?;
    let mut of_table = |table: &str| -> Result<Vec<Vec<String>>> {
        let rows = table_rows(agent.process.pid(), table)?;
        let own = rows.into_iter().filter(|row| {
            let inode = row.iter().position(|word| sockets.contains(word));
            inode.is_some_and(|at| sockets.remove(&row[at]))
        });
        Ok(own.collect())
    };
    let listeners = of_table("tcp")?;
    let addresses = listeners.iter().map(|row| (&*row[1], &*row[3]));
    let addresses: BTreeSet<_> = addresses.collect();
    // The listeners are 127.0.0.1:17400 for metrics, 17401 for control, and 8765 for viewers.
    let expected = ["0100007F:43F8", "0100007F:43F9", "0100007F:223D"];
    assert_eq!(addresses, expected.map(|each| (each, LISTENING)).into());
    for table in ["tcp6", "udp", "udp6", "udplite", "raw", "raw6", "icmp"] {
        assert_eq!(of_table(table)?, Vec::<Vec<String>>::new(), "{table}");
    }
    // Programs at tcx need no socket.
    let hooks = agent
        .scrape()?
        .labels_of("ros2probe_capture_wire_info", "hook");
    let packet_sockets = usize::from(hooks.contains("packet"));
    assert_eq!(of_table("packet")?.len(), packet_sockets, "{hooks:?}");
    of_table("netlink")?;
    of_table("unix")?;
    assert!(sockets.is_empty(), "sockets of no known kind: {sockets:?}");

    // The kernel leaves a group with its last member.
    assert_ne!(joined, before);
    assert_eq!(memberships(&link.robot)?, before);
    let shown = inside(&link.robot, &format!("ip -d -o link show {INTERFACE}"))?;
    assert!(shown.contains("promiscuity 0"), "{shown}");
    Ok(())
}

/// A reliable publisher on one host and its subscriber on the other, of each stack.
struct Nodes {
    publishers: Vec<Peer>,
    subscribers: Vec<Peer>,
}

impl Nodes {
    fn start(link: &Link) -> Result<Nodes> {
        let mut nodes = Nodes {
            publishers: Vec::new(),
            subscribers: Vec::new(),
        };
        for stack in Stack::ALL {
            let stream = stream_of(stack);
            let host = &link.monitor;
            let subscriber = Peer::start(host, stack, Role::Subscriber, &stream, &["/listener"])?;
            nodes.subscribers.push(subscriber);
            let host = &link.robot;
            let publisher = Peer::start(host, stack, Role::Publisher, &stream, &["/talker"])?;
            nodes.publishers.push(publisher);
        }
        for peer in nodes.publishers.iter_mut().chain(&mut nodes.subscribers) {
            peer.wait_matched()?;
        }
        Ok(nodes)
    }

    fn go(&mut self) -> Result<()> {
        self.publishers.iter_mut().try_for_each(Peer::start_sending)
    }

    /// Waits until each publisher has sent the samples of one phase.
    fn wait_phase(&self) -> Result<()> {
        let sent = |peer: &Peer| -> Result<usize> { Ok(peer.log()?.sequences("pub").len()) };
        let before: Vec<usize> = self.publishers.iter().map(sent).collect::<Result<_>>()?;
        wait_until("each publisher has sent the samples of a phase", || {
            for (publisher, before) in self.publishers.iter().zip(&before) {
                if sent(publisher)? < before + PHASE {
                    return Ok(false);
                }
            }
            Ok(true)
        })
    }

    fn all(&self) -> impl Iterator<Item = &Peer> {
        self.publishers.iter().chain(&self.subscribers)
    }

    /// Returns the UDP ports that these processes have bound.
    fn ports(&self) -> Result<BTreeSet<u16>> {
        let mut ports = BTreeSet::new();
        for peer in self.all() {
            let pid = peer.process.pid();
            let sockets = sockets_of(pid)?;
            for row in table_rows(pid, "udp")? {
                let is_own = row.iter().any(|word| sockets.contains(word));
                if let Some(local) = row.get(1).filter(|_| is_own) {
                    let (_, port) = local.split_once(':').context("not an address")?;
                    ports.insert(u16::from_str_radix(port, 16)?);
                }
            }
        }
        ensure!(!ports.is_empty(), "the nodes have no UDP sockets");
        Ok(ports)
    }
}

/// Returns the endpoints of the streams, as the peers log them.
fn guids<'a>(peers: impl Iterator<Item = &'a Peer>) -> Result<BTreeSet<String>> {
    let mut guids = BTreeSet::new();
    for peer in peers {
        let log = peer.log()?;
        guids.extend(log.endpoints().filter_map(|event| event.guid.clone()));
    }
    Ok(guids)
}

/// Returns a stack's stream in a separate domain, since Fast DDS 2.9 aborts in one with other
/// stacks.
fn stream_of(stack: Stack) -> Stream {
    Stream {
        domain: stack as u16,
        topic: topic_of(stack),
        rate: 50.0,
        reliable: true,
        ..Stream::small(0)
    }
}

fn topic_of(stack: Stack) -> String {
    format!("/{stack:?}").to_lowercase()
}

/// Checks that a frame comes from a node's socket, or from a kernel itself.
fn assert_is_of_a_node(frame: &Frame, ports: &BTreeSet<u16>, phase: &str) {
    let is_of_a_kernel = frame
        .protocols
        .split(':')
        .any(|protocol| KERNEL_PROTOCOLS.contains(&protocol));
    let is_of_a_node = frame.source_port.is_some_and(|port| ports.contains(&port));
    assert!(
        is_of_a_kernel || is_of_a_node,
        "{phase}: {} from {} port {:?}",
        frame.protocols,
        frame.ip_source,
        frame.source_port
    );
}

/// Returns the endpoints of streams that send: writers send samples, and readers answers.
fn talking<'a>(frames: impl Iterator<Item = &'a Frame>) -> BTreeSet<String> {
    let mut guids = BTreeSet::new();
    for frame in frames {
        for submessage in &frame.submessages {
            let entity = match submessage.content {
                Content::Data(_) => &submessage.writer,
                Content::Request { .. } => &submessage.reader,
                _ => continue,
            };
            let is_of_a_user = matches!(entity.get(6..), Some("03" | "04"));
            if is_of_a_user {
                guids.insert(format!("{}{entity}", frame.prefix));
            }
        }
    }
    guids
}

fn start_agent<'a>(host: &'a Namespace, directory: &Path) -> Result<Agent<'a>> {
    let configuration = directory.join("ros2probe.yaml");
    fs::write(&configuration, format!("watch: [/**]\n{ON_THE_WIRE}"))?;
    Agent::start(host, env!("CARGO_BIN_EXE_rp"), &configuration)
}

/// Returns the inodes of a process's sockets.
fn sockets_of(pid: u32) -> Result<BTreeSet<String>> {
    let mut sockets = BTreeSet::new();
    for entry in fs::read_dir(format!("/proc/{pid}/fd"))? {
        let Ok(target) = fs::read_link(entry?.path()) else {
            continue;
        };
        let target = target.to_string_lossy().into_owned();
        let inode = target.strip_prefix("socket:[");
        sockets.extend(
            inode
                .and_then(|rest| rest.strip_suffix(']'))
                .map(str::to_owned),
        );
    }
    Ok(sockets)
}

/// Returns the rows of a table of `/proc/<pid>/net`, in words.
fn table_rows(pid: u32, table: &str) -> Result<Vec<Vec<String>>> {
    let path = format!("/proc/{pid}/net/{table}");
    let text = fs::read_to_string(&path).with_context(|| format!("cannot read {path}"))?;
    let rows = text.lines().skip(1);
    Ok(rows
        .map(|row| row.split_whitespace().map(str::to_owned).collect())
        .collect())
}

/// Returns the multicast groups that the host has joined, of IPv4, IPv6 and the link.
fn memberships(host: &Namespace) -> Result<Vec<String>> {
    let shown = inside(host, "ip maddress show")?;
    let mut lines: Vec<_> = shown.lines().map(|line| line.trim().to_owned()).collect();
    lines.sort();
    Ok(lines)
}

fn sent_frames(host: &Namespace) -> Result<u64> {
    let counter = format!("cat /sys/class/net/{INTERFACE}/statistics/tx_packets");
    Ok(inside(host, &counter)?.trim().parse()?)
}

fn inside(host: &Namespace, line: &str) -> Result<String> {
    let words = host.inside();
    let (program, arguments) = words.split_first().context("no words")?;
    let output = Command::new(program)
        .args(arguments)
        .args(line.split_whitespace())
        .output()?;
    ensure!(output.status.success(), "{line} failed");
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

fn unix_seconds() -> f64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.unwrap_or_default().as_secs_f64()
}
