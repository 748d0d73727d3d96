//! Processes and libraries that look like others: equal inodes in two containers, a library that is
//! replaced while in use, and a reused process id.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::breakpoints::AttachMethod;
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::traced_program::TracedProgram;
use ros2probe_testing::harness::wait_until;

use crate::hostile::start_as;

const PATIENCE: Duration = Duration::from_secs(60);
/// Interval at which the agent reads the tables of calls.
const ROUND: Duration = Duration::from_secs(1);
/// User that owns no process and no file of the test.
const UNPRIVILEGED: u32 = 65_534;
/// Covers the directory `$0` of the program and its library with a copy in a separate file system,
/// mounted at `$1` first, and runs it.
const IMAGE: &str = r#"mount -t tmpfs image "$1" && cp "$0"/process "$0"/*.so "$1" && \
    mount --bind "$1" "$0" && exec "$0/process" "$2" "$3" "$4""#;
/// Runs a program as the process with this id (clone3(2), `set_tid`).
const SAME_ID: &str = r#"
import ctypes, os, struct, sys
libc = ctypes.CDLL(None, use_errno=True)
wanted = int(sys.argv[1])
ids = (ctypes.c_int * 1)(wanted)
arguments = struct.pack("11Q", 0, 0, 0, 0, 17, 0, 0, 0, ctypes.addressof(ids), 1, 0)
child = libc.syscall(435, arguments, ctypes.c_size_t(len(arguments)))
if child < 0:
    raise OSError(ctypes.get_errno(), "clone3")
if child == 0:
    os.execv(sys.argv[2], sys.argv[2:])
assert child == wanted
os.close(0)
os.waitpid(child, 0)
"#;

#[test]
fn libraries_and_processes_with_equal_identities_are_distinguished() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let program = TracedProgram::build(248, &[])?;
    let (built, library) = (program.program(), program.library());
    let place = library.parent().context("directory")?;
    let image = directory.path().join("image");
    fs::create_dir(&image)?;
    let mut enter = host.inside();
    enter.extend(["unshare", "--mount"].map(str::to_owned));
    let mut running = Vec::new();
    for (topic, node) in [("/first", "one"), ("/second", "two")] {
        let places = [place, &image].map(|path| path.to_string_lossy().into_owned());
        let mut arguments = vec!["-c".to_owned(), IMAGE.to_owned()];
        arguments.extend(places);
        arguments.extend(["/in", topic, node].map(str::to_owned));
        let process = Process::start(&enter, "sh", &arguments)?;
        running.push((topic, process));
    }
    // The kernel numbers the files of each tmpfs from the same first number.
    let identities = running.iter().map(|(_, process)| identity(process.pid()));
    let identities = identities.collect::<Result<Vec<_>>>()?;
    let [(device, inode), (other_device, other_inode)] = &identities[..] else {
        anyhow::bail!("{identities:?}");
    };
    ensure!(
        inode == other_inode && device != other_device,
        "{identities:?}"
    );

    let replaced = Process::start(&host.inside(), &built, ["/in", "/replaced", "three"])?;
    identity(replaced.pid())?;
    let copy = directory.path().join("copy");
    fs::copy(&library, &copy)?;
    fs::rename(&copy, &library)?;
    running.push(("/replaced", replaced));
    let current = Process::start(&host.inside(), &built, ["/in", "/current", "four"])?;
    running.push(("/current", current));

    let configuration = configured(&host, directory.path())?;
    let agent = Agent::start(&host, env!("CARGO_BIN_EXE_rp"), &configuration)?;
    let attached = [("state", "attached")];
    agent.scrape_until("four libraries are attached", |page| {
        page.sum("ros2probe_inside_library_info", &attached) == 4.0
    })?;
    for (messages, (topic, process)) in (10_u32..).step_by(10).zip(&mut running) {
        publish(process, messages)?;
        agent.scrape_until(topic, |page| published(page, topic) == f64::from(messages))?;
    }

    let (_, mut ended) = running.swap_remove(3);
    let id = ended.pid();
    ended.signal("KILL")?;
    ended.wait(PATIENCE)?;
    let built = built.to_string_lossy().into_owned();
    let id = id.to_string();
    let arguments = ["-c", SAME_ID, &id, &built, "/in", "/again", "five"];
    let mut again = Process::start(&host.inside(), "python3", arguments)?;
    again.write_line("init")?;
    again.wait_for("init", PATIENCE)?;
    // Calls from before the agent has noticed the change count for neither process.
    wait_until("the new process is known", || {
        again.write_line("publish 1")?;
        again.wait_for("publish", PATIENCE)?;
        Ok(published(&agent.scrape()?, "/again") > 0.0)
    })?;
    let mut before = 0.0;
    wait_until("its messages so far", || {
        let now = published(&agent.scrape()?, "/again");
        std::thread::sleep(2 * ROUND);
        before = published(&agent.scrape()?, "/again");
        Ok(now == before)
    })?;
    again.write_line("publish 50")?;
    again.wait_for("publish", PATIENCE)?;
    agent.scrape_until("its further messages", |page| {
        published(page, "/again") == before + 50.0
    })?;
    let page = agent.scrape()?;
    ensure!(
        published(&page, "/current") == 40.0,
        "{}",
        published(&page, "/current")
    );
    Ok(())
}

