//! Live discovery: robots of sixteen nodes that start simultaneously, before or with the agent, and
//! that leave or die. Domains run side by side, and writers without an observed announcement are
//! shown as unknown.

use std::collections::{BTreeMap, BTreeSet};
use std::panic::resume_unwind;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, PACKETS_ALONE, Scrape, datagrams_alone_of};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::wait_until;
use tempfile::TempDir;

const STARTS: usize = 10;
/// Number of starts of half a robot, each with two new agents.
const LATE_STARTS: usize = 4;
const NODES: usize = 16;
/// Maximum time for the start of a whole robot on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);
/// Time for goodbyes of a robot, less than its lease, so that no participant has expired.
const LEAVE: Duration = Duration::from_secs(8);
/// Gives Cyclone DDS a long lease, which a busy machine renews in time, and its usual interval of
/// announcements.
const LONG_LEASE: &str = "CYCLONEDDS_URI=<Discovery><LeaseDuration>60s</LeaseDuration>\
                          <SPDPInterval>8s</SPDPInterval></Discovery>";
/// Maximum number of nodes that may leave without a goodbye.
const SILENT: usize = NODES / 2;

#[test]
fn all_sixteen_fast_dds_nodes_are_shown_in_each_of_ten_starts() -> Result<()> {
    check_all_nodes(Stack::Fast)
}

#[test]
fn all_sixteen_cyclone_dds_nodes_are_shown_in_each_of_ten_starts() -> Result<()> {
    check_all_nodes(Stack::Cyclone)
}

#[test]
fn all_sixteen_rust_dds_nodes_are_shown_in_each_of_ten_starts() -> Result<()> {
    check_all_nodes(Stack::Rust)
}

#[test]
fn an_agent_that_starts_after_half_of_the_fast_dds_nodes_shows_all() -> Result<()> {
    check_late_agent(Stack::Fast)
}

#[test]
fn an_agent_that_starts_after_half_of_the_cyclone_dds_nodes_shows_all() -> Result<()> {
    check_late_agent(Stack::Cyclone)
}

#[test]
fn an_agent_that_starts_after_half_of_the_rust_dds_nodes_shows_all() -> Result<()> {
    check_late_agent(Stack::Rust)
}

#[test]
fn a_late_agent_shows_unknown_writers_with_their_rate() -> Result<()> {
    // Each stack is on a separate link, so that none waits for the others.
    std::thread::scope(|scope| {
        let stacks = Stack::ALL.map(|stack| scope.spawn(move || late_agent_ratio(stack)));
        stacks
            .into_iter()
            .try_for_each(|stack| stack.join().unwrap_or_else(|panic| resume_unwind(panic)))
    })
}

fn late_agent_ratio(stack: Stack) -> Result<()> {
    let link = Link::new()?;
    let stream = Stream {
        rate: 100.0,
        ..Stream::small(100_000)
    };
    let (mut publisher, _subscriber) = start_talker_pair(&link, stack, &stream)?;
    std::thread::sleep(Duration::from_secs(1));
    let watcher = Watcher::start(&link.monitor)?;
    let unknown = |page: &Scrape| page.sum("ros2_unknown_writers", &[]) == 1.0;
    watcher.wait(unknown, PATIENCE, "an unknown writer")?;

    let log = publisher.log()?;
    let guid = log.endpoints().find_map(|endpoint| endpoint.guid.clone());
    let guid = guid.context("no GUID in the log")?;
    let writer = format!("{}.{}", &guid[..24], &guid[24..]);
    let count = || -> Result<f64> {
        let is_fresh = |page: &Scrape| page.sum("ros2probe_snapshot_age_seconds", &[]) < 1.0;
        let page = watcher.agent.scrape_until("a fresh page", is_fresh)?;
        let writer = [("writer", writer.as_str())];
        let count = page.value("ros2_unknown_writer_messages_total", &writer);
        count.with_context(|| format!("no {writer:?} in {}", page.0))
    };
    let sent = || -> Result<f64> { Ok(publisher.log()?.sequences("pub").len() as f64) };
    let counted = || -> Result<_> { Ok((sent()?, count()?, sent()?)) };
    let before = counted()?;
    wait_until(
        "five seconds of samples",
        || Ok(sent()? >= before.2 + 500.0),
    )?;
    let after = counted()?;
    // Counts are as old as the snapshot: up to one of the five seconds.
    let expected = (after.0 - before.2) * 0.7..(after.2 - before.0) * 1.3;
    let seen = after.1 - before.1;
    assert!(
        expected.contains(&seen),
        "{stack:?}: {seen} counted, not {expected:?}"
    );
    publisher.process.terminate()?;
    Ok(())
}

