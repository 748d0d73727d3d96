//! The `ros2` command line of ROS 2 with the agent as its daemon, beside real nodes. It prints the
//! same as with its own daemon, and sends nothing on the network.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::collections::BTreeSet;
use std::fs;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;

use crate::host::{Host, Middleware};
use crate::installed::{self, in_environment};

const PATIENCE: Duration = Duration::from_secs(60);
/// Maximum wait for the port. The kernel keeps the address of a closed connection of the real
/// daemon for at most a minute. The daemon does not permit its reuse.
const TIME_WAIT: Duration = Duration::from_secs(75);
/// Number of nodes of the robot, without those of tools.
const NODES: f64 = 6.0;
const LISTENING: [(&str, &str); 1] = [("state", "listening")];
/// Every command that needs no participant, in each of its forms.
const DAEMON_COMMANDS: &[&str] = &[
    "topic list",
    "topic list -t",
    "topic list -v",
    "topic list -c",
    "topic list --include-hidden-topics",
    "topic info /chatter",
    "topic info -v /chatter",
    "topic info -v /fibonacci/_action/status",
    "topic info /nope",
    "topic type /chatter",
    "topic type /nope",
    "topic find std_msgs/msg/String",
    "topic find -c rcl_interfaces/msg/Log",
    "node list",
    "node list -a",
    "node info /talker",
    "node info --include-hidden /robot1/server",
    "node info /client",
    "node info /nope",
    "service list",
    "service list -t",
    "service list -c",
    "service list --include-hidden-services",
    "service type /robot1/add",
    "service find example_interfaces/srv/AddTwoInts",
    "action list",
    "action list -t",
    "action list -c",
    "action info /fibonacci",
    "action info -t /fibonacci",
    "lifecycle nodes",
    "component list",
];

