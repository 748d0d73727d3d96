//! Cost of the programs for TCP to connections that are neither of Zenoh nor of RTPS, over loopback
//! in a separate namespace. It is measured in bytes per second in one direction, and in exchanges
//! of 100 bytes per second. Rounds with and without the programs alternate. The example needs root.
//!
//! The share of the programs is their time in the kernel's statistics. It is divided by all time
//! that both ends of the connection spend in the kernel. Throughput varies more than the programs
//! cost, so this share is the figure to compare. The statistics themselves take a part of it.
//!
//! ```text
//! make tcp-cost
//! cargo run --release --workspace --example zenoh_cost -- ROUNDS SECONDS
//! ```

#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::indexing_slicing,
    reason = "a measurement may panic"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::time::{Duration, Instant};

use aya::programs::loaded_programs;
use aya::sys::{Stats, enable_stats};
use ros2probe_capture::filter::{Filter, FilterSettings};
use ros2probe_capture::netns;
use ros2probe_testing::harness::cgroup::Cgroup;
use ros2probe_testing::harness::network::Namespace;

/// Prefixes of the names of the programs.
const OURS: [&str; 2] = ["zenoh_", "host_"];
/// Size of one write, in bytes.
const BULK: usize = 65_536;
/// Size of one message of an exchange, in bytes.
const SMALL: usize = 100;

fn connection() -> [TcpStream; 2] {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let (server, _) = listener.accept().unwrap();
    client.set_nodelay(true).unwrap();
    server.set_nodelay(true).unwrap();
    [client, server]
}

/// Returns bytes per second.
fn bulk(duration: Duration) -> f64 {
    let [mut client, mut server] = connection();
    // The bytes resemble no known protocol.
    let bytes: Vec<u8> = (0..BULK).map(|at| (at * 31 + at / 251) as u8).collect();
    std::thread::scope(|scope| {
        let reader = scope.spawn(move || {
            let (mut buffer, mut sum) = (vec![0; 4 * BULK], 0);
            while let Ok(read @ 1..) = server.read(&mut buffer) {
                sum += read;
            }
            sum
        });
        let start = Instant::now();
        while start.elapsed() < duration {
            client.write_all(&bytes).unwrap();
        }
        drop(client);
        reader.join().unwrap() as f64 / start.elapsed().as_secs_f64()
    })
}

/// Returns exchanges per second.
fn exchanges(duration: Duration) -> f64 {
    let [client, mut server] = connection();
    std::thread::scope(move |scope| {
        let mut client = client;
        scope.spawn(move || {
            let mut buffer = [0; SMALL];
            while server.read_exact(&mut buffer).is_ok() {
                server.write_all(&buffer).unwrap();
            }
        });
        let (mut buffer, mut count) = ([b'#'; SMALL], 0.0);
        let start = Instant::now();
        while start.elapsed() < duration {
            client.write_all(&buffer).unwrap();
            client.read_exact(&mut buffer).unwrap();
            count += 1.0;
        }
        // The other thread ends with the connection.
        drop(client);
        count / start.elapsed().as_secs_f64()
    })
}

/// Times of the programs and of the cgroup of this process.
#[derive(Clone, Default)]
struct Times {
    /// Time and number of runs of each program, by name.
    programs: BTreeMap<String, (Duration, u64)>,
    /// Time of this process in the kernel. It does all the work: over loopback, a sender also
    /// processes what its segment causes at the receiver.
    kernel: Duration,
}

impl Times {
    /// `cgroup` is that of the process while it sends. The programs in `others` are not read.
    fn now(cgroup: &Path, others: &BTreeSet<u32>) -> Self {
        let mut programs = BTreeMap::new();
        for program in loaded_programs().filter_map(Result::ok) {
            let name = program.name_as_str().unwrap_or_default();
            let is_ours = OURS.iter().any(|prefix| name.starts_with(prefix));
            if is_ours && !others.contains(&program.id()) {
                let times = (program.run_time(), program.run_count());
                programs.insert(name.to_owned(), times);
            }
        }
        let text = std::fs::read_to_string(cgroup.join("cpu.stat")).unwrap();
        let mut lines = text.lines();
        let microseconds = lines.find_map(|line| line.strip_prefix("system_usec "));
        let kernel = Duration::from_micros(microseconds.unwrap().parse().unwrap());
        Self { programs, kernel }
    }

    /// Returns the times between `before` and these.
    fn since(&self, before: &Self) -> Self {
        let mut programs = self.programs.clone();
        for (name, (time, runs)) in &mut programs {
            let (past, count) = before.programs.get(name).copied().unwrap_or_default();
            *time = time.saturating_sub(past);
            *runs = runs.saturating_sub(count);
        }
        Self {
            programs,
            kernel: self.kernel - before.kernel,
        }
    }

