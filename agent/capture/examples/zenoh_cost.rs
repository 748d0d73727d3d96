//! Cost of the programs for TCP to connections that are not of Zenoh, over loopback in a separate
//! namespace. It is measured in bytes per second in one direction, and in exchanges of 100 bytes
//! per second. Rounds with and without the programs alternate. The example needs root.
//!
//! ```text
//! cargo run --release --workspace --example zenoh_cost -- ROUNDS SECONDS
//! ```

#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::indexing_slicing,
    reason = "a measurement may panic"
)]

use std::fs::File;
use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant};

use aya::programs::loaded_programs;
use ros2probe_capture::filter::{Filter, FilterSettings};
use ros2probe_capture::netns;
use ros2probe_testing::harness::cgroup::Cgroup;
use ros2probe_testing::harness::network::Namespace;

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

/// Prints the mean time of a run of each program, if the kernel measures it
/// (`kernel.bpf_stats_enabled`).
fn print_times() {
    for program in loaded_programs().filter_map(Result::ok) {
        let name = program.name_as_str().unwrap_or_default().to_owned();
        let (time, runs) = (program.run_time(), program.run_count());
        let is_ours = ["zenoh_", "host_"]
            .iter()
            .any(|prefix| name.starts_with(prefix));
        if runs > 1000 && is_ours {
            println!(
                "    {name}: {} ns in {runs} runs",
                time.as_nanos() / u128::from(runs)
            );
        }
    }
}

fn main() {
    let mut arguments = std::env::args()
        .skip(1)
        .map(|text| text.parse::<u64>().unwrap());
    let rounds = arguments.next().unwrap_or(7);
    let duration = Duration::from_secs(arguments.next().unwrap_or(2));
    let cgroup = Cgroup::create(&format!("rp-zenoh-cost-{}", std::process::id())).unwrap();
    let host = Namespace::isolated().unwrap();
    let mut ratios = [Vec::new(), Vec::new()];
    for round in 0..rounds {
        let mut results = [[0.0; 2]; 2];
        for step in 0..2 {
            // The order within a pair of rounds alternates, too.
            let with = (round + step) % 2;
            let filter = (with == 1).then(|| {
                let mut filter = Filter::load_host(&FilterSettings::default()).unwrap();
                filter.attach(&File::open(cgroup.path()).unwrap()).unwrap();
                filter
            });
            let measure = || [bulk(duration), exchanges(duration)];
            let measured = cgroup.hold(|| netns::within(&host.network(), measure));
            results[with as usize] = measured.unwrap().unwrap();
            print_times();
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
    for (name, mut ratios) in ["bytes", "exchanges"].into_iter().zip(ratios) {
        ratios.sort_by(f64::total_cmp);
        println!(
            "{name}: with / without: median {:.3}, {:.3} to {:.3}",
            ratios[ratios.len() / 2],
            ratios[0],
            ratios[ratios.len() - 1]
        );
    }
}
