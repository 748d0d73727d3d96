//! Causes that are injected into the callback of a real node, and those that the agent names.
//!
//! Needs root and ROS 2: `make test-ros2`.

mod cost;

use std::fs;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::{INTERFACE, Link, Namespace};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::quota::Quota;
use ros2probe_testing::harness::{run, wait_until};

use crate::host::{Host, Middleware, RP, udp_only};
use crate::installed;

const PATIENCE: Duration = Duration::from_secs(120);
const CALLS: &str = "ros2_late_calls_total";
const SECONDS: &str = "ros2_late_seconds_total";
/// Time without a further late call after which all are reported: they are once a second.
const REPORTED: Duration = Duration::from_millis(1_500);
/// Number of calls of each cause.
const NUMBER: u64 = 100;

/// A cause, and where the agent must name it.
#[derive(Clone, Copy)]
struct Injected {
    /// Command of `late.cpp`.
    command: &'static str,
    beside: Beside,
    /// The stage, or two of them.
    stages: &'static [&'static str],
    cause: &'static str,
    /// Part of the text of `rp why` that names the culprit.
    named: &'static str,
    /// Length of a message, and messages at once.
    bytes: usize,
    burst: u64,
    /// Milliseconds between two bursts.
    period: u64,
    /// Percentage of the calls that are late at least.
    late: u64,
}

/// What runs beside the node, or limits it or its link.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Beside {
    Nothing,
    /// A thread that always computes, on its CPU.
    Busy,
    /// A thread of real-time priority that computes for most of the time, on its CPU.
    RealTime,
    /// A quota of a twentieth of a CPU.
    Quota,
    /// A link with a low rate.
    SlowLink,
    /// A link that loses a fifth of the messages at random.
    LossyLink,
}

/// A cause in the callback of single messages.
const fn injected(
    command: &'static str,
    beside: Beside,
    cause: &'static str,
    named: &'static str,
) -> Injected {
    Injected {
        command,
        beside,
        stages: &["callback"],
        cause,
        named,
        bytes: 0,
        burst: 1,
        period: 125,
        late: 90,
    }
}

/// A cause before the callback.
const fn before(
    command: &'static str,
    beside: Beside,
    stages: &'static [&'static str],
    (cause, named): (&'static str, &'static str),
) -> Injected {
    Injected {
        stages,
        ..injected(command, beside, cause, named)
    }
}

const OTHER_CALLBACK: (&str, &str) = ("other_callback", "its thread was in another callback");
const REPAIRED: (&str, &str) = ("repaired", "was lost and sent again");

const INJECTED: [Injected; 11] = [
    injected("sleep", Beside::Nothing, "sleep", "clock_nanosleep"),
    injected("compute", Beside::Nothing, "cpu", "it computed"),
    injected("lock", Beside::Nothing, "lock", "holder"),
    injected("disk", Beside::Nothing, "disk", "fsync"),
    injected(
        "pages",
        Beside::Nothing,
        "page_fault",
        "a page of its memory",
    ),
    injected("stop", Beside::Nothing, "stopped", "stopper"),
    injected("compute", Beside::Busy, "runnable", "late-busy"),
    injected("compute", Beside::RealTime, "runnable", "late-busy"),
    Injected {
        period: 600,
        ..injected(
            "compute",
            Beside::Quota,
            "throttled",
            "used up its CPU quota",
        )
    },
    before("before", Beside::Nothing, &["wait"], OTHER_CALLBACK),
    // The subscription's queue is slow: ten messages at once, each for 5 ms.
    Injected {
        burst: 10,
        period: 1_000,
        late: 70,
        ..before("brief", Beside::Nothing, &["wait"], OTHER_CALLBACK)
    },
];

const SMALL_BUFFER_OF_FAST_DDS: &str = "<receiveBufferSize>65536</receiveBufferSize>";
const SMALL_BUFFER_OF_CYCLONE_DDS: &str = "<CycloneDDS><Domain><Internal>\
    <SocketReceiveBufferSize min=\"default\" max=\"64 KiB\"/></Internal></Domain></CycloneDDS>";

