//! podman runs the commands of `docs/containers.md`. One agent in a container observes a robot on
//! the host. Others, on the host and in a sidecar, observe a robot in a container.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2probe_testing::harness::agent::{Agent, Scrape};
use ros2probe_testing::harness::cgroup::Cgroup;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::peer::{Peer, Role, Stack, Stream};
use ros2probe_testing::harness::process::Process;
use ros2probe_testing::harness::shared_memory::SharedMemory;
use ros2probe_testing::harness::{PREFIX, wait_until, wait_within};

use super::podman::{Options, Podman, page};
use super::succeed;
use ros2probe_testing::repository as sources;

const MESSAGES: u64 = 400;
/// Name of the agent's container.
const AGENT: &str = "ros2probe";
/// Number of requests for names.
const ATTEMPTS: usize = 2;
/// Maximum time until a line of an agent.
const PATIENCE: Duration = Duration::from_secs(30);
/// Maximum time of the kernel to verify the programs.
const READY: Duration = Duration::from_secs(60);

/// Returns a stream of Fast DDS through shared memory, its default between processes of one host.
/// Each test has a topic of its own, because the agents observe the whole host.
fn stream(topic: &str) -> Stream {
    Stream {
        topic: topic.to_owned(),
        reliable: true,
        shares_memory: true,
        logged: false,
        linger: 60.0,
        ..Stream::small(MESSAGES)
    }
}

/// Starts a publisher and a subscriber behind a command prefix, and waits until all agents know
/// both. Names are announced once in shared memory, and an agent on a busy machine may miss them:
/// then the one in the container requests them, as the page describes.
fn wait_discovered(
    podman: &Podman,
    enter: &[String],
    topic: &str,
    agents: &[&Agent<'_>],
) -> Result<(Peer, Peer)> {
    let start = |role, node| Peer::launch_behind(enter, Stack::Fast, role, &stream(topic), &[node]);
    let mut subscriber = start(Role::Subscriber, "/listener")?;
    subscriber.wait_ready()?;
    let mut publisher = start(Role::Publisher, "/talker")?;
    publisher.wait_matched()?;
    subscriber.wait_matched()?;
    let is_known = |page: &Scrape| {
        let ends = ["ros2_topic_publishers", "ros2_topic_subscriptions"];
        ends.iter()
            .all(|end| page.sum(end, &[("topic", topic)]) == 1.0)
    };
    let all_know = || -> Result<bool> {
        let pages = agents.iter().map(|agent| agent.scrape());
        Ok(pages.collect::<Result<Vec<_>>>()?.iter().all(is_known))
    };
    for _ in 0..ATTEMPTS {
        if wait_within(Duration::from_secs(3), "names", all_know).is_ok() {
            return Ok((publisher, subscriber));
        }
        let mut discover = podman.command("exec");
        succeed(discover.args([AGENT, "rp", "discover", "--all"]))?;
    }
    wait_within(Duration::from_secs(3), "names", all_know)?;
    Ok((publisher, subscriber))
}

/// Sends the messages, and checks that each agent has counted them.
fn counted(publisher: &mut Peer, topic: &str, agents: &[&Agent<'_>]) -> Result<()> {
    publisher.start_sending()?;
    publisher.wait_sent(PATIENCE)?;
    for agent in agents {
        let page = agent.settled_scrape(topic, MESSAGES)?;
        let counted = page.sum("ros2_topic_messages_total", &[("topic", topic)]);
        println!("{counted} of {MESSAGES} messages");
        // Polling may miss the first messages and the last ones.
        let expected = MESSAGES as f64 * 0.9..=MESSAGES as f64;
        ensure!(
            expected.contains(&counted),
            "{counted} messages: {}",
            page.0
        );
        let passage = [("topic", topic), ("passage", "shared_memory")];
        ensure!(page.sum("ros2_topic_pairs", &passage) == 1.0, "{}", page.0);
    }
    Ok(())
}

/// Makes the profile of the page in a directory, and returns the option for it. The default profile
/// of podman 4.3 refuses `bpf`.
pub(super) fn seccomp(directory: &Path) -> Result<String> {
    let text = std::fs::read_to_string(page())?;
    let command = text.lines().find(|line| line.starts_with("jq "));
    let mut shell = Command::new("sh");
    shell.args(["-c", command.context("no jq in the page")?]);
    succeed(shell.current_dir(directory))?;
    let made = directory.join("ros2probe-seccomp.json");
    Ok(format!("seccomp={}", made.display()))
}

/// Starts `rp run` in a container, and waits until it is ready.
pub(super) fn start_in_container<'h>(
    podman: &Podman,
    options: &Options,
    host: &'h Namespace,
) -> Result<Agent<'h>> {
    let process = podman.start(options, &[])?;
    let mut agent = Agent { process, host };
    agent.wait_ready(READY)?;
    Ok(agent)
}

