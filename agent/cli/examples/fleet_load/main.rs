//! `make fleet-bench`: an engine on this machine, and as many agents as it is given. Each agent is
//! the remote write of the product, with the series of a full robot whose figures change, in a
//! thread of this process. The table shows what the engine needs.
//!
//! One topic of each agent gets another name each minute, so that series end and begin.

use std::fmt;
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::pin::Pin;
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use clap::{Parser, ValueEnum};
use ros2probe_daemon::agent_facts::SourceKind;
use ros2probe_daemon::settings_cell::Settings;
use ros2probe_daemon::surface::{Exposition, Format, MetricSources};
use ros2probe_metrics::export_thread::ExportThread;
use ros2probe_metrics::metric_sink::MetricSink;
use ros2probe_metrics::metric_source::MetricSource;
use ros2probe_metrics::otlp::Host;
use ros2probe_metrics::remote_write::{self, RemoteWriteSettings, Request, SampleFate};
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_testing::{ports, sample_robot};

#[derive(Parser)]
#[command(about = "Measures an engine under the remote write of many agents")]
struct Options {
    /// Numbers of agents, one run for each
    #[arg(long, value_delimiter = ',', default_values_t = [10, 50, 100])]
    agents: Vec<usize>,
    /// Topics of each agent
    #[arg(long, default_value_t = 3)]
    topics: usize,
    /// Length of the measured part of a run
    #[arg(long, default_value_t = 30)]
    seconds: u64,
    /// Interval of samples in seconds
    #[arg(long, default_value_t = 5)]
    interval: u64,
    /// Engines
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = [Kind::Prometheus, Kind::VictoriaMetrics])]
    engine: Vec<Kind>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Kind {
    Prometheus,
    VictoriaMetrics,
}

/// A running engine; dropping the value kills it.
struct Engine {
    child: Child,
    address: SocketAddr,
}

/// A robot whose figures change with each collection.
#[derive(Debug)]
struct Robot {
    sources: MetricSources,
    begun: Instant,
    collections: AtomicU64,
    /// State at the start.
    first: Snapshot,
}

