//! Viewers beside real DDS participants: each message arrives as it was sent. A viewer that is slow
//! or dies costs only itself, and no viewer changes what the robot sends. Needs root.

use std::collections::{BTreeMap, BTreeSet};
use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_capture::netns;
use ros2probe_testing::harness::agent::{
    Agent, ON_THE_WIRE, Scrape, at_the_sockets_of, datagrams_alone_of,
};
use ros2probe_testing::harness::capture::{self, Capture};
use ros2probe_testing::harness::dissection::{Content, Dissection};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream, pair};
use ros2probe_testing::harness::usage::Usage;
use ros2probe_testing::viewer::{PATIENCE, SUBPROTOCOLS, ServerMessage, Viewer, open};
use tempfile::TempDir;

use crate::browser::player::watch;
use crate::browser::robot::{Place, Robot};
use crate::samples::{check, pattern};

const TOPIC: &str = "/points";
/// Name of the schema of point clouds.
const CLOUD: &str = "sensor_msgs/msg/PointCloud2";

/// An agent without watches, and its files.
struct Scene<'a> {
    agent: Agent<'a>,
    _directory: TempDir,
}

impl<'a> Scene<'a> {
    fn start(host: &'a Namespace, configuration: &str) -> Result<Self> {
        let directory = tempfile::tempdir()?;
        let file = directory.path().join("ros2probe.yaml");
        std::fs::write(&file, configuration)?;
        let agent = Agent::start(host, env!("CARGO_BIN_EXE_rp"), &file)?;
        Ok(Self {
            agent,
            _directory: directory,
        })
    }

    /// Connects to the default port.
    fn viewer(&self) -> Result<Viewer> {
        connect(self.agent.host)
    }

    fn wait_for(&self, what: &str, series: &str, wanted: f64) -> Result<Scrape> {
        let shows = |page: &Scrape| page.sum(series, &[]) == wanted;
        self.agent.scrape_until(what, shows)
    }
}

fn connect(host: &Namespace) -> Result<Viewer> {
    let stream = netns::within(&host.network(), || TcpStream::connect("127.0.0.1:8765"))??;
    open(stream, "/", &SUBPROTOCOLS, &[])?.map_err(|refused| anyhow::anyhow!("{refused:?}"))
}

/// Subscribes, and waits until the agent has the subscription.
fn subscribe(scene: &Scene<'_>, viewer: &mut Viewer) -> Result<u32> {
    viewer.wait_for_topics(&[TOPIC])?;
    let id = viewer.subscribe(TOPIC)?;
    let shows = |page: &Scrape| page.sum("ros2probe_subscriptions", &[]) >= 1.0;
    scene.agent.scrape_until("the interest", shows)?;
    Ok(id)
}

#[test]
fn payloads_of_fast_dds_reach_a_viewer_unchanged() -> Result<()> {
    check_payloads(Stack::Fast, 2_720_000)
}

#[test]
fn payloads_of_cyclone_dds_reach_a_viewer_unchanged() -> Result<()> {
    check_payloads(Stack::Cyclone, 644_000)
}

