//! The host hook attaches and detaches while nodes communicate, without effect on them. No sample
//! is lost, and nothing stays in the kernel, however the process ends and whichever other programs
//! are attached.
//!
//! The references are the nodes' logs, the kernel's own counters, and the kernel's list of attached
//! programs.

use std::fs::File;
use std::path::Path;
use std::process::Stdio;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::PREFIX;
use ros2probe_testing::harness::agent::{Agent, get};
use ros2probe_testing::harness::bpf::{self, AttachMode, Direction};
use ros2probe_testing::harness::cgroup::Cgroup;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::snmp::Snmp;
use ros2probe_testing::harness::witness::Witness;
use tempfile::TempDir;

const DIRECTIONS: [Direction; 2] = [Direction::Ingress, Direction::Egress];
/// Number of programs of an agent in each direction: for UDP, and for TCP of Zenoh.
const PROGRAMS: u32 = 2;
/// Maximum wait on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);
const ROUNDS: u64 = 20;
/// Lifetimes of agents in milliseconds. An agent needs about 200 until it is ready.
const LIVES: [u64; 10] = [0, 20, 40, 60, 90, 120, 160, 210, 270, 400];

/// Runs one test at a time, because descriptors of this process are counted.
static TURN: Mutex<()> = Mutex::new(());

#[test]
fn nodes_lose_no_sample_while_agents_start_and_stop() -> Result<()> {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let above = Cgroup::create(&format!("{PREFIX}-{}-attach", std::process::id()))?;
    let link = Link::below(&above)?;
    let configuration = Configuration::at(above.path())?;
    // The same streams without an agent are the baseline of the machine.
    let mut alone = Streams::start(&link)?;
    std::thread::sleep(Duration::from_secs(3));
    alone.ensure_lossless().context("without any agent")?;

    let mut talks = Streams::start(&link)?;
    // After the first start, the library has opened everything that it keeps open.
    Witness::start(&configuration.text)?.finish()?;
    let descriptors = open_descriptors()?;
    for _ in 0..ROUNDS {
        Witness::start(&configuration.text)?.finish()?;
    }
    ensure!(
        open_descriptors()? == descriptors,
        "descriptors: {descriptors} before {ROUNDS} rounds, {} after",
        open_descriptors()?
    );
    ensure_nothing_attached(above.path(), 0)?;

    for milliseconds in LIVES {
        let mut agent = configuration.launch(&link.robot)?;
        std::thread::sleep(Duration::from_millis(milliseconds));
        kill(&mut agent)?;
        ensure_nothing_attached(above.path(), 0)?;
    }
    let mut agent = configuration.start(&link.robot)?;
    let programs = kill(&mut agent.process)?;
    ensure!(programs > 0, "a working agent holds no programs");
    ensure_nothing_attached(above.path(), 0)?;

    for direction in DIRECTIONS {
        bpf::attach_foreign_program(above.path(), direction, AttachMode::Shared)?;
    }
    let one = configuration.start(&link.robot)?;
    let other = configuration.start(&link.monitor)?;
    for direction in DIRECTIONS {
        let attached = bpf::attached(above.path(), direction)?;
        ensure!(
            attached == 1 + 2 * PROGRAMS,
            "{attached} programs of three owners"
        );
    }
    let later = Link::below(&above)?;
    let stream = Stream {
        topic: "/later".to_owned(),
        ..Stream::small(200)
    };
    run_stream(&later, &stream)?;
    for agent in [&one, &other] {
        let scrape = agent.settled_scrape("/later", 200)?;
        let counted = scrape.sum("ros2_topic_messages_total", &[("topic", "/later")]);
        ensure!(
            counted == 200.0,
            "an agent counted {counted} in a later container"
        );
        ensure!(scrape.sum("ros2_topic_lost_messages_total", &[("topic", "/later")]) == 0.0);
    }
    drop(one);
    ensure_nothing_attached(above.path(), 1 + PROGRAMS)?;
    drop(other);
    ensure_nothing_attached(above.path(), 1)?;
    talks
        .ensure_lossless()
        .context("while agents came and went")
}

