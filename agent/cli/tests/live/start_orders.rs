//! Agent, publisher, subscriber and router of Zenoh start in every order. Once the agent knows the
//! names, the same messages give the same figures, also after a restart of the agent and a router.
//!
//! A robot that is older than the agent sends before the agent starts, and repeats its
//! announcements on request.

use std::collections::BTreeSet;
use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape, datagrams_alone_of, get};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer::{self, Peer, Role, Stack, Stream};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::permutations;
use serde_json::Value;
use tempfile::TempDir;

const RP: &str = env!("CARGO_BIN_EXE_rp");
const PATIENCE: Duration = Duration::from_secs(60);
/// Time to settle: longer than the second after which a gap is a loss.
const SETTLE: Duration = Duration::from_secs(2);
/// Time after which the agent has written its state: 3 s after a change, with a margin.
const WRITTEN_AFTER: Duration = Duration::from_secs(4);
/// Number of messages that the publisher sends without a pause.
const STRETCH: u64 = 100;
const TOPIC: [(&str, &str); 1] = [("topic", "/imu")];
/// Number of orders that run at the same time.
const AT_ONCE: usize = 3;

/// A program that starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    Agent,
    Publisher,
    Subscriber,
    Router,
}

use Part::{Agent as A, Publisher as P, Router as R, Subscriber as S};

#[test]
fn fast_dds_and_the_agent_start_in_every_order() -> Result<()> {
    every_order(Stack::Fast, &[A, P, S])
}

#[test]
fn cyclone_dds_and_the_agent_start_in_every_order() -> Result<()> {
    every_order(Stack::Cyclone, &[A, P, S])
}

// Coverage: Zenoh over TCP | Zenoh 1.10 | - | exact
#[test]
fn zenoh_and_the_agent_start_in_every_order_after_the_router() -> Result<()> {
    every_order_from(Stack::Zenoh, &[R], &[A, P, S])
}

#[test]
fn zenoh_and_the_router_start_in_every_order_after_the_agent() -> Result<()> {
    every_order_from(Stack::Zenoh, &[A], &[R, P, S])
}

#[test]
fn zenoh_router_and_agent_start_in_every_order_after_the_publisher() -> Result<()> {
    every_order_from(Stack::Zenoh, &[P], &[R, A, S])
}

#[test]
fn zenoh_router_and_agent_start_in_every_order_after_the_subscriber() -> Result<()> {
    every_order_from(Stack::Zenoh, &[S], &[R, A, P])
}

fn every_order(stack: Stack, parts: &[Part]) -> Result<()> {
    every_order_from(stack, &[], parts)
}

/// Tries each order of `parts` after `first`.
fn every_order_from(stack: Stack, first: &[Part], parts: &[Part]) -> Result<()> {
    let orders: Vec<Vec<Part>> = permutations(parts)
        .into_iter()
        .map(|order| [first, &order[..]].concat())
        .collect();
    let mut failed = Vec::new();
    for some in orders.chunks(AT_ONCE) {
        std::thread::scope(|scope| {
            let running: Vec<_> = some
                .iter()
                .map(|order| scope.spawn(|| one_order(stack, order)))
                .collect();
            for (order, thread) in some.iter().zip(running) {
                if let Err(error) = thread.join().unwrap() {
                    failed.push(format!("{order:?}: {error:#}"));
                }
            }
        });
    }
    ensure!(failed.is_empty(), "{}", failed.join("\n"));
    Ok(())
}

/// The agent's report of a stretch of messages.
#[derive(Debug, PartialEq, Eq)]
struct Figures {
    nodes: BTreeSet<String>,
    participants: u64,
    unknown_writers: u64,
    publishers: u64,
    subscriptions: u64,
    messages: u64,
    lost: u64,
    delivered: u64,
    lost_deliveries: u64,
    /// Nodes and process of each receiver.
    receivers: Vec<(String, u64)>,
}

struct Robot<'n> {
    host: &'n Namespace,
    stack: Stack,
    directory: TempDir,
    agent: Option<Agent<'n>>,
    router: Option<Process>,
    publisher: Option<Peer>,
    subscriber: Option<Peer>,
    sent: u64,
    /// Whether sessions are older than the agent.
    is_late: bool,
    /// Time at which the first agent had all names.
    known_since: Option<Instant>,
}