    /// Returns the share of the programs in the time in the kernel, with the time of the statistics
    /// and without it. The second share assumes that the program with the shortest runs takes no
    /// time itself, so it is a lower bound.
    fn shares(&self) -> [f64; 2] {
        let all: f64 = self
            .programs
            .values()
            .map(|(time, _)| time.as_secs_f64())
            .sum();
        let runs: u64 = self.programs.values().map(|(_, runs)| *runs).sum();
        let each = self.programs.values().filter(|(_, runs)| *runs > 1000);
        let each = each.map(|(time, runs)| time.as_secs_f64() / *runs as f64);
        let statistics = each.reduce(f64::min).unwrap_or(0.0) * runs as f64;
        [all, all - statistics].map(|time| time / self.kernel.as_secs_f64())
    }

    /// Prints the mean time of a run of each program, and the time in the kernel per segment.
    fn print(&self, what: &str) {
        let segments = self.programs.values().map(|(_, runs)| *runs).max();
        let Some(segments) = segments.filter(|segments| *segments > 0) else {
            return;
        };
        let nanoseconds = |time: Duration, count: u64| time.as_nanos() / u128::from(count);
        for (name, (time, runs)) in &self.programs {
            if *runs > 0 {
                let each = nanoseconds(*time, *runs);
                println!("    {what}: {name}: {each} ns in {runs} runs");
            }
        }
        let kernel = nanoseconds(self.kernel, segments);
        let [all, least] = self.shares().map(|share| 100.0 * share);
        println!(
            "    {what}: kernel: {kernel} ns per segment, of which {least:.2} to {all:.2} % are \
             programs"
        );
    }
}

/// Returns the median, the least and the largest of these values.
fn spread(values: &mut [f64]) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    [
        values[values.len() / 2],
        values[0],
        values[values.len() - 1],
    ]
}

fn main() {
    let mut arguments = std::env::args()
        .skip(1)
        .map(|text| text.parse::<u64>().unwrap());
    let rounds = arguments.next().unwrap_or(7);
    let duration = Duration::from_secs(arguments.next().unwrap_or(2));
    let cgroup = Cgroup::create(&format!("rp-zenoh-cost-{}", std::process::id())).unwrap();
    let host = Namespace::isolated().unwrap();
    let _statistics = enable_stats(Stats::RunTime).unwrap();
    let mut ratios = [Vec::new(), Vec::new()];
    let mut shares = [[Vec::new(), Vec::new()], [Vec::new(), Vec::new()]];
    for round in 0..rounds {
        let mut results = [[0.0; 2]; 2];
        for step in 0..2 {
            // The order within a pair of rounds alternates, too.
            let with = (round + step) % 2;
            // An agent beside this process has programs of the same names.
            let others: BTreeSet<u32> = loaded_programs()
                .filter_map(|program| Some(program.ok()?.id()))
                .collect();
            let filter = (with == 1).then(|| {
                let mut filter = Filter::load_host(&FilterSettings::default()).unwrap();
                filter.attach(&File::open(cgroup.path()).unwrap()).unwrap();
                filter
            });
            let measure = || {
                [bulk, exchanges].map(|workload| {
                    let before = Times::now(cgroup.path(), &others);
                    (
                        workload(duration),
                        Times::now(cgroup.path(), &others).since(&before),
                    )
                })
            };
            let measured = cgroup.hold(|| netns::within(&host.network(), measure));
            let measured = measured.unwrap().unwrap();
            for (kind, (result, times)) in measured.into_iter().enumerate() {
                results[with as usize][kind] = result;
                if with == 1 {
                    times.print(["bytes", "exchanges"][kind]);
                    for (bound, share) in times.shares().into_iter().enumerate() {
                        shares[kind][bound].push(share);
                    }
                }
            }
            drop(filter);
        }
        for kind in 0..2 {
            ratios[kind].push(results[1][kind] / results[0][kind]);
        }
        println!(
            "round {round}: without {:.2} GB/s, {:.0} exchanges/s; with {:.2} GB/s, {:.0} exchanges/s",
            results[0][0] / 1e9,
            results[0][1],
            results[1][0] / 1e9,
            results[1][1]
        );
    }
    for (kind, name) in ["bytes", "exchanges"].into_iter().enumerate() {
        let [median, least, most] = spread(&mut ratios[kind]);
        println!("{name}: with / without: median {median:.3}, {least:.3} to {most:.3}");
        for (bound, about) in ["with", "without"].into_iter().enumerate() {
            let shares = spread(&mut shares[kind][bound]);
            let [median, least, most] = shares.map(|share| 100.0 * share);
            println!(
                "{name}: programs, {about} the statistics: median {median:.2} % of the time in the \
                 kernel, {least:.2} to {most:.2} %"
            );
        }
    }
}
