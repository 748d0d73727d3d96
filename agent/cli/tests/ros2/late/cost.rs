//! What the observation of causes costs (`make bench-ros2`). Needs root and ROS 2.

use std::fs;
use std::process::Stdio;
use std::time::Instant;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::soak::median;
use ros2probe_testing::harness::usage::machine_idle;

use super::{PATIENCE, built};
use crate::host::{Host, Middleware, RP};

const NODES: usize = 5;
const MESSAGES: u64 = 4_000;
/// Messages of 1 kHz before the measured ones.
const WARM_UP: u64 = 3_000;

/// What the agent observes.
const MODES: [(&str, &str); 3] = [
    ("no calls", ""),
    ("calls", ", inside: full, late: auto"),
    ("calls and events", ", inside: full, late: on"),
];

/// One window of 4,000 messages.
#[derive(Clone, Copy, Debug, Default)]
struct Window {
    /// Work of the machine, in percent of a core.
    work: f64,
    /// Microseconds: 99th percentiles of the nodes, the mean over the nodes.
    duration: f64,
    delay: f64,
}

struct Robot {
    nodes: Vec<Process>,
    publisher: Process,
    _switches: Process,
}

impl Robot {
    fn start(host: &Host<'_>, switches: u64) -> Result<Self> {
        let line = format!("exec {} \"$@\"", built()?.display());
        let start = |words: &[&str]| host.run(&line, words, Stdio::inherit());
        let mut nodes = Vec::new();
        for _ in 0..NODES {
            let mut node = start(&["measure"])?;
            node.wait_for("ready", PATIENCE)?;
            nodes.push(node);
        }
        let mut publisher = start(&["publish", &NODES.to_string()])?;
        publisher.wait_for("matched", PATIENCE)?;
        Ok(Self {
            nodes,
            publisher,
            _switches: start(&["switch", &switches.to_string()])?,
        })
    }

    fn publish(&mut self, messages: u64) -> Result<()> {
        let line = format!("{messages} 1 work 300");
        self.publisher.write_line(&line)?;
        self.publisher.wait_for("sent", PATIENCE)
    }

    /// Returns the percentiles of all nodes since the last report, in microseconds.
    fn report(&mut self) -> Result<Vec<[f64; 2]>> {
        self.publisher.write_line("1 0 report")?;
        self.publisher.wait_for("sent", PATIENCE)?;
        let mut all = Vec::new();
        for node in &mut self.nodes {
            let report = node.line_with_end("reported", PATIENCE)?;
            let mut numbers = report.split(' ').map_while(|word| word.parse::<u64>().ok());
            let mut next = || numbers.next().context(report.clone());
            let (count, duration, delay) = (next()?, next()?, next()?);
            ensure!(count > 0, "{report}");
            all.push([duration, delay].map(|time| time as f64 / 1e3));
        }
        Ok(all)
    }

    fn window(&mut self) -> Result<Window> {
        self.publish(WARM_UP)?;
        self.report()?;
        let (began, idle) = (Instant::now(), machine_idle()?);
        self.publish(MESSAGES)?;
        let (elapsed, idle) = (began.elapsed(), machine_idle()?.saturating_sub(idle));
        let cores = std::thread::available_parallelism()?.get();
        let all = elapsed.as_secs_f64() * cores as f64;
        let percentiles = self.report()?;
        let mean = |index: usize| {
            percentiles.iter().map(|node| node[index]).sum::<f64>() / percentiles.len() as f64
        };
        Ok(Window {
            work: (all - idle.as_secs_f64()) / elapsed.as_secs_f64() * 100.0,
            duration: mean(0),
            delay: mean(1),
        })
    }
}

fn agent<'n>(host: &Host<'n>, mode: &str) -> Result<Agent<'n>> {
    let settings = host.settings("watch: [{topic: /work}]\n");
    let (capture, others) = settings.split_once("}\n").context("no capture")?;
    let configuration = host.file("ros2probe.yaml");
    fs::write(&configuration, format!("{capture}{mode}}}\n{others}"))?;
    Agent::start(host.network, RP, &configuration)
}

/// Checks that the agent observes what the mode says.
fn check(agent: &Agent<'_>, mode: &str) -> Result<()> {
    let is_inside = !mode.is_empty();
    agent.scrape_until("calls, if they are observed", |page| {
        let name = [("name", "/work")];
        let calls = page.sum("ros2_callback_duration_seconds_count", &name);
        (calls > 0.0) == is_inside
    })?;
    Ok(())
}

/// Returns the mean, and half of the 95 % confidence interval.
fn mean(values: &[f64]) -> (f64, f64) {
    let number = values.len() as f64;
    let mean = values.iter().sum::<f64>() / number;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let deviation = (squares / (number - 1.0).max(1.0)).sqrt();
    (mean, 1.96 * deviation / number.sqrt())
}

#[test]
#[ignore = "a benchmark: make bench-ros2"]
fn observing_the_causes_of_late_calls_is_measured() -> Result<()> {
    let rounds = std::env::var("ROUNDS").map_or(Ok(3), |rounds| rounds.parse())?;
    for switches in [8_000, 100_000] {
        let network = Namespace::isolated()?;
        let host = Host::new(&network, Middleware::FastUdp)?;
        let mut robot = Robot::start(&host, switches)?;
        let mut windows = [const { Vec::new() }; MODES.len()];
        for round in 0..rounds {
            // Each mode is the first one in turn, because machines change.
            for index in 0..MODES.len() {
                let index = (index + round) % MODES.len();
                let (_, mode) = MODES[index];
                let agent = agent(&host, mode)?;
                windows[index].push(robot.window()?);
                check(&agent, mode)?;
            }
            eprintln!("round {} of {rounds}", round + 1);
        }
        println!(
            "{NODES} nodes at 1 kHz beside {switches} switches a second, {rounds} windows of 4 s: \
             percent of a core, beyond the mode before; 99th percentiles of calls and of delays in us, \
             medians and ratios to the mode before"
        );
        for (index, (name, _)) in MODES.into_iter().enumerate() {
            let before = &windows[index.saturating_sub(1)];
            let pairs = || windows[index].iter().zip(before);
            let works: Vec<f64> = windows[index]
                .iter()
                .map(|window: &Window| window.work)
                .collect();
            let more: Vec<f64> = pairs()
                .map(|(now, before)| now.work - before.work)
                .collect();
            let ratio =
                |of: fn(&Window) -> f64| median(pairs().map(|(a, b)| of(a) / of(b)).collect());
            let middle = |of: fn(&Window) -> f64| median(windows[index].iter().map(of).collect());
            let (duration, delay) = (|it: &Window| it.duration, |it: &Window| it.delay);
            let ((work, _), (more, half)) = (mean(&works), mean(&more));
            println!(
                "{name}: {work:.1} %, {more:+.1} ± {half:.1} %; {:.0} ({:.3}), {:.0} ({:.3})",
                middle(duration),
                ratio(duration),
                middle(delay),
                ratio(delay),
            );
        }
    }
    Ok(())
}