fn check_payloads(stack: Stack, size: usize) -> Result<()> {
    let link = Link::new()?;
    let configuration = format!("{}watch: []\n", datagrams_alone_of(&link.robot));
    let scene = Scene::start(&link.robot, &configuration)?;
    let stream = Stream {
        reliable: true,
        rate: 10.0,
        ..Stream::point_cloud(size, 30)
    };
    let mut viewer = scene.viewer()?;
    let (mut publisher, subscriber) = pair(&link.robot, &link.monitor, stack, &stream)?;
    let id = subscribe(&scene, &mut viewer)?;
    let channel = viewer.channel(TOPIC).context("no channel")?;
    ensure!(
        channel.schema_name == CLOUD && channel.encoding == "cdr",
        "{channel:?}"
    );
    ensure!(
        channel.schema.contains("PointField[] fields"),
        "{}",
        channel.schema
    );
    let pattern: Vec<u8> = (8..size).map(pattern).collect();
    publisher.start_sending()?;
    let mut received = BTreeMap::new();
    let mut reported = 0;
    let deadline = Instant::now() + 3 * PATIENCE;
    while received.len() as u64 + reported < stream.count {
        ensure!(
            Instant::now() < deadline,
            "{:?}, {reported} reported",
            received.keys()
        );
        match viewer.next_within(PATIENCE)? {
            Some(ServerMessage::Data(data)) if data.subscription == id => {
                ensure!(
                    data.payload.len() == size,
                    "{} of {size}",
                    data.payload.len()
                );
                let number = check(&data.payload, &pattern)?;
                ensure!(
                    received.insert(number, data.time).is_none(),
                    "{number} twice"
                );
            }
            Some(ServerMessage::Status(status)) if status.message.contains("too slowly") => {
                let count = status.message.split(' ').next().unwrap_or_default();
                reported = count.parse()?;
            }
            Some(ServerMessage::Channels | ServerMessage::Data(_)) => {}
            server_message => bail!("{server_message:?} after {:?}", received.keys()),
        }
    }
    publisher.wait_sent(PATIENCE)?;
    let sent = publisher.log()?.sequences("pub");
    ensure!(
        received.keys().all(|number| sent.contains(number)),
        "{sent:?}"
    );
    ensure!(
        received.len() >= 10,
        "{} of {}",
        received.len(),
        stream.count
    );
    let mut times = received.values();
    ensure!(
        times
            .clone()
            .zip(times.clone().skip(1))
            .all(|(one, next)| one < next)
    );
    let now = std::time::SystemTime::UNIX_EPOCH.elapsed()?.as_nanos();
    let last = times.next_back().context("no message")?;
    ensure!(
        now - u128::from(*last) < 60_000_000_000,
        "{last} is no wall time"
    );
    viewer.unsubscribe(id)?;
    scene.wait_for("no interest", "ros2probe_subscriptions", 0.0)?;
    if stack == Stack::Cyclone {
        // The channel vanishes with the topic, once the lease of the killed nodes ends.
        drop((publisher, subscriber));
        let is_gone =
            |viewer: &Viewer, _: &ServerMessage| viewer.channel(TOPIC).is_none().then_some(());
        viewer.wait_for("end of the channel", is_gone)?;
    }
    Ok(())
}

#[test]
fn the_public_client_decodes_every_channel_of_the_demo_robot() -> Result<()> {
    let place = Place::new()?;
    let agent = place.agent("watch: [/**]\n")?;
    let _robot = Robot::start(&place.host)?;
    watch(&place.inside(), "viewer", &["ws://127.0.0.1:8765"])?;
    agent.scrape_until("no viewer", |page| {
        page.sum("ros2probe_subscriptions", &[]) == 0.0
    })?;
    Ok(())
}

