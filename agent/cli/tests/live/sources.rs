//! The sources agree: a capture leads to the same counts whether it is replayed from the file or
//! sent again between sockets. There, the host source sees whole datagrams, and the wire source
//! frames.
//!
//! The compared counts are messages, bytes and losses of each topic and of each unknown writer, and
//! the lost sequence numbers of each writer. Times and duplicates are not compared. Times are those
//! of the second sending, and the host sees a copy of duplicates on each side.

mod injection;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use injection::Injection;
use ros2probe_capture::frame_decoder::FrameDecoder;
use ros2probe_capture::pcap::PcapReader;
use ros2probe_capture::reassembly::Limits;
use ros2probe_capture::tcx;
use ros2probe_daemon::config::{Config, Watchlist};
use ros2probe_model::facts::loss::Loss;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_testing::harness::PREFIX;
use ros2probe_testing::harness::cgroup::Cgroup;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::witness::{Witness, WitnessReport};
use ros2probe_wire::Expansion;

/// Configuration that watches every topic, including hidden ones.
const ALL_TOPICS: &str = "watch: ['/**', '/**/_action/*', '/**/_service_event']\n";
/// Longer captures run only if `ROS2PROBE_FIXTURES` names them.
const LONGEST: Duration = Duration::from_secs(60);
/// Captures are sent in half their time. Windows in which gaps may still be filled are long enough.
const SPEED: u32 = 2;
/// Time after which both sources have processed everything.
const SETTLE: Duration = Duration::from_millis(800);

#[test]
fn host_wire_and_file_lead_to_the_same_counts() -> Result<()> {
    let asked = std::env::var_os("ROS2PROBE_FIXTURES").map(PathBuf::from);
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let corpus = asked
        .clone()
        .unwrap_or(here.join("../../../shared/fixtures"));
    let own = captures(&here.join("../testing/data"));
    ensure!(own.len() >= 8, "{own:?}");
    // The corpus also contains the captures of the repository.
    let more = captures(&corpus).into_iter().filter(|path| {
        let end: PathBuf = path.iter().rev().take(3).collect();
        !own.iter()
            .any(|own| own.iter().rev().take(3).collect::<PathBuf>() == end)
    });
    let all: Vec<PathBuf> = own.iter().cloned().chain(more).collect();
    // The captures are prepared one after the other, because what starts while sockets are created
    // would belong to their cgroup.
    let prepared = (0..)
        .zip(&all)
        .map(|(number, path)| Sending::prepare(number, path));
    let prepared: Vec<Sending<'_>> = prepared
        .filter_map(Result::transpose)
        .collect::<Result<_>>()?;
    let outcomes = std::thread::scope(|scope| {
        let compare = |each| scope.spawn(move || Sending::compare(each));
        let running: Vec<_> = prepared.iter().map(compare).collect();
        let outcomes = running.into_iter().map(std::thread::ScopedJoinHandle::join);
        outcomes.collect::<Vec<_>>()
    });
    let mut faults = Vec::new();
    for (sending, outcome) in prepared.iter().zip(outcomes) {
        let capture = sending.capture.display();
        match outcome {
            Ok(Ok(agreed)) => println!("{capture}: {agreed}"),
            Ok(Err(error)) => faults.push(format!("{capture}: {error:#}")),
            Err(_) => faults.push(format!("{capture}: panicked")),
        }
    }
    ensure!(faults.is_empty(), "{}", faults.join("\n"));
    let compared = prepared.len();
    ensure!(compared >= own.len(), "only {compared} can be sent again");
    Ok(())
}

/// A capture about to be sent again.
struct Sending<'a> {
    capture: &'a Path,
    injection: Injection,
    cgroup: Cgroup,
    host: Namespace,
}

impl<'a> Sending<'a> {
    /// Prepares a capture; `None` if it cannot be sent again, or takes too long.
    fn prepare(number: usize, capture: &'a Path) -> Result<Option<Self>> {
        let host = Namespace::isolated()?;
        let cgroup = Cgroup::create(&format!("{PREFIX}-{}-source{number}", std::process::id()))?;
        let injection = Injection::of(capture, &host, &cgroup)
            .with_context(|| capture.display().to_string())?;
        let asked = std::env::var_os("ROS2PROBE_FIXTURES").is_some();
        let sending = injection.filter(|injection| asked || injection.duration() <= LONGEST);
        Ok(sending.map(|injection| Self {
            capture,
            injection,
            cgroup,
            host,
        }))
    }

