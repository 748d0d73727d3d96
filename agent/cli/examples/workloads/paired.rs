//! `make cost`: the additional cost of an observer, with its confidence interval.
//!
//! The workload runs on while an observer comes and goes. Each window beside the observer is
//! compared with the windows directly before and after it. A change of the machine's other work
//! affects both alike. Windows are short and numerous: the interval shows whether a difference
//! is one.
//!
//! The CPU time of the workload includes the observer, what the kernel does on its behalf in
//! other processes, and the kernel's threads for packets.

use std::fmt;
use std::fs;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::Agent;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::shared_memory::SharedMemory;
use tempfile::TempDir;

use crate::programs::{ProgramCost, Programs};
use crate::subject::Subject;
use crate::window::{Observer, Spent, WARM_UP, configuration, subscribers};

pub(crate) const HEAD: &str = "\
| workload | observer | pairs | its CPU s | workload alone, CPU s | beside it, % more |
| --- | --- | ---: | ---: | ---: | ---: |";

/// Time in which an observer starts and discovers the nodes before its window.
const SETTLING: Duration = Duration::from_secs(1);
/// Factor by which the window of the kernel's statistics is longer than the others.
const LONGER: u32 = 5;
/// Directory of the agents' state.
const STATE: &str = "state";
/// Megabytes of `/dev/shm`.
const SHARED_MEGABYTES: u32 = 256;

/// The publisher and the subscriber, which run until this value is dropped.
pub(crate) struct Running {
    streams: Vec<Stream>,
    publishers: Vec<Peer>,
    listeners: Vec<Peer>,
    _memory: Option<SharedMemory>,
    directory: TempDir,
    link: Link,
}

/// All pairs of one workload and one observer.
pub(crate) struct Row {
    workload: String,
    subject: Subject,
    pairs: Vec<Pair>,
    programs: Vec<ProgramCost>,
}

/// CPU seconds per 20 s.
#[derive(Clone, Copy, Debug)]
struct Pair {
    /// Of the workload in the windows before and after.
    alone: f64,
    /// Of the workload and the observer.
    beside: f64,
    /// Of the observer.
    own: f64,
}

/// A mean, and half of its interval of 95 % by Student's distribution.
#[derive(Clone, Copy, Debug)]
struct Interval {
    mean: f64,
    half: f64,
}

impl Running {
    /// Starts the workload. `shares_memory`: both peers are on one host, and Fast DDS uses its
    /// default transports. `program` is an agent that saves the names of the endpoints, which later
    /// agents read: they start after the announcements.
    pub(crate) fn start(
        stack: Stack,
        streams: Vec<Stream>,
        shares_memory: bool,
        program: &Path,
    ) -> Result<Running> {
        let link = Link::new()?;
        let directory = tempfile::tempdir().context("cannot create a directory")?;
        fs::create_dir(directory.path().join(STATE)).context("cannot create a directory")?;
        let memory = match shares_memory {
            true => Some(SharedMemory::of(&link.robot, SHARED_MEGABYTES)?),
            false => None,
        };
        let mut running = Running {
            streams,
            publishers: Vec::new(),
            listeners: Vec::new(),
            _memory: memory,
            directory,
            link,
        };
        let mut agent = running.agent(Observer::Host, program)?;
        let (robot, monitor) = (&running.link.robot, &running.link.monitor);
        let listener_host = if shares_memory { robot } else { monitor };
        let enter = |host: &Namespace| match &running._memory {
            Some(memory) => memory.inside(host),
            None => host.inside(),
        };
        let (mut publishers, mut listeners) = (Vec::new(), Vec::new());
        for (number, stream) in running.streams.iter().enumerate() {
            let stream = Stream {
                logged: false,
                shares_memory,
                ..stream.clone()
            };
            for (host, role, name, peers) in [
                (listener_host, Role::Subscriber, "listener", &mut listeners),
                (robot, Role::Publisher, "sensor", &mut publishers),
            ] {
                let node = format!("/{name}{number}");
                let mut peer = Peer::launch_behind(&enter(host), stack, role, &stream, &[&node])?;
                peer.wait_ready()?;
                peers.push(peer);
            }
        }
        for peer in publishers.iter_mut().chain(&mut listeners) {
            peer.wait_matched()?;
        }
        for publisher in &mut publishers {
            publisher.start_sending()?;
        }
        std::thread::sleep(WARM_UP);
        agent.process.terminate()?;
        drop(agent);
        (running.publishers, running.listeners) = (publishers, listeners);
        Ok(running)
    }

    /// Measures each observer `pairs` times, in turns.
    pub(crate) fn measure(
        &self,
        workload: &str,
        subjects: &[Subject],
        (pairs, length): (u16, Duration),
    ) -> Result<Vec<Row>> {
        let mut rows: Vec<Row> = subjects.iter().map(|it| Row::new(workload, it)).collect();
        let mut before = self.window(None, length)?;
        for number in 0..pairs {
            for row in &mut rows {
                let beside = self.window(Some(&row.subject), length)?;
                let after = self.window(None, length)?;
                let pair = Pair {
                    alone: f64::midpoint(before.workload, after.workload),
                    beside: beside.workload,
                    own: beside.cpu,
                };
                eprintln!("{workload}: pair {} of {pairs}: {pair:?}", number + 1);
                row.pairs.push(pair);
                before = after;
            }
        }
        for row in rows
            .iter_mut()
            .filter(|row| row.subject.observer.is_agent())
        {
            row.programs = self.programs(&row.subject, length * LONGER)?;
        }
        Ok(rows)
    }

