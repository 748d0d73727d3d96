//! Two hosts of the demo robot, each with an agent and a real OpenTelemetry receiver. Both agents
//! report the same traces, and a receiver that stops and returns does not disturb the capture.
//! Events and spans of an outage wait on disk, also while the agent is killed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_model::derive::trace::Message;
use ros2probe_model::graph::discovery::hexadecimal;
use ros2probe_testing::harness::agent::{Agent, Scrape, at_the_sockets_of};
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream, robot};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::wait_within;
use ros2probe_testing::ports::free_address;
use ros2probe_testing::rotel::{Item, Rotel, exports};
use ros2probe_wire::{EntityId, Guid, GuidPrefix, SequenceNumber};

const MESSAGES: u64 = 1_200;
const DROPPED: &str = "ros2probe_otlp_dropped_total";
const QUEUE: &str = "ros2probe_otlp_queue_bytes";

fn on(host: &Namespace) -> Command {
    let [enter, network] = host.outside();
    let mut command = Command::new(enter);
    command.arg(network).arg(Rotel::binary());
    command
}

/// Writes a configuration that traces every other message and pushes all signals to `receiver`.
fn configuration(directory: &Path, host: &Namespace, receiver: &Rotel) -> Result<PathBuf> {
    let path = directory.join(format!("{}.yaml", host.name()));
    let yaml = format!(
        "watch: [{{topic: /**, trace: 0.5}}]\n\
         otlp: {{endpoint: 'http://{}', interval_s: 1, robot: {}}}\n{}",
        receiver.address,
        host.name(),
        at_the_sockets_of(host)
    );
    std::fs::write(&path, yaml)?;
    Ok(path)
}

#[test]
fn events_and_spans_of_an_outage_survive_a_kill_of_the_agent_over_grpc() -> Result<()> {
    an_outage_loses_nothing("grpc")
}

#[test]
fn events_and_spans_of_an_outage_survive_a_kill_of_the_agent_over_http() -> Result<()> {
    an_outage_loses_nothing("http/protobuf")
}

fn an_outage_loses_nothing(protocol: &str) -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let state = directory.path().join("state");
    std::fs::create_dir(&state)?;
    let addresses = [free_address(), free_address()];
    let address = match protocol {
        "grpc" => addresses[0],
        _ => addresses[1],
    };
    let configuration = directory.path().join("ros2probe.yaml");
    let yaml = format!(
        "watch: [{{topic: /truth, trace: 1.0}}]\nstate_directory: {}\n\
         otlp: {{endpoint: 'http://{address}', protocol: {protocol}, timeout_s: 30, \
         metrics: false}}\n{}",
        state.display(),
        at_the_sockets_of(&host)
    );
    std::fs::write(&configuration, yaml)?;
    let start = || Agent::start(&host, env!("CARGO_BIN_EXE_rp"), &configuration);
    let mut first = start()?;
    let stream = Stream {
        topic: "/truth".to_owned(),
        ..Stream::small(600)
    };
    let peer = |role, node| Peer::start(&host, Stack::Rust, role, &stream, &[node]);
    let mut subscriber = peer(Role::Subscriber, "/listener")?;
    let mut publisher = peer(Role::Publisher, "/sensor")?;
    subscriber.wait_matched()?;
    publisher.wait_matched()?;
    publisher.start_sending()?;
    publisher.wait_sent(Duration::from_secs(60))?;
    let queued = |page: &Scrape| page.sum(QUEUE, &[("signal", "traces")]);
    let mut last = (0.0, Instant::now());
    let quiet = Duration::from_secs(8);
    wait_within(Duration::from_secs(60), "all spans are on disk", || {
        let bytes = queued(&first.scrape()?);
        if bytes > last.0 {
            last = (bytes, Instant::now());
        }
        // Items are written every 5 s.
        Ok(bytes > 0.0 && last.1.elapsed() > quiet)
    })?;
    first.process.signal("KILL")?;
    first.process.wait(Duration::from_secs(60))?;
    start()?.process.terminate()?;

    let third = start()?;
    let page = third.scrape()?;
    ensure!(queued(&page) > 0.0, "{}", page.0);
    let mut receiver = Rotel::start_at(&mut on(&host), directory.path(), addresses);
    third.scrape_until("the queues are empty", |page| page.sum(QUEUE, &[]) < 0.5)?;
    let started = |text: &str| text.matches("EventName: ros2probe.agent.started\n").count();
    let text = receiver.wait_for("all events have come", |text| started(text) >= 3);
    let sent: Vec<u64> = spans(&text, "send /truth").into_keys().collect();
    let items = exports(&text).into_iter().flat_map(|export| export.items);
    let named = items.filter(|item| {
        item.fields
            .get("Name")
            .is_some_and(|it| it == "send /truth")
    });
    let ids: BTreeSet<String> = named
        .filter_map(|item| item.fields.get("ID").cloned())
        .collect();
    ensure!(sent == (1..=600).collect::<Vec<_>>(), "{sent:?}");
    // A receiver that answers late may get a request twice.
    ensure!(
        ids.len() == 600 && started(&text) == 3,
        "{} spans",
        ids.len()
    );
    let page = third.scrape()?;
    ensure!(page.sum(DROPPED, &[]) < 0.5, "{}", page.0);
    Ok(())
}

