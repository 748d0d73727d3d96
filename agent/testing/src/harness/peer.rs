//! Real DDS participants and Zenoh sessions: one command line for four stacks (see
//! `agent/cli/tests/peers/peer.hpp`).

use std::net::SocketAddrV4;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};
use tempfile::TempDir;

use super::event_log::EventLog;
use super::network::Namespace;
use super::process::Process;
use super::wait_until;

/// Maximum time of discovery on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stack {
    Fast,
    Cyclone,
    Rust,
    /// Sessions with the keys, tokens and attachments of rmw_zenoh. They need a [`router`].
    Zenoh,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    Publisher,
    Subscriber,
}

impl Role {
    /// Returns the value of `--role`.
    pub(super) fn name(self) -> &'static str {
        match self {
            Role::Publisher => "pub",
            Role::Subscriber => "sub",
        }
    }
}

/// Samples that the publisher sends and the subscriber expects.
#[derive(Clone, Debug)]
pub struct Stream {
    pub topic: String,
    pub size: usize,
    pub rate: f64,
    pub count: u64,
    pub reliable: bool,
    pub transient_local: bool,
    pub depth: usize,
    pub domain: u16,
    /// Whether the peers log every sample.
    pub logged: bool,
    /// Seconds for which a publisher stays after its last sample, unless it is terminated.
    pub linger: f64,
    /// Number of samples after which a publisher waits for [`Peer::start_sending`], repeatedly; 0 =
    /// never.
    pub stretch: u64,
    /// Number of peers of the other role for which a peer waits.
    pub peers: usize,
    /// Requested bytes of each peer's receive buffer, limited by net.core.rmem_max.
    pub receive_buffer: u32,
    /// Fast DDS: whether it uses its default transports, which include shared memory.
    pub shares_memory: bool,
    /// Fast DDS: the publisher's TCP address, at which it listens. Both peers use no other
    /// transport.
    pub tcp: Option<SocketAddrV4>,
    /// Fast DDS: whether readers read the history of writers on their host.
    pub shares_history: bool,
    /// Whether a thread of Fast DDS sends the samples, so that a slow connection delays no write.
    pub asynchronous: bool,
    /// Whether the type has buffers, as in Lyrical, and the best backend that the peer accepts.
    pub buffers: Option<&'static str>,
}

pub struct Peer {
    pub process: Process,
    directory: TempDir,
}

impl Stack {
    /// The DDS stacks.
    pub const ALL: [Stack; 3] = [Stack::Fast, Stack::Cyclone, Stack::Rust];

    /// Returns the path of its program, or of the interpreter of its script.
    pub fn program(self) -> Result<PathBuf> {
        match self {
            Stack::Fast => built("fastdds"),
            Stack::Cyclone => built("cyclonedds"),
            Stack::Rust => is_there(robot()?, "cargo build --example robot"),
            Stack::Zenoh => python("zenoh"),
        }
    }

    /// Returns the script that the program runs, if the program is an interpreter.
    fn script(self) -> Option<&'static str> {
        const SCRIPT: &str = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../cli/tests/peers/zenoh/peer.py"
        );
        (self == Stack::Zenoh).then_some(SCRIPT)
    }

    /// Returns the library of this name that its program loads, as the dynamic linker finds it.
    pub fn library(self, name: &str) -> Result<PathBuf> {
        let list = Command::new("ldd").arg(self.program()?).output()?;
        let list = String::from_utf8_lossy(&list.stdout).into_owned();
        let line = list.lines().find(|line| line.contains(name));
        let path = line.and_then(|line| line.split_ascii_whitespace().nth(2));
        path.map(PathBuf::from)
            .with_context(|| format!("{name} is not in {list}"))
    }
}

impl Stream {
    /// Returns a stream of small samples, as from an IMU: 320 B at 200 Hz, best effort. The history
    /// holds five seconds of samples: RustDDS drops samples that it overwrites before a busy CPU
    /// has sent them.
    pub fn small(count: u64) -> Stream {
        Stream {
            topic: "/imu".to_owned(),
            size: 320,
            rate: 200.0,
            count,
            reliable: false,
            transient_local: false,
            depth: 1000,
            domain: 0,
            logged: true,
            linger: 1.0,
            stretch: 0,
            peers: 1,
            receive_buffer: 4 << 20,
            shares_memory: false,
            tcp: None,
            shares_history: false,
            asynchronous: false,
            buffers: None,
        }
    }

