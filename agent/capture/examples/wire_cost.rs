//! Cost of observing interfaces to a sender of large messages: messages of 2.72 MB, as Cyclone DDS
//! sends them, on a link of MTU 1500 between two network namespaces. Windows without a tap, beside a
//! packet socket and beside tcx alternate. The CPU time of the sender and the receiver includes what
//! the kernel does for them. The example needs root and Linux 6.6.
//!
//! ```text
//! cargo run --release --workspace --example wire_cost -- ROUNDS MESSAGES
//! ```

#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::indexing_slicing,
    reason = "a measurement may panic"
)]

use std::net::UdpSocket;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use aya::programs::loaded_programs;
use aya::sys::{Stats, enable_stats};
use ros2probe_capture::interfaces::Selection;
use ros2probe_capture::netns;
use ros2probe_capture::reassembly::Limits;
use ros2probe_capture::settings::WireChoice;
use ros2probe_capture::system::{Clocks, thread_cpu};
use ros2probe_capture::wire_tap::{WireTap, WireTapSettings};
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::program_run;
use ros2probe_wire::record::Verdict;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const WRITER: Guid = Guid::new(
    GuidPrefix(*b"\x01\x10wirecostwi"),
    EntityId([0, 0, 0x11, 3]),
);
/// Bytes of a DDS fragment, fragments in a message, and fragments in a datagram.
const FRAGMENT: u16 = 1344;
const FRAGMENTS: u32 = 2024;
const PER_DATAGRAM: usize = 10;
/// Length of the headers in front of a UDP payload.
const HEADERS: usize = 28;
/// Interval in which the tap is read.
const INTERVAL: Duration = Duration::from_millis(20);

/// Returns the datagrams of a message.
fn message(number: u32) -> Vec<Vec<u8>> {
    let starts: Vec<u32> = (1..=FRAGMENTS).collect();
    let datagrams = starts.chunks(PER_DATAGRAM).map(|starts| {
        let starts = starts.iter().copied();
        let packet = program_run::data_frags(WRITER, number, starts, FRAGMENTS, FRAGMENT);
        packet[HEADERS..].to_vec()
    });
    datagrams.collect()
}

/// CPU seconds of a window.
struct Spent {
    /// Of the sender and the receiver.
    workload: f64,
    /// Of the tap.
    own: f64,
}

fn open(host: &Namespace, wire: WireChoice) -> WireTap {
    let settings = WireTapSettings {
        wire,
        selection: Selection::new(&[], &[]).unwrap(),
        ring_bytes: 4 << 20,
        record_ring_bytes: 1 << 20,
        reassembly: Limits::default(),
        zenoh_ports: vec![7447],
    };
    let tap = netns::within(&host.network(), || WireTap::open(&settings, 0, None));
    let mut tap = tap.unwrap().unwrap();
    let filter = tap.filter_mut();
    filter.set_interest(WRITER, Some(Verdict::Meter)).unwrap();
    tap
}

/// Sends the messages beside a tap, if there is one.
fn window(link: &Link, wire: Option<WireChoice>, messages: u32) -> Spent {
    let bind = |host: &Namespace| {
        let address = (host.address(), 0);
        netns::within(&host.network(), || UdpSocket::bind(address))
            .unwrap()
            .unwrap()
    };
    let (sender, receiver) = (bind(&link.robot), bind(&link.monitor));
    let to = receiver.local_addr().unwrap();
    let datagrams: Vec<_> = (1..=messages).map(message).collect();
    let mut tap = wire.map(|wire| open(&link.robot, wire));
    receiver
        .set_read_timeout(Some(Duration::from_millis(300)))
        .unwrap();
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let sending = scope.spawn(|| {
            let before = thread_cpu();
            for datagram in datagrams.iter().flatten() {
                sender.send_to(datagram, to).unwrap();
            }
            thread_cpu() - before
        });
        let receiving = scope.spawn(|| {
            let before = thread_cpu();
            let mut buffer = vec![0; 65_536];
            while receiver.recv(&mut buffer).is_ok() {}
            thread_cpu() - before
        });
        let reading = scope.spawn(|| {
            let before = thread_cpu();
            let mut observer = Observer::new(Settings::default());
            while let Some(tap) = tap.as_mut().filter(|_| !is_over.load(Ordering::Relaxed)) {
                std::thread::sleep(INTERVAL);
                tap.poll(&Clocks::read(), None, &mut observer).unwrap();
            }
            thread_cpu() - before
        });
        let workload = sending.join().unwrap() + receiving.join().unwrap();
        is_over.store(true, Ordering::Relaxed);
        let own = reading.join().unwrap();
        let seconds = |nanoseconds: u64| nanoseconds as f64 / 1e9;
        Spent {
            workload: seconds(workload),
            own: seconds(own),
        }
    })
}

