//! Hosts: network namespaces joined by a veth pair of MTU 1500 with real checksums, each with a
//! cgroup for its processes.

use std::fs;
use std::io::Write as _;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Once;
use std::sync::atomic::{AtomicU16, Ordering};

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::netns;

use super::cgroup::{self, Cgroup};
use super::{PREFIX, remove_leftovers, require, run};

/// The interface of every host.
pub const INTERFACE: &str = "eth0";

/// The interface of a robot to its centre.
const UPLINK: &str = "uplink";

static NEXT: AtomicU16 = AtomicU16::new(0);

/// One host.
pub struct Namespace {
    name: String,
    address: Ipv4Addr,
    cgroup: Cgroup,
}

/// Two hosts joined by one link.
pub struct Link {
    pub robot: Namespace,
    pub monitor: Namespace,
    /// Parent of both hosts' cgroups, as if one machine ran them as containers.
    cgroup: Cgroup,
}

impl Link {
    pub fn new() -> Result<Link> {
        sweep()?;
        let subnet = next_subnet();
        Link::create(subnet, Cgroup::create(&name_of("link", subnet))?)
    }

    /// Creates a link as [`Link::new`] does, below a cgroup that may already be observed.
    pub fn below(above: &Cgroup) -> Result<Link> {
        sweep()?;
        let subnet = next_subnet();
        Link::create(subnet, above.create_below(&name_of("link", subnet))?)
    }

    fn create(subnet: u16, cgroup: Cgroup) -> Result<Link> {
        let robot = Namespace::create("robot", subnet, 1, Some(&cgroup))?;
        let monitor = Namespace::create("monitor", subnet, 2, Some(&cgroup))?;
        run(&format!(
            "ip link add {INTERFACE} netns {} mtu 1500 type veth peer name {INTERFACE} mtu 1500 netns {}",
            robot.name, monitor.name
        ))?;
        robot.configure(INTERFACE)?;
        monitor.configure(INTERFACE)?;
        Ok(Link {
            robot,
            monitor,
            cgroup,
        })
    }

    /// Returns the parent of both hosts' cgroups.
    pub fn cgroup(&self) -> &Path {
        self.cgroup.path()
    }
}

