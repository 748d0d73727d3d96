//! One measurement: a publisher, its subscriber and optionally an observer, for some time.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};

use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::{INTERFACE, Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::run;
use ros2probe_testing::harness::usage::{Memory, Usage, machine_idle, softirq_cpu};

/// Time for discovery to settle and caches to fill before the window opens.
pub(crate) const WARM_UP: Duration = Duration::from_secs(3);
/// Interval of reading the observer's memory.
const SAMPLING: Duration = Duration::from_secs(1);
/// Length of time to which CPU times are scaled.
pub(crate) const UNIT_SECONDS: f64 = 20.0;

/// The observer of a window.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub(crate) enum Observer {
    None,
    /// The agent with the host hook.
    Host,
    /// The agent with packet sockets.
    Wire,
    /// An additional subscriber to everything, Cyclone DDS in C++.
    Subscriber,
}

pub(crate) struct Window {
    pub(crate) observer: Observer,
    /// CPU seconds of the whole machine, per 20 s.
    pub(crate) machine: f64,
    /// CPU seconds of publisher, subscriber, observer and the kernel's packet threads, per 20 s.
    pub(crate) workload: f64,
    /// CPU seconds of the observer, per 20 s.
    pub(crate) cpu: f64,
    /// The observer's maximum memory in the window.
    pub(crate) memory: Memory,
    /// Number of samples written, from the publishers' first to their last.
    pub(crate) sent: u64,
    /// The agent's counters at the end.
    pub(crate) agent_totals: Option<AgentTotals>,
}

/// The agent's counters since its start.
pub(crate) struct AgentTotals {
    pub(crate) counted: f64,
    pub(crate) lost: f64,
    /// Frames and records that the kernel dropped before the agent read them.
    pub(crate) dropped: f64,
    /// Bytes copied to user space, as a fraction of the bytes that crossed the link.
    pub(crate) copied: f64,
}

impl Observer {
    pub(crate) const ALL: [Observer; 4] = [
        Observer::None,
        Observer::Host,
        Observer::Wire,
        Observer::Subscriber,
    ];

    /// Returns whether the observer is the agent.
    pub(crate) const fn is_agent(self) -> bool {
        matches!(self, Observer::Host | Observer::Wire)
    }
}

/// Returns the configuration if the observer is the agent. With the host hook, the agent observes
/// both hosts as if all nodes ran on one, but nothing else on the machine.
pub(crate) fn configuration(observer: Observer, link: &Link) -> Option<String> {
    let capture = match observer {
        Observer::Host => format!("source: host, cgroup: {}", link.cgroup().display()),
        Observer::Wire => "source: wire".to_owned(),
        Observer::None | Observer::Subscriber => return None,
    };
    Some(format!("watch: [/**]\ncapture: {{{capture}}}\nlog: warn\n"))
}

impl Window {
    pub(crate) fn measure(
        stack: Stack,
        streams: &[Stream],
        observer: Observer,
        program: &Path,
        length: Duration,
    ) -> Result<Window> {
        let link = Link::new()?;
        let directory = tempfile::tempdir().context("cannot create a directory")?;
        let file = directory.path().join("ros2probe.yaml");
        let agent = match configuration(observer, &link) {
            Some(text) => {
                std::fs::write(&file, text).context("cannot write a configuration")?;
                Some(Agent::start(&link.robot, program, &file)?)
            }
            None => None,
        };
        let observers = if observer == Observer::Subscriber {
            subscribers(&link.monitor, Stack::Cyclone, streams, "observer")?
        } else {
            Vec::new()
        };
        let mut listeners = subscribers(&link.monitor, stack, streams, "listener")?;
        let publishers = streams.iter().enumerate().map(|(number, stream)| {
            let node = format!("/sensor{number}");
            Peer::start(&link.robot, stack, Role::Publisher, stream, &[&node])
        });
        let mut publishers: Vec<Peer> = publishers.collect::<Result<_>>()?;
        for peer in publishers.iter_mut().chain(&mut listeners) {
            peer.wait_matched()?;
        }
        for publisher in &mut publishers {
            publisher.start_sending()?;
        }
        std::thread::sleep(WARM_UP);

        let processes =
            |peers: &[Peer]| -> Vec<u32> { peers.iter().map(|peer| peer.process.pid()).collect() };
        let mut watching = processes(&observers);
        watching.extend(agent.as_ref().map(|agent| agent.process.pid()));
        let parts = [processes(&publishers), processes(&listeners)].concat();
        let spent = Spent::during(length, &watching, &parts)?;

        let mut sent = 0;
        for publisher in &mut publishers {
            publisher.process.terminate()?;
            sent += publisher.log()?.sequences("pub").len() as u64;
        }
        let traffic = bytes_sent(&link.robot)?;
        let pages = agent.iter().flat_map(|agent| {
            let topics = streams.iter().map(|stream| &stream.topic);
            topics.map(|topic| agent.settled_scrape(topic, 0))
        });
        let scrape = pages.collect::<Result<Vec<_>>>()?.pop();
        Ok(Window {
            observer,
            machine: spent.machine,
            workload: spent.workload,
            cpu: spent.cpu,
            memory: spent.memory,
            sent,
            agent_totals: scrape.map(|scrape| AgentTotals::of(&scrape, streams, traffic)),
        })
    }
}

