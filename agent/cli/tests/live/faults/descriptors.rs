//! No file descriptors left.

use std::fs;
use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use super::{API_PORT, Counted, FaultBench, METRICS_PORT, ask, request};
use ros2probe_testing::harness::agent::{ON_THE_WIRE, Scrape};
use ros2probe_testing::harness::network::Link;
use ros2probe_testing::harness::soak::{long, outcome};
use ros2probe_testing::harness::usage::Usage;
use ros2probe_testing::harness::{run, wait_until};

/// Number of clients that keep an unused connection open.
const CLIENTS: usize = 24;

#[test]
fn without_descriptors_only_operations_that_need_one_fail_and_later_recover() -> Result<()> {
    let link = Link::new()?;
    let directory = tempfile::tempdir()?;
    let (state, bags) = (
        directory.path().join("state"),
        directory.path().join("bags"),
    );
    fs::create_dir(&state)?;
    let configuration = format!(
        "watch: [/**]\nstate_directory: {}\n\
         recordings: {{directory: {}, reserve_percent: 0, reserve_bytes: 0}}\n{ON_THE_WIRE}",
        state.display(),
        bags.display()
    );
    let scene = FaultBench::start(&link.robot, &directory, &configuration, &[])?;
    let mut counted = Counted::start(&link, 1, "before")?;
    scene.node_is_known("/before")?;
    let mut metrics = scene.connect(METRICS_PORT)?;
    let mut api = scene.connect(API_PORT)?;
    page(&mut metrics)?;
    ask(&mut api, "GET", "/health", "")?;

    let pid = scene.pid();
    let open = || -> Result<usize> { Ok(fs::read_dir(format!("/proc/{pid}/fd"))?.count()) };
    run(&format!("prlimit --pid {pid} --nofile={}:4096", open()?))?;
    let clients: Vec<_> = (0..CLIENTS)
        .map(|client| scene.connect([METRICS_PORT, API_PORT][client % 2]))
        .collect::<Result<_>>()?;

    let before = Usage::of(pid)?;
    let span = Duration::from_secs(if long().is_some() { 30 } else { 3 });
    let began = Instant::now();
    std::thread::sleep(span);
    let cpu = Usage::of(pid)?.since(&before).cpu;
    let span = began.elapsed();
    ensure!(cpu < span / 4, "{cpu:?} of CPU in {span:?}: it spins");
    counted.send_samples(320, 300)?;
    let detail = a_recording_is_refused(&mut api, &bags)?;
    let mut late = Counted::start(&link, 2, "meanwhile")?;
    wait_until("a state write that fails", || {
        Ok(writes(&page(&mut metrics)?, "failed") >= 1.0)
    })?;
    counted.send_samples(320, 100)?;
    wait_until("all messages", || {
        let label = [("topic", counted.topic.as_str())];
        let count = page(&mut metrics)?.sum("ros2_topic_messages_total", &label);
        Ok(count >= counted.sent as f64)
    })?;
    counted.check_page(&page(&mut metrics)?)?;

    // The clients leave, and the limit is restored.
    drop(clients);
    run(&format!("prlimit --pid {pid} --nofile=1024:4096"))?;
    let written = writes(&page(&mut metrics)?, "written");
    let _more = Counted::start(&link, 3, "after")?;
    wait_until("a state write", || {
        Ok(writes(&page(&mut metrics)?, "written") > written)
    })?;
    let text = fs::read_to_string(state.join("discovery.json"))?;
    ensure!(text.contains("/meanwhile"), "{text}");
    a_recording_works(&scene, &mut late)?;
    counted.check(&scene.agent)?;
    let took = scene.end()?;
    outcome(
        &format!("no descriptor left (RLIMIT_NOFILE), {CLIENTS} clients that need one"),
        &format!(
            "{cpu:?} of CPU in {span:?}, every message counted; a recording is refused ({detail}), state \
             writes fail and are counted; both work again with the limit; ended in {took:?}"
        ),
    )
}

/// Reads the metrics on a connection that is already open.
fn page(metrics: &mut TcpStream) -> Result<Scrape> {
    Ok(Scrape(request(metrics, "GET", "/metrics", "")?.1))
}

fn writes(page: &Scrape, outcome: &str) -> f64 {
    page.sum("ros2probe_state_writes_total", &[("outcome", outcome)])
}

/// Returns the detail of the answer, which names the error.
fn a_recording_is_refused(api: &mut TcpStream, bags: &Path) -> Result<String> {
    let (status, refused) = ask(api, "POST", "/recordings", r#"{"name": "none"}"#)?;
    let detail = refused["detail"].as_str().unwrap_or_default().to_owned();
    ensure!(
        status == 507 && detail.contains("(os error 24)"),
        "{status} {refused}"
    );
    ensure!(!bags.join("none").exists(), "an empty bag is left");
    Ok(detail)
}

/// Checks that a recording of 50 messages has all of them.
fn a_recording_works(scene: &FaultBench<'_>, late: &mut Counted) -> Result<()> {
    let (status, begun) = scene.ask("POST", "/recordings", r#"{"name": "some"}"#)?;
    ensure!(status == 201, "{status} {begun}");
    late.send_samples(320, 50)?;
    let (status, ended) = scene.ask("DELETE", "/recordings/some", "")?;
    ensure!(
        status == 200 && ended["report"]["messages"] == 50,
        "{status} {ended}"
    );
    Ok(())
}