impl Namespace {
    /// Creates a host without a link: its nodes communicate over loopback only.
    pub fn isolated() -> Result<Namespace> {
        sweep()?;
        let host = Namespace::create("robot", next_subnet(), 1, None)?;
        // A browser treats an IPv6 address that is confirmed seconds later as a network change and
        // aborts its requests (ERR_NETWORK_CHANGED).
        netns::within(&host.network(), || {
            fs::write("/proc/sys/net/ipv6/conf/default/accept_dad", "0")
        })?
        .context("cannot set accept_dad")?;
        host.ip(&[
            &format!("link add {INTERFACE} type veth peer name unplugged"),
            "link set unplugged up",
        ])?;
        host.configure(INTERFACE)?;
        Ok(host)
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    pub fn address(&self) -> Ipv4Addr {
        self.address
    }

    /// Returns the cgroup of its processes.
    pub fn cgroup(&self) -> &Path {
        self.cgroup.path()
    }

    /// Runs `make` with this process in the host's cgroup: a socket belongs to the cgroup in which
    /// it was created.
    pub fn hold<T>(&self, make: impl FnOnce() -> T) -> Result<T> {
        self.cgroup.hold(make)
    }

    /// Returns the command prefix that runs a program in this host with the host's own `/sys`.
    pub fn inside(&self) -> Vec<String> {
        let mut words = self.cgroup.inside();
        words.extend(["ip", "netns", "exec", &self.name].map(str::to_owned));
        words
    }

    /// Returns the command prefix that runs a program on this host's network only: `/sys/fs/cgroup`
    /// and the rest of the file system are unchanged, as for a system service.
    pub fn on_network(&self) -> Vec<String> {
        let mut words = self.cgroup.inside();
        words.extend(self.outside());
        words
    }

    /// Returns the command prefix that runs a program on this host's network but outside of its
    /// cgroup.
    pub fn outside(&self) -> [String; 2] {
        let network = format!("--net={}", self.network().display());
        ["nsenter".to_owned(), network]
    }

    /// Returns the file of its network namespace.
    pub fn network(&self) -> PathBuf {
        Path::new("/run/netns").join(&self.name)
    }

    fn create(role: &str, subnet: u16, host: u8, above: Option<&Cgroup>) -> Result<Namespace> {
        let name = name_of(role, subnet);
        let [_, third] = subnet.to_be_bytes();
        let cgroup = match above {
            Some(above) => above.create_below(role)?,
            None => Cgroup::create(&name)?,
        };
        run(&format!("ip netns add {name}"))?;
        Ok(Namespace {
            name,
            cgroup,
            address: Ipv4Addr::new(10, 99, third, host),
        })
    }

    pub(super) fn configure(&self, interface: &str) -> Result<()> {
        let address = self.address;
        self.ip(&[
            "link set lo multicast on up",
            &format!("addr add {address}/24 dev {interface}"),
            &format!("link set {interface} up"),
            &format!("route add 239.0.0.0/8 dev {interface}"),
        ])?;
        // Otherwise veth carries incomplete checksums, unlike a physical link.
        let enter = self.outside().join(" ");
        run(&format!("{enter} ethtool -K {interface} tx off"))?;
        Ok(())
    }

    /// Runs commands of `ip` on this host's network. For each, `ip -n` would create a mount
    /// namespace, too, whose removal waits for the kernel.
    fn ip(&self, commands: &[&str]) -> Result<()> {
        let mut ip = Command::new("nsenter")
            .args(&self.outside()[1..])
            .args(["ip", "-batch", "-"])
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .context("cannot run nsenter")?;
        let mut input = ip.stdin.take().context("no input")?;
        input.write_all(commands.join("\n").as_bytes())?;
        input.write_all(b"\n")?;
        drop(input);
        let output = ip.wait_with_output()?;
        let errors = String::from_utf8_lossy(&output.stderr);
        ensure!(output.status.success(), "{commands:?}: {}", errors.trim());
        Ok(())
    }
}

impl Namespace {
    /// Joins this host to `centre` by a further link.
    pub fn join(&self, centre: &Namespace) -> Result<Uplink> {
        let subnet = next_subnet();
        let [second, third] = subnet.to_be_bytes();
        let address = |host| Ipv4Addr::new(10, 100 + second, third, host);
        let far = format!("to{subnet}");
        run(&format!(
            "ip link add {UPLINK} netns {} mtu 1500 type veth peer name {far} mtu 1500 netns {}",
            self.name, centre.name
        ))?;
        for (host, interface, address) in [
            (self, UPLINK, address(1)),
            (centre, far.as_str(), address(2)),
        ] {
            host.ip(&[
                &format!("addr add {address}/24 dev {interface}"),
                &format!("link set {interface} up"),
            ])?;
        }
        Ok(Uplink {
            host: self.name.clone(),
            address: address(2),
        })
    }
}

/// A link of a robot to its centre.
pub struct Uplink {
    host: String,
    address: Ipv4Addr,
}

impl Uplink {
    /// Returns the address of the centre.
    #[must_use]
    pub const fn address(&self) -> Ipv4Addr {
        self.address
    }

    /// Cuts or mends the link.
    pub fn set_up(&self, is_up: bool) -> Result<()> {
        let state = if is_up { "up" } else { "down" };
        run(&format!("ip -n {} link set {UPLINK} {state}", self.host))?;
        Ok(())
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        if let Err(error) = run(&format!("ip netns delete {}", self.name)) {
            eprintln!("{error:#}");
        }
    }
}

/// Fails if tests cannot run here; removes leftovers of killed tests.
fn sweep() -> Result<()> {
    require()?;
    static SWEPT: Once = Once::new();
    SWEPT.call_once(|| {
        remove_leftovers(Path::new("/run/netns"), |name| {
            let _ = run(&format!("ip netns delete {name}"));
        });
        cgroup::sweep();
    });
    Ok(())
}

fn name_of(role: &str, subnet: u16) -> String {
    format!("{PREFIX}-{}-{subnet}-{role}", std::process::id())
}

fn next_subnet() -> u16 {
    NEXT.fetch_add(1, Ordering::Relaxed)
}
