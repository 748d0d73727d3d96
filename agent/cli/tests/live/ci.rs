//! `rp ci` beside real DDS participants: a healthy robot passes, and each fault fails by its name.
//! Needs root.

use std::ffi::OsStr;
use std::fs::{self, File, Permissions};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use quick_xml::Reader;
use quick_xml::escape::unescape;
use quick_xml::events::{BytesStart, Event};
use ros2probe_testing::harness;
use ros2probe_testing::harness::agent::{
    Agent, PACKETS_ALONE, at_the_sockets_of, datagrams_alone_of,
};
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream, robot};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::snmp::Snmp;
use ros2probe_testing::harness::wait_until;
use ros2probe_testing::robot_log;
use tempfile::TempDir;

use crate::robot_parts::Node;

const RP: &str = env!("CARGO_BIN_EXE_rp");
/// Exit code if a condition failed.
const CONDITION_FAILED: i32 = 79;
const PATIENCE: Duration = Duration::from_secs(60);

/// A directory with a watchlist and the output of `rp ci`.
struct Place(TempDir);

/// The cases of a JUnit file.
struct Cases(Vec<Case>);

#[derive(Debug)]
struct Case {
    group: String,
    name: String,
    has_failed: bool,
}

impl Place {
    /// Returns a directory with a watchlist of these settings.
    fn new(settings: &str) -> Result<Self> {
        let directory = tempfile::tempdir()?;
        fs::write(directory.path().join("watchlist.yaml"), settings)?;
        // An agent of root may have another user.
        let temporary = directory.path().join("temporary");
        fs::create_dir(&temporary)?;
        for (path, mode) in [(directory.path(), 0o755), (&temporary, 0o777)] {
            fs::set_permissions(path, Permissions::from_mode(mode))?;
        }
        Ok(Self(directory))
    }

    /// Checks that no temporary file is left.
    fn is_clean(&self) -> Result<()> {
        let left: Vec<_> = fs::read_dir(self.path("temporary"))?.collect();
        ensure!(left.is_empty(), "{left:?}");
        Ok(())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Returns the arguments of `rp ci` for this shell script.
    fn arguments(&self, options: &[&str], script: &str) -> Vec<String> {
        let watchlist = self.path("watchlist.yaml").display().to_string();
        let output = self.path("out").display().to_string();
        let mut all = ["ci", "--expect", &watchlist, "--output", &output]
            .map(str::to_owned)
            .to_vec();
        all.extend(options.iter().map(|option| (*option).to_owned()));
        all.extend(["--", "sh", "-c", script].map(str::to_owned));
        all
    }

    /// Starts `rp ci` on a host, with its report in the file `said`.
    fn start(&self, host: &Namespace, options: &[&str], script: &str) -> Result<Process> {
        let printed = File::create(self.path("said"))?;
        let arguments = self.arguments(options, script);
        let mut prefix = host.on_network();
        let temporary = format!("TMPDIR={}", self.path("temporary").display());
        prefix.extend(["env".to_owned(), temporary]);
        Process::start_with(&prefix, RP, arguments, printed.into())
    }

    /// Waits for the end of `rp ci`, and checks its exit code.
    fn end(&self, process: &mut Process, code: i32) -> Result<Cases> {
        let status = process.wait(PATIENCE)?;
        let printed = fs::read_to_string(self.path("said"))?;
        ensure!(status.code() == Some(code), "{status}: {printed}");
        self.is_clean()?;
        Cases::read(&self.path("out/junit.xml"))
    }
}

impl Cases {
    fn read(path: &Path) -> Result<Self> {
        let text = fs::read_to_string(path)?;
        let mut reader = Reader::from_str(&text);
        let mut cases = Vec::new();
        loop {
            match reader.read_event()? {
                Event::Start(tag) if tag.name().as_ref() == "testcase" => cases.push(Case {
                    group: attribute(&tag, "classname")?,
                    name: attribute(&tag, "name")?,
                    has_failed: false,
                }),
                Event::Start(tag) if tag.name().as_ref() == "failure" => {
                    cases.last_mut().context("no case")?.has_failed = true;
                }
                Event::Eof => return Ok(Self(cases)),
                _ => {}
            }
        }
    }

