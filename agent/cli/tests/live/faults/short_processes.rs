//! Thousands of processes that call and end immediately, within the unit's memory and CPU.

use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::soak::{long, outcome};
use ros2probe_testing::harness::traced_program::TracedProgram;

use super::FaultBench;
use super::unit::{Allowance, UnitCgroups, mebibytes};

const PATIENCE: Duration = Duration::from_secs(60);
/// Interval of a scraper.
const SCRAPE_INTERVAL: Duration = Duration::from_secs(1);
/// Number of shells that start one process after the other.
const SHELLS: u32 = 4;
const MESSAGES: u32 = 200;
/// Minimum number of calls of each short process.
const CALLS: f64 = 10.0;
/// Runs `$1` processes of `$0`, each with other names.
const LOOP: &str = r#"i=0; while [ $i -lt $1 ]; do
    printf 'init\npublish 3\n' | "$0" /in$i /out$2_$i node$2_$i >/dev/null; i=$((i+1))
done"#;

#[test]
fn thousands_of_short_processes_use_bounded_memory_and_lose_no_message_of_others() -> Result<()> {
    let all: u32 = if long().is_some() { 20_000 } else { 2_000 };
    let allowance = Allowance::of_the_unit()?;
    let group = UnitCgroups::to(&allowance)?;
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let program = TracedProgram::build(248, &[])?;
    let configuration = format!(
        "capture: {{source: host, cgroup: {}, inside: full}}\nlog: warn\n",
        host.cgroup().display()
    );
    let enter = group.enter();
    let words = ["sh", "-c", &enter];
    let scene = FaultBench::start(&host, &directory, &configuration, &words)?;
    let arguments = ["/in", "/real", "real"];
    let mut real = Process::start(&host.inside(), program.program(), arguments)?;
    scene
        .agent
        .scrape_until("the library is observed", |page| {
            page.sum("ros2probe_inside_library_info", &[("state", "attached")]) >= 1.0
        })?;
    real.write_line("init")?;
    real.wait_for("init", PATIENCE)?;
    let began = Instant::now();
    let mut shells = Vec::new();
    for shell in 0..SHELLS {
        let program = program.program();
        let program = program.to_str().context("path")?;
        let (count, shell) = ((all / SHELLS).to_string(), shell.to_string());
        let arguments = ["-c", LOOP, program, &count, &shell];
        shells.push(Process::start(&host.inside(), "sh", arguments)?);
    }
    let (mut published, mut peak, mut most) = (0, 0, 0.0_f64);
    let mut scraped = began;
    while shells
        .iter_mut()
        .any(|shell| shell.wait(Duration::ZERO).is_err())
        || published < MESSAGES
    {
        ensure!(began.elapsed() < 20 * PATIENCE, "the shells still run");
        if published < MESSAGES {
            real.write_line("publish 1")?;
            real.wait_for("publish", PATIENCE)?;
            published += 1;
        }
        peak = peak.max(group.needed()?);
        // A page takes a part of the agent's CPU.
        if scraped.elapsed() > SCRAPE_INTERVAL {
            most = most.max(scene.agent.scrape()?.sum("ros2probe_inside_processes", &[]));
            scraped = Instant::now();
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    ensure!(group.oom_kills()? == 0, "killed");
    ensure!(peak < allowance.memory, "{peak} bytes");
    let took = began.elapsed();
    let label = [("topic", "/real")];
    scene
        .agent
        .scrape_until("all messages of the other process", |page| {
            page.sum("ros2_topic_inside_published_messages_total", &label) == f64::from(published)
        })?;
    let calls = scene.agent.scrape()?;
    let calls = calls.sum("ros2probe_inside_events_total", &[("event", "hits")]);
    ensure!(calls >= f64::from(all) * CALLS, "{calls} calls");
    scene
        .agent
        .scrape_until("the ended processes are forgotten", |page| {
            page.sum("ros2probe_inside_processes", &[]) == 1.0
        })?;
    let ended = scene.end()?;
    outcome(
        &format!(
            "{all} short processes in {} MiB",
            mebibytes(allowance.memory)
        ),
        &format!(
            "{took:.0?}, {calls} calls, {most} processes known at once, {:.1} MiB at most; {published} of {published} messages of \
             another process; ended in {ended:.1?}",
            mebibytes(peak)
        ),
    )
}
