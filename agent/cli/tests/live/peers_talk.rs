//! The test peers and the harness themselves: the peers' logs must agree with the packets on the
//! link.

use std::time::Duration;

use anyhow::Result;
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::wait_until;

const SAMPLES: u64 = 600;

#[test]
fn fast_dds_delivers_every_sample() -> Result<()> {
    delivers_every_sample(Stack::Fast)
}

#[test]
fn cyclone_dds_delivers_every_sample() -> Result<()> {
    delivers_every_sample(Stack::Cyclone)
}

#[test]
fn rust_dds_delivers_every_sample() -> Result<()> {
    delivers_every_sample(Stack::Rust)
}

#[test]
fn fast_dds_loses_exactly_the_samples_that_the_link_drops() -> Result<()> {
    loses_what_the_link_drops(Stack::Fast)
}

#[test]
fn cyclone_dds_loses_exactly_the_samples_that_the_link_drops() -> Result<()> {
    loses_what_the_link_drops(Stack::Cyclone)
}

#[test]
fn rust_dds_loses_exactly_the_samples_that_the_link_drops() -> Result<()> {
    loses_what_the_link_drops(Stack::Rust)
}

fn delivers_every_sample(stack: Stack) -> Result<()> {
    let exchange = Exchange::of_small_samples(stack, 0)?;
    assert_eq!(exchange.sent, (0..SAMPLES).collect::<Vec<_>>());
    assert_eq!(exchange.received, exchange.sent);
    Ok(())
}

fn loses_what_the_link_drops(stack: Stack) -> Result<()> {
    let exchange = Exchange::of_small_samples(stack, 100)?;
    assert_eq!(exchange.sent, (0..SAMPLES).collect::<Vec<_>>());
    assert!(
        exchange.dropped > 20,
        "only {} of {SAMPLES} dropped",
        exchange.dropped
    );
    assert_eq!(exchange.received.len() as u64, SAMPLES - exchange.dropped);
    Ok(())
}

/// Samples that a best-effort publisher sent, that its subscriber received, and that the link
/// dropped.
struct Exchange {
    sent: Vec<u64>,
    received: Vec<u64>,
    dropped: u64,
}

impl Exchange {
    fn of_small_samples(stack: Stack, per_mille: u16) -> Result<Exchange> {
        let link = Link::new()?;
        let stream = Stream::small(SAMPLES);
        let listener = ["/listener"];
        let mut subscriber =
            Peer::start(&link.monitor, stack, Role::Subscriber, &stream, &listener)?;
        let mut publisher = Peer::start(
            &link.robot,
            stack,
            Role::Publisher,
            &stream,
            &["/imu_driver"],
        )?;
        subscriber.wait_matched()?;
        publisher.wait_matched()?;
        let loss = Loss::of_samples(&link.robot, &link.monitor, &stream, per_mille)?;
        publisher.start_sending()?;
        publisher.wait_sent(Duration::from_secs(60))?;
        // A busy RustDDS writer sends later, and a busy subscriber logs later.
        wait_until("each sample is received or dropped", || {
            let received = subscriber.log()?.sequences("sub").len() as u64;
            Ok(received + loss.counts()?.dropped >= SAMPLES)
        })?;
        let counts = loss.counts()?;
        // A busy RustDDS writer packs several samples into a datagram, which is never dropped.
        assert!(
            counts.matched > SAMPLES / 2,
            "{counts:?} of {SAMPLES} samples"
        );
        assert!(counts.matched <= SAMPLES, "{counts:?} of {SAMPLES} samples");
        subscriber.process.terminate()?;
        Ok(Exchange {
            sent: publisher.log()?.sequences("pub"),
            received: subscriber.log()?.sequences("sub"),
            dropped: counts.dropped,
        })
    }
}
