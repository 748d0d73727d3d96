//! Causes that are injected into the callback of a real node, and those that the agent names.
//!
//! Needs root and ROS 2: `make test-ros2`.

use std::fs;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_until;

use crate::host::{Host, Middleware, RP};
use crate::installed;

const PATIENCE: Duration = Duration::from_secs(120);
const CALLS: &str = "ros2_late_calls_total";
const SECONDS: &str = "ros2_late_seconds_total";
/// Number of calls of each cause.
const NUMBER: u64 = 100;

/// A cause, and where the agent must name it.
struct Injected {
    /// Command of `late.cpp`.
    command: &'static str,
    beside: Beside,
    stage: &'static str,
    cause: &'static str,
    /// Part of the text of `rp why` that names the culprit.
    named: &'static str,
}

/// What runs beside the node on its CPU.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Beside {
    Nothing,
    /// A thread that always computes.
    Busy,
    /// A thread of real-time priority that computes for most of the time.
    RealTime,
}

const fn injected(
    command: &'static str,
    beside: Beside,
    cause: &'static str,
    named: &'static str,
) -> Injected {
    Injected {
        command,
        beside,
        stage: "callback",
        cause,
        named,
    }
}

const INJECTED: [Injected; 8] = [
    injected("sleep", Beside::Nothing, "sleep", "clock_nanosleep"),
    injected("compute", Beside::Nothing, "cpu", "it computed"),
    injected("lock", Beside::Nothing, "lock", "holder"),
    injected("disk", Beside::Nothing, "disk", "fsync"),
    injected("stop", Beside::Nothing, "stopped", "stopper"),
    injected("compute", Beside::Busy, "runnable", "late-busy"),
    injected("compute", Beside::RealTime, "runnable", "late-busy"),
    Injected {
        command: "before",
        beside: Beside::Nothing,
        stage: "wait",
        cause: "other_callback",
        named: "its thread was in another callback",
    },
];

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, ament_cmake: make test-ros2"]
fn injected_causes_over_fast_dds_are_named() -> Result<()> {
    names_the_causes(Middleware::FastExact("auto"))
}

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp, ament_cmake: make test-ros2"]
fn injected_causes_over_cyclone_dds_are_named() -> Result<()> {
    names_the_causes(Middleware::Cyclone)
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp, ament_cmake: make test-ros2"]
fn injected_causes_over_zenoh_are_named() -> Result<()> {
    names_the_causes(Middleware::Zenoh)
}

fn names_the_causes(middleware: Middleware) -> Result<()> {
    let program = built()?;
    let network = Namespace::isolated()?;
    let host = Host::new(&network, middleware)?;
    let _router = host.router_if_any()?;
    let configuration = host.file("ros2probe.yaml");
    let settings = host.settings("watch: [{topic: /work, max_latency_ms: 10}]\n");
    let (capture, others) = settings.split_once("}\n").context("no capture")?;
    let settings = format!("{capture}, inside: full, late: on}}\n{others}");
    fs::write(&configuration, settings)?;
    let agent = Agent::start(&network, RP, &configuration)?;
    let line = format!("exec {} \"$@\"", program.display());
    let file = host.path("data");
    let mut subscriber = host.run(&line, &["subscribe", &file], Stdio::inherit())?;
    subscriber.wait_for("ready", PATIENCE)?;
    let mut publisher = host.run(&line, &["publish"], Stdio::inherit())?;
    publisher.wait_for("matched", PATIENCE)?;
    let robot = Robot {
        host: &host,
        agent: &agent,
        subscriber,
        publisher,
    };
    robot.names_all()
}

/// Compiles the node for the installed distribution, and returns its path.
fn built() -> Result<PathBuf> {
    let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/ros2/late");
    let build = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("ros2-late");
    let build = build.join(installed::distro());
    fs::create_dir_all(&build)?;
    let script = "flock \"$1/lock\" sh -c 'cmake -S \"$0\" -B \"$1\" -DCMAKE_BUILD_TYPE=Release \
                  && cmake --build \"$1\"' \"$0\" \"$1\"";
    let output = installed::shell(script).arg(source).arg(&build).output()?;
    ensure!(output.status.success(), "{output:?}");
    Ok(build.join("late"))
}

struct Robot<'h, 'n> {
    host: &'h Host<'n>,
    agent: &'h Agent<'n>,
    subscriber: Process,
    publisher: Process,
}

/// Late calls, and their seconds, by stage and cause.
struct Late {
    stage: &'static str,
    cause: &'static str,
    /// All of the stage or the cause's stage.
    calls: f64,
    of_cause: f64,
    seconds: f64,
    /// Calls that waited for a CPU, although nothing was injected beside them.
    busy: f64,
}

impl Late {
    fn read(page: &Scrape, stage: &'static str, cause: &'static str) -> Self {
        let node = ("ros_node", "/late");
        let of = |name, cause| page.sum(name, &[node, ("stage", stage), ("cause", cause)]);
        Self {
            stage,
            cause,
            calls: page.sum(CALLS, &[node]),
            of_cause: of(CALLS, cause),
            seconds: of(SECONDS, cause),
            busy: ["runnable", "stolen"]
                .into_iter()
                .filter(|busy| *busy != cause)
                .map(|busy| page.sum(CALLS, &[node, ("cause", busy)]))
                .sum(),
        }
    }

    fn since(&self, before: &Self) -> Self {
        Self {
            stage: self.stage,
            cause: self.cause,
            calls: self.calls - before.calls,
            of_cause: self.of_cause - before.of_cause,
            seconds: self.seconds - before.seconds,
            busy: self.busy - before.busy,
        }
    }
}

impl Robot<'_, '_> {
    fn names_all(mut self) -> Result<()> {
        // Ordinary calls, whose delays the agent compares with.
        self.inject("nothing", 50)?;
        let mut failures = Vec::new();
        for injected in INJECTED {
            if let Err(error) = self.names(&injected) {
                failures.push(format!("{}: {error:#}", injected.command));
            }
        }
        ensure!(failures.is_empty(), "{}", failures.join("\n"));
        Ok(())
    }

    fn names(&mut self, injected: &Injected) -> Result<()> {
        let _busy = self.beside(injected.beside)?;
        let (stage, cause) = (injected.stage, injected.cause);
        let before = Late::read(&self.agent.scrape()?, stage, cause);
        let (calls, truth) = self.inject(injected.command, NUMBER)?;
        ensure!(calls == NUMBER, "{calls} calls");
        let mut late = before.since(&before);
        let waited = wait_until("all late calls are reported", || {
            late = Late::read(&self.agent.scrape()?, stage, cause).since(&before);
            Ok(late.calls >= NUMBER as f64)
        });
        let text = self.host.rp(&["why", "--node", "/late"])?;
        println!(
            "{}: {} of {} late calls by {cause}, {} by a busy machine; {:.3} s of {:.3} s",
            injected.command,
            late.of_cause,
            late.calls,
            late.busy,
            late.seconds,
            truth.as_secs_f64()
        );
        // A call of 10 ms or less is not late.
        ensure!(
            waited.is_ok() || late.calls >= NUMBER as f64 * 0.9,
            "{text}"
        );
        let others = late.calls - late.busy;
        ensure!(
            late.of_cause >= others * 0.95 && others >= late.calls * 0.5,
            "{} of {}, {} busy: {text}",
            late.of_cause,
            late.calls,
            late.busy
        );
        // Others contain time on a CPU, and that of the kernel.
        if matches!(injected.command, "sleep" | "lock" | "stop") {
            let share = late.seconds / truth.as_secs_f64();
            ensure!((0.9..1.1).contains(&share), "{share} of the time: {text}");
        }
        ensure!(text.contains(injected.named), "{}: {text}", injected.named);
        Ok(())
    }

    /// Publishes messages with a command. Returns the number of calls, and the time of the causes
    /// that the node injected.
    fn inject(&mut self, command: &str, number: u64) -> Result<(u64, Duration)> {
        self.publisher
            .write_line(&format!("{number} 125 {command}"))?;
        self.publisher.wait_for("sent", PATIENCE)?;
        self.publisher.write_line("1 0 report")?;
        let report = self.subscriber.line_with_end("reported", PATIENCE)?;
        let mut numbers = report.split(' ').map_while(|word| word.parse().ok());
        let (calls, nanoseconds) = numbers.next().zip(numbers.next()).context(report.clone())?;
        Ok((calls, Duration::from_nanos(nanoseconds)))
    }

    /// Starts what runs beside the node, and pins the node to the same CPU.
    fn beside(&self, beside: Beside) -> Result<Option<Busy>> {
        let last = std::thread::available_parallelism()?.get() - 1;
        let cpus = match beside {
            Beside::Nothing => format!("0-{last}"),
            Beside::Busy | Beside::RealTime => "0".to_owned(),
        };
        let id = self.subscriber.pid().to_string();
        let pinned = Command::new("taskset")
            .args(["-apc", &cpus, &id])
            .output()?;
        ensure!(pinned.status.success(), "{pinned:?}");
        Ok(match beside {
            Beside::Nothing => None,
            Beside::Busy => Some(Busy::start(&[], "while :; do :; done")?),
            Beside::RealTime => Some(Busy::start(
                &["chrt", "-f", "50"],
                "while :; do i=0; while [ $i -lt 60000 ]; do i=$((i+1)); done; sleep 0.01; done",
            )?),
        })
    }
}

/// A busy process with the name `late-busy`, at the CPU of the node.
struct Busy(Child);

impl Busy {
    fn start(scheduler: &[&str], script: &str) -> Result<Self> {
        let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
        let program = directory.join("late-busy");
        let _ = std::os::unix::fs::symlink("/bin/sh", &program);
        let mut words = scheduler.to_vec();
        words.extend(["taskset", "-c", "0"]);
        let (first, others) = words.split_first().context("no command")?;
        let mut command = Command::new(first);
        command.args(others).arg(&program).args(["-c", script]);
        Ok(Self(command.stdin(Stdio::null()).spawn()?))
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