#[test]
fn one_topic_name_in_two_domains_counts_as_two_topics() -> Result<()> {
    let link = Link::new()?;
    let watcher = Watcher::start(&link.monitor)?;
    let mut pairs = Vec::new();
    let counts = [(0, 300), (5, 500)];
    for (stack, (domain, count)) in [Stack::Fast, Stack::Cyclone].into_iter().zip(counts) {
        let stream = Stream {
            domain,
            // Both pairs stay until the agent has shown them.
            linger: 120.0,
            ..Stream::small(count)
        };
        pairs.push(start_talker_pair(&link, stack, &stream)?);
    }
    let nodes = |page: &Scrape| {
        let of = |domain| page.sum("ros2_nodes", &[("domain_id", domain)]) == 2.0;
        of("0") && of("5")
    };
    watcher.wait(nodes, PATIENCE, "two nodes in each domain")?;
    for (publisher, _) in &mut pairs {
        publisher.wait_sent(PATIENCE)?;
    }
    let all = counts.iter().map(|(_, count)| count).sum();
    let page = watcher.agent.settled_scrape("/imu", all)?;
    for (domain, count) in counts {
        let labels = [("domain_id", &*domain.to_string()), ("topic", "/imu")];
        assert_eq!(
            page.sum("ros2_topic_messages_total", &labels),
            count as f64,
            "{domain}"
        );
        assert_eq!(
            page.sum("ros2_topic_subscriptions", &labels),
            1.0,
            "{domain}"
        );
    }
    Ok(())
}