#[test]
#[ignore = "looks at a release: make release"]
fn a_robot_on_the_host_is_observed_from_a_container() -> Result<()> {
    let topic = "/beside_a_container";
    let host = Namespace::isolated()?;
    let memory = SharedMemory::of(&host, 64)?;
    let podman = Podman::load(&memory.inside(&host))?;
    let directory = tempfile::tempdir()?;
    let options = Options::documented("--network host")?
        .with("--name", AGENT)
        .with("--security-opt", &seccomp(directory.path())?);
    let mut agent = start_in_container(&podman, &options, &host)?;
    let (mut publisher, _subscriber) =
        wait_discovered(&podman, &memory.inside(&host), topic, &[&agent])?;
    counted(&mut publisher, topic, &[&agent])?;
    let mut list = podman.command("exec");
    let list = succeed(list.args([AGENT, "rp", "topic", "list"]))?;
    ensure!(list.lines().any(|line| line == topic), "{list}");
    // The saved state is for the next container.
    let status = agent.process.terminate()?;
    ensure!(status.success(), "{status}");
    let mut volume = podman.command("volume");
    let volume = volume.args(["inspect", "--format", "{{.Mountpoint}}", "ros2probe-state"]);
    let saved = Path::new(succeed(volume)?.trim()).join("discovery.json");
    ensure!(saved.exists(), "no {}", saved.display());
    Ok(())
}

#[test]
#[ignore = "looks at a release: make release"]
fn a_robot_in_a_container_is_observed_from_the_host_and_from_a_sidecar() -> Result<()> {
    let topic = "/in_a_container";
    let (network, machine) = (Namespace::isolated()?, Namespace::isolated()?);
    let podman = Podman::load(&[])?;
    let root = robot_root()?;
    let peers = Stack::Fast.program()?;
    let peers = peers.parent().context("no directory")?.display();
    let robot = Options(Vec::new())
        .with("--name", "robot")
        .with("--network", &format!("ns:{}", network.network().display()))
        .with("--volume", "/usr:/usr:ro")
        .with("--volume", &format!("{peers}:{peers}:ro"))
        .with("--rootfs", &root.path().display().to_string());
    let mut words = podman.run(&robot);
    words.extend(["sleep", "infinity"].map(str::to_owned));
    let _robot = Process::start(podman.enter(), Podman::program(), words)?;
    wait_until("a robot", || {
        let mut inspect = podman.command("inspect");
        let state = inspect.args(["--format", "{{.State.Running}}", "robot"]);
        Ok(state.output()?.stdout == b"true\n")
    })?;

    let directory = tempfile::tempdir()?;
    let configuration = directory.path().join("host.yaml");
    std::fs::write(&configuration, "capture: {source: host}\nwatch: [/**]\n")?;
    let on_host = Agent::start(&machine, env!("CARGO_BIN_EXE_rp"), &configuration)?;
    let sidecar = Options::documented("--network container:robot")?;
    let mounted = sources("deploy/sidecar.yaml").display().to_string();
    let sidecar = sidecar
        .without("--volume", "./sidecar.yaml:")?
        .with("--name", AGENT)
        .with(
            "--volume",
            &format!("{mounted}:/etc/ros2probe/ros2probe.yaml:ro"),
        )
        .with("--security-opt", &seccomp(directory.path())?);
    let sidecar = start_in_container(&podman, &sidecar, &network)?;

    let agents = [&on_host, &sidecar];
    let mut exec = podman.enter().to_vec();
    exec.push(Podman::program().display().to_string());
    exec.extend(podman.arguments("exec"));
    exec.extend(["--interactive", "robot"].map(str::to_owned));
    let (mut publisher, _subscriber) = wait_discovered(&podman, &exec, topic, &agents)?;
    counted(&mut publisher, topic, &agents)
}

/// Makes a root file system that shows this machine's programs and libraries.
fn robot_root() -> Result<tempfile::TempDir> {
    let root = tempfile::tempdir()?;
    for name in ["dev", "etc", "proc", "run", "sys", "tmp", "usr"] {
        std::fs::create_dir(root.path().join(name))?;
    }
    for name in ["bin", "lib", "lib64", "sbin"] {
        if let Ok(target) = std::fs::read_link(Path::new("/").join(name)) {
            std::os::unix::fs::symlink(target, root.path().join(name))?;
        }
    }
    Ok(root)
}