fn one_order(stack: Stack, order: &[Part]) -> Result<()> {
    let host = Namespace::isolated()?;
    let mut robot = Robot {
        host: &host,
        stack,
        directory: tempfile::tempdir()?,
        agent: None,
        router: None,
        publisher: None,
        subscriber: None,
        sent: 0,
        is_late: false,
        known_since: None,
    };
    for part in order {
        if *part == Part::Agent && robot.is_whole() {
            // The robot sends messages that the agent cannot know.
            robot.matched()?;
            robot.send()?;
        }
        robot.start(*part)?;
    }
    if robot.sent > 0 {
        robot.is_late = true;
        if stack == Stack::Zenoh {
            robot.send()?;
        }
        robot.discover()?;
    } else {
        robot.matched()?;
    }
    let expected = robot.expected()?;
    robot.figures_of_a_stretch(&expected)?;

    robot.restart_agent()?;
    robot.is_late = true;
    if stack == Stack::Zenoh {
        // The agent finds the batches of connections in their first messages (docs/zenoh.md).
        robot.send()?;
    }
    robot
        .figures_of_a_stretch(&expected)
        .context("after a restart of the agent")?;

    if stack == Stack::Zenoh {
        robot.router = None;
        robot.start(Part::Router)?;
        robot
            .figures_of_a_stretch(&expected)
            .context("after a restart of the router")?;
    }
    Ok(())
}

impl<'n> Robot<'n> {
    fn is_whole(&self) -> bool {
        let has_router = self.router.is_some() || self.stack != Stack::Zenoh;
        has_router && self.publisher.is_some() && self.subscriber.is_some()
    }

    fn start(&mut self, part: Part) -> Result<()> {
        let stream = Stream {
            reliable: true,
            stretch: STRETCH,
            linger: 60.0,
            ..Stream::small(10 * STRETCH)
        };
        let peer = |role, node| Peer::start(self.host, self.stack, role, &stream, &[node]);
        match part {
            Part::Agent => self.agent = Some(self.start_agent()?),
            Part::Publisher => self.publisher = Some(peer(Role::Publisher, "/sensor")?),
            Part::Subscriber => self.subscriber = Some(peer(Role::Subscriber, "/listener")?),
            Part::Router => self.router = Some(peer::router(self.host, &[])?),
        }
        Ok(())
    }

    fn configuration(&self) -> Result<PathBuf> {
        let state = self.directory.path().join("state");
        fs::create_dir_all(&state)?;
        let path = self.directory.path().join("ros2probe.yaml");
        let sockets = datagrams_alone_of(self.host);
        let text = format!(
            "watch: [/imu]\nlog: warn\nstate_directory: {}\n{sockets}",
            state.display()
        );
        fs::write(&path, text)?;
        Ok(path)
    }