    /// Compares the sources, and returns a summary.
    fn compare(&self) -> Result<String> {
        let path = self.cgroup.path().display();
        let at_sockets = format!("{ALL_TOPICS}capture: {{source: host, cgroup: {path}}}\n");
        let on_wire = |hook| format!("{ALL_TOPICS}capture: {{source: wire, wire: {hook}}}\n");
        let start = |configuration: &str| Witness::start_on(&self.host, configuration);
        let mut witnesses = vec![
            ("host", start(&at_sockets)?),
            ("packet", start(&on_wire("packet"))?),
        ];
        if tcx::check().is_ok() {
            witnesses.push(("tcx", start(&on_wire("tcx"))?));
        }
        let sent = self.injection.run(SPEED)?;
        std::thread::sleep(SETTLE);
        let file = Counts::replayed(self.capture)?;
        for (source, witness) in &mut witnesses {
            let seen = Counts::counts_of_witness(&witness.finish()?)?;
            let agreed = file.ensure_equal(&seen);
            agreed.with_context(|| format!("file and {source}"))?;
        }
        Ok(format!("{sent} datagrams, {file}"))
    }
}

/// The counts on which all sources must agree.
#[derive(Debug, Default, PartialEq, Eq)]
struct Counts {
    /// Messages, bytes and losses by DDS topic or GUID.
    measured: BTreeMap<String, (u64, u64, u64)>,
    lost: BTreeMap<String, BTreeSet<u64>>,
}

impl Counts {
    fn replayed(capture: &Path) -> Result<Counts> {
        let config = Config::parse(ALL_TOPICS.as_bytes())
            .ok()
            .context("the watchlist")?;
        let mut observer = Observer::new(Settings::default());
        observer.input(Input::Watchlist(Arc::new(Watchlist::new(config.watches)?)));
        let mut feed = FrameDecoder::new(Limits::default());
        feed.run(
            &mut PcapReader::open(capture, Expansion::Limited)?,
            &mut observer,
        )?;
        let losses = observer.journal().losses();
        Ok(Counts::of(&observer.snapshot(feed.last()), losses))
    }

    fn counts_of_witness(testimony: &WitnessReport) -> Result<Counts> {
        testimony.ensure_complete()?;
        Ok(Counts::of(&testimony.end, testimony.losses.iter()))
    }

    fn of<'a>(snapshot: &Snapshot, losses: impl Iterator<Item = &'a Loss>) -> Counts {
        let mut counts = Counts::default();
        for topic in &snapshot.topics {
            if let Some(all) = &topic.measurement {
                let numbers = (all.messages, all.bytes, all.lost);
                counts.measured.insert(topic.dds_name.to_string(), numbers);
            }
        }
        for unknown in &snapshot.unknown_writers {
            let all = &unknown.measurement;
            let numbers = (all.messages, all.bytes, all.lost);
            counts.measured.insert(unknown.guid.to_string(), numbers);
        }
        for loss in losses {
            let lost = counts.lost.entry(loss.writer.to_string()).or_default();
            lost.extend(loss.first.0..=loss.last.0);
        }
        counts
    }

    fn ensure_equal(&self, other: &Counts) -> Result<()> {
        let names: BTreeSet<&String> = self.measured.keys().chain(other.measured.keys()).collect();
        let mut faults = Vec::new();
        for name in names {
            let (one, two) = (self.measured.get(name), other.measured.get(name));
            if one != two {
                faults.push(format!("{name}: {one:?} and {two:?}"));
            }
        }
        if self.lost != other.lost {
            faults.push(format!("lost {:?} and {:?}", self.lost, other.lost));
        }
        ensure!(faults.is_empty(), "{}", faults.join("; "));
        Ok(())
    }
}

impl std::fmt::Display for Counts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let sum = self.measured.values();
        let sum = sum.fold((0, 0), |sum, each| (sum.0 + each.0, sum.1 + each.2));
        write!(
            f,
            "{} messages and {} losses of {} topics",
            sum.0,
            sum.1,
            self.measured.len()
        )
    }
}

/// Returns the captures two levels below `root`; none if it does not exist.
fn captures(root: &Path) -> Vec<PathBuf> {
    let children = |directory: &Path| {
        let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
        let mut paths: Vec<_> = entries.map(|entry| entry.path()).collect();
        paths.sort();
        paths
    };
    // Zenoh does not send RTPS, and the agent does not read RTPS over TCP.
    let directories = children(root)
        .into_iter()
        .filter(|label| !label.ends_with("zenoh") && !label.ends_with("fastrtps-tcp"))
        .flat_map(|label| children(&label));
    let files = directories.flat_map(|directory| children(&directory));
    files
        .filter(|file| file.to_string_lossy().ends_with(".pcap.gz"))
        .collect()
}