/// One of ten viewers does not read, and one dies without a close. The other viewers and the
/// capture lose nothing. A status reports the losses of the slow viewer.
#[test]
fn a_slow_or_killed_viewer_affects_no_other_viewer_and_no_capture() -> Result<()> {
    const MESSAGES: u64 = 120;
    let host = Namespace::isolated()?;
    let configuration = format!(
        "{}watch: []\nlimits: {{payload_bytes: 25165824}}\n",
        datagrams_alone_of(&host)
    );
    let scene = Scene::start(&host, &configuration)?;
    let stream = Stream {
        reliable: true,
        linger: 60.0,
        ..Stream::point_cloud(200_000, MESSAGES)
    };
    let (mut publisher, _subscriber) = pair(&host, &host, Stack::Cyclone, &stream)?;
    let mut viewers = Vec::new();
    for _ in 0..10 {
        let mut viewer = scene.viewer()?;
        subscribe(&scene, &mut viewer)?;
        viewers.push(viewer);
    }
    scene.wait_for("ten interests", "ros2probe_subscriptions", 10.0)?;
    let mut slow = viewers.pop().context("no viewer")?;
    let dying = viewers.pop().context("no viewer")?;
    let others: Vec<_> = viewers
        .into_iter()
        .map(|mut viewer| {
            std::thread::spawn(move || -> Result<(Vec<u64>, Viewer)> {
                let mut numbers = Vec::new();
                while numbers.len() as u64 != MESSAGES {
                    match viewer.next_within(PATIENCE)? {
                        Some(ServerMessage::Data(data)) => numbers.push(number(&data.payload)?),
                        Some(ServerMessage::Channels) => {}
                        server_message => bail!("{server_message:?} after {numbers:?}"),
                    }
                }
                Ok((numbers, viewer))
            })
        })
        .collect();
    publisher.start_sending()?;
    std::thread::sleep(Duration::from_millis(500));
    // The kernel closes the sockets of a killed process in the same way: without a close frame, and
    // with unread data.
    drop(dying);
    let mut kept = Vec::new();
    for other in others {
        let (numbers, viewer) = other
            .join()
            .map_err(|_| anyhow::anyhow!("a viewer failed"))??;
        ensure!(numbers == (0..MESSAGES).collect::<Vec<_>>(), "{numbers:?}");
        kept.push(viewer);
    }
    scene.wait_for("nine interests", "ros2probe_subscriptions", 9.0)?;
    let mut numbers = BTreeSet::new();
    let mut reported = 0;
    while numbers.len() as u64 + reported != MESSAGES {
        match slow.next_within(PATIENCE)? {
            Some(ServerMessage::Data(data)) => ensure!(numbers.insert(number(&data.payload)?)),
            Some(ServerMessage::Status(status)) => {
                ensure!(
                    status.level == 1 && status.message.ends_with("of /points"),
                    "{status:?}"
                );
                reported = status
                    .message
                    .split(' ')
                    .next()
                    .unwrap_or_default()
                    .parse()?;
            }
            Some(ServerMessage::Channels) => {}
            server_message => bail!(
                "{server_message:?} after {} and {reported} reported",
                numbers.len()
            ),
        }
    }
    ensure!(
        reported > 0,
        "nothing was dropped: {} arrived",
        numbers.len()
    );
    ensure!(
        numbers.contains(&(MESSAGES - 1)),
        "the last message is kept: {numbers:?}"
    );
    let label = [("topic", TOPIC)];
    let page = scene.agent.scrape_until("all messages", |page| {
        page.sum("ros2_topic_messages_total", &label) == MESSAGES as f64
    })?;
    ensure!(page.sum("ros2_topic_lost_messages_total", &label) == 0.0);
    let dropped = page.sum("ros2probe_foxglove_dropped_messages_total", &[]);
    // The viewer that died may have lost some messages, too.
    ensure!(dropped >= reported as f64, "{dropped} of {reported}");
    drop((kept, slow));
    scene.wait_for("no viewer", "ros2probe_foxglove_clients", 0.0)?;
    let page = scene.wait_for("no interest", "ros2probe_subscriptions", 0.0)?;
    ensure!(page.sum("ros2probe_queued_bytes", &[]) == 0.0);
    Ok(())
}

/// Returns the number in a point cloud.
fn number(payload: &[u8]) -> Result<u64> {
    let (_, data) = payload.split_at_checked(52).context("no data")?;
    let (number, _) = data.split_first_chunk().context("no number")?;
    Ok(u64::from_le_bytes(*number))
}

/// Packets of the hosts: announcements and messages by host, writer and number, and the ports.
#[derive(Debug, PartialEq, Eq)]
struct Sent {
    announcements: BTreeSet<(String, String, u64)>,
    /// How often each message was sent.
    messages: BTreeMap<(String, u64), u32>,
    endpoints: usize,
}

