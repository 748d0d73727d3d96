//! Length of endurance tests, the agent's resource usage over time, and its report: the same tests
//! run for seconds in `make test` and for an hour in `make soak`.

use std::fmt::Write as _;
use std::fs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};

use super::agent::{METRICS, Scrape, get};
use super::network::Namespace;
use super::usage::Usage;

/// Variable that is set for the long run.
const SOAK: &str = "ROS2PROBE_SOAK";
/// Variable with the length of the long run in seconds; an hour if unset.
const SECONDS: &str = "ROS2PROBE_SOAK_SECONDS";
/// Variable with the path of `rp`, if it is not the one that the tests build.
const PROGRAM: &str = "ROS2PROBE_SOAK_PROGRAM";
/// Variable with the directory of results; `target/soak` if unset.
const RESULTS: &str = "ROS2PROBE_SOAK_RESULTS";

/// Returns the length of the long run; `None` in `make test`.
pub fn long() -> Option<Duration> {
    let is_set = std::env::var_os(SOAK).is_some_and(|value| !value.is_empty() && value != "0");
    let seconds = std::env::var(SECONDS)
        .ok()
        .and_then(|text| text.parse().ok());
    is_set.then(|| Duration::from_secs(seconds.unwrap_or(3600)))
}

/// Returns the agent's program: `built` unless the environment names another.
pub fn program(built: &str) -> PathBuf {
    std::env::var_os(PROGRAM).map_or_else(|| built.into(), Into::into)
}

/// Returns the directory of the long run's results.
pub fn results() -> Result<PathBuf> {
    let target = crate::repository("target");
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or(target, Into::into);
    let directory = std::env::var_os(RESULTS).map_or_else(|| target.join("soak"), Into::into);
    fs::create_dir_all(&directory)
        .with_context(|| format!("cannot create {}", directory.display()))?;
    Ok(directory)
}

/// Resource usage of an agent at one time.
#[derive(Clone, Copy, Debug, Default)]
pub struct Need {
    pub seconds: f64,
    pub participants: f64,
    pub topics: f64,
    pub unreclaimable: u64,
    pub cpu: f64,
    pub descriptors: usize,
    pub threads: usize,
    /// Memory of its BPF programs and maps.
    pub kernel_bytes: u64,
    pub page_bytes: usize,
    pub dropped: f64,
    /// Age of the agent's snapshot, in seconds.
    pub age: f64,
}

impl Need {
    fn of(pid: u32, host: &Namespace, since: Instant) -> Result<Need> {
        let usage = Usage::of(pid)?;
        let page = Scrape(get(host, &format!("{METRICS}/metrics"))?);
        let count = |what: &str| -> Result<usize> {
            Ok(fs::read_dir(format!("/proc/{pid}/{what}"))?.count())
        };
        Ok(Need {
            seconds: since.elapsed().as_secs_f64(),
            participants: page.sum("ros2_participants", &[]),
            topics: page.sum("ros2_topics", &[]),
            unreclaimable: usage.memory.unreclaimable,
            cpu: usage.cpu.as_secs_f64(),
            descriptors: count("fd")?,
            threads: count("task")?,
            kernel_bytes: kernel_bytes(pid)?,
            page_bytes: page.0.len(),
            dropped: dropped(&page),
            age: page.sum("ros2probe_snapshot_age_seconds", &[]),
        })
    }
}

/// Returns the number of packets and records that the kernel could not deliver to the agent.
pub fn dropped(page: &Scrape) -> f64 {
    page.sum("ros2probe_capture_dropped_packets_total", &[])
        + page.sum("ros2probe_records_dropped_total", &[])
}

/// Returns the memory of the BPF objects held by a process, as the kernel reports it.
fn kernel_bytes(pid: u32) -> Result<u64> {
    let mut bytes = 0;
    for entry in fs::read_dir(format!("/proc/{pid}/fdinfo"))? {
        // A descriptor may be closed between listing and reading.
        let text = fs::read_to_string(entry?.path()).unwrap_or_default();
        let locked = text
            .lines()
            .filter_map(|line| line.strip_prefix("memlock:"));
        bytes += locked
            .filter_map(|it| it.trim().parse::<u64>().ok())
            .sum::<u64>();
    }
    Ok(bytes)
}

/// An agent's resource usage over time.
#[derive(Clone, Debug)]
pub struct Curve {
    pub name: &'static str,
    pub needs: Vec<Need>,
}