    fn start_agent(&self) -> Result<Agent<'n>> {
        Agent::start(self.host, RP, &self.configuration()?)
    }

    /// Kills the agent after it has saved its state, and starts it again.
    fn restart_agent(&mut self) -> Result<()> {
        let known_since = self.known_since.context("no names")?;
        std::thread::sleep(WRITTEN_AFTER.saturating_sub(known_since.elapsed()));
        let written = [("outcome", "written")];
        self.agent()?.scrape_until("a written state", |page| {
            page.sum("ros2probe_state_writes_total", &written) >= 1.0
        })?;
        self.agent()?.process.signal("KILL")?;
        self.agent = None;
        self.agent = Some(self.start_agent()?);
        Ok(())
    }

    fn agent(&self) -> Result<&Agent<'n>> {
        self.agent.as_ref().context("no agent")
    }

    fn matched(&mut self) -> Result<()> {
        for peer in [&mut self.publisher, &mut self.subscriber] {
            peer.as_mut().context("no peer")?.wait_matched()?;
        }
        Ok(())
    }

    /// Sends a stretch and waits until the subscriber has it.
    fn send(&mut self) -> Result<()> {
        self.publisher
            .as_mut()
            .context("no publisher")?
            .start_sending()?;
        self.sent += STRETCH;
        let deadline = Instant::now() + PATIENCE;
        let subscriber = self.subscriber.as_ref().context("no subscriber")?;
        while (subscriber.log()?.sequences("sub").len() as u64) < self.sent {
            ensure!(Instant::now() < deadline, "the subscriber lacks messages");
            std::thread::sleep(Duration::from_millis(50));
        }
        Ok(())
    }

    /// Requests the announcements from before the agent's start, as its hints recommend.
    fn discover(&self) -> Result<()> {
        let enter = self.host.on_network();
        let (program, arguments) = enter.split_first().context("no host")?;
        let configuration = self.configuration()?.display().to_string();
        let how = match self.stack {
            Stack::Zenoh => vec!["--router"],
            _ => vec!["--all", "--config", &configuration],
        };
        let output = Command::new(program)
            .args(arguments)
            .args([RP, "discover"])
            .args(how)
            .output()?;
        ensure!(output.status.success(), "{output:?}");
        Ok(())
    }

    fn expected(&self) -> Result<Figures> {
        let subscriber = self.subscriber.as_ref().context("no subscriber")?;
        Ok(Figures {
            nodes: ["/listener", "/sensor"].map(str::to_owned).into(),
            participants: 2,
            unknown_writers: 0,
            publishers: 1,
            subscriptions: 1,
            messages: STRETCH,
            lost: 0,
            delivered: STRETCH,
            lost_deliveries: 0,
            receivers: vec![("/listener".to_owned(), subscriber.process.pid().into())],
        })
    }

    /// Sends a stretch, and waits until the agent reports the expected figures, which then stay.
    fn figures_of_a_stretch(&mut self, expected: &Figures) -> Result<()> {
        let none = Figures {
            messages: 0,
            delivered: 0,
            receivers: Vec::new(),
            ..self.expected()?
        };
        let idle = |found: &Figures| Figures {
            receivers: Vec::new(),
            nodes: found.nodes.clone(),
            ..*found
        };
        self.reaches(|robot| {
            let begin = robot.agent()?.scrape()?;
            std::thread::sleep(SETTLE / 2);
            let found = robot.figures(&begin)?;
            Ok((idle(&found) == none, found))
        })
        .context("before the messages")?;
        self.known_since.get_or_insert_with(Instant::now);
        let before = self.agent()?.scrape()?;
        self.send()?;
        self.reaches(|robot| {
            let found = robot.figures(&before)?;
            Ok((found == *expected, found))
        })
        .context("after the messages")?;
        std::thread::sleep(SETTLE);
        let found = self.figures(&before)?;
        ensure!(found == *expected, "later {found:#?}");
        Ok(())
    }

    fn reaches(&self, look: impl Fn(&Self) -> Result<(bool, Figures)>) -> Result<()> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let (is_reached, found) = look(self)?;
            if is_reached {
                return Ok(());
            }
            if Instant::now() > deadline {
                let page = self.agent()?.scrape()?;
                bail!("found {found:#?}\n{}", page.suspicious_counters());
            }
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    /// Returns the figures since `before`.
    fn figures(&self, before: &Scrape) -> Result<Figures> {
        let agent = self.agent()?;
        let page = agent.scrape()?;
        let whole = |value: f64| value.round() as u64;
        let since = |name| whole(page.sum(name, &TOPIC) - before.sum(name, &TOPIC));
        let text = get(agent.host, "http://127.0.0.1:17401/topics/imu")?;
        let topic: Value = serde_json::from_str(&text)?;
        let deliveries = topic["deliveries"].as_array().context("no deliveries")?;
        let received = deliveries
            .iter()
            .filter(|delivery| delivery["direction"] == "received");
        let receivers = received.map(|delivery| {
            let nodes = delivery["nodes"].as_array().into_iter().flatten();
            let nodes: Vec<_> = nodes.filter_map(Value::as_str).collect();
            let process = delivery["process_id"].as_u64().unwrap_or_default();
            (nodes.join(" "), process)
        });
        // A session of Zenoh that is older than the agent may receive without a name
        // (docs/zenoh.md).
        let may_lack_name = self.stack == Stack::Zenoh && self.is_late;
        let named = self.expected()?.receivers;
        let receivers = receivers.map(|(nodes, process)| match &named[..] {
            [(name, id)] if may_lack_name && (nodes.is_empty() || nodes == *name) => {
                let is_unknown = process == 0 || process == *id;
                (name.clone(), if is_unknown { *id } else { process })
            }
            _ => (nodes, process),
        });
        Ok(Figures {
            nodes: page.labels_of("ros2_node_info", "ros_node"),
            participants: whole(page.sum("ros2_participants", &[])),
            unknown_writers: whole(page.sum("ros2_unknown_writers", &[])),
            publishers: whole(page.sum("ros2_topic_publishers", &TOPIC)),
            subscriptions: whole(page.sum("ros2_topic_subscriptions", &TOPIC)),
            messages: since("ros2_topic_messages_total"),
            lost: since("ros2_topic_lost_messages_total"),
            delivered: since("ros2_topic_delivered_messages_total"),
            lost_deliveries: since("ros2_topic_delivery_lost_messages_total"),
            receivers: receivers.collect(),
        })
    }
}