/// Returns the mean of some ratios as a percentage above 1, and half of its interval of 95 %.
fn interval(ratios: &[f64]) -> (f64, f64) {
    let count = ratios.len() as f64;
    let mean = ratios.iter().sum::<f64>() / count;
    let squares: f64 = ratios.iter().map(|ratio| (ratio - mean).powi(2)).sum();
    let error = (squares / (count - 1.0) / count).sqrt();
    ((mean - 1.0) * 100.0, 2.1 * error * 100.0)
}

/// Prints the mean time of a run of each program during a window.
fn print_times(link: &Link, wire: WireChoice, messages: u32) {
    let _statistics = enable_stats(Stats::RunTime).unwrap();
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let watching = scope.spawn(|| {
            let mut latest = std::collections::BTreeMap::new();
            while !stop.load(Ordering::Relaxed) {
                for program in loaded_programs().filter_map(Result::ok) {
                    let name = program.name_as_str().unwrap_or_default().to_owned();
                    if ["wire", "tcx_"]
                        .iter()
                        .any(|prefix| name.starts_with(prefix))
                    {
                        latest.insert(name, (program.run_time(), program.run_count()));
                    }
                }
                std::thread::sleep(Duration::from_millis(50));
            }
            latest
        });
        window(link, Some(wire), messages);
        stop.store(true, Ordering::Relaxed);
        for (name, (time, runs)) in watching.join().unwrap() {
            if runs > 1000 {
                let each = time.as_nanos() / u128::from(runs);
                println!("{wire:?}: {name}: {each} ns in {runs} runs");
            }
        }
    });
}

fn main() {
    let mut arguments = std::env::args()
        .skip(1)
        .map(|text| text.parse::<u32>().unwrap());
    let rounds = arguments.next().unwrap_or(20);
    let messages = arguments.next().unwrap_or(40);
    let link = Link::new().unwrap();
    let kinds = [WireChoice::Packet, WireChoice::Tcx];
    let (mut ratios, mut own) = ([Vec::new(), Vec::new()], [0.0; 2]);
    let mut before = window(&link, None, messages);
    for round in 0..rounds {
        for step in 0..2 {
            let kind = ((round + step) % 2) as usize;
            let beside = window(&link, Some(kinds[kind]), messages);
            let after = window(&link, None, messages);
            let alone = f64::midpoint(before.workload, after.workload);
            ratios[kind].push(beside.workload / alone);
            own[kind] += beside.own / alone / f64::from(rounds);
            println!(
                "{:?}: alone {alone:.3} s, beside {:.3} s, own {:.4} s",
                kinds[kind], beside.workload, beside.own
            );
            before = after;
        }
    }
    for kind in 0..2 {
        let (more, half) = interval(&ratios[kind]);
        println!(
            "{:?}: the workload takes {more:+.2} ± {half:.2} % more, and the tap {:.2} %",
            kinds[kind],
            own[kind] * 100.0
        );
    }
    for kind in kinds {
        print_times(&link, kind, messages);
    }
}