fn main() -> ExitCode {
    match measure(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("fleet_load: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn measure(options: &Options) -> Result<()> {
    println!(
        "| engine | agents | series of an agent | samples/s | cores | memory | bytes/sample | behind | refused |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- | --- |");
    for kind in &options.engine {
        for agents in &options.agents {
            run(*kind, *agents, options)?;
        }
    }
    Ok(())
}

fn run(kind: Kind, count: usize, options: &Options) -> Result<()> {
    let directory = tempfile::tempdir()?;
    let engine = Engine::start(kind, directory.path())?;
    let mut agents = Vec::with_capacity(count);
    let mut figures = Vec::with_capacity(count);
    for number in 0..count {
        let robot = Robot::new(options.topics);
        figures.push(Arc::clone(&robot.sources.remote_write));
        agents.push(robot.deliver(number, engine.address, options)?);
    }
    let series = Exposition::new(Robot::new(options.topics)).render(Format::Classic)?;
    let series = series.lines().filter(|line| !line.starts_with('#')).count();
    // All agents have begun, and the engine knows all series.
    std::thread::sleep(Duration::from_secs(2 * options.interval));
    let sum = |read: &dyn Fn(&remote_write::Figures) -> u64| -> u64 {
        figures.iter().map(|figures| read(figures)).sum()
    };
    let state = || {
        let samples = sum(&|figures| figures.samples(SampleFate::Delivered));
        let bytes = sum(&remote_write::Figures::sent_bytes);
        Ok::<_, anyhow::Error>((samples, bytes, engine.cpu()?, Instant::now()))
    };
    let (samples, bytes, cpu, begun) = state()?;
    std::thread::sleep(Duration::from_secs(options.seconds));
    let (samples_after, bytes_after, cpu_after, ended) = state()?;
    let elapsed = (ended - begun).as_secs_f64();
    let samples = samples_after - samples;
    let behind = figures
        .iter()
        .map(|figures| figures.lag_seconds())
        .fold(0.0, f64::max);
    let refused = sum(&|figures| figures.requests(Request::Refused));
    let real = |count: u64| f64::from(u32::try_from(count).unwrap_or(u32::MAX));
    println!(
        "| {kind} | {count} | {series} | {:.0} | {:.2} | {} MB | {:.1} | {behind:.0} s | {refused} |",
        real(samples) / elapsed,
        (cpu_after - cpu) / elapsed,
        engine.memory()? >> 20,
        real(bytes_after - bytes) / real(samples).max(1.0),
    );
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    agents.iter().for_each(ExportThread::stop);
    runtime.block_on(async {
        for agent in agents {
            agent.finish().await;
        }
    });
    Ok(())
}

impl Robot {
    fn new(topics: usize) -> Self {
        let settings = Settings {
            histograms: true,
            ..Settings::default()
        };
        let names: Vec<String> = (0..topics)
            .map(|topic| format!("/sensor_{topic}"))
            .collect();
        let robot = Self {
            sources: MetricSources::new(SourceKind::Wire, settings),
            begun: Instant::now(),
            collections: AtomicU64::new(0),
            first: sample_robot::snapshot(names.iter().map(String::as_str)),
        };
        robot.publish();
        robot
    }

    /// Publishes figures that are those of the time, as of topics with 20 messages a second.
    fn publish(&self) {
        let count = self.collections.fetch_add(1, Ordering::Relaxed);
        let minute = self.begun.elapsed().as_secs() / 60;
        let mut snapshot = self.first.clone();
        if let Some(topic) = snapshot.topics.first_mut() {
            topic.name = format!("/restarted_{minute}").as_str().into();
        }
        for (index, topic) in snapshot.topics.iter_mut().enumerate() {
            if let Some(measurement) = &mut topic.measurement {
                // Real intervals have neither the same number of messages nor the same sizes.
                let messages = count * 100 + (count * 7 + index as u64 * 13) % 5;
                measurement.messages += messages;
                measurement.bytes += messages * 640_000 + (count * 31) % 977;
                measurement.rate_hz += f64::from(u32::try_from(count % 17).unwrap_or(0)) / 100.0;
                for step in 0..messages % 50 {
                    let seconds = Duration::from_micros(step * 97).as_secs_f64();
                    measurement.source_latency.observe(seconds);
                    measurement.interarrival.observe(seconds * 10.0);
                }
            }
        }
        self.sources.latest.publish(snapshot, sample_robot::agent());
    }

    /// Starts remote write of this robot.
    fn deliver(self, number: usize, to: SocketAddr, options: &Options) -> Result<ExportThread> {
        let settings = RemoteWriteSettings {
            url: Some(format!("http://{to}/api/v1/write")),
            interval: Duration::from_secs(options.interval),
            instance: Some(format!("robot-{number}")),
            ..RemoteWriteSettings::default()
        };
        let host = Host::default();
        let read = |path: &Path, _| std::fs::read_to_string(path);
        let settings = remote_write::Settings::resolve(&settings, read, &host)?;
        let figures = Arc::clone(&self.sources.remote_write);
        let inputs = remote_write::Inputs {
            metrics: Arc::new(self),
            figures,
            directory: None,
        };
        let settings = settings.context("no settings")?;
        Ok(remote_write::start(settings, inputs, |thread, work| {
            thread.spawn(work)
        })?)
    }
}

impl MetricSource for Robot {
    fn collect(&self, sink: &mut MetricSink<'_>, previous: Duration) -> fmt::Result {
        self.publish();
        self.sources.collect(sink, previous)
    }

    fn has_exemplars(&self) -> bool {
        false
    }

    fn refresh(&self, _: Duration) -> Pin<Box<dyn Future<Output = ()> + '_>> {
        Box::pin(std::future::ready(()))
    }
}

impl Engine {
    fn start(kind: Kind, directory: &Path) -> Result<Self> {
        let address = ports::free_address();
        let data = directory.join("data");
        let mut command = match kind {
            Kind::Prometheus => {
                let file = directory.join("prometheus.yaml");
                std::fs::write(&file, "global: {scrape_interval: 5s}\n")?;
                let mut command = Command::new("prometheus");
                command
                    .arg(format!("--config.file={}", file.display()))
                    .arg(format!("--storage.tsdb.path={}", data.display()))
                    .arg(format!("--web.listen-address={address}"))
                    .args(["--web.enable-remote-write-receiver", "--log.level=error"]);
                command
            }
            Kind::VictoriaMetrics => {
                let mut command = Command::new("victoria-metrics");
                command
                    .arg(format!("-storageDataPath={}", data.display()))
                    .arg(format!("-httpListenAddr={address}"))
                    .arg("-loggerLevel=ERROR");
                command
            }
        };
        let child = command.stdout(Stdio::null()).spawn();
        let child = child.context("the engine: run `.ci/prerequisites.sh fleet`")?;
        let engine = Self { child, address };
        let deadline = Instant::now() + Duration::from_secs(20);
        while TcpStream::connect(address).is_err() {
            ensure!(Instant::now() < deadline, "the engine does not listen");
            std::thread::sleep(Duration::from_millis(50));
        }
        Ok(engine)
    }

    /// Returns its CPU time in seconds.
    fn cpu(&self) -> Result<f64> {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id()))?;
        let fields = stat.rsplit_once(") ").context("no state")?.1;
        let ticks = fields.split(' ').skip(11).take(2);
        let ticks: f64 = ticks.filter_map(|ticks| ticks.parse::<f64>().ok()).sum();
        // The kernel shows hundredths of a second to programs, whatever its own tick is.
        Ok(ticks / 100.0)
    }

    /// Returns its resident memory in bytes.
    fn memory(&self) -> Result<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id()))?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        let kibibytes =
            line.and_then(|line| line.trim().trim_end_matches(" kB").parse::<u64>().ok());
        Ok(kibibytes.context("no memory")? << 10)
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Prometheus => "prometheus",
            Self::VictoriaMetrics => "victoria-metrics",
        })
    }
}