/// Causes on the way from another host.
const ON_THE_WAY: [Injected; 3] = [
    Injected {
        bytes: 8_000,
        ..before(
            "delay",
            Beside::SlowLink,
            &["network"],
            ("transit", "on its way to the socket"),
        )
    },
    // Those behind a lost message are late, too.
    Injected {
        bytes: 1_000,
        period: 25,
        late: 15,
        ..before(
            "delay",
            Beside::LossyLink,
            &["network", "receive"],
            REPAIRED,
        )
    },
    // Two megabytes at once, for a receive buffer of 64 KiB.
    Injected {
        bytes: 100_000,
        burst: 20,
        period: 2_000,
        late: 15,
        ..before("delay", Beside::Nothing, &["network", "receive"], REPAIRED)
    },
];

/// The same with Zenoh: routers pass messages on, so that their way is not known.
const BETWEEN_ROUTERS: [Injected; 1] = [Injected {
    bytes: 8_000,
    ..before(
        "delay",
        Beside::SlowLink,
        &["wait"],
        ("arrival", "the executor waited for it"),
    )
}];

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

#[test]
#[ignore = "needs ROS 2 with rmw_fastrtps_cpp, ament_cmake: make test-ros2"]
fn injected_causes_between_hosts_of_fast_dds_are_named() -> Result<()> {
    names_the_causes_between_hosts(Middleware::FastUdp)
}

#[test]
#[ignore = "needs ROS 2 with rmw_cyclonedds_cpp, ament_cmake: make test-ros2"]
fn injected_causes_between_hosts_of_cyclone_dds_are_named() -> Result<()> {
    names_the_causes_between_hosts(Middleware::Cyclone)
}

#[test]
#[ignore = "needs ROS 2 with rmw_zenoh_cpp, ament_cmake: make test-ros2"]
fn a_slow_link_between_routers_of_zenoh_is_an_arrival() -> Result<()> {
    let link = Link::new()?;
    let far = Host::new(&link.robot, Middleware::Zenoh)?;
    let host = Host::new(&link.monitor, Middleware::Zenoh)?;
    let _router = host.router_if_any()?;
    let endpoint = format!("tcp/{}:7447", link.monitor.address());
    let _far_router = far.router(&format!("connect/endpoints=[\"{endpoint}\"]"))?;
    let agent = observed(&host)?;
    Robot::start(&far, &host, &agent, "")?.names_all(&BETWEEN_ROUTERS)
}

fn names_the_causes(middleware: Middleware) -> Result<()> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, middleware)?;
    let _router = host.router_if_any()?;
    let agent = observed(&host)?;
    Robot::start(&host, &host, &agent, "")?.names_all(&INJECTED)
}

fn names_the_causes_between_hosts(middleware: Middleware) -> Result<()> {
    let link = Link::new()?;
    let far = Host::new(&link.robot, middleware)?;
    let host = Host::new(&link.monitor, middleware)?;
    let agent = observed(&host)?;
    fs::write(host.file("small.xml"), udp_only(SMALL_BUFFER_OF_FAST_DDS))?;
    let profile = host.path("small.xml");
    let small_buffer = format!(
        "export FASTRTPS_DEFAULT_PROFILES_FILE={profile} CYCLONEDDS_URI='{SMALL_BUFFER_OF_CYCLONE_DDS}'; "
    );
    Robot::start(&far, &host, &agent, &small_buffer)?.names_all(&ON_THE_WAY)
}

/// Starts an agent that observes the causes of late calls.
fn observed<'n>(host: &Host<'n>) -> Result<Agent<'n>> {
    let configuration = host.file("ros2probe.yaml");
    let settings = host.settings("watch: [{topic: /work, max_latency_ms: 10}]\n");
    let (capture, others) = settings.split_once("}\n").context("no capture")?;
    let settings = format!("{capture}, inside: full, late: on}}\n{others}");
    fs::write(&configuration, settings)?;
    Agent::start(host.network, RP, &configuration)
}

/// Compiles the node for the installed distribution, and returns its path.
pub fn built() -> Result<PathBuf> {
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
    /// Where the publisher is, and where the subscriber and the agent are.
    far: &'h Host<'n>,
    host: &'h Host<'n>,
    agent: &'h Agent<'n>,
    subscriber: Process,
    publisher: Process,
}

