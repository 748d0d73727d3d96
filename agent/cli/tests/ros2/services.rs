//! Real services and an action of ROS 2. The agent's times agree with the logs of both ends, a
//! hanging call is found, and a lost reply does not count as an answer.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::fs;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::{run, wait_until};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use crate::host::{Host, Middleware};

const PATIENCE: Duration = Duration::from_secs(60);
/// Log of the client, in the directory of the host.
const LOG: &str = "calls.jsonl";
/// Log of the server, in the same directory.
const ANSWERS: &str = "answers.jsonl";
const EXACT: Middleware = Middleware::FastExact("uprobe");
const CALLS: usize = 1000;
/// Maximum distance of the agent's median and mean from the range that server and client log.
const CLOSE: f64 = 0.000_1;
/// Maximum distance of the 99th percentile, which a delay of ten calls changes.
const TAIL: f64 = 0.000_2;

/// One call or goal of the client's log, in nanoseconds.
#[derive(Deserialize)]
struct Logged {
    #[serde(default)]
    goal: bool,
    /// Time at which the call that sends the request began.
    began: i64,
    /// Time at which the middleware received the response, or the client took it.
    received: i64,
}

/// One answer in the server's log, in nanoseconds.
#[derive(Deserialize)]
struct Answered {
    /// Time at which the middleware received the request, or its callback began.
    received: i64,
    /// Time at which the call that sends the response began.
    sent: i64,
}

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp: make test-ros2"]
fn calls_over_cyclone_dds_have_the_durations_that_the_client_logs() -> Result<()> {
    agrees_with_the_client(Middleware::Cyclone)
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn calls_over_fast_dds_and_udp_have_the_durations_that_the_client_logs() -> Result<()> {
    agrees_with_the_client(Middleware::FastUdp)
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn calls_over_shared_memory_with_the_uprobe_have_the_durations_in_the_log() -> Result<()> {
    agrees_with_the_client(EXACT)
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp: make test-ros2"]
fn calls_over_zenoh_have_the_durations_that_the_client_logs() -> Result<()> {
    agrees_with_the_client(Middleware::Zenoh)
}

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp: make test-ros2"]
fn calls_over_sampled_shared_memory_are_reported_as_not_seen() -> Result<()> {
    let network = Namespace::isolated()?;
    let robot = Robot::start(&network, Middleware::FastSampled)?;
    let (agent, _server, mut client) = robot.ready()?;
    robot.run_command(&mut client, "add")?;
    std::thread::sleep(Duration::from_secs(8));
    let page = agent.scrape()?;
    ensure!(count(&page, "ros2_service_requests_total", "/add") == 0.0);
    ensure!(page.sum("ros2_diagnoses", &[("kind", "hanging_call")]) == 0.0);
    let text = robot.host.rp(&["service", "info", "-v", "/add"])?;
    let expected = "Calls: none seen\nCalls not seen: through shared memory\n";
    ensure!(text.ends_with(expected), "{text}");
    Ok(())
}

fn agrees_with_the_client(middleware: Middleware) -> Result<()> {
    let network = Namespace::isolated()?;
    let robot = Robot::start(&network, middleware)?;
    let (agent, _server, mut client) = robot.ready()?;
    robot.run_command(&mut client, "add")?;
    robot.run_command(&mut client, "goal")?;
    let page = agent.scrape_until("all calls are answered", |page| {
        count(page, "ros2_service_answered_requests_total", "/add") == CALLS as f64
            && page.sum("ros2_action_goals_total", &[("state", "succeeded")]) == 1.0
    })?;
    robot.compare(&page)?;
    check_hanging_call(&robot, &agent, &mut client)?;
    // TCP delivers a repeated segment in its order, so no reply is lost.
    if !matches!(middleware, EXACT | Middleware::Zenoh) {
        check_lost_reply(&network, &agent, &mut client)?;
    }
    let text = robot.host.rp(&["service", "info", "-v", "/add"])?;
    ensure!(text.contains("\n  Latency p50: "), "{text}");
    client.write_line("end")?;
    Ok(())
}

/// Checks that a call that the server never answers becomes a finding.
fn check_hanging_call(robot: &Robot<'_>, agent: &Agent<'_>, client: &mut Process) -> Result<()> {
    robot.run_command(client, "hang")?;
    let page = agent.scrape_until("the call hangs", |page| {
        page.sum("ros2_diagnoses", &[("kind", "hanging_call")]) == 1.0
    })?;
    ensure!(count(&page, "ros2_service_hanging_requests", "/hang") == 1.0);
    ensure!(count(&page, "ros2_service_hanging_requests", "/add") == 0.0);
    Ok(())
}

/// Checks that a reply lost between server and client does not count until it is repaired.
fn check_lost_reply(network: &Namespace, agent: &Agent<'_>, client: &mut Process) -> Result<()> {
    let nft = |rule: &str| run(&format!("ip netns exec {} nft {rule}", network.name()));
    nft("add table ip lost")?;
    nft("add chain ip lost input { type filter hook input priority 0 ; }")?;
    client.write_line("lose")?;
    client.wait_for("done", PATIENCE)?;
    // The server already has the request, and takes 1.5 s.
    std::thread::sleep(Duration::from_millis(500));
    nft("add rule ip lost input meta l4proto udp drop")?;
    let answered = |page: &Scrape| count(page, "ros2_service_answered_requests_total", "/add");
    let page = agent.scrape_until("the call hangs", |page| {
        count(page, "ros2_service_hanging_requests", "/add") == 1.0
    })?;
    ensure!(answered(&page) == CALLS as f64, "{}", answered(&page));
    nft("delete table ip lost")?;
    agent.scrape_until("the repaired reply is an answer", |page| {
        answered(page) == (CALLS + 1) as f64
            && count(page, "ros2_service_hanging_requests", "/add") == 0.0
    })?;
    Ok(())
}

fn count(page: &Scrape, name: &str, service: &str) -> f64 {
    page.sum(name, &[("ros_service", service)])
}

struct Robot<'n> {
    host: Host<'n>,
    _router: Option<Process>,
}

impl<'n> Robot<'n> {
    fn start(network: &'n Namespace, middleware: Middleware) -> Result<Self> {
        let host = Host::new(network, middleware)?;
        let router = host.router_if_any()?;
        Ok(Self {
            host,
            _router: router,
        })
    }

    /// Starts agent, server and client.
    fn ready(&self) -> Result<(Agent<'n>, Process, Process)> {
        let agent = self.host.agent("service_timeout_s: 2\n")?;
        let mut server = self
            .host
            .python("services.py", &["serve", &self.host.path(ANSWERS)])?;
        server.wait_for("ready", PATIENCE)?;
        if self.host.middleware == EXACT {
            agent.scrape_until("the uprobe is attached", |page| {
                let ability = [("ability", "shared_memory_exact")];
                page.sum("ros2probe_capture_ability", &ability) == 1.0
            })?;
        }
        let arguments = ["call", &self.host.path(LOG), &CALLS.to_string()];
        let mut client = self.host.python("services.py", &arguments)?;
        client.wait_for("ready", PATIENCE)?;
        Ok((agent, server, client))
    }

    fn run_command(&self, client: &mut Process, command: &str) -> Result<()> {
        client.write_line(command)?;
        client.wait_for("done", PATIENCE)
    }

    /// Compares the agent's figures with the logs of server and client.
    fn compare(&self, page: &Scrape) -> Result<()> {
        let logged = self.logged(LOG, CALLS + 1)?;
        let (goals, calls): (Vec<Logged>, Vec<Logged>) =
            logged.into_iter().partition(|each: &Logged| each.goal);
        ensure!(calls.len() == CALLS, "{}", calls.len());
        // A request takes longer than the server's work, and less than the client's wait, whatever
        // delays the threads of both.
        let answers: Vec<Answered> = self.logged(ANSWERS, CALLS)?;
        let least = sorted(answers.iter().map(|each| each.sent - each.received));
        let most = sorted(calls.iter().map(|each| each.received - each.began));
        let of_agent = |figure: &str| {
            let name = format!("ros2_service_latency_{figure}");
            count(page, &name, "/add")
        };
        let sum = of_agent("seconds_sum");
        let mean = |times: &[f64]| times.iter().sum::<f64>() / CALLS as f64;
        let middle = |times: &[f64]| times[CALLS / 2 - 1];
        let tail = |times: &[f64]| times[CALLS * 99 / 100 - 1];
        let (p50, p99) = (of_agent("p50_seconds"), of_agent("p99_seconds"));
        let figures = [
            ("mean", sum / CALLS as f64, mean(&least), mean(&most), CLOSE),
            ("p50", p50, middle(&least), middle(&most), CLOSE),
            ("p99", p99, tail(&least), tail(&most), TAIL),
        ];
        for (name, agent, least, most, close) in figures {
            println!("{name}: server {least:.6} s, agent {agent:.6} s, client {most:.6} s");
            let possible = least - close..most + close;
            ensure!(
                possible.contains(&agent),
                "{name}: {agent}, not {possible:?}"
            );
        }
        let goal = goals.first().context("no goal")?;
        let goal = (goal.received - goal.began) as f64 / 1e9;
        let labels = [("ros_action", "/fib")];
        let seen = page.sum("ros2_action_goal_duration_p50_seconds", &labels);
        println!("goal: agent {seen:.6} s, client {goal:.6} s");
        // The client is written in Python, and polls.
        ensure!((goal - seen).abs() < 0.02, "{seen} {goal}");
        Ok(())
    }

    /// Returns the lines of a log of this name once it has this many.
    fn logged<T: DeserializeOwned>(&self, name: &str, count: usize) -> Result<Vec<T>> {
        let mut logged = Vec::new();
        wait_until("the log is complete", || {
            let text = fs::read_to_string(self.host.file(name))?;
            let lines = text.lines().map(serde_json::from_str::<T>);
            logged = lines.flatten().collect();
            Ok(logged.len() >= count)
        })?;
        Ok(logged)
    }
}

/// Returns these nanoseconds in seconds, the shortest first.
fn sorted(times: impl Iterator<Item = i64>) -> Vec<f64> {
    let mut times: Vec<f64> = times.map(|time| time as f64 / 1e9).collect();
    times.sort_by(f64::total_cmp);
    times
}