impl Curve {
    /// Samples the usage until `stop` is set, and logs it once per minute.
    pub fn draw(
        name: &'static str,
        (pid, host): (u32, &Namespace),
        period: Duration,
        stop: &AtomicBool,
    ) -> Result<Curve> {
        let since = Instant::now();
        let (mut needs, mut next, mut logged) = (Vec::new(), since, since);
        while !stop.load(Ordering::Relaxed) {
            if Instant::now() < next {
                std::thread::sleep(Duration::from_millis(50));
                continue;
            }
            next = Instant::now() + period;
            let need = Need::of(pid, host, since)?;
            if logged.elapsed() >= Duration::from_secs(60) {
                logged = Instant::now();
                eprintln!("{name}: {need}");
            }
            needs.push(need);
        }
        Ok(Curve { name, needs })
    }

    /// Returns the median memory of each minute with a large graph, after the first `skipped`
    /// seconds.
    fn minutes(&self, skipped: f64) -> Vec<(f64, f64)> {
        let largest = self.needs.iter().map(|need| need.participants);
        let large = largest.fold(0.0, f64::max) * 0.9;
        let mut minutes = std::collections::BTreeMap::<u64, Vec<f64>>::new();
        let late = self.needs.iter().filter(|need| need.seconds >= skipped);
        for need in late.filter(|need| need.participants >= large) {
            let minute = minutes.entry((need.seconds / 60.0) as u64).or_default();
            minute.push(need.unreclaimable as f64);
        }
        let points = minutes.into_iter();
        points
            .map(|(minute, unreclaimable)| (minute as f64, median(unreclaimable)))
            .collect()
    }

    /// Returns the growth of its memory over the whole time as a fraction: by the median of all
    /// slopes between two minutes (Theil and Sen), and by comparing the last tenth with the first.
    pub fn growth(&self, skipped: f64) -> Option<(f64, f64)> {
        let minutes = self.minutes(skipped);
        let (first, last) = (minutes.first()?, minutes.last()?);
        let mut slopes = Vec::new();
        for (index, one) in minutes.iter().enumerate() {
            let later = minutes.iter().skip(index + 1);
            slopes.extend(later.map(|other| (other.1 - one.1) / (other.0 - one.0)));
        }
        let tenth = (minutes.len() / 10).max(1);
        let unreclaimable =
            |part: &[(f64, f64)]| median(part.iter().map(|point| point.1).collect());
        let (begin, end) = (
            unreclaimable(minutes.get(..tenth)?),
            unreclaimable(minutes.get(minutes.len() - tenth..)?),
        );
        (!slopes.is_empty()).then(|| {
            let slope = median(slopes) * (last.0 - first.0) / begin;
            (slope, end / begin - 1.0)
        })
    }

    /// Fails if any usage other than memory is higher in the second half than in the first.
    pub fn is_level(&self) -> Result<()> {
        let middle = self.needs.len() / 2;
        let (early, late) = self.needs.split_at(middle);
        let most =
            |part: &[Need], what: fn(&Need) -> f64| part.iter().map(what).fold(0.0, f64::max);
        type Kind = (&'static str, fn(&Need) -> f64, f64);
        let kinds: [Kind; 4] = [
            // A scrape may have a connection open during the count.
            ("descriptors", |need| need.descriptors as f64, 4.0),
            ("threads", |need| need.threads as f64, 1.0),
            // Hash maps grow with their entries.
            (
                "bytes of BPF objects",
                |need| need.kernel_bytes as f64,
                0.02 * most(early, |need| need.kernel_bytes as f64),
            ),
            (
                "bytes a page",
                |need| need.page_bytes as f64,
                0.1 * most(early, |need| need.page_bytes as f64),
            ),
        ];
        for (what, of, slack) in kinds {
            let (before, after) = (most(early, of), most(late, of));
            ensure!(
                after <= before + slack,
                "{}: {before} {what}, then {after}",
                self.name
            );
        }
        Ok(())
    }
}

impl std::fmt::Display for Need {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            formatter,
            "{:.0} s, {} participants, {} topics, {:.2} MB unreclaimable, {:.1} s CPU, {} descriptors, {} threads, \
             {:.1} MB BPF, page {} KB, {} dropped, {:.1} s old",
            self.seconds,
            self.participants,
            self.topics,
            self.unreclaimable as f64 / 1e6,
            self.cpu,
            self.descriptors,
            self.threads,
            self.kernel_bytes as f64 / 1e6,
            self.page_bytes / 1000,
            self.dropped,
            self.age,
        )
    }
}