/// One option of the documented command is missing or different, and the agent prints this line, in
/// full or behind its time.
struct Refusal {
    options: Options,
    line: &'static str,
}

fn refusals(directory: &Path) -> Result<Vec<Refusal>> {
    let permitting = seccomp(directory)?;
    let documented = || -> Result<Options> {
        Ok(Options::documented("--network host")?.with("--security-opt", &permitting))
    };
    let empty = directory.join("empty");
    std::fs::create_dir(&empty)?;
    let profile = directory.join("seccomp.json");
    let refusing = r#"{"defaultAction":"SCMP_ACT_ALLOW","syscalls":[{"names":["bpf"],"action":"SCMP_ACT_ERRNO"}]}"#;
    std::fs::write(&profile, refusing)?;
    let groups = "/sys/fs/cgroup:/sys/fs/cgroup:ro";
    let refusal = |options: Options, line| Refusal { options, line };
    Ok(vec![
        refusal(
            documented()?.without("--cap-add", "BPF")?,
            "CAP_BPF is missing: add --cap-add BPF",
        ),
        refusal(
            documented()?.without("--cap-add", "PERFMON")?,
            "CAP_PERFMON is missing: add --cap-add PERFMON",
        ),
        refusal(
            documented()?.without("--cap-add", "NET_ADMIN")?,
            "CAP_NET_ADMIN is missing: add --cap-add NET_ADMIN",
        ),
        refusal(
            documented()?.without("--volume", groups)?.with(
                "--volume",
                &format!("{}:/sys/fs/cgroup:ro", empty.display()),
            ),
            "no cgroup v2 hierarchy is mounted: add --cgroupns host --volume \
             /sys/fs/cgroup:/sys/fs/cgroup:ro",
        ),
        refusal(
            documented()?
                .without("--cgroupns", "host")?
                .without("--volume", groups)?
                .with("--cgroupns", "private"),
            "/sys/fs/cgroup is not the root of the host's control groups, so sockets of other \
             containers are not observed: add --cgroupns host --volume \
             /sys/fs/cgroup:/sys/fs/cgroup:ro",
        ),
        refusal(
            documented()?
                .without("--security-opt", "seccomp=")?
                .with("--security-opt", &format!("seccomp={}", profile.display())),
            "the seccomp profile refuses the system call bpf: add --security-opt seccomp=FILE \
             (docs/containers.md)",
        ),
        refusal(
            documented()?.with("--uidmap", "0:100000:65536"),
            "a user namespace of its own has no right to load the kernel filter: add --userns host, \
             and start the container as root",
        ),
        refusal(
            documented()?.without("--pid", "host")?,
            "process ids are not the host's, so owners of sockets are unknown: add --pid host",
        ),
        refusal(
            documented()?
                .without("--network", "host")?
                .with("--network", "none"),
            "interfaces are those of the container, so the host's are not observed: add --network \
             host",
        ),
        refusal(
            documented()?.without("--volume", "/dev/shm:")?,
            "/dev/shm is not the host's, so its shared memory is not observed: add --volume \
             /dev/shm:/dev/shm:ro",
        ),
        refusal(
            documented()?.without("--volume", "ros2probe-state:")?,
            "/var/lib/ros2probe cannot be written, so a restart loses names and added watches: add \
             --volume ros2probe-state:/var/lib/ros2probe",
        ),
        refusal(
            documented()?.with("--user", "0"),
            "/var/lib/ros2probe cannot be written, so a restart loses names and added watches: add \
             --user 0:65532",
        ),
    ])
}

#[test]
#[ignore = "looks at a release: make release"]
fn each_missing_option_is_one_line_with_the_option() -> Result<()> {
    let directory = tempfile::tempdir()?;
    let page = std::fs::read_to_string(page())?;
    // A group that is not the root, as engines make one for each container.
    let group = Cgroup::create(&format!("{PREFIX}-{}-refusals", std::process::id()))?;
    let podman = Podman::load(&group.inside())?;
    for Refusal { options, line } in refusals(directory.path())? {
        let quiet = ["run", "--metrics=off", "--api=off", "--foxglove=off"];
        let mut agent = podman.start(&options, &quiet)?;
        let printed = agent.line_with_end(line, PATIENCE);
        let printed = printed.with_context(|| format!("{options:?}"))?;
        let before = printed.strip_suffix(line).unwrap_or_default();
        ensure!(before == "rp: " || before.ends_with(" WARN "), "{printed}");
        ensure!(page.contains(line), "{line}: not in docs/containers.md");
        podman.remove_containers()?;
    }
    Ok(())
}