    /// Measures one window, alone or beside an observer.
    fn window(&self, subject: Option<&Subject>, length: Duration) -> Result<Spent> {
        let Some(subject) = subject else {
            return self.spent(&[], length);
        };
        if !subject.observer.is_agent() {
            let host = &self.link.monitor;
            let observers = subscribers(host, Stack::Cyclone, &self.streams, "observer")?;
            std::thread::sleep(SETTLING);
            let watching: Vec<_> = observers.iter().map(|peer| peer.process.pid()).collect();
            return self.spent(&watching, length);
        }
        let mut agent = self.agent(subject.observer, &subject.program)?;
        std::thread::sleep(SETTLING);
        let spent = self.spent(&[agent.process.pid()], length)?;
        let page = agent.scrape()?;
        for stream in &self.streams {
            let counted = page.sum("ros2_topic_messages_total", &[("topic", &stream.topic)]);
            let least = stream.rate * length.as_secs_f64() / 2.0;
            ensure!(
                counted >= least,
                "the agent counted {counted} of {}: {}",
                stream.topic,
                page.suspicious_counters()
            );
        }
        agent.process.terminate()?;
        Ok(spent)
    }

    /// Returns the run time of the kernel programs of an agent, with the kernel's own statistics,
    /// which slow the programs down.
    fn programs(&self, subject: &Subject, length: Duration) -> Result<Vec<ProgramCost>> {
        let others = Programs::loaded()?;
        let mut agent = self.agent(subject.observer, &subject.program)?;
        std::thread::sleep(SETTLING);
        let costs = Programs::loaded()?.without(&others).run_for(length)?;
        agent.process.terminate()?;
        Ok(costs)
    }

    fn spent(&self, watching: &[u32], length: Duration) -> Result<Spent> {
        let parts = self.publishers.iter().chain(&self.listeners);
        let parts: Vec<_> = parts.map(|peer| peer.process.pid()).collect();
        Spent::during(length, watching, &parts)
    }

    fn agent(&self, observer: Observer, program: &Path) -> Result<Agent<'_>> {
        let text = configuration(observer, &self.link).context("not an agent")?;
        let state = self.directory.path().join(STATE);
        let text = format!("{text}state_directory: {}\n", state.display());
        let file = self.directory.path().join("ros2probe.yaml");
        fs::write(&file, text).context("cannot write a configuration")?;
        Agent::start(&self.link.robot, program, &file)
    }
}

impl Row {
    fn new(workload: &str, subject: &Subject) -> Row {
        Row {
            workload: workload.to_owned(),
            subject: subject.clone(),
            pairs: Vec::new(),
            programs: Vec::new(),
        }
    }

    fn of_pairs(&self, value: impl Fn(&Pair) -> f64) -> Interval {
        Interval::of(&self.pairs.iter().map(value).collect::<Vec<_>>())
    }

    /// Returns the cost of the kernel programs, as lines of a list.
    pub(crate) fn programs(&self) -> String {
        let lines = self.programs.iter().map(|cost| {
            let name = self.subject.name();
            format!("- {}, {name}: {cost}\n", self.workload)
        });
        lines.collect()
    }
}

impl Interval {
    fn of(values: &[f64]) -> Interval {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let error = (squares / (count - 1.0) / count).sqrt();
        Interval {
            mean,
            half: quantile(count - 1.0) * error,
        }
    }
}

/// Returns the quantile 0.975 of Student's distribution, by its expansion around the normal
/// distribution (Abramowitz and Stegun, 26.7.5). Its error is below 1 % from 5 degrees on.
fn quantile(degrees: f64) -> f64 {
    const NORMAL: f64 = 1.959_964;
    let first = (NORMAL.powi(3) + NORMAL) / 4.0;
    let second = (5.0 * NORMAL.powi(5) + 16.0 * NORMAL.powi(3) + 3.0 * NORMAL) / 96.0;
    NORMAL + first / degrees + second / degrees.powi(2)
}

impl fmt::Display for Row {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (own, alone) = (
            self.of_pairs(|pair| pair.own),
            self.of_pairs(|pair| pair.alone),
        );
        let more = self.of_pairs(|pair| (pair.beside / pair.alone - 1.0) * 100.0);
        write!(
            formatter,
            "| {} | {} | {} | {:.4} ± {:.4} | {:.2} | {:+.2} ± {:.2} |",
            self.workload,
            self.subject.name(),
            self.pairs.len(),
            own.mean,
            own.half,
            alone.mean,
            more.mean,
            more.half
        )
    }
}