#[test]
fn an_exclusive_program_makes_the_agent_read_the_wire_and_report_why() -> Result<()> {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let above = Cgroup::create(&format!("{PREFIX}-{}-alone", std::process::id()))?;
    let link = Link::below(&above)?;
    bpf::attach_foreign_program(above.path(), Direction::Egress, AttachMode::Exclusive)?;
    let configuration = Configuration::at(above.path())?;
    let mut refused = configuration.launch(&link.robot)?;
    ensure!(!refused.wait(PATIENCE)?.success(), "`source: host` came up");
    let configuration = Configuration::new(&format!(
        "watch: [/**]\ncapture: {{source: auto, cgroup: {}}}\n",
        above.path().display()
    ))?;
    let agent = configuration.start(&link.robot)?;
    run_stream(&link, &Stream::small(200))?;
    let scrape = agent.settled_scrape("/imu", 200)?;
    let wire = [("source", "wire")];
    ensure!(
        scrape.value("ros2probe_capture_source_info", &wire) == Some(1.0),
        "{}",
        scrape.0
    );
    let counted = scrape.sum("ros2_topic_messages_total", &[("topic", "/imu")]);
    ensure!(counted == 200.0, "counted {counted}");
    drop(agent);
    ensure!(bpf::attached(above.path(), Direction::Egress)? == 1);
    ensure_nothing_attached(link.cgroup(), 0)
}

#[test]
fn a_recreated_cgroup_is_observed_again_and_reported_while_it_is_missing() -> Result<()> {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let name = format!("{PREFIX}-{}-anew", std::process::id());
    // The agent is in none of the removed groups.
    let elsewhere = Namespace::isolated()?;
    let above = Cgroup::create(&name)?;
    let configuration = Configuration::at(above.path())?;
    let mut agent = configuration.start(&elsewhere)?;
    let wait_for_event = |what: &str, round: usize| {
        eventually(|| {
            let events = get(
                &elsewhere,
                "http://127.0.0.1:17401/events?after=0&follow=false",
            )?;
            let reported = events.matches(what).count();
            ensure!(
                reported == round,
                "{reported} of {round} {what} in {events}"
            );
            Ok(())
        })
    };
    for round in 1..=2 {
        let topic = format!("/round{round}");
        let link = Link::below(&above)?;
        let stream = Stream {
            topic: topic.clone(),
            ..Stream::small(200)
        };
        run_stream(&link, &stream)?;
        let scrape = agent.settled_scrape(&topic, 200)?;
        let counted = scrape.sum("ros2_topic_messages_total", &[("topic", &topic)]);
        ensure!(counted == 200.0, "counted {counted} in round {round}");
        drop(link);
        remove_until(above.path(), || agent.request("/readyz").is_err())?;
        agent.scrape_until("unready without any ability", |page| {
            page.value("ros2probe_ready", &[]) == Some(0.0)
                && page.sum("ros2probe_capture_ability", &[]) == 0.0
        })?;
        let health = agent.request("/healthz");
        ensure!(health.is_ok(), "the agent is gone: {health:?}");
        wait_for_event("\"ros2probe.capture.blind\"", round)?;
        wait_for_event("was removed", round)?;
        std::fs::create_dir(above.path())?;
        agent.wait_ready(PATIENCE)?;
        wait_for_event("\"ros2probe.capture.seeing\"", round)?;
        for direction in DIRECTIONS {
            let attached = bpf::attached(above.path(), direction)?;
            ensure!(attached == PROGRAMS, "{attached} programs are attached");
        }
    }
    agent.process.terminate()?;
    ensure_nothing_attached(above.path(), 0)
}

#[test]
fn a_briefly_missing_cgroup_is_reported_and_observed_again() -> Result<()> {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let elsewhere = Namespace::isolated()?;
    let above = Cgroup::create(&format!("{PREFIX}-{}-moment", std::process::id()))?;
    let configuration = Configuration::at(above.path())?;
    let mut agent = configuration.start(&elsewhere)?;
    agent.wait_ready(PATIENCE)?;
    // A starting agent does not report a blind capture. Until then, the thread of events polls
    // every 100 ms, or later on a busy machine.
    std::thread::sleep(Duration::from_secs(3));
    for round in 1..=2 {
        std::fs::remove_dir(above.path())?;
        std::fs::create_dir(above.path())?;
        eventually(|| {
            let page = agent.scrape()?;
            for name in ["ros2probe.capture.blind", "ros2probe.capture.seeing"] {
                let reported = page.sum("ros2probe_events_total", &[("name", name)]);
                ensure!(reported == f64::from(round), "{reported} of {round} {name}");
            }
            Ok(())
        })?;
    }
    for direction in DIRECTIONS {
        let attached = bpf::attached(above.path(), direction)?;
        ensure!(attached == PROGRAMS, "{attached} programs are attached");
    }
    let link = Link::below(&above)?;
    run_stream(&link, &Stream::small(200))?;
    let scrape = agent.settled_scrape("/imu", 200)?;
    let counted = scrape.sum("ros2_topic_messages_total", &[("topic", "/imu")]);
    ensure!(counted == 200.0, "counted {counted}");
    drop(link);
    agent.process.terminate()?;
    ensure_nothing_attached(above.path(), 0)
}