    /// Returns the names of the failed cases, with their groups.
    fn failed(&self) -> Vec<String> {
        let failed = self.0.iter().filter(|case| case.has_failed);
        let name = |case: &Case| {
            let group = case.group.trim_start_matches("rp.ci.");
            format!("{group} {}", case.name)
        };
        failed.map(name).collect()
    }

    fn has(&self, group: &str, name: &str) -> bool {
        let group = format!("rp.ci.{group}");
        let mut cases = self.0.iter();
        cases.any(|case| case.group == group && case.name == name)
    }
}

fn attribute(tag: &BytesStart<'_>, name: &str) -> Result<String> {
    let value = tag.try_get_attribute(name)?.context("no attribute")?.value;
    Ok(unescape(&value)?.into_owned())
}

/// Returns a report, after checks that it has no script and refers to nothing.
fn report(place: &Place) -> Result<String> {
    let page = fs::read_to_string(place.path("out/report.html"))?;
    for forbidden in [
        "<script", "<img", "<link", "://", "href=", "src=\"", "url(", "@import",
    ] {
        ensure!(!page.contains(forbidden), "{forbidden} in {page}");
    }
    ensure!(page.ends_with("</html>\n"), "{page}");
    Ok(page)
}

/// Returns a script that runs a publisher and a subscriber of `/imu` until this command ends.
/// RustDDS drops samples that its history overwrites before they are sent, so the history covers a
/// busy machine.
fn healthy_during(command: &str) -> Result<String> {
    let robot = robot()?.display().to_string();
    let peer = |role: &str, node: &str| {
        format!(
            "{robot} --role {role} --topic /imu --size 320 --rate 50 --depth 1000 --best-effort \
             --node {node} \
             >&2 &"
        )
    };
    let (listens, sends) = (peer("sub", "/ekf"), peer("pub", "/driver"));
    Ok(format!(
        "{listens} A=$!; {sends} B=$!; {command}; kill $A $B; wait; exit 0"
    ))
}

#[test]
fn a_healthy_robot_passes_and_leaves_complete_artefacts() -> Result<()> {
    let host = Namespace::isolated()?;
    let place = Place::new(&format!(
        "{}watch:\n  - {{topic: /imu, min_rate_hz: 1, max_silence_s: 10, publishers: 1}}\n",
        at_the_sockets_of(&host)
    ))?;
    let script = format!("echo began; {}", healthy_during("read line")?);
    let mut process = place.start(&host, &["--fail-on", "warning"], &script)?;
    end_after(&mut process, 400, Duration::from_secs(13))?;
    let cases = place.end(&mut process, 0)?;
    let failed = cases.failed();
    ensure!(failed.is_empty(), "{failed:?}");
    for (group, name) in [
        ("observation", "participants"),
        ("expectations", "/imu min_rate_hz"),
        ("expectations", "/imu max_silence_s"),
        ("expectations", "/imu publishers"),
        ("findings", "all kinds"),
        ("loss", "/imu"),
    ] {
        ensure!(cases.has(group, name), "no {group} {name}: {:?}", cases.0);
    }
    let page = report(&place)?;
    for part in [
        "/driver publishes /imu",
        "/ekf subscribes to /imu",
        ">passed<",
        "<svg",
    ] {
        ensure!(page.contains(part), "no {part} in {page}");
    }
    let info = Command::new(RP)
        .args(["bag", "info"])
        .arg(place.path("out/bag"))
        .output()?;
    let info = String::from_utf8(info.stdout)?;
    ensure!(info.contains("Topic: /imu"), "{info}");
    let log = fs::read_to_string(place.path("out/agent.log"))?;
    ensure!(log.contains("ready") && log.contains("ended"), "{log}");
    Ok(())
}

#[test]
fn lost_messages_and_a_low_rate_fail_by_the_name_of_the_topic() -> Result<()> {
    let link = Link::new()?;
    let place = Place::new(&format!(
        "{}watch:\n  - {{topic: /imu, min_rate_hz: 5000}}\n  - {{topic: /odom, publishers: 1}}\n",
        datagrams_alone_of(&link.monitor)
    ))?;
    let stream = Stream::small(1_000_000);
    let script = format!(
        "{} --role sub --topic /imu --size 320 --best-effort --node /ekf >&2 & A=$!
         echo began; read line; kill $A; wait; exit 0",
        robot()?.display()
    );
    let mut process = place.start(&link.monitor, &["--settle", "2"], &script)?;
    process.wait_for("began", PATIENCE)?;
    let mut driver = Peer::start(
        &link.robot,
        Stack::Rust,
        Role::Publisher,
        &stream,
        &["/driver"],
    )?;
    driver.wait_matched()?;
    let _loss = Loss::of_samples(&link.robot, &link.monitor, &stream, 100)?;
    driver.start_sending()?;
    wait_until("samples of ten seconds are sent", || {
        Ok(driver.log()?.sequences("pub").len() >= 2_000)
    })?;
    process.write_line("end")?;
    let cases = place.end(&mut process, CONDITION_FAILED)?;
    let failed = cases.failed();
    assert_eq!(
        failed,
        [
            "expectations /imu min_rate_hz",
            "expectations /odom publishers",
            "loss /imu"
        ]
    );
    let page = report(&place)?;
    ensure!(page.contains("/imu loses messages"), "{page}");
    Ok(())
}

#[test]
fn the_status_of_the_command_is_kept() -> Result<()> {
    let host = Namespace::isolated()?;
    let place = Place::new(&datagrams_alone_of(&host))?;
    for (script, code) in [
        ("exit 7", 7),
        ("kill -KILL $$", 137),
        ("exit 0", CONDITION_FAILED),
    ] {
        let mut process = place.start(&host, &["--no-bag"], script)?;
        let cases = place.end(&mut process, code)?;
        let failed = cases.failed();
        ensure!(
            failed.contains(&"observation participants".to_owned()),
            "{failed:?}"
        );
        ensure!(!place.path("out/bag").exists());
    }
    Ok(())
}

#[test]
fn a_bag_that_cannot_be_kept_does_not_lose_the_verdict() -> Result<()> {
    let host = Namespace::isolated()?;
    let place = Place::new(&datagrams_alone_of(&host))?;
    let bag = place.path("out/bag");
    let script = format!("mkdir {}; exit 0", bag.display());
    let mut process = place.start(&host, &[], &script)?;
    let cases = place.end(&mut process, CONDITION_FAILED)?;
    ensure!(cases.has("observation", "participants"), "{:?}", cases.0);
    let page = report(&place)?;
    ensure!(page.contains("not kept: cannot write"), "{page}");
    let printed = fs::read_to_string(place.path("said"))?;
    ensure!(printed.contains("cannot write"), "{printed}");
    Ok(())
}

#[test]
fn hostile_names_are_escaped_in_every_artefact() -> Result<()> {
    let link = Link::new()?;
    let place = Place::new(PACKETS_ALONE)?;
    let script = "echo began; read line";
    let mut process = place.start(&link.monitor, &["--settle", "1"], script)?;
    process.wait_for("began", PATIENCE)?;
    // The agent refuses names with quotation marks and control characters.
    let hostile = "/a><script>alert(1)</script>&amp;]]>\u{200f}";
    let topic = format!("rt{hostile}");
    let mut node = Node::start(&link, 1, "x><script>", (&topic, robot_log::DDS_TYPE))?;
    for number in 0..20 {
        node.send(&robot_log::log(20, "x", format!("{number}").as_bytes()))?;
        std::thread::sleep(Duration::from_millis(100));
    }
    process.write_line("end")?;
    process.wait(PATIENCE)?;
    let cases = Cases::read(&place.path("out/junit.xml"))?;
    let shown = hostile.replace('\u{200f}', "\\u{200f}");
    ensure!(cases.has("loss", &shown), "{:?}", cases.0);
    let page = report(&place)?;
    ensure!(page.contains("&lt;script&gt;alert("), "{page}");
    for name in ["junit.xml", "report.html", "../said"] {
        let text = fs::read_to_string(place.path("out").join(name))?;
        ensure!(!text.contains('\u{200f}'), "{name}: {text}");
    }
    Ok(())
}

#[test]
fn signals_reach_the_command_and_the_artefacts_are_written() -> Result<()> {
    let host = Namespace::isolated()?;
    let place = Place::new(&datagrams_alone_of(&host))?;
    for (signal, code) in [("INT", 42), ("TERM", 43)] {
        let script =
            "trap 'exit 42' INT; trap 'exit 43' TERM; echo began; while :; do sleep 0.1; done";
        let mut process = place.start(&host, &["--no-bag"], script)?;
        process.wait_for("began", PATIENCE)?;
        process.signal(signal)?;
        place.end(&mut process, code)?;
        report(&place)?;
    }
    Ok(())
}

#[test]
fn children_end_with_an_rp_ci_that_is_killed() -> Result<()> {
    let host = Namespace::isolated()?;
    let place = Place::new(&datagrams_alone_of(&host))?;
    let script = "sleep 3601 & sleep 3602 & echo began; wait";
    let mut process = place.start(&host, &[], script)?;
    process.wait_for("began", PATIENCE)?;
    let group = fs::read_to_string(host.cgroup().join("cgroup.procs"))?;
    // This program, the agent, the guard, the shell and two sleeps.
    ensure!(group.lines().count() >= 6, "{group}");
    process.signal("KILL")?;
    wait_until("no process is left", || {
        let left = fs::read_to_string(host.cgroup().join("cgroup.procs"))?;
        Ok(left.trim().is_empty())
    })?;
    place.is_clean()
}

#[test]
fn several_runs_do_not_disturb_each_other_nor_an_installed_agent() -> Result<()> {
    let host = Namespace::isolated()?;
    let installed = tempfile::tempdir()?;
    let file = installed.path().join("ros2probe.yaml");
    fs::write(&file, at_the_sockets_of(&host))?;
    let agent = Agent::start(&host, RP, &file)?;
    let places = [
        Place::new(&at_the_sockets_of(&host))?,
        Place::new(&at_the_sockets_of(&host))?,
    ];
    let options = ["--settle", "2", "--page", "127.0.0.1:0"];
    let mut runs = Vec::new();
    for place in &places {
        let script = format!("echo began; {}", healthy_during("read line")?);
        runs.push(place.start(&host, &options, &script)?);
    }
    for run in &mut runs {
        run.wait_for("began", PATIENCE)?;
    }
    // The first two seconds are not judged.
    let began = Instant::now();
    wait_until_sent(&runs[0], 400)?;
    std::thread::sleep(Duration::from_secs(4).saturating_sub(began.elapsed()));
    for run in &mut runs {
        run.write_line("end")?;
    }
    for (place, run) in places.iter().zip(&mut runs) {
        let failed = place.end(run, 0)?.failed();
        ensure!(failed.is_empty(), "{failed:?}");
    }
    let page = agent.scrape()?;
    ensure!(
        page.value("ros2probe_watches", &[]) != Some(1.0),
        "a watch is left"
    );
    Ok(())
}

#[test]
fn a_missing_capability_is_reported_before_the_command_runs() -> Result<()> {
    let place = Place::new("")?;
    let marker = place.path("ran");
    fs::set_permissions(place.0.path(), Permissions::from_mode(0o777))?;
    let Output { status, stderr, .. } = Command::new("setpriv")
        .args(["--reuid=65534", "--regid=65534", "--clear-groups"])
        .args([OsStr::new(RP), OsStr::new("ci"), OsStr::new("-o")])
        .arg(place.path("out"))
        .args(["--", "touch"])
        .arg(&marker)
        .output()?;
    let printed = String::from_utf8(stderr)?;
    ensure!(
        status.code() == Some(77) && printed.lines().count() == 1,
        "{status}: {printed}"
    );
    for part in ["CAP_BPF", "`host`", "`wire`", "sudo setcap"] {
        ensure!(printed.contains(part), "no {part} in {printed}");
    }
    ensure!(!marker.exists());
    Ok(())
}

#[test]
fn a_run_with_more_messages_than_the_bag_may_hold_keeps_a_complete_bag() -> Result<()> {
    let host = Namespace::isolated()?;
    let place = Place::new(&format!(
        "{}recordings: {{max_bytes: 1048576}}\n",
        datagrams_alone_of(&host)
    ))?;
    let robot = healthy_during("read line")?.replace("--size 320", "--size 32000");
    let script = format!("echo began; {robot}");
    let mut process = place.start(&host, &["--settle", "1", "--max-lost", "any"], &script)?;
    end_after(&mut process, 300, Duration::from_secs(7))?;
    place.end(&mut process, 0)?;
    let page = report(&place)?;
    ensure!(page.contains("it ended early: "), "{page}");
    let bag = place.path("out/bag");
    let bytes: u64 = fs::read_dir(&bag)?
        .map(|file| anyhow::Ok(file?.metadata()?.len()))
        .sum::<Result<u64>>()?;
    ensure!(bytes < 2 << 20, "{bytes} bytes");
    let info = Command::new(RP).args(["bag", "info"]).arg(bag).output()?;
    let info = String::from_utf8(info.stdout)?;
    ensure!(info.contains("Topic: /imu"), "{info}");
    Ok(())
}

#[test]
fn the_action_runs_rp_ci_with_its_inputs_and_keeps_the_status() -> Result<()> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let action = fs::read_to_string(root.join("deploy/ci/action.yml"))?;
    let action: serde_yaml::Value = serde_yaml::from_str(&action)?;
    let step = &action["runs"]["steps"][0];
    let script = step["run"].as_str().context("no script")?;
    let host = Namespace::isolated()?;
    let place = Place::new(&datagrams_alone_of(&host))?;
    let input = |name: &str| match name {
        "run" => "source ./env.sh; exit $CODE".to_owned(),
        "rp" => RP.to_owned(),
        "expect" => "watchlist.yaml".to_owned(),
        "arguments" => "--no-bag --settle 0".to_owned(),
        "output" => "a directory".to_owned(),
        _ => String::new(),
    };
    fs::write(place.path("env.sh"), "CODE=9\n")?;
    let prefix = host.on_network();
    let [enter, words @ ..] = &prefix[..] else {
        anyhow::bail!("no way into the host")
    };
    let mut command = Command::new(enter);
    command
        .args(words)
        .args(["bash", "-e", "-c", script])
        .current_dir(place.0.path());
    let variables = step["env"].as_mapping().context("no variables")?;
    for (variable, value) in variables {
        let variable = variable.as_str().context("not a name")?;
        let value = value.as_str().context("not a text")?;
        let name = value
            .strip_prefix("${{ inputs.")
            .and_then(|it| it.strip_suffix(" }}"));
        let name = name.with_context(|| format!("{variable} is not an input: {value}"))?;
        ensure!(!action["inputs"][name].is_null(), "no input {name}");
        command.env(variable, input(name));
    }
    let output = command.output()?;
    let printed = String::from_utf8(output.stderr)?;
    ensure!(
        output.status.code() == Some(9),
        "{}: {printed}",
        output.status
    );
    ensure!(place.path("a directory/junit.xml").exists(), "{printed}");
    command.env("RP", "/nonexistent/rp");
    let output = command.output()?;
    let printed = String::from_utf8(output.stdout)?;
    ensure!(
        output.status.code() == Some(127) && printed.contains("not installed"),
        "{printed}"
    );
    Ok(())
}

