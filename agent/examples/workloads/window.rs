//! One measurement: a publisher, its subscriber, perhaps an observer, for a while.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};

use crate::harness::agent::{Agent, Scrape};
use crate::harness::network::{INTERFACE, Link, Namespace};
use crate::harness::peer::{Peer, Role, Stack, Stream};
use crate::harness::process::Process;
use crate::harness::run;
use crate::harness::usage::{Usage, machine_idle, softirq_cpu};

/// Time for discovery to settle and caches to fill before the window opens.
const WARM_UP: Duration = Duration::from_secs(3);
/// Between two looks at the observer's memory.
const SAMPLING: Duration = Duration::from_secs(1);
/// CPU times are told for this long.
const UNIT_SECONDS: f64 = 20.0;

/// Who watches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Observer {
    Nobody,
    Agent,
    Subscriber,
}

pub(crate) struct Window {
    pub(crate) observer: Observer,
    /// CPU seconds of the whole machine, per 20 s.
    pub(crate) machine: f64,
    /// Those of publisher, subscriber, observer and the kernel's packet threads.
    pub(crate) workload: f64,
    /// CPU seconds of the observer, per 20 s.
    pub(crate) cpu: f64,
    /// The most memory of the observer seen in the window.
    pub(crate) pss: u64,
    /// Samples written, from the publisher's first to its last.
    pub(crate) sent: u64,
    /// What the agent says at the end.
    pub(crate) told: Option<Told>,
}

/// The agent's numbers over its whole life, start included.
pub(crate) struct Told {
    pub(crate) counted: f64,
    pub(crate) lost: f64,
    /// Frames and records that the kernel dropped before the agent saw them.
    pub(crate) dropped: f64,
    /// Bytes copied to user space, of the bytes that crossed the link.
    pub(crate) copied: f64,
}

impl Observer {
    pub(crate) const ALL: [Observer; 3] = [Observer::Nobody, Observer::Agent, Observer::Subscriber];
}

impl Window {
    pub(crate) fn measure(
        stack: Stack,
        stream: &Stream,
        observer: Observer,
        program: &Path,
        length: Duration,
    ) -> Result<Window> {
        let link = Link::new()?;
        let unlogged = Stream {
            logged: false,
            ..stream.clone()
        };
        let directory = tempfile::tempdir().context("cannot create a directory")?;
        let configuration = directory.path().join("ros2probe.yaml");
        let cgroup = link.robot.cgroup().display();
        let text = format!("watch: [/**]\nlog: warn\ncapture: {{cgroup: {cgroup}}}\n");
        std::fs::write(&configuration, text).context("cannot write a configuration")?;

        let agent = (observer == Observer::Agent)
            .then(|| Agent::start(&link.robot, program, &configuration))
            .transpose()?;
        let subscriber =
            |stack, node| Peer::start(&link.monitor, stack, Role::Subscriber, &unlogged, &[node]);
        let second = (observer == Observer::Subscriber)
            .then(|| subscriber(Stack::Cyclone, "/observer"))
            .transpose()?;
        let mut listener = subscriber(stack, "/listener")?;
        let mut publisher = Peer::start(&link.robot, stack, Role::Publisher, stream, &["/lidar"])?;
        publisher.wait_matched()?;
        listener.wait_matched()?;
        publisher.go()?;
        std::thread::sleep(WARM_UP);

        let watching = match (&agent, &second) {
            (Some(agent), _) => Some(&agent.process),
            (None, Some(second)) => Some(&second.process),
            (None, None) => None,
        };
        let parts = [&publisher.process, &listener.process];
        let spent = Spent::during(length, watching, &parts)?;

        publisher.process.terminate()?;
        let sent = publisher.log()?.sequences("pub").len() as u64;
        let traffic = bytes_sent(&link.robot)?;
        let scrape = agent.as_ref().map(Agent::settled_scrape).transpose()?;
        Ok(Window {
            observer,
            machine: spent.machine,
            workload: spent.workload,
            cpu: spent.cpu,
            pss: spent.pss,
            sent,
            told: scrape.map(|scrape| Told::of(&scrape, stream, traffic)),
        })
    }
}

impl Told {
    fn of(scrape: &Scrape, stream: &Stream, traffic: f64) -> Told {
        let topic = [("topic", stream.topic.as_str())];
        Told {
            counted: scrape.sum("ros2_topic_messages_total", &topic),
            lost: scrape.sum("ros2_topic_lost_messages_total", &topic),
            dropped: scrape.sum("ros2probe_capture_dropped_packets_total", &[])
                + scrape.sum("ros2probe_records_dropped_total", &[]),
            copied: scrape.sum("ros2probe_capture_copied_bytes_total", &[]) / traffic,
        }
    }
}

struct Spent {
    machine: f64,
    workload: f64,
    cpu: f64,
    pss: u64,
}

impl Spent {
    fn during(length: Duration, watching: Option<&Process>, parts: &[&Process]) -> Result<Spent> {
        let look = || watching.map(|process| Usage::of(process.pid())).transpose();
        let rest = || {
            parts.iter().try_fold(softirq_cpu()?, |sum, part| {
                anyhow::Ok(sum + Usage::of(part.pid())?.cpu)
            })
        };
        let cpus = std::thread::available_parallelism().context("cannot count CPUs")?;
        let (rest_before, first) = (rest()?, look()?);
        let (idle, began) = (machine_idle()?, Instant::now());
        let mut last = first;
        let mut pss = 0;
        while let Some(left) = length.checked_sub(began.elapsed()) {
            std::thread::sleep(left.min(SAMPLING));
            last = look()?;
            pss = last.map_or(0, |usage| usage.pss).max(pss);
        }
        let elapsed = began.elapsed().as_secs_f64();
        let unit = UNIT_SECONDS / elapsed;
        let idle = machine_idle()?.saturating_sub(idle).as_secs_f64();
        let rest = rest()?.saturating_sub(rest_before);
        let cpu = last
            .zip(first)
            .map_or(Duration::ZERO, |(last, first)| last.since(&first).cpu);
        Ok(Spent {
            machine: (elapsed * cpus.get() as f64 - idle).max(0.0) * unit,
            workload: (rest + cpu).as_secs_f64() * unit,
            cpu: cpu.as_secs_f64() * unit,
            pss,
        })
    }
}

/// Bytes that a host has put on its cable.
fn bytes_sent(host: &Namespace) -> Result<f64> {
    let counter = run(&format!(
        "ip netns exec {} cat /sys/class/net/{INTERFACE}/statistics/tx_bytes",
        host.name()
    ))?;
    counter.trim().parse().context("no count of bytes")
}