    /// Returns a stream of point clouds of `size` bytes at 20 Hz, best effort. The history holds
    /// one second of samples: RustDDS drops samples that it overwrites before a busy CPU has sent
    /// them.
    pub fn point_cloud(size: usize, count: u64) -> Stream {
        Stream {
            topic: "/points".to_owned(),
            size,
            rate: 20.0,
            depth: 20,
            ..Stream::small(count)
        }
    }
}

/// Starts a Zenoh router, which connects to the routers of the hosts in `others`.
pub fn router(host: &Namespace, others: &[&Namespace]) -> Result<Process> {
    let mut words = vec!["--role".to_owned(), "router".to_owned()];
    for other in others {
        words.extend([
            "--connect".to_owned(),
            format!("tcp/{}:7447", other.address()),
        ]);
    }
    let words = Stack::Zenoh
        .script()
        .map(str::to_owned)
        .into_iter()
        .chain(words);
    let mut router = Process::start(&host.inside(), Stack::Zenoh.program()?, words)?;
    router.wait_for("ready", PATIENCE)?;
    Ok(router)
}

/// Starts a publisher that holds its samples, and a subscriber matched with it.
pub fn pair(
    from: &Namespace,
    to: &Namespace,
    stack: Stack,
    stream: &Stream,
) -> Result<(Peer, Peer)> {
    let mut subscriber = Peer::start(to, stack, Role::Subscriber, stream, &["/listener"])?;
    let mut publisher = Peer::start(from, stack, Role::Publisher, stream, &["/sensor"])?;
    publisher.wait_matched()?;
    subscriber.wait_matched()?;
    Ok((publisher, subscriber))
}

impl Peer {
    /// Starts a peer and waits until its endpoints exist. A publisher waits for
    /// [`Peer::start_sending`] before it sends.
    pub fn start(
        host: &Namespace,
        stack: Stack,
        role: Role,
        stream: &Stream,
        nodes: &[&str],
    ) -> Result<Peer> {
        let mut peer = Peer::launch(host, stack, role, stream, nodes)?;
        peer.wait_ready()
            .with_context(|| format!("{stack:?} {role:?}"))?;
        Ok(peer)
    }

    /// Starts a peer as [`Peer::start`] does, without waiting, so that peers can start at the same
    /// time.
    pub fn launch(
        host: &Namespace,
        stack: Stack,
        role: Role,
        stream: &Stream,
        nodes: &[&str],
    ) -> Result<Peer> {
        Peer::launch_behind(&host.inside(), stack, role, stream, nodes)
    }

    /// Starts a peer as [`Peer::launch`] does, behind the caller's command prefix, such as that of
    /// a host with environment variables.
    pub fn launch_behind(
        enter: &[String],
        stack: Stack,
        role: Role,
        stream: &Stream,
        nodes: &[&str],
    ) -> Result<Peer> {
        let directory = tempfile::tempdir().context("cannot create a directory for the log")?;
        let options = ["--role", role.name(), "--topic", &stream.topic, "--hold"];
        let options = options.into_iter();
        let mut words: Vec<String> = stack
            .script()
            .into_iter()
            .chain(options.filter(|word| *word != "--hold" || role == Role::Publisher))
            .map(str::to_owned)
            .collect();
        let mut option = |name: &str, value: String| words.extend([name.to_owned(), value]);
        option("--size", stream.size.to_string());
        option("--rate", stream.rate.to_string());
        option("--depth", stream.depth.to_string());
        option("--domain", stream.domain.to_string());
        option("--peers", stream.peers.to_string());
        option("--receive-buffer", stream.receive_buffer.to_string());
        if let Some(address) = stream.tcp {
            let name = match role {
                Role::Publisher => "--tcp-listen",
                Role::Subscriber => "--tcp-peer",
            };
            option(name, address.to_string());
        }
        if let Some(backend) = stream.buffers {
            option("--buffers", backend.to_owned());
        }
        if stream.logged {
            option("--log", directory.path().join("log").display().to_string());
        }
        if role == Role::Publisher {
            option("--count", stream.count.to_string());
            option("--stretch", stream.stretch.to_string());
            option("--linger", stream.linger.to_string());
        }
        for node in nodes {
            option("--node", (*node).to_owned());
        }
        words.push(
            if stream.reliable {
                "--reliable"
            } else {
                "--best-effort"
            }
            .to_owned(),
        );
        if stream.shares_memory {
            words.extend(["--transport", "default"].map(str::to_owned));
        }
        if stream.shares_history {
            words.push("--data-sharing".to_owned());
        }
        if stream.asynchronous {
            words.push("--asynchronous".to_owned());
        }
        if stream.transient_local {
            words.push("--transient-local".to_owned());
        }
        let process = Process::start(enter, stack.program()?, words)?;
        Ok(Peer { process, directory })
    }