/// Returns the process id of the agent of `rp ci` on a host.
fn agent_of(host: &Namespace) -> Result<String> {
    let group = fs::read_to_string(host.cgroup().join("cgroup.procs"))?;
    // A child that the agent forks has the same command line for a moment, and a later id.
    let ids = group.lines().filter_map(|id| id.parse::<u32>().ok());
    let mut ids: Vec<_> = ids.collect();
    ids.sort_unstable();
    let agent = ids.into_iter().find(|id| {
        let line = fs::read(format!("/proc/{id}/cmdline")).unwrap_or_default();
        line.windows(9).any(|part| part == b"--private")
    });
    Ok(agent.context("no agent")?.to_string())
}

/// Waits until the host of a process has sent this many more datagrams.
fn wait_until_sent(process: &Process, datagrams: u64) -> Result<()> {
    let sent = || Snmp::of(process.pid())?.sent();
    let before = sent()?;
    wait_until("datagrams are sent", || Ok(sent()? >= before + datagrams))
}

/// Lets a command run for this time at least, and until the host has sent this many datagrams. The
/// command prints `began`, and reads a line at its end. The robot of a busy machine starts late.
fn end_after(process: &mut Process, datagrams: u64, least: Duration) -> Result<()> {
    process.wait_for("began", PATIENCE)?;
    let began = Instant::now();
    wait_until_sent(process, datagrams)?;
    std::thread::sleep(least.saturating_sub(began.elapsed()));
    process.write_line("end")
}