impl AgentTotals {
    fn of(scrape: &Scrape, streams: &[Stream], traffic: f64) -> AgentTotals {
        let sum = |name: &str| -> f64 {
            let each = streams.iter().map(|stream| stream.topic.as_str());
            each.map(|topic| scrape.sum(name, &[("topic", topic)]))
                .sum()
        };
        AgentTotals {
            counted: sum("ros2_topic_messages_total"),
            lost: sum("ros2_topic_lost_messages_total"),
            dropped: scrape.sum("ros2probe_capture_dropped_packets_total", &[])
                + scrape.sum("ros2probe_records_dropped_total", &[]),
            copied: scrape.sum("ros2probe_capture_copied_bytes_total", &[]) / traffic,
        }
    }
}

/// What a window took. CPU seconds are per 20 s.
pub(crate) struct Spent {
    machine: f64,
    pub(crate) workload: f64,
    pub(crate) cpu: f64,
    memory: Memory,
}

impl Spent {
    pub(crate) fn during(length: Duration, watching: &[u32], parts: &[u32]) -> Result<Spent> {
        let look = || {
            let nothing = (Duration::ZERO, Memory::default());
            watching.iter().try_fold(nothing, |sum, pid| {
                let usage = Usage::of(*pid)?;
                anyhow::Ok((sum.0 + usage.cpu, sum.1.plus(usage.memory)))
            })
        };
        let rest = || {
            parts.iter().try_fold(softirq_cpu()?, |sum, part| {
                anyhow::Ok(sum + Usage::of(*part)?.cpu)
            })
        };
        let cpus = std::thread::available_parallelism().context("cannot count CPUs")?;
        let (rest_before, first) = (rest()?, look()?);
        let (idle, began) = (machine_idle()?, Instant::now());
        let mut last = first;
        let mut memory = Memory::default();
        while let Some(left) = length.checked_sub(began.elapsed()) {
            std::thread::sleep(left.min(SAMPLING));
            last = look()?;
            memory = last.1.max(memory);
        }
        let elapsed = began.elapsed().as_secs_f64();
        let unit = UNIT_SECONDS / elapsed;
        let idle = machine_idle()?.saturating_sub(idle).as_secs_f64();
        let rest = rest()?.saturating_sub(rest_before);
        let cpu = last.0.saturating_sub(first.0);
        Ok(Spent {
            machine: (elapsed * cpus.get() as f64 - idle).max(0.0) * unit,
            workload: (rest + cpu).as_secs_f64() * unit,
            cpu: cpu.as_secs_f64() * unit,
            memory,
        })
    }
}

/// Starts a subscriber to each stream, in nodes that are called `node` and a number.
pub(crate) fn subscribers(
    host: &Namespace,
    stack: Stack,
    streams: &[Stream],
    node: &str,
) -> Result<Vec<Peer>> {
    let each = streams.iter().enumerate().map(|(number, stream)| {
        let unlogged = Stream {
            logged: false,
            ..stream.clone()
        };
        let node = format!("/{node}{number}");
        Peer::start(host, stack, Role::Subscriber, &unlogged, &[&node])
    });
    each.collect()
}

/// Returns the bytes that a host has sent on its link.
fn bytes_sent(host: &Namespace) -> Result<f64> {
    let counter = run(&format!(
        "ip netns exec {} cat /sys/class/net/{INTERFACE}/statistics/tx_bytes",
        host.name()
    ))?;
    counter.trim().parse().context("no count of bytes")
}