/// Returns the spans of this name by sequence number.
fn spans(text: &str, name: &str) -> BTreeMap<u64, Item> {
    let items = exports(text).into_iter().flat_map(|export| export.items);
    let named = items.filter(|item| item.fields.get("Name").is_some_and(|found| found == name));
    named
        .filter_map(|item| {
            let number = item.attributes.get("sequence_number")?.parse().ok()?;
            Some((number, item))
        })
        .collect()
}

fn field(item: &Item, name: &str) -> Result<String> {
    let value = item.fields.get(name).or(item.attributes.get(name));
    value
        .cloned()
        .with_context(|| format!("no {name} in {item:?}"))
}

#[test]
fn two_hosts_report_the_same_traces_and_a_stopped_receiver_loses_no_capture() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let mut at_robot = Rotel::start(&mut on(&link.robot), directory.path(), None);
    let mut at_monitor = Rotel::start(&mut on(&link.monitor), directory.path(), None);
    let mut agents = Vec::new();
    for (host, receiver) in [(&link.robot, &at_robot), (&link.monitor, &at_monitor)] {
        let yaml = configuration(directory.path(), host, receiver)?;
        agents.push(Agent::start(host, env!("CARGO_BIN_EXE_rp"), &yaml)?);
    }
    let [agent, _] = agents.as_slice() else {
        unreachable!("there are two")
    };
    let mut roles = Vec::new();
    for (host, role) in [
        (&link.robot, "base"),
        (&link.robot, "lidar"),
        (&link.monitor, "monitor"),
    ] {
        roles.push(Process::start(&host.inside(), robot()?, ["--role", role])?);
    }
    let stream = Stream {
        topic: "/truth".to_owned(),
        ..Stream::small(MESSAGES)
    };
    let start =
        |host: &Namespace, role, node| Peer::start(host, Stack::Rust, role, &stream, &[node]);
    let mut subscriber = start(&link.monitor, Role::Subscriber, "/listener")?;
    let mut publisher = start(&link.robot, Role::Publisher, "/sensor")?;
    subscriber.wait_matched()?;
    publisher.wait_matched()?;

    spans_of_all_kinds_come(&mut at_robot, &mut at_monitor)?;

    // The receiver is stopped while the stream begins.
    let address = at_robot.address;
    drop(at_robot);
    publisher.start_sending()?;
    agent.scrape_until("given up metrics", |page| {
        page.sum(DROPPED, &[("signal", "metrics")]) > 0.0
    })?;
    let mut at_robot = Rotel::start(&mut on(&link.robot), directory.path(), Some(address));
    publisher.wait_sent(Duration::from_secs(60))?;
    check_no_loss(&agent.settled_scrape("/truth", MESSAGES)?)?;

    let writer = publisher
        .log()?
        .0
        .iter()
        .find_map(|event| event.guid.clone());
    let writer = guid(&writer.context("the publisher's log lacks its GUID")?)?;
    both_ends_report_the_same_traces(writer, &mut at_robot, &mut at_monitor)
}

