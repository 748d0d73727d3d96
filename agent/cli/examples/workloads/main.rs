//! `make bench` and `make cost`: the cost of observing. Each workload runs between two hosts, alternately without
//! an observer, with the agent (host hook, packet sockets) and with a Cyclone DDS subscriber. The
//! table shows CPU time and memory of the observer, and the total of all processes.
//!
//! Before that, it measures the agent's footprint (`footprint`) and the cost of open pages
//! (`tabs`).
//!
//! Figures that do not depend on the machine's load (memory, bytes copied, messages counted) are
//! checked and end the run with a failure. CPU time is compared with its targets, and only
//! reported.

mod caps;
mod footprint;
mod paired;
mod programs;
mod report;
mod spread;
mod subject;
mod tabs;
mod window;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode};
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use clap::{Parser, ValueEnum};

use crate::footprint::Footprint;
use crate::paired::Running;
use crate::report::{Row, Targets};
use crate::spread::{Spread, Windows};
use crate::subject::Subject;
use crate::window::{Observer, Window};
use ros2probe_testing::harness::peer::{Stack, Stream};

#[derive(Parser)]
#[command(about = "Measures what observing costs; needs root for network namespaces")]
struct Options {
    /// Program of the agent [default: the shipped static binary]
    #[arg(long)]
    agent: Option<PathBuf>,
    /// Compares this many pairs of windows with and without each observer, while the workload runs on
    #[arg(long, value_parser = clap::value_parser!(u16).range(2..), conflicts_with_all = ["spread", "rounds"])]
    pairs: Option<u16>,
    /// Busy processes beside the workload
    #[arg(long, default_value_t = 0)]
    load: u16,
    /// Length of each measurement
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..))]
    seconds: u64,
    /// Measurements of each kind; the table shows medians
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    rounds: u16,
    /// Only workloads whose name contains this; `footprint` for sizes, startup and memory, `caps`
    /// for the memory of full tables, `tabs` for open pages
    #[arg(long, default_value = "")]
    only: String,
    /// Only publishers and subscribers of this DDS
    #[arg(long, value_enum)]
    stack: Option<StackName>,
    /// Prints minimum, median and maximum of each kind instead of the table
    #[arg(long)]
    spread: bool,
    /// With `--spread` or `--pairs`: another binary of the agent, whose windows alternate with those
    /// of the first
    #[arg(long)]
    before: Option<PathBuf>,
    /// With `--spread` or `--pairs`: only these kinds
    #[arg(long, value_enum, value_delimiter = ',')]
    observer: Vec<Observer>,
}

#[derive(Clone, Copy, ValueEnum)]
enum StackName {
    Fast,
    Cyclone,
    Rust,
}

/// One line of the table.
struct Workload {
    name: &'static str,
    /// Bytes per message and rate of each topic.
    topics: &'static [(usize, f64)],
    stacks: &'static [Stack],
    /// CPU seconds of the reference implementation for 20 s (docs/benchmarks.md), if known.
    reference: Option<f64>,
}

/// Two lidars of 435 and 103 Mbit/s, four cameras of 36 Mbit/s, a depth camera of 147 Mbit/s, and
/// small topics.
const ROBOT: [(usize, f64); 10] = [
    (2_720_000, 20.0),
    (644_000, 20.0),
    (150_000, 30.0),
    (150_000, 30.0),
    (150_000, 30.0),
    (150_000, 30.0),
    (614_400, 30.0),
    (320, 200.0),
    (720, 50.0),
    (120, 100.0),
];

/// Workloads of `make cost`: name, bytes, rate, and whether both peers share memory on one host.
const PAIRED: [(&str, usize, f64, Stack, bool); 4] = [
    ("320 B @ 200 Hz", 320, 200.0, Stack::Cyclone, false),
    ("2.72 MB @ 20 Hz", 2_720_000, 20.0, Stack::Cyclone, false),
    (
        "320 B @ 200 Hz, shared memory",
        320,
        200.0,
        Stack::Fast,
        true,
    ),
    (
        "2.72 MB @ 20 Hz, shared memory",
        2_720_000,
        20.0,
        Stack::Fast,
        true,
    ),
];