#[test]
fn a_cgroup_that_does_not_exist_yet_ends_the_agent_so_that_it_is_started_again() -> Result<()> {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    let elsewhere = Namespace::isolated()?;
    let above = Cgroup::create(&format!("{PREFIX}-{}-later", std::process::id()))?;
    let group = above.path().join("robot");
    let group = group.display();
    let configuration = Configuration::new(&format!(
        "watch: [/**]\ncapture: {{source: auto, cgroup: {group}}}\n"
    ))?;
    let log = configuration.directory.path().join("log");
    let mut early = configuration.launch_with(&elsewhere, File::create(&log)?.into())?;
    let status = early.wait(PATIENCE)?;
    let printed = std::fs::read_to_string(&log)?;
    // The unit does not restart an agent that ends with 77.
    ensure!(status.code() == Some(1), "{status}: {printed}");
    let reason = format!("cannot open the control group {group}");
    ensure!(printed.contains(&reason), "{printed}");

    let _group = above.create_below("robot")?;
    let agent = configuration.start(&elsewhere)?;
    let page = agent.scrape()?;
    let host = page.value("ros2probe_capture_source_info", &[("source", "host")]);
    ensure!(host == Some(1.0), "{}", page.0);
    Ok(())
}

/// Removes a cgroup after its last process has ended, and waits until `noticed` is true.
fn remove_until(cgroup: &Path, noticed: impl Fn() -> bool) -> Result<()> {
    eventually(|| Ok(std::fs::remove_dir(cgroup)?))?;
    eventually(|| {
        ensure!(noticed(), "nothing is noticed");
        Ok(())
    })
}

/// The agent's configuration file.
struct Configuration {
    text: String,
    directory: TempDir,
}

impl Configuration {
    fn at(cgroup: &Path) -> Result<Configuration> {
        let path = cgroup.display();
        Configuration::new(&format!(
            "watch: [/**]\ncapture: {{source: host, cgroup: {path}}}\n"
        ))
    }

    fn new(text: &str) -> Result<Configuration> {
        let directory = tempfile::tempdir()?;
        std::fs::write(directory.path().join("ros2probe.yaml"), text)?;
        Ok(Configuration {
            text: text.to_owned(),
            directory,
        })
    }

    fn start<'a>(&self, host: &'a Namespace) -> Result<Agent<'a>> {
        let file = self.directory.path().join("ros2probe.yaml");
        Agent::start(host, env!("CARGO_BIN_EXE_rp"), &file)
    }

    /// Starts the agent without waiting for it.
    fn launch(&self, host: &Namespace) -> Result<Process> {
        self.launch_with(host, Stdio::inherit())
    }

    /// Starts the agent as [`Configuration::launch`] does, with standard error redirected.
    fn launch_with(&self, host: &Namespace, errors: Stdio) -> Result<Process> {
        let file = self.directory.path().join("ros2probe.yaml");
        let arguments = ["run".as_ref(), "--config".as_ref(), file.as_os_str()];
        let program = env!("CARGO_BIN_EXE_rp");
        Process::start_with(&host.on_network(), program, arguments, errors)
    }
}

/// A stream of small samples and one of point clouds.
struct Streams {
    publishers: Vec<Peer>,
    subscribers: Vec<Peer>,
}