/// Writes `memory.csv` and `memory.svg`.
pub fn publish(curves: &[Curve]) -> Result<()> {
    let directory = results()?;
    let mut table =
        "agent,seconds,participants,topics,unreclaimable_bytes,cpu_seconds,descriptors,threads,\
                     bpf_bytes,page_bytes,dropped,age_seconds\n"
            .to_owned();
    for curve in curves {
        for need in &curve.needs {
            writeln!(
                table,
                "{},{:.1},{},{},{},{:.3},{},{},{},{},{},{:.1}",
                curve.name,
                need.seconds,
                need.participants,
                need.topics,
                need.unreclaimable,
                need.cpu,
                need.descriptors,
                need.threads,
                need.kernel_bytes,
                need.page_bytes,
                need.dropped,
                need.age,
            )?;
        }
    }
    fs::write(directory.join("memory.csv"), table)?;
    fs::write(directory.join("memory.svg"), picture(curves)?)?;
    Ok(())
}

/// Draws the memory of each agent in colour, and its number of participants in grey.
fn picture(curves: &[Curve]) -> Result<String> {
    const COLOURS: [&str; 2] = ["#0b6", "#06c"];
    const POINTS: usize = 240;
    let (left, top, width, height) = (60.0, 20.0, 640.0, 260.0);
    let all = || curves.iter().flat_map(|curve| &curve.needs);
    let most = |what: fn(&Need) -> f64| all().map(what).fold(1.0, f64::max);
    let (seconds, participants) = (most(|need| need.seconds), most(|need| need.participants));
    let megabytes = (most(|need| need.unreclaimable as f64) / 1e6 * 1.15).ceil();
    let mut svg = "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 760 330\" \
                   font-family=\"sans-serif\" font-size=\"12\">\n\
                   <rect width=\"760\" height=\"330\" fill=\"#fff\"/>\n"
        .to_owned();
    for step in 0..=4 {
        let part = f64::from(step) / 4.0;
        let y = top + height * (1.0 - part);
        let end = left + width;
        writeln!(
            svg,
            "<path d=\"M{left} {y}H{end}\" stroke=\"#ddd\"/><text x=\"{}\" y=\"{}\" \
             text-anchor=\"end\">{:.1} MB</text><text x=\"{}\" y=\"{}\" fill=\"#888\">{:.0}</text>",
            left - 4.0,
            y + 4.0,
            megabytes * part,
            end + 4.0,
            y + 4.0,
            participants * part,
        )?;
        let x = left + width * part;
        let minutes = seconds * part / 60.0;
        writeln!(
            svg,
            "<text x=\"{x}\" y=\"{}\" text-anchor=\"middle\">{minutes:.0} min</text>",
            top + height + 18.0
        )?;
    }
    let mut line = |needs: &[Need], colour: &str, of: &dyn Fn(&Need) -> f64| -> Result<()> {
        let mut path = String::new();
        let chunk = needs.len().div_ceil(POINTS).max(1);
        for group in needs.chunks(chunk) {
            let x = median(group.iter().map(|need| need.seconds).collect()) / seconds;
            let y = median(group.iter().map(of).collect());
            let start = if path.is_empty() { 'M' } else { 'L' };
            write!(
                path,
                "{start}{:.1} {:.1}",
                left + width * x,
                top + height * (1.0 - y)
            )?;
        }
        writeln!(
            svg,
            "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\"/>"
        )?;
        Ok(())
    };
    for (curve, colour) in curves.iter().zip(COLOURS) {
        line(&curve.needs, "#bbb", &|need| {
            need.participants / participants
        })?;
        line(&curve.needs, colour, &|need| {
            need.unreclaimable as f64 / 1e6 / megabytes
        })?;
    }
    for (index, (curve, colour)) in curves.iter().zip(COLOURS).enumerate() {
        let x = left + 160.0 * index as f64;
        writeln!(
            svg,
            "<text x=\"{x}\" y=\"320\" fill=\"{colour}\">unreclaimable {}</text>",
            curve.name
        )?;
    }
    writeln!(
        svg,
        "<text x=\"700\" y=\"320\" fill=\"#888\" text-anchor=\"end\">participants (right)</text>\n</svg>"
    )?;
    Ok(svg)
}

/// Prints the result of a fault. In the long run, also appends it to `faults.md`.
pub fn outcome(fault: &str, outcome: &str) -> Result<()> {
    eprintln!("{fault}: {outcome}");
    if long().is_none() {
        return Ok(());
    }
    let file = results()?.join("faults.md");
    let is_new = !file.exists();
    let mut text = String::new();
    if is_new {
        text.push_str("| fault | outcome |\n| --- | --- |\n");
    }
    writeln!(text, "| {fault} | {outcome} |")?;
    // The row is one write, because tests run in parallel.
    let mut file = fs::File::options().create(true).append(true).open(file)?;
    std::io::Write::write_all(&mut file, text.as_bytes())?;
    Ok(())
}

/// Returns the median, or 0 without values.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}