const WORKLOADS: [Workload; 7] = [
    Workload::of_all("320 B @ 200 Hz", &[(320, 200.0)], 0.145),
    Workload::of_all("644 KB @ 20 Hz", &[(644_000, 20.0)], 0.24),
    Workload::of_all("2.72 MB @ 20 Hz", &[(2_720_000, 20.0)], 0.79),
    Workload::of_cyclone("64 KiB @ 100 Hz", &[(65_536, 100.0)]),
    Workload::of_cyclone("64 KiB @ 500 Hz", &[(65_536, 500.0)]),
    Workload::of_cyclone("64 KiB @ 1000 Hz", &[(65_536, 1000.0)]),
    Workload::of_cyclone("a whole robot", &ROBOT),
];

fn main() -> Result<ExitCode> {
    let options = Options::parse();
    let program = match &options.agent {
        Some(program) => program.clone(),
        None => shipped()?,
    };
    if !program.exists() {
        bail!("{} is missing: run `make bench`", program.display());
    }
    let _load: Vec<Busy> = (0..options.load)
        .map(|_| Busy::start())
        .collect::<Result<_>>()?;
    if let Some(pairs) = options.pairs {
        compare(&program, pairs, &options)?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut missed = Vec::new();
    if "footprint".contains(&options.only) {
        let length = Duration::from_secs(options.seconds);
        let footprint = Footprint::measure(&program, length).context("footprint")?;
        println!("{footprint}");
        missed.extend(footprint.missed());
    }
    if "caps".contains(&options.only) {
        caps::measure(&program).context("caps")?;
    }
    if "tabs".contains(&options.only) {
        let length = Duration::from_secs(options.seconds);
        missed.extend(tabs::measure(&program, length).context("tabs")?);
    }
    println!(
        "{} windows of {} s each; CPU seconds are per 20 s; workload = publisher, subscriber, observer and ksoftirqd\n",
        options.rounds, options.seconds
    );
    println!(
        "{}",
        if options.spread {
            spread::HEAD
        } else {
            report::HEAD
        }
    );
    for workload in WORKLOADS {
        for stack in workload.stacks {
            if !workload.name.contains(&options.only)
                || options.stack.is_some_and(|name| name.stack() != *stack)
            {
                continue;
            }
            let context = || format!("{} with {stack:?}", workload.name);
            if options.spread {
                let spread = spread(&workload, *stack, &program, &options).with_context(context)?;
                print!("{spread}");
                continue;
            }
            let row = measure(&workload, *stack, &program, &options).with_context(context)?;
            println!("{row}");
            missed.extend(row.missed(&Targets::default()));
        }
    }
    println!();
    for miss in &missed {
        println!("{miss}");
    }
    Ok(if missed.iter().any(|miss| miss.fails) {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
}

/// Measures alternately without an observer, with the agent, and with the subscriber, so that other
/// work of the machine affects all of them equally.
fn measure(workload: &Workload, stack: Stack, program: &Path, options: &Options) -> Result<Row> {
    let streams = workload.streams();
    let seconds = Duration::from_secs(options.seconds);
    let mut row = Row::new(workload.name, stack, workload.reference);
    for _ in 0..options.rounds {
        for observer in Observer::ALL {
            row.add(Window::measure(
                stack, &streams, observer, program, seconds,
            )?);
        }
    }
    Ok(row)
}

/// Measures as [`measure`] does, with each binary of the agent. Every round begins with another
/// kind, so that no kind always follows the same one.
fn spread(workload: &Workload, stack: Stack, program: &Path, options: &Options) -> Result<Spread> {
    let streams = workload.streams();
    let seconds = Duration::from_secs(options.seconds);
    let subjects = Subject::all(&Observer::ALL, &options.observer, options.binaries(program));
    let mut subjects: Vec<_> = subjects.into_iter().map(Windows::new).collect();
    for _ in 0..options.rounds {
        for windows in &mut subjects {
            let Subject {
                observer, program, ..
            } = windows.subject();
            let window = Window::measure(stack, &streams, *observer, program, seconds)?;
            eprintln!("{}: {}", workload.name, windows.add(&window));
        }
        subjects.rotate_left(1);
    }
    Ok(Spread::new(
        format!("{}, {stack:?}", workload.name),
        subjects,
    ))
}

/// Prints what each observer adds to the workloads of `make cost`.
fn compare(program: &Path, pairs: u16, options: &Options) -> Result<()> {
    let seconds = Duration::from_secs(options.seconds);
    let mut programs = String::new();
    println!(
        "{pairs} pairs of windows of {} s; CPU seconds are per 20 s; ± is the interval of 95 %\n\n{}",
        options.seconds,
        paired::HEAD
    );
    for (name, size, rate, stack, shares_memory) in PAIRED {
        if !name.contains(&options.only) {
            continue;
        }
        let context = || format!("{name} with {stack:?}");
        let stream = Stream {
            topic: "/sensor".to_owned(),
            rate,
            // Fast DDS sends best-effort messages by UDP, too.
            reliable: shares_memory,
            ..Stream::point_cloud(size, 0)
        };
        let running = Running::start(stack, vec![stream], shares_memory, program);
        let running = running.with_context(context)?;
        // A subscriber to shared memory would have to be on the host.
        let kinds: &[Observer] = match shares_memory {
            true => &[Observer::Host],
            false => &[Observer::Host, Observer::Wire, Observer::Subscriber],
        };
        let subjects = Subject::all(kinds, &options.observer, options.binaries(program));
        let rows = running.measure(name, &subjects, (pairs, seconds));
        for row in rows.with_context(context)? {
            println!("{row}");
            programs += &row.programs();
        }
    }
    println!("\n{programs}");
    Ok(())
}

/// A process that takes a CPU, until this value is dropped.
struct Busy(Child);

impl Busy {
    fn start() -> Result<Busy> {
        let child = Command::new("sh")
            .args(["-c", "while :; do :; done"])
            .spawn();
        Ok(Busy(child.context("cannot start a busy process")?))
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns the binary in the target directory for this machine's architecture.
fn shipped() -> Result<PathBuf> {
    let program = std::env::current_exe().context("cannot tell where this program is")?;
    let target = program.ancestors().nth(3);
    let target = target.context("this program is in no target directory")?;
    let triple = format!("{}-unknown-linux-musl", std::env::consts::ARCH);
    Ok(target.join(triple).join("release/rp"))
}

impl Options {
    /// Returns the agent's binary, and the one of `--before`.
    fn binaries<'a>(&'a self, program: &'a Path) -> (&'a Path, Option<&'a Path>) {
        (program, self.before.as_deref())
    }
}

impl Workload {
    fn streams(&self) -> Vec<Stream> {
        let topics = self.topics.iter().enumerate();
        topics
            .map(|(number, (size, rate))| Stream {
                topic: format!("/sensor{number}"),
                rate: *rate,
                ..Stream::point_cloud(*size, 0)
            })
            .collect()
    }

    const fn of_all(
        name: &'static str,
        topics: &'static [(usize, f64)],
        reference: f64,
    ) -> Workload {
        Workload {
            name,
            topics,
            stacks: &Stack::ALL,
            reference: Some(reference),
        }
    }

    const fn of_cyclone(name: &'static str, topics: &'static [(usize, f64)]) -> Workload {
        Workload {
            name,
            topics,
            stacks: &[Stack::Cyclone],
            reference: None,
        }
    }
}

impl StackName {
    fn stack(self) -> Stack {
        match self {
            StackName::Fast => Stack::Fast,
            StackName::Cyclone => Stack::Cyclone,
            StackName::Rust => Stack::Rust,
        }
    }
}
