//! The cost of observing real nodes of rmw_zenoh, alternately without an observer, with the agent
//! and with `ros2 topic hz` (`make bench-ros2`). Needs root and ROS 2.

use std::fs::File;
use std::time::Duration;

use anyhow::{Result, ensure};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::soak::median;
use ros2probe_testing::harness::usage::Usage;

use crate::counting::{log, publish, publisher, subscription};
use crate::host::{Host, Middleware};

const SECONDS: u64 = 10;

/// A publisher and its subscription.
struct Workload {
    name: &'static str,
    messages_per_second: u64,
    bytes: u64,
}

const WORKLOADS: [Workload; 2] = [
    Workload {
        name: "300 B at 1 kHz",
        messages_per_second: 1000,
        bytes: 300,
    },
    Workload {
        name: "2.72 MB at 20 Hz",
        messages_per_second: 20,
        bytes: 2_720_000,
    },
];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Observer {
    None,
    Agent,
    Subscriber,
}

/// CPU seconds in [`SECONDS`] of publishing.
#[derive(Clone, Copy, Debug)]
struct Cost {
    /// CPU seconds of publisher and subscription.
    nodes: f64,
    observer: f64,
}

fn cpu(process: Option<&Process>) -> Result<Duration> {
    process.map_or(Ok(Duration::ZERO), |process| {
        Ok(Usage::of(process.pid())?.cpu)
    })
}

fn measure(workload: &Workload, observer: Observer) -> Result<Cost> {
    let network = Namespace::isolated()?;
    let host = Host::new(&network, Middleware::Zenoh)?;
    let agent = match observer {
        Observer::Agent => Some(host.agent("watch: ['/**']\n")?),
        Observer::None | Observer::Subscriber => None,
    };
    let _router = host.router("")?;
    let [rate, bytes] = [workload.messages_per_second, workload.bytes].map(|it| it.to_string());
    let mut sensor = publisher(
        &host,
        "sensor",
        "/data",
        &[&rate, &bytes, "100", "RELIABLE"],
    )?;
    let mut listener = subscription(&host, "listener", "/data", &["100", "RELIABLE"])?;
    let tool = match observer {
        Observer::Subscriber => {
            let line = format!("exec ros2 topic hz /data >{}", host.path("hz"));
            Some(host.run(&line, &[], File::create(host.file("hz.err"))?.into())?)
        }
        Observer::None | Observer::Agent => None,
    };
    sensor.wait_for("matched", Duration::from_secs(60))?;
    // Waits until `ros2 topic hz` has begun.
    std::thread::sleep(Duration::from_secs(3));
    let warm_up = workload.messages_per_second;
    publish(&mut sensor, warm_up, warm_up)?;
    let observing = agent.as_ref().map(|agent| &agent.process).or(tool.as_ref());
    let now = |sensor: &Process, listener: &Process| -> Result<[Duration; 2]> {
        Ok([cpu(Some(sensor))? + cpu(Some(listener))?, cpu(observing)?])
    };
    let before = now(&sensor, &listener)?;
    let messages = SECONDS * workload.messages_per_second;
    publish(&mut sensor, messages, warm_up + messages)?;
    std::thread::sleep(Duration::from_millis(500));
    let after = now(&sensor, &listener)?;
    let received = log(&mut listener)?.received;
    ensure!(received == warm_up + messages, "{received} received");
    if let Some(agent) = agent {
        let counted = agent
            .scrape()?
            .sum("ros2_topic_messages_total", &[("topic", "/data")]);
        ensure!(counted == received as f64, "{counted} of {received}");
    }
    let [nodes, observer] = [0, 1].map(|index| (after[index] - before[index]).as_secs_f64());
    Ok(Cost { nodes, observer })
}

#[test]
#[ignore = "a benchmark: make bench-ros2"]
fn the_cpu_of_the_agent_and_of_a_subscriber_beside_zenoh_is_measured() -> Result<()> {
    let rounds = std::env::var("ROUNDS").map_or(Ok(3), |rounds| rounds.parse())?;
    println!(
        "CPU seconds in {SECONDS} s, medians of {rounds}: nodes, observer, nodes against none"
    );
    for workload in &WORKLOADS {
        let observers = [Observer::None, Observer::Agent, Observer::Subscriber];
        let mut costs = [const { Vec::new() }; 3];
        for _ in 0..rounds {
            for (costs, observer) in costs.iter_mut().zip(observers) {
                costs.push(measure(workload, observer)?);
            }
        }
        for (index, observer) in observers.into_iter().enumerate() {
            let ratios = costs[index].iter().zip(&costs[0]);
            println!(
                "{}, {observer:?}: {:.2} {:.3} {:.3}",
                workload.name,
                median(costs[index].iter().map(|cost| cost.nodes).collect()),
                median(costs[index].iter().map(|cost| cost.observer).collect()),
                median(ratios.map(|(cost, none)| cost.nodes / none.nodes).collect()),
            );
        }
    }
    Ok(())
}