/// Some of [`DAEMON_COMMANDS`], one for each kind of facts.
const ZENOH_DAEMON_COMMANDS: &[&str] = &[
    "topic list -v --include-hidden-topics",
    "topic info -v /chatter",
    "topic info -v /fibonacci/_action/status",
    "node list -a",
    "node info --include-hidden /robot1/server",
    "service list -t --include-hidden-services",
    "action info -t /fibonacci",
    "lifecycle nodes",
];

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, demo_nodes_cpp, lifecycle: make test-ros2"]
fn with_fast_dds_ros2_prints_the_same_and_sends_nothing() -> Result<()> {
    answers_as_the_real_daemon(Middleware::FastExact("auto"))
}

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp, demo_nodes_cpp, lifecycle: make test-ros2"]
fn with_cyclone_dds_ros2_prints_the_same_and_sends_nothing() -> Result<()> {
    answers_as_the_real_daemon(Middleware::Cyclone)
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp, demo_nodes_cpp, lifecycle: make test-ros2"]
fn with_zenoh_ros2_prints_the_same_and_opens_no_session() -> Result<()> {
    answers_as_the_real_daemon(Middleware::Zenoh)
}

fn answers_as_the_real_daemon(middleware: Middleware) -> Result<()> {
    let network = Namespace::isolated()?;
    let robot = Robot {
        host: Host::new(&network, middleware)?,
    };
    let agent = robot.host.agent("watch: ['/**']\nros2_daemon: on\n")?;
    let _router = robot.host.router_if_any()?;
    let nodes = robot.nodes()?;
    agent.scrape_until("all nodes are known", |page| {
        page.sum("ros2_nodes", &[]) == NODES
            && page.sum("ros2_topic_subscriptions", &[("topic", "/chatter")]) == 1.0
            && page.sum("ros2probe_ros2_daemon_ports", &LISTENING) == 1.0
    })?;
    robot.prints("daemon status", "The daemon is running")?;
    robot.prints("daemon start", "The daemon is already running")?;

    let sniffer = Sniffer::start(&robot)?;
    let with_agent = robot.all()?;
    let senders = sniffer.finish()?;
    // Nodes of Zenoh have had their session with the router since they started.
    let is_zenoh = middleware == Middleware::Zenoh;
    let own = if is_zenoh {
        BTreeSet::new()
    } else {
        ports(&nodes)?
    };
    ensure!(senders.is_subset(&own), "{senders:?} sent, of {own:?}");
    ensure!(is_zenoh || !senders.is_empty(), "the nodes sent nothing");
    let participants = agent.scrape()?.sum("ros2_participants", &[]);
    ensure!(participants == nodes.len() as f64, "{participants}");
    // A command that uses no daemon is seen on the network.
    let sniffer = Sniffer::start(&robot)?;
    robot.ros2("topic list --no-daemon")?;
    let senders = sniffer.finish()?;
    ensure!(!senders.is_subset(&own), "{senders:?} sent, of {own:?}");

    robot.prints("daemon stop", "The daemon has been stopped")?;
    robot.prints("daemon status", "The daemon is not running")?;
    robot.prints("daemon start", "The daemon has been started")?;
    wait_until("the real daemon knows the robot", || {
        let text = robot.ros2("topic info -v /chatter")?;
        let text = String::from_utf8_lossy(&text.stdout).into_owned();
        let nodes = robot.ros2("node list")?;
        let count = nodes.stdout.iter().filter(|byte| **byte == b'\n').count();
        Ok(text.contains("Node name: listener") && count == NODES as usize)
    })?;
    // Waits for the discovery of the last endpoints.
    std::thread::sleep(Duration::from_secs(2));
    let with_daemon = robot.all()?;
    for ((command, real), ours) in robot.free().iter().zip(&with_daemon).zip(&with_agent) {
        let (real, ours) = (Printed::of(real), Printed::of(ours));
        ensure!(
            real == ours,
            "ros2 {command}:\n{real:#?}\nwith the agent:\n{ours:#?}"
        );
        if is_zenoh && !command.starts_with("lifecycle") {
            let words: Vec<&str> = command.split(' ').collect();
            let text = robot.host.rp(&words)?;
            let mut lines: Vec<_> = text.lines().filter_map(without_daemon).collect();
            lines.sort_unstable();
            // Humble prints the name of a node in a namespace in this way.
            let whole = |line: &String| line.replace("//r/o/b/o/t/1server", "/robot1/server");
            let mut real: Vec<_> = real.output.iter().map(whole).collect();
            real.sort_unstable();
            ensure!(real == lines, "rp {command}:\n{real:#?}\n{lines:#?}");
        }
    }
    match is_zenoh {
        // The port is independent of the middleware.
        true => Ok(()),
        false => takes_over(&robot, &agent),
    }
}

/// Checks that the agent waits while a real daemon has the port, and answers once the daemon has
/// ended.
fn takes_over(robot: &Robot<'_>, agent: &Agent<'_>) -> Result<()> {
    agent.process.signal("HUP")?;
    agent.scrape_until("the port is occupied", |page| {
        page.sum("ros2probe_ros2_daemon_ports", &[("state", "occupied")]) == 1.0
    })?;
    robot.prints("daemon stop", "The daemon has been stopped")?;
    let deadline = Instant::now() + TIME_WAIT;
    while agent
        .scrape()?
        .sum("ros2probe_ros2_daemon_ports", &LISTENING)
        != 1.0
    {
        ensure!(Instant::now() < deadline, "the agent does not take over");
        std::thread::sleep(Duration::from_millis(200));
    }
    robot.prints("daemon start", "The daemon is already running")?;
    robot.prints("topic type /chatter", "std_msgs/msg/String")
}

struct Robot<'n> {
    host: Host<'n>,
}

/// The output of a command, without the order of lines and without the real daemon's own node.
#[derive(Debug, PartialEq, Eq)]
struct Printed {
    status: Option<i32>,
    output: Vec<String>,
    errors: Vec<String>,
}

/// A tcpdump on every interface of the namespace.
struct Sniffer<'r> {
    process: Process,
    robot: &'r Robot<'r>,
}