#[test]
fn packets_that_the_agent_dropped_are_a_warning_and_fail_a_strict_run() -> Result<()> {
    let host = Namespace::isolated()?;
    // This ring holds some 500 records, and the robot causes one for each message. For a bag, the
    // messages would be in the ring of packets, which holds more.
    let place = Place::new("capture: {source: wire, record_ring_bytes: 65536}\n")?;
    let robot = healthy_during("read line")?.replace("--rate 50", "--rate 500");
    let script = format!("echo began; {robot}");
    for (option, code, failed) in [
        (&[][..], 0, &[][..]),
        (
            &["--strict"],
            CONDITION_FAILED,
            &["observation completeness"],
        ),
    ] {
        let options = [&["--settle", "2", "--max-lost", "any", "--no-bag"], option].concat();
        let mut process = place.start(&host, &options, &script)?;
        process.wait_for("began", PATIENCE)?;
        let began = Instant::now();
        wait_until_sent(&process, 1500)?;
        // The first two seconds are not judged.
        std::thread::sleep(Duration::from_secs(3).saturating_sub(began.elapsed()));
        // A stopped agent reads no record.
        let agent = agent_of(&host)?;
        harness::run(&format!("kill -STOP {agent}"))?;
        wait_until_sent(&process, 1500)?;
        harness::run(&format!("kill -CONT {agent}"))?;
        wait_until_sent(&process, 500)?;
        process.write_line("end")?;
        let cases = place.end(&mut process, code)?;
        assert_eq!(cases.failed(), failed);
        let printed = fs::read_to_string(place.path("said"))?;
        let verdict = match code {
            0 => "rp ci: warning    observation  completeness: the agent dropped ",
            _ => "rp ci: failed     observation  completeness: the agent dropped ",
        };
        ensure!(printed.contains(verdict), "{printed}");
        ensure!(
            printed.contains(", with a warning: the agent missed") == (code == 0),
            "{printed}"
        );
        let junit = fs::read_to_string(place.path("out/junit.xml"))?;
        let output = "<system-out>warning: the agent dropped ";
        ensure!(junit.contains(output) == (code == 0), "{junit}");
        let page = report(&place)?;
        ensure!(page.contains("the agent dropped "), "{page}");
    }
    Ok(())
}

