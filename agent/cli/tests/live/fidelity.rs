//! Compares the losses that the agent reports for each subscriber with the subscriber's own log:
//! exactly the lost sequence numbers, each with its cause.
//!
//! A best-effort stream of each stack and size passes through stretches with at most one fault
//! each. Every n-th datagram is dropped on the link, after the publisher's socket. Or only the
//! first IP fragment of such datagrams passes. Or a subscriber is stopped repeatedly, so that its
//! receive buffer overflows. The publisher waits between stretches, so each loss has a known cause.
//!
//! The log contains the samples that the application received. They equal those of its socket only
//! if the middleware itself drops nothing. Readers' histories therefore hold more than accumulates
//! during a stop (depth 1000), and receive buffers of point clouds hold more than one sample.
//! RustDDS treats the end of a stop as the end of its event loop, so its peer waits again
//! (`robot/patience.rs`). An observer cannot distinguish a loss before the first sample from late
//! joining.
//!
//! Reliable streams are observed only on the receiving host: dropped samples that are sent again,
//! and a tail that HEARTBEATs announce and that never arrives.

mod cell;
mod experiment;
mod repair;

use anyhow::{Result, ensure};
use experiment::{Experiment, InjectedFault, Size};
use repair::Repair;
use ros2probe_testing::harness::peer::Stack;

#[test]
fn lost_small_samples_of_fast_dds_are_reported_with_their_causes() -> Result<()> {
    one_subscriber(Stack::Fast, Size::B320)
}

#[test]
fn lost_point_clouds_of_644_kb_of_fast_dds_are_reported_with_their_causes() -> Result<()> {
    one_subscriber(Stack::Fast, Size::KB644)
}

#[test]
fn lost_point_clouds_of_2_72_mb_of_fast_dds_are_reported_with_their_causes() -> Result<()> {
    one_subscriber(Stack::Fast, Size::MB2_72)
}

#[test]
fn repaired_and_lost_reliable_samples_of_fast_dds_are_reported() -> Result<()> {
    Repair::of(Stack::Fast)?.ensure_reported()
}

#[test]
fn losses_of_two_fast_dds_subscribers_are_reported_separately() -> Result<()> {
    two_subscribers(Stack::Fast)
}

#[test]
fn lost_small_samples_of_cyclone_dds_are_reported_with_their_causes() -> Result<()> {
    one_subscriber(Stack::Cyclone, Size::B320)
}

#[test]
fn lost_point_clouds_of_644_kb_of_cyclone_dds_are_reported_with_their_causes() -> Result<()> {
    one_subscriber(Stack::Cyclone, Size::KB644)
}

#[test]
fn lost_point_clouds_of_2_72_mb_of_cyclone_dds_are_reported_with_their_causes() -> Result<()> {
    one_subscriber(Stack::Cyclone, Size::MB2_72)
}

#[test]
fn repaired_and_lost_reliable_samples_of_cyclone_dds_are_reported() -> Result<()> {
    Repair::of(Stack::Cyclone)?.ensure_reported()
}

#[test]
fn losses_of_two_cyclone_dds_subscribers_are_reported_separately() -> Result<()> {
    two_subscribers(Stack::Cyclone)
}

#[test]
fn lost_small_samples_of_rust_dds_are_reported_with_their_causes() -> Result<()> {
    one_subscriber(Stack::Rust, Size::B320)
}

#[test]
fn lost_point_clouds_of_644_kb_of_rust_dds_are_reported_with_their_causes() -> Result<()> {
    one_subscriber(Stack::Rust, Size::KB644)
}

#[test]
fn lost_point_clouds_of_2_72_mb_of_rust_dds_are_reported_with_their_causes() -> Result<()> {
    one_subscriber(Stack::Rust, Size::MB2_72)
}

#[test]
fn repaired_and_lost_reliable_samples_of_rust_dds_are_reported() -> Result<()> {
    Repair::of(Stack::Rust)?.ensure_reported()
}

#[test]
fn losses_of_two_rust_dds_subscribers_are_reported_separately() -> Result<()> {
    two_subscribers(Stack::Rust)
}

fn one_subscriber(stack: Stack, size: Size) -> Result<()> {
    let mut troubles = vec![
        InjectedFault::Nothing,
        InjectedFault::Datagrams(10),
        InjectedFault::Datagrams(20),
    ];
    // RustDDS sends no datagram that a frame cannot hold.
    if size != Size::B320 && stack != Stack::Rust {
        troubles.push(InjectedFault::Fragments(20));
    }
    troubles.push(InjectedFault::Stops);
    check(&Experiment {
        stack,
        size,
        subscribers: 1,
        troubles,
    })
}

fn two_subscribers(stack: Stack) -> Result<()> {
    // RustDDS sends samples to a multicast address, so one datagram serves both subscribers.
    let on_the_link = match stack {
        Stack::Rust => InjectedFault::Datagrams(20),
        _ => InjectedFault::DatagramsToTheLast(20),
    };
    check(&Experiment {
        stack,
        size: Size::B320,
        subscribers: 2,
        troubles: vec![InjectedFault::Nothing, on_the_link, InjectedFault::Stops],
    })
}

fn check(experiment: &Experiment) -> Result<()> {
    let cells = experiment.run()?;
    cells.iter().for_each(|cell| println!("{cell}"));
    let faults: Vec<String> = cells.iter().flat_map(cell::Cell::faults).collect();
    ensure!(faults.is_empty(), "{}", faults.join("\n"));
    Ok(())
}