    pub fn wait_ready(&mut self) -> Result<()> {
        self.process.wait_for("ready", PATIENCE)
    }

    /// Waits until a peer of the other role is matched.
    pub fn wait_matched(&mut self) -> Result<()> {
        self.process.wait_for("matched", PATIENCE)
    }

    /// Lets a publisher send.
    pub fn start_sending(&mut self) -> Result<()> {
        self.process.write_line("go")
    }

    /// Waits until a publisher has sent all its samples.
    pub fn wait_sent(&mut self, limit: Duration) -> Result<()> {
        self.process.wait_for("done", limit)
    }

    /// Waits until a subscriber has logged this many samples.
    pub fn wait_received(&self, count: u64) -> Result<()> {
        wait_until("the subscriber has all samples", || {
            Ok(self.log()?.sequences("sub").len() as u64 >= count)
        })
    }

    /// Waits as [`Peer::wait_received`] does, but ends as well if the subscriber has logged no
    /// further sample for three seconds.
    pub fn wait_settled(&self, count: u64) -> Result<()> {
        const QUIET: Duration = Duration::from_secs(3);
        let (mut before, mut since) = (None, Instant::now());
        wait_until("the subscriber has all samples that arrive", || {
            let received = self.log()?.sequences("sub").len() as u64;
            if before.replace(received) != Some(received) {
                since = Instant::now();
            }
            Ok(received >= count || since.elapsed() >= QUIET)
        })
    }

    /// Returns the GUID of the peer's endpoint, from its log.
    pub fn guid(&self) -> Result<Guid> {
        let log = self.log()?;
        let digits = log.endpoints().find_map(|endpoint| endpoint.guid.clone());
        let digits = digits.context("no GUID in the log")?;
        let bytes = u128::from_str_radix(&digits, 16)?.to_be_bytes();
        let (prefix, entity) = bytes.split_at(12);
        Ok(Guid::new(
            GuidPrefix(prefix.try_into()?),
            EntityId(entity.try_into()?),
        ))
    }

    pub fn log_path(&self) -> PathBuf {
        self.directory.path().join("log")
    }

    pub fn log(&self) -> Result<EventLog> {
        EventLog::read(&self.log_path())
    }
}

/// Returns the path of the demo robot, which cargo builds as an example beside the tests.
pub fn robot() -> Result<PathBuf> {
    Ok(profile_directory()?.join("examples/robot"))
}

/// Starts the robot's program on a host in a role of the demo, and returns once it has announced
/// its endpoints.
pub fn start_robot(host: &Namespace, role: &str) -> Result<Process> {
    let mut robot = Process::start(&host.inside(), robot()?, ["--role", role])?;
    robot.wait_for("ready", PATIENCE)?;
    Ok(robot)
}

/// Returns `rp` of the same build.
pub fn rp() -> Result<PathBuf> {
    Ok(profile_directory()?.join("rp"))
}

/// Returns `target/debug` or its equivalent: tests run in its `deps`, examples in its `examples`.
fn profile_directory() -> Result<PathBuf> {
    let program = std::env::current_exe().context("cannot tell where this program is")?;
    let directory = program
        .ancestors()
        .nth(2)
        .context("this program is not in a target directory")?;
    Ok(directory.to_owned())
}

/// Returns the interpreter of a Python environment of this name.
pub fn python(name: &str) -> Result<PathBuf> {
    let program = target_directory()?.join(format!("tools/{name}/bin/python"));
    is_there(program, ".ci/prerequisites.sh test")
}

/// Returns a program built by `make peers`.
pub fn built(name: &str) -> Result<PathBuf> {
    is_there(target_directory()?.join("peers").join(name), "make peers")
}

fn is_there(program: PathBuf, remedy: &str) -> Result<PathBuf> {
    if !program.exists() {
        bail!("{} is missing: run `{remedy}`", program.display());
    }
    Ok(program)
}

fn target_directory() -> Result<PathBuf> {
    let profile = profile_directory()?;
    let target = profile
        .ancestors()
        .find(|directory| directory.join("CACHEDIR.TAG").exists());
    Ok(target
        .or_else(|| profile.parent())
        .unwrap_or(Path::new("target"))
        .to_owned())
}