/// Checks that the demo robot's own topics are traced on both hosts, a cloud with its fragments and
/// times.
fn spans_of_all_kinds_come(at_robot: &mut Rotel, at_monitor: &mut Rotel) -> Result<()> {
    for (receiver, names) in [
        (&mut *at_robot, &["send /points", "receive /cmd_vel"][..]),
        (
            at_monitor,
            &["receive /points", "send /cmd_vel", "settle /cmd_vel"],
        ),
    ] {
        let holds = |text: &str, name: &&str| text.contains(&format!("Name           : {name}\n"));
        let text = receiver.wait_for("all kinds of spans have come", |text| {
            names.iter().all(|name| holds(text, name))
                && text.contains("-> Name: ros2.topic.messages\n")
        });
        ensure!(text.contains("ros2.participant.discovered"), "events, too");
    }
    let clouds = spans(&at_robot.text(), "send /points");
    let cloud = clouds.values().next().context("a cloud")?;
    let fragments: u64 = field(cloud, "fragments")?.parse()?;
    ensure!(fragments > 100, "{fragments} fragments");
    let time = |name: &str| -> Result<u64> { Ok(field(cloud, name)?.parse()?) };
    let (begin, end) = (time("Start time")?, time("End time")?);
    let own = time("source_timestamp_unix_nano")?;
    ensure!(
        own <= begin && begin < end && end - own < 60_000_000_000,
        "{cloud:?}"
    );
    Ok(())
}

/// Checks that every message is counted and no span is dropped while the receiver is stopped.
fn check_no_loss(page: &Scrape) -> Result<()> {
    let truth = [("topic", "/truth")];
    let counted = page.sum("ros2_topic_messages_total", &truth);
    ensure!(counted as u64 == MESSAGES, "{counted} counted");
    ensure!(page.sum("ros2_topic_lost_messages_total", &truth) < 0.5);
    ensure!(page.sum("ros2probe_records_dropped_total", &[]) < 0.5);
    let traces = page.sum(DROPPED, &[("signal", "traces")]);
    ensure!(traces < 0.5, "{traces} spans dropped");
    Ok(())
}

/// Checks that exactly the sampled messages of `/truth` have a span on each host, parent and child.
fn both_ends_report_the_same_traces(
    writer: Guid,
    at_robot: &mut Rotel,
    at_monitor: &mut Rotel,
) -> Result<()> {
    let sampled: Vec<u64> = (1..=MESSAGES)
        .filter(|number| Message::identity(writer, SequenceNumber(*number)) >> 55 & 1 == 1)
        .collect();
    ensure!(
        sampled.len() as u64 > MESSAGES / 3,
        "{} sampled",
        sampled.len()
    );
    let all = |text: &str, name: &str| {
        let spans = spans(text, name);
        sampled.iter().all(|number| spans.contains_key(number))
    };
    let text = at_robot.wait_for("all sent are traced", |text| all(text, "send /truth"));
    let sent = spans(&text, "send /truth");
    let text = at_monitor.wait_for("all received are traced", |text| {
        all(text, "receive /truth")
    });
    let received = spans(&text, "receive /truth");
    ensure!(sent.len() == sampled.len() && received.len() == sampled.len());
    for (number, sent) in &sent {
        let received = received.get(number).context("not received")?;
        ensure!(field(sent, "Trace ID")? == field(received, "Trace ID")?);
        ensure!(field(sent, "ID")? == field(received, "Parent ID")?);
        let trace = format!(
            "{:032x}",
            Message::identity(writer, SequenceNumber(*number))
        );
        ensure!(field(sent, "Trace ID")? == trace);
    }
    Ok(())
}

fn guid(text: &str) -> Result<Guid> {
    let (prefix, entity) = text.split_at_checked(24).context("no GUID")?;
    let prefix = hexadecimal(prefix).map(GuidPrefix);
    let entity = hexadecimal(entity).map(EntityId);
    let (prefix, entity) = prefix.zip(entity).context("no GUID")?;
    Ok(Guid::new(prefix, entity))
}
