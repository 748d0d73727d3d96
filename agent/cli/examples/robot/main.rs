//! A small robot of real ROS 2 participants (crate `ros2-client` on RustDDS), for machines without
//! ROS. The demo observes it, and the tests count its messages. It behaves like any node and does
//! not communicate with the agent.
//!
//! `lidar`, `base` and `monitor` are the demo's processes. `pub` and `sub` are the test peers,
//! which share their command line and log format with `agent/cli/tests/peers`. `talkers` and
//! `listeners` have many small topics (`crowd`).

use std::fs::File;
use std::io::{BufRead, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, anyhow};
use clap::{Parser, ValueEnum};
use ros2_client::dds::rustdds::{DomainParticipantBuilder, GUID};
use ros2_client::qos::{Durability, History, Reliability, WhenFull};
use ros2_client::{
    Context, MessageTypeName, Name, Node, NodeName, NodeOptions, Publisher, QosProfile,
    ServiceMapping, ServiceTypeName, Subscription,
};
use serde::Serialize;
use serde_json::json;

use crate::messages::{AddTwoIntsRequest, AddTwoIntsResponse, Imu, LaserScan, PointCloud2, Twist};

mod crowd;
mod messages;
mod patience;
mod start;

#[derive(Parser)]
#[command(about = "Demo robot and test peer made of ROS 2 participants in Rust")]
struct Options {
    #[arg(long, value_enum)]
    role: Role,
    /// ROS topic of the `pub` and `sub` roles
    #[arg(long, default_value = "/points")]
    topic: String,
    /// Serialized size of a sample in bytes, encapsulation header included; a multiple of 4
    #[arg(long, default_value_t = 644_000)]
    size: usize,
    #[arg(long, default_value_t = 20.0)]
    rate: f64,
    /// Topics of the `talkers` and `listeners` roles
    #[arg(long, default_value_t = 200)]
    topics: usize,
    /// Samples to send or to receive before exiting; 0 means until a signal
    #[arg(long, default_value_t = 0)]
    count: u64,
    #[arg(long, conflicts_with = "best_effort")]
    reliable: bool,
    #[arg(long)]
    best_effort: bool,
    #[arg(long)]
    transient_local: bool,
    /// History depth (keep last)
    #[arg(long, default_value_t = 10)]
    depth: usize,
    #[arg(long, default_value_t = 0)]
    domain: u16,
    /// Fully qualified node name; each further name gets a silent endpoint on `<topic>_<n>`
    #[arg(long)]
    node: Vec<String>,
    /// Write one JSON object per event to this file
    #[arg(long)]
    log: Option<PathBuf>,
    /// Matched endpoints to wait for before sending
    #[arg(long, default_value_t = 1)]
    peers: usize,
    /// Once matched, wait for a line on standard input before sending
    #[arg(long)]
    hold: bool,
    /// Number of samples after which to wait for a line again, repeatedly; 0 means never
    #[arg(long, default_value_t = 0)]
    stretch: u64,
    /// Seconds to stay after the last sample was sent
    #[arg(long, default_value_t = 1.0)]
    linger: f64,
    /// Bytes of each socket's receive buffer, limited by net.core.rmem_max
    #[arg(long, default_value_t = 4 << 20)]
    receive_buffer: usize,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Role {
    /// `/points` 644 KB at 20 Hz, `/scan` 10 Hz and `/imu` 200 Hz
    Lidar,
    /// Follows `/cmd_vel` and serves `/add_two_ints`
    Base,
    /// Another host's nodes: subscribe to the sensors, send `/cmd_vel`, call the service
    Monitor,
    Pub,
    Sub,
    /// `--topics` topics of an Imu at `--rate`
    Talkers,
    /// Subscribes to the topics of `talkers`
    Listeners,
}

#[tokio::main(worker_threads = 2)]
async fn main() -> Result<()> {
    let options = Options::parse();
    start::watch()?;
    let stop = Arc::new(AtomicBool::new(false));
    let interrupted = tokio::spawn(stop_on_signal(stop.clone()));
    let log = Arc::new(Log::open(&options)?);

    let participant = DomainParticipantBuilder::new(options.domain)
        .socket_receive_buffer_size(options.receive_buffer)
        .build()
        .map_err(|error| anyhow!("cannot create a DDS participant: {error:?}"))?;
    let context = Context::from_domain_participant(participant)
        .map_err(|error| anyhow!("cannot create a ROS context: {error:?}"))?;
    match options.role {
        Role::Lidar => lidar(&context, &stop, interrupted).await?,
        Role::Base => base(&context, interrupted).await?,
        Role::Monitor => monitor(&context, &stop, interrupted).await?,
        Role::Pub => publish(&context, &options, &stop, &log).await?,
        Role::Sub => subscribe(&context, &options, &stop, &log).await?,
        Role::Talkers => crowd::send_all(&context, options.topics, options.rate, &stop).await?,
        Role::Listeners => crowd::receive_all(&context, options.topics, &stop).await?,
    }
    log.write(&json!({"ev": "exit", "t": unix_ns()}));
    Ok(())
}

async fn lidar(
    context: &Context,
    stop: &Arc<AtomicBool>,
    interrupted: tokio::task::JoinHandle<Result<()>>,
) -> Result<()> {
    let sensor = QosProfile::default().history(History::KeepLast { depth: 5 });
    let mut lidar = node(context, "/lidar", NodeOptions::new())?;
    let mut imu = node(context, "/imu_driver", NodeOptions::new())?;
    let points = advertise(&mut lidar, "/points", "sensor_msgs/PointCloud2", &sensor)?;
    let scan = advertise(&mut lidar, "/scan", "sensor_msgs/LaserScan", &sensor)?;
    // RustDDS drops samples that its history overwrites before they are sent. A history of half a
    // second is enough on a busy CPU.
    let patient = QosProfile::default().history(History::KeepLast { depth: 100 });
    let measurements = advertise(&mut imu, "/imu", "sensor_msgs/Imu", &patient)?;
    spin(&mut lidar)?;
    spin(&mut imu)?;
    start::ready();

    let cloud = PointCloud2::with_fields(644_000);
    let sensors = [
        periodic(20.0, stop, move |_| points.publish(cloud.stamped()).is_ok()),
        periodic(10.0, stop, move |_| {
            scan.publish(LaserScan::now(720)).is_ok()
        }),
        periodic(200.0, stop, move |_| {
            measurements.publish(Imu::now()).is_ok()
        }),
    ];
    interrupted.await??;
    join(sensors)
}

async fn base(context: &Context, interrupted: tokio::task::JoinHandle<Result<()>>) -> Result<()> {
    let reliable = reliable(10);
    let mut base = node(context, "/base", NodeOptions::new())?;
    let commands: Subscription<Twist> =
        listen(&mut base, "/cmd_vel", "geometry_msgs/Twist", &reliable)?;
    let server = base
        .create_server::<AddTwoIntsRequest, AddTwoIntsResponse>(
            ServiceMapping::Enhanced,
            &name("/add_two_ints")?,
            &ServiceTypeName::new("example_interfaces", "AddTwoInts"),
            reliable.clone(),
            reliable,
        )
        .map_err(|error| anyhow!("cannot serve /add_two_ints: {error:?}"))?;
    spin(&mut base)?;
    start::ready();

    let drive = tokio::spawn(async move { while commands.async_take().await.is_ok() {} });
    let serve = tokio::spawn(async move {
        while let Ok((id, request)) = server.async_receive_request().await {
            let response = AddTwoIntsResponse {
                sum: request.a.wrapping_add(request.b),
            };
            let _ = server.async_send_response(id, response).await;
        }
    });
    interrupted.await??;
    drive.abort();
    serve.abort();
    Ok(())
}

async fn monitor(
    context: &Context,
    stop: &Arc<AtomicBool>,
    interrupted: tokio::task::JoinHandle<Result<()>>,
) -> Result<()> {
    let sensor = QosProfile::default().history(History::KeepLast { depth: 5 });
    let reliable = reliable(10);
    let mut monitor = node(context, "/operator/monitor", NodeOptions::new())?;
    let mut teleop = node(context, "/operator/teleop", NodeOptions::new())?;
    let points: Subscription<PointCloud2> =
        listen(&mut monitor, "/points", "sensor_msgs/PointCloud2", &sensor)?;
    let scan: Subscription<LaserScan> =
        listen(&mut monitor, "/scan", "sensor_msgs/LaserScan", &sensor)?;
    let imu: Subscription<Imu> = listen(&mut monitor, "/imu", "sensor_msgs/Imu", &sensor)?;
    let commands = advertise(&mut teleop, "/cmd_vel", "geometry_msgs/Twist", &reliable)?;
    let client = teleop
        .create_client::<AddTwoIntsRequest, AddTwoIntsResponse>(
            ServiceMapping::Enhanced,
            &name("/add_two_ints")?,
            &ServiceTypeName::new("example_interfaces", "AddTwoInts"),
            reliable.clone(),
            reliable,
        )
        .map_err(|error| anyhow!("cannot create a client of /add_two_ints: {error:?}"))?;
    spin(&mut monitor)?;
    spin(&mut teleop)?;
    start::ready();

    let tasks = [
        tokio::spawn(async move { while points.async_take().await.is_ok() {} }),
        tokio::spawn(async move { while scan.async_take().await.is_ok() {} }),
        tokio::spawn(async move { while imu.async_take().await.is_ok() {} }),
        tokio::spawn(async move {
            let mut second = tokio::time::interval(Duration::from_secs(1));
            for a in 0.. {
                second.tick().await;
                let call = client.async_call_service(AddTwoIntsRequest { a, b: 1 });
                let _ = tokio::time::timeout(Duration::from_secs(1), call).await;
            }
        }),
    ];
    let driving = periodic(10.0, stop, move |count| {
        commands.publish(Twist::turning(count)).is_ok()
    });
    interrupted.await??;
    for task in tasks {
        task.abort();
    }
    join([driving])
}

/// Runs the `pub` role: waits for its peers, sends `count` samples at `rate`, and logs each.
async fn publish(
    context: &Context,
    options: &Options,
    stop: &Arc<AtomicBool>,
    log: &Arc<Log>,
) -> Result<()> {
    let qos = options.qos();
    let mut silent: Vec<Publisher<PointCloud2>> = Vec::new();
    let mut nodes = Vec::new();
    let mut first = None;
    for (index, full_name) in options.nodes("publisher").iter().enumerate() {
        let mut node = node(context, full_name, bare())?;
        let topic = options.topic_of(index);
        let publisher = advertise(&mut node, &topic, "sensor_msgs/PointCloud2", &qos)?;
        log.endpoint("pub", publisher.guid(), &topic, full_name);
        match index {
            0 => first = Some(Arc::new(publisher)),
            _ => silent.push(publisher),
        }
        spin(&mut node)?;
        nodes.push(node);
    }
    let (publisher, node) = first.zip(nodes.first()).context("no node was created")?;
    start::ready();
    while publisher.get_subscription_count(node) < options.peers {
        if stop.load(Ordering::Relaxed) {
            return Ok(());
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    println!("matched");
    options.wait_for_start().await?;

    let cloud = PointCloud2::of_serialized_size(options.size)?;
    let (count, size) = (options.count, options.size);
    let logging = log.clone();
    let writer = publisher.clone();
    let (rate, stretch) = (options.rate, options.stretch);
    let send = move |sequence| {
        if count > 0 && sequence >= count {
            return false;
        }
        let began = unix_ns();
        let sent = writer.publish(cloud.numbered(sequence)).is_ok();
        let event = if sent { "pub" } else { "pub_failed" };
        let done = unix_ns();
        logging
            .write(&json!({"ev": event, "t": began, "done": done, "seq": sequence, "len": size}));
        true
    };
    match stretch {
        0 => {
            let sending = periodic(rate, stop, send);
            tokio::task::spawn_blocking(move || join([sending])).await??;
        }
        _ => {
            for first in (0..count).step_by(usize::try_from(stretch)?) {
                if first > 0 {
                    wait_for_line().await?;
                }
                let send = send.clone();
                let next = move |index| index < stretch && send(first + index);
                let sending = periodic(rate, stop, next);
                tokio::task::spawn_blocking(move || join([sending])).await??;
            }
        }
    }
    log.write(&json!({"ev": "stop", "t": unix_ns()}));
    println!("done");
    let leave = Instant::now() + Duration::from_secs_f64(options.linger.max(0.0));
    while Instant::now() < leave && !stop.load(Ordering::Relaxed) {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    Ok(())
}

/// Runs the `sub` role: logs every received sample with the writer's sequence number.
async fn subscribe(
    context: &Context,
    options: &Options,
    stop: &Arc<AtomicBool>,
    log: &Arc<Log>,
) -> Result<()> {
    let qos = options.qos();
    let mut silent: Vec<Subscription<PointCloud2>> = Vec::new();
    let mut nodes = Vec::new();
    let mut first = None;
    for (index, full_name) in options.nodes("subscriber").iter().enumerate() {
        let mut node = node(context, full_name, bare())?;
        let topic = options.topic_of(index);
        let subscription = listen(&mut node, &topic, "sensor_msgs/PointCloud2", &qos)?;
        log.endpoint("sub", subscription.guid(), &topic, full_name);
        match index {
            0 => first = Some(subscription),
            _ => silent.push(subscription),
        }
        spin(&mut node)?;
        nodes.push(node);
    }
    let (subscription, node) = first.zip(nodes.first()).context("no node was created")?;
    start::ready();
    let mut matched = false;
    let mut received = 0;
    while !stop.load(Ordering::Relaxed) && (options.count == 0 || received < options.count) {
        if !matched && subscription.get_publisher_count(node) >= options.peers {
            matched = true;
            println!("matched");
        }
        let next = subscription.async_take();
        let Ok(taken) = tokio::time::timeout(Duration::from_millis(20), next).await else {
            continue;
        };
        let (cloud, info) = match taken {
            Ok(taken) => taken,
            Err(error) => {
                log.write(&json!({"ev": "error", "t": unix_ns(), "what": format!("{error:?}")}));
                continue;
            }
        };
        received += 1;
        let stamp_ns = cloud.header.stamp.to_nanos();
        log.write(&json!({
            "ev": "sub", "t": unix_ns(), "seq": cloud.sequence(), "sn": info.sequence_number(),
            "len": cloud.serialized_size(), "stamp_ns": stamp_ns,
        }));
    }
    log.write(&json!({"ev": "stop", "t": unix_ns()}));
    println!("done");
    Ok(())
}

impl Options {
    fn qos(&self) -> QosProfile {
        let reliability = match self.best_effort {
            true => Reliability::BestEffort,
            false => Reliability::Reliable {
                when_full: WhenFull::DEFAULT,
            },
        };
        let durability = match self.transient_local {
            true => Durability::TransientLocal,
            false => Durability::Volatile,
        };
        QosProfile::default()
            .reliability(reliability)
            .durability(durability)
            .history(History::KeepLast { depth: self.depth })
    }

    fn nodes(&self, default: &str) -> Vec<String> {
        match self.node.is_empty() {
            true => vec![format!("/{default}")],
            false => self.node.clone(),
        }
    }

    fn topic_of(&self, node_index: usize) -> String {
        match node_index {
            0 => self.topic.clone(),
            index => format!("{}_{index}", self.topic),
        }
    }

    async fn wait_for_start(&self) -> Result<()> {
        if !self.hold {
            tokio::time::sleep(Duration::from_millis(500)).await;
            return Ok(());
        }
        wait_for_line().await
    }
}

async fn wait_for_line() -> Result<()> {
    tokio::task::spawn_blocking(|| {
        let mut line = String::new();
        match std::io::stdin().lock().read_line(&mut line) {
            Ok(read) if read > 0 => Ok(()),
            _ => Err(anyhow!("standard input ended before the start")),
        }
    })
    .await?
}

/// The event log: one JSON object per line. Each line is flushed immediately, so that a killed
/// process leaves a complete log.
struct Log {
    file: Option<Mutex<File>>,
}

impl Log {
    fn open(options: &Options) -> Result<Log> {
        let Some(path) = &options.log else {
            return Ok(Log { file: None });
        };
        let file =
            File::create(path).with_context(|| format!("cannot create {}", path.display()))?;
        let log = Log {
            file: Some(Mutex::new(file)),
        };
        let pid = std::process::id();
        log.write(&json!({"ev": "start", "stack": "rustdds", "pid": pid, "t": unix_ns()}));
        Ok(log)
    }

    fn endpoint(&self, kind: &str, guid: GUID, topic: &str, node: &str) {
        let guid: String = guid
            .to_bytes()
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect();
        self.write(&json!({
            "ev": "endpoint", "kind": kind, "guid": guid, "topic": topic, "node": node,
            "t": unix_ns(),
        }));
    }

    fn write(&self, event: &serde_json::Value) {
        if let Some(Ok(mut file)) = self.file.as_ref().map(Mutex::lock) {
            let _ = file.write_all(format!("{event}\n").as_bytes());
        }
    }
}

fn reliable(depth: usize) -> QosProfile {
    QosProfile::default()
        .reliability_reliable(WhenFull::DEFAULT)
        .history(History::KeepLast { depth })
}

fn bare() -> NodeOptions {
    NodeOptions::new()
        .enable_rosout(false)
        .start_parameter_services(false)
}

fn node(context: &Context, full_name: &str, options: NodeOptions) -> Result<Node> {
    let (namespace, base) = full_name
        .rsplit_once('/')
        .with_context(|| format!("{full_name} is not absolute"))?;
    let namespace = if namespace.is_empty() { "/" } else { namespace };
    let name = NodeName::new(namespace, base)
        .map_err(|error| anyhow!("{full_name} is not a node name: {error:?}"))?;
    context
        .new_node(name, options)
        .map_err(|error| anyhow!("cannot create {full_name}: {error:?}"))
}

fn name(topic: &str) -> Result<Name> {
    Name::parse(topic).map_err(|error| anyhow!("{topic} is not a topic name: {error:?}"))
}

fn message_type(name: &str) -> Result<MessageTypeName> {
    let (package, message) = name
        .split_once('/')
        .with_context(|| format!("{name} is not package/Message"))?;
    Ok(MessageTypeName::new(package, message))
}

fn advertise<M: Serialize>(
    node: &mut Node,
    topic: &str,
    type_name: &str,
    qos: &QosProfile,
) -> Result<Publisher<M>> {
    let dds_topic = node
        .create_topic(&name(topic)?, message_type(type_name)?, qos)
        .map_err(|error| anyhow!("cannot create {topic}: {error:?}"))?;
    node.create_publisher(&dds_topic, None)
        .map_err(|error| anyhow!("cannot publish {topic}: {error:?}"))
}

fn listen<M: 'static>(
    node: &mut Node,
    topic: &str,
    type_name: &str,
    qos: &QosProfile,
) -> Result<Subscription<M>> {
    let dds_topic = node
        .create_topic(&name(topic)?, message_type(type_name)?, qos)
        .map_err(|error| anyhow!("cannot create {topic}: {error:?}"))?;
    node.create_subscription(&dds_topic, None)
        .map_err(|error| anyhow!("cannot subscribe to {topic}: {error:?}"))
}

fn spin(node: &mut Node) -> Result<()> {
    let spinner = node
        .spinner()
        .map_err(|error| anyhow!("cannot spin a node: {error:?}"))?;
    tokio::spawn(spinner.spin());
    Ok(())
}

/// Calls `action` with 0, 1, 2, ... at `rate` until it returns `false` or the process is stopped.
/// Deadlines are absolute: a late call does not delay later ones.
fn periodic(
    rate: f64,
    stop: &Arc<AtomicBool>,
    mut action: impl FnMut(u64) -> bool + Send + 'static,
) -> std::thread::JoinHandle<()> {
    let stop = stop.clone();
    std::thread::spawn(move || {
        let began = Instant::now();
        for count in 0.. {
            let due = Duration::from_secs_f64(count as f64 / rate.max(0.001));
            while let Some(left) = due.checked_sub(began.elapsed()) {
                if stop.load(Ordering::Relaxed) {
                    return;
                }
                std::thread::sleep(left.min(Duration::from_millis(50)));
            }
            if stop.load(Ordering::Relaxed) || !action(count) {
                return;
            }
        }
    })
}

fn join(threads: impl IntoIterator<Item = std::thread::JoinHandle<()>>) -> Result<()> {
    for thread in threads {
        thread
            .join()
            .map_err(|_| anyhow!("a publishing thread panicked"))?;
    }
    Ok(())
}

async fn stop_on_signal(stop: Arc<AtomicBool>) -> Result<()> {
    use tokio::signal::unix::{SignalKind, signal};
    let mut terminate = signal(SignalKind::terminate())?;
    tokio::select! {
        _ = terminate.recv() => {}
        interrupted = tokio::signal::ctrl_c() => interrupted?,
    }
    stop.store(true, Ordering::Relaxed);
    Ok(())
}

fn unix_ns() -> u64 {
    let since_epoch = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    u64::try_from(since_epoch.as_nanos()).unwrap_or(u64::MAX)
}