#[test]
fn stopped_nodes_vanish_immediately_and_killed_ones_when_their_lease_ends() -> Result<()> {
    let link = Link::new()?;
    let watcher = Watcher::start(&link.robot)?;
    // Each node is in a separate domain, because an assertion of Fast DDS 2.9 fails when it
    // discovers RustDDS.
    let node = |stack, name| {
        let stream = Stream {
            domain: stack as u16,
            ..Stream::small(1)
        };
        Peer::start(&link.robot, stack, Role::Subscriber, &stream, &[name])
    };
    let mut stopping = vec![
        ("/fast_stops", node(Stack::Fast, "/fast_stops")?),
        ("/cyclone_stops", node(Stack::Cyclone, "/cyclone_stops")?),
        ("/rust_stops", node(Stack::Rust, "/rust_stops")?),
    ];
    // The lease, and the maximum time between its last renewal and the end.
    let dying = BTreeMap::from([
        ("/fast_dies", (node(Stack::Fast, "/fast_dies")?, 20, 3)),
        (
            "/cyclone_dies",
            (node(Stack::Cyclone, "/cyclone_dies")?, 10, 8),
        ),
    ]);
    watcher.wait(|page| nodes(page).len() == 5, PATIENCE, "five nodes")?;

    for (name, peer) in &mut stopping {
        let ended = peer.process.terminate()?;
        assert!(ended.success(), "{name} ended with {ended}");
        // The counts below show that no lease ended.
        let is_gone = |page: &Scrape| !nodes(page).contains(*name);
        watcher.wait(is_gone, PATIENCE, "a node that stopped")?;
    }
    let page = watcher.agent.scrape()?;
    let went = |event| {
        let labels = [("entity", "participant"), ("event", event)];
        page.sum("ros2_discovery_events_total", &labels)
    };
    assert_eq!((went("disposed"), went("expired")), (3.0, 0.0));

    for (peer, ..) in dying.values() {
        peer.process.signal("KILL")?;
    }
    let killed = Instant::now();
    let mut gone: BTreeMap<&str, Duration> = BTreeMap::new();
    while gone.len() < dying.len() {
        assert!(killed.elapsed() < PATIENCE, "only {gone:?}");
        let page = watcher.agent.scrape()?;
        let there = nodes(&page);
        for name in dying.keys().filter(|name| !there.contains(**name)) {
            gone.entry(name).or_insert_with(|| killed.elapsed());
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    for (name, (_, lease, renewal)) in &dying {
        // A busy machine shows the end late.
        let expected = Duration::from_secs(lease - renewal)..Duration::from_secs(lease + 20);
        assert!(expected.contains(&gone[name]), "{name}: {gone:?}");
    }
    let page = watcher.agent.scrape()?;
    assert_eq!(page.sum("ros2_participants", &[]), 0.0);
    assert_eq!(
        page.sum("ros2_topic_subscriptions", &[("topic", "/imu")]),
        0.0
    );
    let labels = [("entity", "participant"), ("event", "expired")];
    assert_eq!(page.sum("ros2_discovery_events_total", &labels), 2.0);
    Ok(())
}

fn check_all_nodes(stack: Stack) -> Result<()> {
    let link = Link::new()?;
    let mut watchers = watchers(&link)?;
    for start in 0..STARTS {
        let began = Instant::now();
        let mut robot = Robot::new(&link, stack, start);
        robot.launch(NODES)?;
        robot.wait_shown(&watchers)?;
        eprintln!("{stack:?} {start}: shown after {:?}", began.elapsed());
        if !robot.stop(&watchers)? {
            drop(watchers);
            watchers = self::watchers(&link)?;
        }
    }
    Ok(())
}

fn check_late_agent(stack: Stack) -> Result<()> {
    let link = Link::new()?;
    for start in 0..LATE_STARTS {
        let began = Instant::now();
        let mut robot = Robot::new(&link, stack, start);
        robot.launch(NODES / 2)?;
        let watchers = watchers(&link)?;
        robot.launch(NODES / 2)?;
        robot.wait_shown(&watchers)?;
        eprintln!("{stack:?} {start}: shown after {:?}", began.elapsed());
        robot.stop(&watchers)?;
    }
    Ok(())
}

/// Starts an agent on the wire of one host, and one at the sockets of the other.
fn watchers(link: &Link) -> Result<[Watcher<'_>; 2]> {
    Ok([
        Watcher::start(&link.monitor)?,
        Watcher::start_looking(&link.robot, &datagrams_alone_of(&link.robot))?,
    ])
}

/// Sixteen processes of one node each, on both hosts, that all publish or subscribe to one topic.
struct Robot<'a> {
    link: &'a Link,
    stack: Stack,
    start: usize,
    peers: Vec<Peer>,
}

impl<'a> Robot<'a> {
    fn new(link: &'a Link, stack: Stack, start: usize) -> Robot<'a> {
        Robot {
            link,
            stack,
            start,
            peers: Vec::new(),
        }
    }

    /// Starts this many more nodes at the same time, and waits until they have their endpoints.
    fn launch(&mut self, count: usize) -> Result<()> {
        let first = self.peers.len();
        for number in first..first + count {
            // Each host has publishers and subscribers.
            let host = match number / 2 % 2 {
                0 => &self.link.robot,
                _ => &self.link.monitor,
            };
            let role = match number % 2 {
                0 => Role::Publisher,
                _ => Role::Subscriber,
            };
            let (stream, name) = (Stream::small(1), self.name(number));
            let mut enter = host.inside();
            enter.extend(["env", LONG_LEASE].map(str::to_owned));
            let peer = Peer::launch_behind(&enter, self.stack, role, &stream, &[&name])?;
            self.peers.push(peer);
        }
        self.peers[first..]
            .iter_mut()
            .try_for_each(Peer::wait_ready)
    }

    fn name(&self, number: usize) -> String {
        format!("/start_{}/node_{number}", self.start)
    }

    /// Returns the time for goodbyes, less than the lease. RustDDS rarely sends one late.
    fn leave(&self) -> Duration {
        match self.stack {
            Stack::Cyclone => Duration::from_secs(40),
            Stack::Fast => Duration::from_secs(15),
            _ => LEAVE,
        }
    }

    fn wait_shown(&self, watchers: &[Watcher<'_>]) -> Result<()> {
        let names: BTreeSet<_> = (0..NODES).map(|number| self.name(number)).collect();
        let shown = |page: &Scrape| {
            let topic = [("topic", "/imu")];
            nodes(page) == names
                && page.sum("ros2_topic_publishers", &topic) == NODES as f64 / 2.0
                && page.sum("ros2_topic_subscriptions", &topic) == NODES as f64 / 2.0
                && page.sum("ros2_participants", &[]) == NODES as f64
        };
        let what = format!("all of start {}", self.start);
        watchers
            .iter()
            .try_for_each(|watcher| watcher.wait(shown, PATIENCE, &what))
    }

    /// Ends all nodes in order, and returns whether the watchers saw all goodbyes.
    fn stop(mut self, watchers: &[Watcher<'_>]) -> Result<bool> {
        // The monitor's nodes end first, because goodbyes reach the robot's sockets only while some
        // of them are open.
        for on_monitor in [1, 0] {
            let peers = self.peers.iter_mut().enumerate();
            let there = peers.filter(|(number, _)| number / 2 % 2 == on_monitor);
            let mut ending = Vec::new();
            for (number, peer) in there {
                // The Rust peer cannot end while it waits for the start.
                if number % 2 == 0 {
                    peer.start_sending()?;
                }
                peer.process.signal("TERM")?;
                ending.push(peer);
            }
            for peer in ending {
                peer.process.wait(PATIENCE)?;
            }
        }
        let is_empty = |page: &Scrape| page.sum("ros2_participants", &[]) == 0.0;
        let left = watchers
            .iter()
            .map(|watcher| watcher.wait(is_empty, self.leave(), "without participants"));
        let Err(error) = left.collect::<Result<Vec<()>>>() else {
            return Ok(true);
        };
        // RustDDS 0.15 ends its sending thread right after it queues the goodbye (dp_event_loop.rs,
        // drain_queues). A late thread ends before it sends. Watchers of different kinds on
        // different hosts then miss the same goodbyes.
        let stay = |watcher: &Watcher<'_>| {
            let page = watcher.agent.scrape()?;
            anyhow::Ok(page.labels_of("ros2_participant_info", "participant"))
        };
        let stay: Vec<_> = watchers.iter().map(stay).collect::<Result<_>>()?;
        eprintln!("{:?} {}: {stay:?} stay", self.stack, self.start);
        let same = stay.windows(2).all(|pair| pair[0] == pair[1]);
        if self.stack == Stack::Rust && same && stay[0].len() <= SILENT {
            return Ok(false);
        }
        Err(error)
    }
}

/// The agent on a host.
struct Watcher<'a> {
    agent: Agent<'a>,
    _directory: TempDir,
}

impl<'a> Watcher<'a> {
    fn start(host: &'a Namespace) -> Result<Watcher<'a>> {
        Self::start_looking(host, PACKETS_ALONE)
    }

    fn start_looking(host: &'a Namespace, capture: &str) -> Result<Watcher<'a>> {
        let directory = tempfile::tempdir()?;
        let file = directory.path().join("ros2probe.yaml");
        std::fs::write(&file, format!("watch: [/**]\nlog: warn\n{capture}"))?;
        let agent = Agent::start(host, Path::new(env!("CARGO_BIN_EXE_rp")), &file)?;
        Ok(Watcher {
            agent,
            _directory: directory,
        })
    }

    /// Scrapes until the page shows `what`.
    fn wait(&self, shows: impl Fn(&Scrape) -> bool, limit: Duration, what: &str) -> Result<()> {
        let deadline = Instant::now() + limit;
        loop {
            let page = self.agent.scrape()?;
            if shows(&page) {
                return Ok(());
            }
            ensure!(
                Instant::now() < deadline,
                "not {what} within {limit:?}: {}",
                page.0
            );
            std::thread::sleep(Duration::from_millis(200));
        }
    }
}

/// A publisher on the robot that sends to a subscriber on the monitor.
fn start_talker_pair(link: &Link, stack: Stack, stream: &Stream) -> Result<(Peer, Peer)> {
    let mut subscriber = Peer::start(
        &link.monitor,
        stack,
        Role::Subscriber,
        stream,
        &["/listener"],
    )?;
    let mut publisher = Peer::start(&link.robot, stack, Role::Publisher, stream, &["/talker"])?;
    subscriber.wait_matched()?;
    publisher.wait_matched()?;
    publisher.start_sending()?;
    Ok((publisher, subscriber))
}

fn nodes(page: &Scrape) -> BTreeSet<String> {
    page.labels_of("ros2_node_info", "ros_node")
}