#[test]
fn topics_beyond_a_limit_fail_a_strict_run() -> Result<()> {
    let host = Namespace::isolated()?;
    let place = Place::new(&format!(
        "{}limits: {{topics: 1}}\n",
        datagrams_alone_of(&host)
    ))?;
    // A shell in the background has no input.
    let end = place.path("end");
    let robot = healthy_during(&format!(
        "while [ ! -e {} ]; do sleep 0.1; done",
        end.display()
    ))?;
    let other = robot
        .replace("/imu", "/odom")
        .replace("/ekf", "/planner")
        .replace("/driver", "/wheels");
    let script = format!("echo began; ({robot}) & ({other}) & wait");
    for (option, code, failed) in [
        ("--no-bag", 0, &[][..]),
        ("--strict", CONDITION_FAILED, &["observation completeness"]),
    ] {
        let options = ["--settle", "2", "--max-lost", "any", option];
        let mut process = place.start(&host, &options, &script)?;
        process.wait_for("began", PATIENCE)?;
        let began = Instant::now();
        wait_until_sent(&process, 600)?;
        std::thread::sleep(Duration::from_secs(8).saturating_sub(began.elapsed()));
        fs::write(&end, "")?;
        assert_eq!(place.end(&mut process, code)?.failed(), failed);
        fs::remove_file(&end)?;
        let printed = fs::read_to_string(place.path("said"))?;
        ensure!(
            printed.contains("limits.topics was reached, and "),
            "{printed}"
        );
    }
    Ok(())
}

#[test]
fn an_agent_that_is_killed_fails_the_run_but_not_the_command() -> Result<()> {
    let host = Namespace::isolated()?;
    let place = Place::new(&datagrams_alone_of(&host))?;
    let mut process = place.start(&host, &["--settle", "0"], "echo began; read line; exit 0")?;
    process.wait_for("began", PATIENCE)?;
    harness::run(&format!("kill -KILL {}", agent_of(&host)?))?;
    process.write_line("end")?;
    let failed = place.end(&mut process, CONDITION_FAILED)?.failed();
    ensure!(
        failed.contains(&"observation agent".to_owned()),
        "{failed:?}"
    );
    let printed = fs::read_to_string(place.path("said"))?;
    ensure!(printed.contains("signal 9 ended it"), "{printed}");
    Ok(())
}