/// Late calls, and their seconds.
struct Late {
    /// By all causes.
    calls: f64,
    of_cause: f64,
    /// Whether each of the stages has such calls.
    has_all_stages: bool,
    seconds: f64,
    /// Calls that waited for a CPU, although nothing was injected beside them.
    busy: f64,
}

impl Late {
    fn read(page: &Scrape, injected: &Injected) -> Self {
        let (node, cause) = (("ros_node", "/late"), injected.cause);
        let of = |name| -> Vec<f64> {
            let of_stage = |stage| page.sum(name, &[node, ("stage", stage), ("cause", cause)]);
            injected
                .stages
                .iter()
                .map(|stage| of_stage(*stage))
                .collect()
        };
        let calls = of(CALLS);
        Self {
            calls: page.sum(CALLS, &[node]),
            of_cause: calls.iter().sum(),
            has_all_stages: calls.iter().all(|calls| *calls > 0.0),
            seconds: of(SECONDS).iter().sum(),
            busy: ["runnable", "stolen"]
                .into_iter()
                .filter(|busy| *busy != cause)
                .map(|busy| page.sum(CALLS, &[node, ("cause", busy)]))
                .sum(),
        }
    }

    fn since(&self, before: &Self) -> Self {
        Self {
            calls: self.calls - before.calls,
            of_cause: self.of_cause - before.of_cause,
            has_all_stages: self.has_all_stages,
            seconds: self.seconds - before.seconds,
            busy: self.busy - before.busy,
        }
    }
}

impl<'h, 'n> Robot<'h, 'n> {
    /// Starts both nodes. `setting`: shell commands before the subscriber.
    fn start(
        far: &'h Host<'n>,
        host: &'h Host<'n>,
        agent: &'h Agent<'n>,
        setting: &str,
    ) -> Result<Self> {
        let line = format!("exec {} \"$@\"", built()?.display());
        let file = host.path("data");
        let subscribe = format!("{setting}{line}");
        let mut subscriber = host.run(&subscribe, &["subscribe", &file], Stdio::inherit())?;
        subscriber.wait_for("ready", PATIENCE)?;
        let mut publisher = far.run(&line, &["publish", "1"], Stdio::inherit())?;
        publisher.wait_for("matched", PATIENCE)?;
        Ok(Self {
            far,
            host,
            agent,
            subscriber,
            publisher,
        })
    }

    fn names_all(mut self, all: &[Injected]) -> Result<()> {
        // Ordinary calls, whose delays the agent compares with.
        let nothing = injected("nothing", Beside::Nothing, "", "");
        self.inject(&nothing, 50)?;
        self.names_nothing(&nothing)?;
        let mut failures = Vec::new();
        for injected in all {
            if let Err(error) = self.names(injected) {
                failures.push(format!("{}: {error:#}", injected.command));
            }
        }
        ensure!(failures.is_empty(), "{}", failures.join("\n"));
        Ok(())
    }

    /// Checks that ordinary calls are not late. Reports have the order of the calls: that of a later
    /// call shows that none is outstanding.
    fn names_nothing(&mut self, nothing: &Injected) -> Result<()> {
        let last = injected("sleep", Beside::Nothing, "sleep", "");
        let before = Late::read(&self.agent.scrape()?, &last);
        self.inject(nothing, NUMBER)?;
        self.inject(&last, 3)?;
        let page = self.agent.scrape_until("the last calls are late", |page| {
            Late::read(page, &last).since(&before).calls >= 3.0
        })?;
        let late = Late::read(&page, &last).since(&before);
        ensure!(
            late.calls == late.of_cause + late.busy,
            "{} late calls, {} by a busy machine, 3 injected",
            late.calls,
            late.busy
        );
        Ok(())
    }

