//! Compares the losses that the agent reports for each subscriber with the subscriber's own log:
//! exactly the lost sequence numbers, each with its cause.
//!
//! A best-effort stream of each stack and size passes through stretches, in each of which one thing
//! is wrong: nothing; every n-th datagram dropped on the link, behind the publisher's socket; all
//! IP fragments but the first of such datagrams; a subscriber that is stopped again and again, so
//! that its receive buffer overflows. The publisher waits in between, so the cause is known.
//!
//! The log holds what the application received. That equals what its socket received only if the
//! middleware itself drops nothing. So readers' histories hold more than accumulates during a stop
//! (depth 1000), and receive buffers of point clouds hold more than one sample. RustDDS takes the
//! end of a stop for the end of its event loop, so it continues to wait (`robot/patience.rs`). An
//! observer cannot distinguish a loss before the first sample from late joining.
//!
//! Reliable streams are observed on the receiving host only: dropped samples that are sent again,
//! and a tail that HEARTBEATs announce and that never arrives.

mod cell;
mod experiment;
mod repair;

use anyhow::{Result, ensure};
use experiment::{Experiment, Size, Trouble};
use repair::Repair;
use ros2probe_testing::harness::peer::Stack;

#[test]
fn fast_dds_small_samples() -> Result<()> {
    one_subscriber(Stack::Fast, Size::B320)
}

#[test]
fn fast_dds_point_clouds_of_644_kb() -> Result<()> {
    one_subscriber(Stack::Fast, Size::KB644)
}

#[test]
fn fast_dds_point_clouds_of_2_72_mb() -> Result<()> {
    one_subscriber(Stack::Fast, Size::MB2_72)
}

#[test]
fn fast_dds_reliable_samples() -> Result<()> {
    Repair::of(Stack::Fast)?.ensure_reported()
}

#[test]
fn fast_dds_two_subscribers() -> Result<()> {
    two_subscribers(Stack::Fast)
}

#[test]
fn cyclone_dds_small_samples() -> Result<()> {
    one_subscriber(Stack::Cyclone, Size::B320)
}

#[test]
fn cyclone_dds_point_clouds_of_644_kb() -> Result<()> {
    one_subscriber(Stack::Cyclone, Size::KB644)
}

#[test]
fn cyclone_dds_point_clouds_of_2_72_mb() -> Result<()> {
    one_subscriber(Stack::Cyclone, Size::MB2_72)
}

#[test]
fn cyclone_dds_reliable_samples() -> Result<()> {
    Repair::of(Stack::Cyclone)?.ensure_reported()
}

#[test]
fn cyclone_dds_two_subscribers() -> Result<()> {
    two_subscribers(Stack::Cyclone)
}

#[test]
fn rust_dds_small_samples() -> Result<()> {
    one_subscriber(Stack::Rust, Size::B320)
}

#[test]
fn rust_dds_point_clouds_of_644_kb() -> Result<()> {
    one_subscriber(Stack::Rust, Size::KB644)
}

#[test]
fn rust_dds_point_clouds_of_2_72_mb() -> Result<()> {
    one_subscriber(Stack::Rust, Size::MB2_72)
}

#[test]
fn rust_dds_reliable_samples() -> Result<()> {
    Repair::of(Stack::Rust)?.ensure_reported()
}

#[test]
fn rust_dds_two_subscribers() -> Result<()> {
    two_subscribers(Stack::Rust)
}

fn one_subscriber(stack: Stack, size: Size) -> Result<()> {
    let mut troubles = vec![
        Trouble::Nothing,
        Trouble::Datagrams(10),
        Trouble::Datagrams(20),
    ];
    // RustDDS sends no datagram that a frame cannot hold.
    if size != Size::B320 && stack != Stack::Rust {
        troubles.push(Trouble::Fragments(20));
    }
    troubles.push(Trouble::Stops);
    check(&Experiment {
        stack,
        size,
        subscribers: 1,
        troubles,
    })
}

fn two_subscribers(stack: Stack) -> Result<()> {
    // RustDDS sends samples to a multicast address: one datagram for both.
    let on_the_link = match stack {
        Stack::Rust => Trouble::Datagrams(20),
        _ => Trouble::DatagramsToTheLast(20),
    };
    check(&Experiment {
        stack,
        size: Size::B320,
        subscribers: 2,
        troubles: vec![Trouble::Nothing, on_the_link, Trouble::Stops],
    })
}

fn check(experiment: &Experiment) -> Result<()> {
    let cells = experiment.run()?;
    cells.iter().for_each(|cell| println!("{cell}"));
    let faults: Vec<String> = cells.iter().flat_map(cell::Cell::faults).collect();
    ensure!(faults.is_empty(), "{}", faults.join("\n"));
    Ok(())
}