impl Streams {
    fn start(link: &Link) -> Result<Streams> {
        let mut talks = Streams {
            publishers: Vec::new(),
            subscribers: Vec::new(),
        };
        let streams = [
            (Stack::Cyclone, Stream::small(0)),
            // A receive buffer holds a third of a second of this stream.
            (
                Stack::Fast,
                Stream {
                    rate: 10.0,
                    ..Stream::point_cloud(644_000, 0)
                },
            ),
        ];
        for ((stack, stream), domain) in streams.into_iter().zip(10..) {
            let stream = Stream {
                domain,
                depth: 1000,
                ..stream
            };
            let role = Role::Subscriber;
            talks.subscribers.push(Peer::start(
                &link.monitor,
                stack,
                role,
                &stream,
                &["/listener"],
            )?);
            let role = Role::Publisher;
            talks.publishers.push(Peer::start(
                &link.robot,
                stack,
                role,
                &stream,
                &["/talker"],
            )?);
        }
        for peer in talks.publishers.iter_mut().chain(&mut talks.subscribers) {
            peer.wait_matched()?;
        }
        // Fast DDS notifies its subscriber before the publisher.
        std::thread::sleep(Duration::from_millis(300));
        talks
            .publishers
            .iter_mut()
            .try_for_each(Peer::start_sending)?;
        Ok(talks)
    }

    /// Ends the streams, and checks that they lost no sample.
    fn ensure_lossless(&mut self) -> Result<()> {
        for publisher in &mut self.publishers {
            publisher.process.terminate()?;
        }
        for (publisher, subscriber) in self.publishers.iter().zip(&self.subscribers) {
            let sent = publisher.log()?.sequences("pub").len() as u64;
            subscriber.wait_settled(sent)?;
        }
        let host = self
            .subscribers
            .first()
            .context("no subscriber")?
            .process
            .pid();
        let counted = Snmp::of(host)?;
        for subscriber in &mut self.subscribers {
            subscriber.process.terminate()?;
        }
        let overflows = counted.receive_buffer_errors()?;
        for (publisher, subscriber) in self.publishers.iter().zip(&self.subscribers) {
            let sent = publisher.log()?.writer_numbers("pub")?;
            let received = subscriber.log()?.writer_numbers("sub")?;
            let lost: Vec<_> = sent.difference(&received).collect();
            // A node without CPU time may overflow its own receive buffer.
            ensure!(
                lost.len() as u64 <= overflows,
                "lost {lost:?} of {}, {overflows} overflows",
                sent.len()
            );
            println!("{} samples, {lost:?} lost", sent.len());
        }
        // The kernel counts datagrams that a program refuses among the other errors.
        ensure!(
            counted.receive_errors()? == overflows,
            "a datagram was refused"
        );
        Ok(())
    }
}

/// Runs a stream from beginning to end, and checks that all of it is received.
fn run_stream(link: &Link, stream: &Stream) -> Result<()> {
    let host = &link.monitor;
    let mut subscriber = Peer::start(
        host,
        Stack::Cyclone,
        Role::Subscriber,
        stream,
        &["/listener"],
    )?;
    let host = &link.robot;
    let mut publisher = Peer::start(host, Stack::Cyclone, Role::Publisher, stream, &["/talker"])?;
    publisher.wait_matched()?;
    subscriber.wait_matched()?;
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    subscriber.wait_received(stream.count)?;
    let received = subscriber.log()?.writer_numbers("sub")?.len() as u64;
    ensure!(received == stream.count, "{received} received");
    Ok(())
}

fn open_descriptors() -> Result<usize> {
    Ok(std::fs::read_dir("/proc/self/fd")?.count())
}

/// Retries `what`, because the kernel releases a process shortly after it has ended.
fn eventually(what: impl Fn() -> Result<()>) -> Result<()> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let outcome = what();
        if outcome.is_ok() || Instant::now() > deadline {
            return outcome;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Kills a process and returns how many programs it held. All are unloaded on return.
fn kill(agent: &mut Process) -> Result<usize> {
    let programs = bpf::programs_of(agent.pid())?;
    agent.signal("KILL")?;
    agent.wait(PATIENCE)?;
    eventually(|| {
        for program in &programs {
            ensure!(!bpf::exists(*program)?, "program {program} stays behind");
        }
        Ok(())
    })?;
    Ok(programs.len())
}

fn ensure_nothing_attached(cgroup: &Path, but: u32) -> Result<()> {
    eventually(|| {
        for direction in DIRECTIONS {
            let attached = bpf::attached(cgroup, direction)?;
            ensure!(
                attached == but,
                "{attached} programs are attached for {direction:?}, not {but}"
            );
        }
        Ok(())
    })
}