/// Discovery and user packets of the robot are the same with and without a viewer that shows
/// everything.
#[test]
fn a_viewer_of_all_topics_causes_no_packet_of_the_robot() -> Result<()> {
    let mut sent = Vec::new();
    for is_viewed in [false, true] {
        let link = Link::new()?;
        let scene = Scene::start(&link.robot, &format!("watch: [/**]\n{ON_THE_WIRE}"))?;
        let directory = tempfile::tempdir()?;
        let recording = Capture::start(&link.robot, &directory.path().join("link.pcap"))?;
        let mut viewer = is_viewed.then(|| scene.viewer()).transpose()?;
        if let Some(viewer) = &mut viewer {
            viewer.send(&serde_json::json!({"op": "subscribeConnectionGraph"}))?;
        }
        // The stream is best effort, so that no repair depends on the load of the machine.
        let stream = Stream {
            rate: 50.0,
            linger: 8.0,
            ..Stream::small(150)
        };
        let (mut publisher, subscriber) =
            pair(&link.robot, &link.monitor, Stack::Cyclone, &stream)?;
        if let Some(viewer) = &mut viewer {
            viewer.wait_for_topics(&["/imu", "/rp/topics/imu"])?;
            viewer.subscribe("/imu")?;
            viewer.subscribe("/rp/topics/imu")?;
            let interest = |page: &Scrape| page.sum("ros2probe_subscriptions", &[]) == 1.0;
            scene.agent.scrape_until("the interest", interest)?;
        }
        let mut ports = publisher.process.udp_ports()?;
        ports.extend(subscriber.process.udp_ports()?);
        publisher.start_sending()?;
        // The viewer receives while the publisher sends, so that the recordings of both runs end
        // equally late.
        if let Some(viewer) = &mut viewer {
            let mut count = 0;
            viewer.wait_for("messages", |viewer, server_message| {
                let is_message = |id| viewer.channels[&viewer.subscriptions[&id]].topic == "/imu";
                count +=
                    u32::from(matches!(server_message, ServerMessage::Data(data) if is_message(data.subscription)));
                (count > 100).then_some(())
            })?;
            ensure!(
                viewer.graph.published.contains_key("/imu"),
                "{:?}",
                viewer.graph
            );
        }
        publisher.wait_sent(PATIENCE)?;
        std::thread::sleep(capture::SETTLE);
        sent.push(sent_payloads(&recording.finish()?, &ports)?);
    }
    let [without, with] = sent.as_slice() else {
        bail!("{} runs", sent.len());
    };
    ensure!(
        !without.announcements.is_empty() && without.messages.len() == 150,
        "{without:?}"
    );
    ensure!(with == without, "{with:#?}\n{without:#?}");
    Ok(())
}

fn sent_payloads(recording: &Path, ports: &BTreeSet<u16>) -> Result<Sent> {
    let frames = Dissection::read(recording)?.frames;
    let mut sent = Sent {
        announcements: BTreeSet::new(),
        messages: BTreeMap::new(),
        endpoints: 0,
    };
    let mut endpoints = BTreeSet::new();
    for frame in &frames {
        let Some(port) = frame.source_port else {
            continue;
        };
        ensure!(
            ports.contains(&port),
            "{} from port {port}",
            frame.protocols
        );
        let host = frame.ip_source.rsplit('.').next().unwrap_or_default();
        for submessage in &frame.submessages {
            let Content::Data(number) = submessage.content else {
                continue;
            };
            let writer = &submessage.writer;
            if ["000003c2", "000004c2"].contains(&writer.as_str()) {
                let announcement = (host.to_owned(), writer.clone(), number);
                sent.announcements.insert(announcement);
            } else if matches!(writer.get(6..), Some("03")) && host == "1" {
                endpoints.insert(writer.clone());
                *sent.messages.entry((writer.clone(), number)).or_default() += 1;
            }
        }
    }
    sent.endpoints = endpoints.len();
    // ros_discovery_info is repeated when nodes appear. The stream is the writer with most
    // messages.
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for (writer, _) in sent.messages.keys() {
        *counts.entry(writer).or_default() += 1;
    }
    let most = counts.into_iter().max_by_key(|(_, count)| *count);
    let most = most.map(|(writer, _)| writer.to_owned());
    sent.messages
        .retain(|(writer, _), _| Some(writer) == most.as_ref());
    Ok(sent)
}