/// Starts the publishers of `/kept` and `/gone`. The directories of their libraries get this mode.
fn started(host: &Namespace, programs: &[TracedProgram; 2], mode: u32) -> Result<Vec<Process>> {
    let mut processes = Vec::new();
    for (program, (topic, node)) in programs.iter().zip([("/kept", "one"), ("/gone", "two")]) {
        let place = program.library();
        let place = place.parent().context("directory")?;
        fs::set_permissions(place, Permissions::from_mode(mode))?;
        let arguments = ["/in", topic, node];
        let process = Process::start(&host.inside(), program.program(), arguments)?;
        identity(process.pid())?;
        processes.push(process);
    }
    Ok(processes)
}

#[test]
fn without_root_a_library_is_attached_by_its_path_unless_it_was_replaced() -> Result<()> {
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let programs = [
        TracedProgram::build(248, &[])?,
        TracedProgram::build(248, &[])?,
    ];
    let mut processes = started(&host, &programs, 0o755)?;
    let gone = programs[1].library();
    fs::remove_file(&gone)?;
    std::os::unix::fs::symlink(programs[0].library(), &gone)?;

    let configuration = configured(&host, directory.path())?;
    let capabilities = match AttachMethod::of_this_kernel() {
        AttachMethod::Links => "-all,+net_admin,+bpf,+perfmon,+sys_ptrace",
        AttachMethod::PerfEvents => "-all,+net_admin,+bpf,+perfmon,+sys_ptrace,+sys_admin",
    };
    let start = start_as(UNPRIVILEGED, capabilities, &directory)?;
    let agent = Agent::start(&host, start, &configuration)?;
    let [kept, _] = &mut processes[..] else {
        anyhow::bail!("no processes");
    };
    let libraries =
        |page: &Scrape, state| page.sum("ros2probe_inside_library_info", &[("state", state)]);
    agent.scrape_until("one library is attached and one refused", |page| {
        libraries(page, "attached") == 1.0 && libraries(page, "refused") == 1.0
    })?;
    publish(kept, 10)?;
    agent.scrape_until("all messages", |page| published(page, "/kept") == 10.0)?;
    let page = agent.scrape()?;
    let reasons = page.labels_of("ros2probe_inside_library_info", "reason");
    ensure!(
        reasons.iter().any(|reason| reason.contains("was replaced")),
        "{reasons:?}"
    );
    Ok(())
}

/// The directories of the libraries are for root only, as a home of mode 0750 is for its user.
#[test]
fn the_packaged_broker_attaches_libraries_of_private_directories_also_replaced_ones() -> Result<()>
{
    let host = Namespace::isolated()?;
    let directory = tempfile::tempdir()?;
    let programs = [
        TracedProgram::build(248, &[])?,
        TracedProgram::build(248, &[])?,
    ];
    let mut processes = started(&host, &programs, 0o700)?;
    fs::remove_file(programs[1].library())?;

    let configuration = configured(&host, directory.path())?;
    let mut capabilities = "-all,+net_admin,+bpf,+perfmon,+sys_ptrace".to_owned();
    capabilities += ",+checkpoint_restore,+dac_read_search";
    if matches!(AttachMethod::of_this_kernel(), AttachMethod::PerfEvents) {
        capabilities += ",+sys_admin";
    }
    let start = start_as(UNPRIVILEGED, &capabilities, &directory)?;
    let agent = Agent::start(&host, start, &configuration)?;
    agent.scrape_until("both libraries are attached", |page| {
        page.sum("ros2probe_inside_library_info", &[("state", "attached")]) == 2.0
    })?;
    for (process, topic) in processes.iter_mut().zip(["/kept", "/gone"]) {
        publish(process, 10)?;
        agent.scrape_until("all messages", |page| published(page, topic) == 10.0)?;
    }
    Ok(())
}

fn configured(host: &Namespace, directory: &Path) -> Result<PathBuf> {
    let configuration = directory.join("ros2probe.yaml");
    let text = format!(
        "capture: {{source: host, cgroup: {}, inside: full}}\n",
        host.cgroup().display()
    );
    fs::write(&configuration, text)?;
    Ok(configuration)
}

fn publish(process: &mut Process, messages: u32) -> Result<()> {
    process.write_line("init")?;
    process.wait_for("init", PATIENCE)?;
    process.write_line(&format!("publish {messages}"))?;
    process.wait_for("publish", PATIENCE)
}

fn published(page: &Scrape, topic: &str) -> f64 {
    page.sum(
        "ros2_topic_inside_published_messages_total",
        &[("topic", topic)],
    )
}

/// Returns device and inode of the library that a process maps.
fn identity(process: u32) -> Result<(String, String)> {
    let path = Path::new("/proc").join(process.to_string()).join("maps");
    let mut found = None;
    wait_until("the library is mapped", || {
        let maps = fs::read_to_string(&path)?;
        let line = maps
            .lines()
            .find(|line| line.ends_with("/libtracetools.so"));
        let mut words = line.unwrap_or_default().split_whitespace().skip(3);
        found = words
            .next()
            .zip(words.next())
            .map(|(device, inode)| (device.to_owned(), inode.to_owned()));
        Ok(found.is_some())
    })?;
    found.context("library")
}
