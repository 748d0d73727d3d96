//! A leaving publisher announces its end within milliseconds after its last sample. Announcements
//! in a frame do not overtake samples, so the last samples count.

use anyhow::{Context as _, Result};
use ros2probe_testing::harness::agent::{Agent, PACKETS_ALONE};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::wait_until;

#[test]
fn the_last_samples_before_a_goodbye_are_counted() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir().context("cannot create a directory")?;
    let configuration = directory.path().join("ros2probe.yaml");
    std::fs::write(&configuration, format!("watch: [/**]\n{PACKETS_ALONE}"))
        .context("cannot write a configuration")?;
    let agent = Agent::start(&link.robot, env!("CARGO_BIN_EXE_rp"), &configuration)?;
    let stream = Stream::small(0);
    let (host, role) = (&link.monitor, Role::Subscriber);
    let _subscriber = Peer::start(host, Stack::Cyclone, role, &stream, &["/listener"])?;
    let (host, role) = (&link.robot, Role::Publisher);
    let mut publisher = Peer::start(host, Stack::Cyclone, role, &stream, &["/imu_driver"])?;
    publisher.wait_matched()?;
    publisher.start_sending()?;
    wait_until("a hundred samples are sent", || {
        Ok(publisher.log()?.sequences("pub").len() > 100)
    })?;
    publisher.process.terminate()?;
    let sent = publisher.log()?.sequences("pub").len();
    let counted = agent
        .settled_scrape("/imu", sent as u64)?
        .sum("ros2_topic_messages_total", &[("topic", "/imu")]);
    assert_eq!(counted as usize, sent);
    Ok(())
}