    fn names(&mut self, injected: &Injected) -> Result<()> {
        let began = Instant::now();
        let beside = self.beside(injected.beside)?;
        let cause = injected.cause;
        let number = NUMBER * 100 / injected.late.clamp(20, 100) / injected.burst * injected.burst;
        let before = Late::read(&self.agent.scrape()?, injected);
        let (calls, truth) = self.inject(injected, number)?;
        drop(beside);
        ensure!(calls == number, "{calls} calls");
        let least = (number * injected.late / 100) as f64;
        let mut late = before.since(&before);
        let mut changed = Instant::now();
        let reported = wait_until("the late calls are reported", || {
            let known = late.calls;
            late = Late::read(&self.agent.scrape()?, injected).since(&before);
            if late.calls > known {
                changed = Instant::now();
            }
            Ok(late.calls >= least && changed.elapsed() > REPORTED)
        });
        let last = format!("{}s", began.elapsed().as_secs() + 1);
        let text = self.host.rp(&["why", "--node", "/late", "--last", &last])?;
        println!(
            "{}: {} of {} late calls by {cause}, {} by a busy machine; {:.3} s of {:.3} s",
            injected.command,
            late.of_cause,
            late.calls,
            late.busy,
            late.seconds,
            truth.as_secs_f64()
        );
        ensure!(reported.is_ok(), "{} late calls: {text}", late.calls);
        ensure!(late.has_all_stages, "{:?}: {text}", injected.stages);
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
    fn inject(&mut self, injected: &Injected, number: u64) -> Result<(u64, Duration)> {
        let Injected {
            command,
            bytes,
            burst,
            period,
            ..
        } = *injected;
        let bursts = number / burst;
        let line = format!("{bursts} {period} {command} {bytes} {burst}");
        self.publisher.write_line(&line)?;
        self.publisher.wait_for("sent", PATIENCE)?;
        self.publisher.write_line("1 0 report")?;
        let report = self.subscriber.line_with_end("reported", PATIENCE)?;
        let mut numbers = report.split(' ').map_while(|word| word.parse().ok());
        let (calls, nanoseconds) = numbers.next().zip(numbers.next()).context(report.clone())?;
        Ok((calls, Duration::from_nanos(nanoseconds)))
    }

    /// Starts what runs beside the node or limits it, and pins the node to the same CPU.
    fn beside(&self, beside: Beside) -> Result<Running<'h>> {
        let last = std::thread::available_parallelism()?.get() - 1;
        let pin = |process: &Process, is_pinned| -> Result<()> {
            let cpus = if is_pinned {
                "0".to_owned()
            } else {
                format!("0-{last}")
            };
            let id = process.pid().to_string();
            let pinned = Command::new("taskset")
                .args(["-apc", &cpus, &id])
                .output()?;
            ensure!(pinned.status.success(), "{pinned:?}");
            Ok(())
        };
        let is_crowded = matches!(beside, Beside::Busy | Beside::RealTime);
        pin(&self.subscriber, is_crowded)?;
        let mut running = Running::default();
        match beside {
            Beside::Nothing => {}
            Beside::Busy => running.busy = Some(Busy::start(&[], "while :; do :; done")?),
            Beside::RealTime => {
                let half = "while :; do i=0; while [ $i -lt 60000 ]; do i=$((i+1)); done; sleep 0.01; done";
                running.busy = Some(Busy::start(&["chrt", "-f", "50"], half)?);
            }
            Beside::Quota => running.quota = Some(Quota::limit(self.subscriber.pid(), 5)?),
            Beside::SlowLink => running.slow_link = Some(SlowLink::start(self.far.network)?),
            Beside::LossyLink => {
                let messages = "udp length 1000-1400";
                running.lossy_link = Some(Loss::of(self.far.network, messages, 200)?);
            }
        }
        Ok(running)
    }
}

/// Processes and limits beside a node, until the value is dropped.
#[derive(Default)]
struct Running<'h> {
    busy: Option<Busy>,
    quota: Option<Quota>,
    slow_link: Option<SlowLink<'h>>,
    lossy_link: Option<Loss<'h>>,
}

/// A link on which a message of 8 kB takes 64 ms.
struct SlowLink<'h>(&'h Namespace);

impl<'h> SlowLink<'h> {
    fn start(host: &'h Namespace) -> Result<Self> {
        shape(host, "add", "tbf rate 1mbit burst 3000 limit 300000")?;
        Ok(Self(host))
    }
}

impl Drop for SlowLink<'_> {
    fn drop(&mut self) {
        let _ = shape(self.0, "del", "");
    }
}

fn shape(host: &Namespace, action: &str, queue: &str) -> Result<()> {
    let outside = host.outside().join(" ");
    run(&format!(
        "{outside} tc qdisc {action} dev {INTERFACE} root {queue}"
    ))?;
    Ok(())
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