impl Robot<'_> {
    /// Starts the robot's nodes, each a process.
    fn nodes(&self) -> Result<Vec<Process>> {
        let prefix = installed::prefix();
        let programs = [
            "demo_nodes_cpp/talker",
            "demo_nodes_cpp/listener",
            "demo_nodes_cpp/add_two_ints_server",
            "lifecycle/lifecycle_talker",
        ];
        let mut nodes = Vec::new();
        for program in programs {
            let line = format!("exec {}/lib/{program}", prefix.display());
            nodes.push(self.host.run(&line, &[], Stdio::inherit())?);
        }
        nodes.push(self.host.python("graph.py", &[])?);
        Ok(nodes)
    }

    /// Runs `ros2` with these words.
    fn ros2(&self, words: &str) -> Result<Output> {
        let enter = self.host.enter();
        let (program, arguments) = enter.split_first().context("no prefix")?;
        let mut command = Command::new(program);
        command.args(arguments).args([
            "bash",
            "-c",
            &in_environment(&format!("exec ros2 {words}")),
        ]);
        command.output().with_context(|| words.to_owned())
    }

    /// Returns the compared commands.
    fn free(&self) -> &'static [&'static str] {
        match self.host.middleware {
            Middleware::Zenoh => ZENOH_DAEMON_COMMANDS,
            _ => DAEMON_COMMANDS,
        }
    }

    /// Returns the output of each command of [`Self::free`].
    fn all(&self) -> Result<Vec<Output>> {
        self.free().iter().map(|words| self.ros2(words)).collect()
    }

    fn prints(&self, words: &str, expected: &str) -> Result<()> {
        let output = self.ros2(words)?;
        let text = String::from_utf8_lossy(&output.stdout);
        let errors = String::from_utf8_lossy(&output.stderr);
        ensure!(text.trim() == expected, "ros2 {words}: {text}{errors}");
        Ok(())
    }
}

impl Printed {
    fn of(output: &Output) -> Self {
        let lines = |bytes: &[u8]| -> Vec<String> {
            let text = String::from_utf8_lossy(bytes);
            let mut lines: Vec<_> = text.lines().filter_map(without_daemon).collect();
            lines.sort_unstable();
            lines
        };
        Self {
            status: output.status.code(),
            output: lines(&output.stdout),
            errors: lines(&output.stderr),
        }
    }
}

/// Returns a line without the real daemon's node, which publishes `/rosout` and
/// `/parameter_events`. The numbers of publishers of these topics differ by one, and are omitted.
fn without_daemon(line: &str) -> Option<String> {
    if line.starts_with("/_ros2cli_daemon_") {
        return None;
    }
    let is_of_all = line.starts_with(" * /rosout ") || line.starts_with(" * /parameter_events ");
    match line.rsplit_once("] ") {
        Some((name, count)) if is_of_all && count.contains("publisher") => Some(name.to_owned()),
        _ => Some(line.to_owned()),
    }
}

impl<'r> Sniffer<'r> {
    fn start(robot: &'r Robot<'r>) -> Result<Self> {
        let file = robot.host.file("ros2.pcap");
        let errors = robot.host.file("tcpdump.txt");
        let file = file.display().to_string();
        let filter = match robot.host.middleware {
            Middleware::Zenoh => "tcp dst port 7447",
            _ => "udp",
        };
        let words = ["-i", "any", "-n", "-U", "-Z", "root", "-w", &file, filter];
        let enter = robot.host.network.inside();
        let printed = fs::File::create(&errors)?.into();
        let process = Process::start_with(&enter, "tcpdump", words, printed)?;
        wait_until("tcpdump listens", || {
            Ok(fs::read_to_string(&errors)?.contains("listening on"))
        })?;
        Ok(Self { process, robot })
    }

    /// Returns the source ports of all datagrams, or of connections to the router of Zenoh.
    fn finish(mut self) -> Result<BTreeSet<u16>> {
        // tcpdump reads the kernel's buffer each second.
        std::thread::sleep(Duration::from_millis(1_500));
        self.process.signal("INT")?;
        self.process.wait(PATIENCE)?;
        let file = self.robot.host.file("ros2.pcap");
        let output = Command::new("tcpdump")
            .args(["-n", "-r"])
            .arg(file)
            .output()?;
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        // TIME INTERFACE DIRECTION IP SOURCE.PORT > DESTINATION.PORT: UDP or Flags
        let sources = text.lines().filter_map(|line| {
            let (source, rest) = line.split_once(" > ")?;
            if rest.contains(": Flags ") && !rest.contains(": Flags [S]") {
                return None;
            }
            source.rsplit_once('.')?.1.parse().ok()
        });
        Ok(sources.collect())
    }
}

/// Returns the UDP ports of these processes.
fn ports(nodes: &[Process]) -> Result<BTreeSet<u16>> {
    let mut ports = BTreeSet::new();
    for node in nodes {
        ports.extend(node.udp_ports()?);
    }
    Ok(ports)
}