/// Measures the table of `docs/benchmarks-parts.md`: `cargo test --release --test live foxglove::
/// -- --ignored --nocapture`. The observers of one publisher alternate.
#[test]
#[ignore = "takes three minutes and a quiet machine to mean anything"]
fn the_cost_of_a_viewer_is_measured_beside_the_subscriber_of_a_bridge() -> Result<()> {
    const WINDOW: Duration = Duration::from_secs(10);
    const ROUNDS: usize = 3;
    let link = Link::new()?;
    let configuration = format!("{}watch: [/**]\n", at_the_sockets_of(&link.robot));
    let scene = Scene::start(&link.robot, &configuration)?;
    let stream = Stream {
        logged: false,
        linger: 1.0,
        ..Stream::point_cloud(2_720_000, 20 * 150)
    };
    let (mut publisher, _subscriber) = pair(&link.robot, &link.monitor, Stack::Cyclone, &stream)?;
    publisher.start_sending()?;
    std::thread::sleep(Duration::from_secs(2));
    for round in 1..=ROUNDS {
        for watcher in ["nothing", "one viewer", "a subscriber in C++"] {
            let mut bridge = match watcher {
                "a subscriber in C++" => {
                    let role = Role::Subscriber;
                    let stack = Stack::Cyclone;
                    let mut bridge = Peer::start(&link.robot, stack, role, &stream, &["/bridge"])?;
                    bridge.wait_matched()?;
                    Some(bridge)
                }
                _ => None,
            };
            let viewer = match watcher {
                "one viewer" => {
                    let mut viewer = scene.viewer()?;
                    subscribe(&scene, &mut viewer)?;
                    Some(std::thread::spawn(move || count(viewer, WINDOW)))
                }
                _ => None,
            };
            let pids = [scene.agent.process.pid(), publisher.process.pid()];
            let before = pids.map(Usage::of);
            let bridge_before = bridge.as_ref().map(|each| Usage::of(each.process.pid()));
            std::thread::sleep(WINDOW);
            let [agent, robot] = pids.map(Usage::of);
            let [agent_before, robot_before] = before;
            let agent = agent?.since(&agent_before?);
            let robot = robot?.since(&robot_before?);
            let bridge_used = match (&mut bridge, bridge_before) {
                (Some(bridge), Some(before)) => Usage::of(bridge.process.pid())?
                    .since(&before?)
                    .cpu
                    .as_secs_f64(),
                _ => 0.0,
            };
            let shown = viewer.map(|viewer| viewer.join().map_err(|_| anyhow::anyhow!("viewer")));
            println!(
                "round {round}, {watcher}: agent {:.3} s, publisher {:.3} s, subscriber {:.3} s \
                 CPU in {WINDOW:?}; agent {:.1} MB unreclaimable; the viewer got {:?}",
                agent.cpu.as_secs_f64(),
                robot.cpu.as_secs_f64(),
                bridge_used,
                agent.memory.unreclaimable as f64 / 1e6,
                shown.transpose()?.transpose()?,
            );
        }
    }
    Ok(())
}

/// Reads for this long, and returns the number of messages and of bytes.
fn count(mut viewer: Viewer, span: Duration) -> Result<(u64, u64)> {
    let deadline = Instant::now() + span;
    let (mut messages, mut bytes) = (0, 0);
    while Instant::now() < deadline {
        if let Some(ServerMessage::Data(data)) = viewer.next_within(Duration::from_millis(200))? {
            messages += 1;
            bytes += data.payload.len() as u64;
        }
    }
    Ok((messages, bytes))
}
