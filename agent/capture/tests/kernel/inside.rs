//! Datagrams lost inside this host, attributed to their samples: in full receive buffers and in
//! reassembly. Further tests find the processes that hold a socket. All need root.

mod full_buffers;
mod reassembly;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::os::fd::{AsRawFd as _, FromRawFd as _, OwnedFd};
use std::process::Command;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};

use ros2probe_capture::filter::{Filter, FilterSettings};
use ros2probe_capture::netns;
use ros2probe_capture::owners::Owner;
use ros2probe_testing::forged::frames::Wire;
use ros2probe_testing::forged::{self, Carrier as _, SAMPLES_WRITER, Talker};
use ros2probe_testing::harness::cgroup::{self, Cgroup};
use ros2probe_testing::harness::loss::Loss;
use ros2probe_testing::harness::network::{INTERFACE, Link, Namespace};
use ros2probe_testing::harness::{self, PREFIX, run};
use ros2probe_wire::filter::Counter;
use ros2probe_wire::record::{Record, Verdict, flag, kind};
use ros2probe_wire::walk::{self, Envelope};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

static NEXT: AtomicU16 = AtomicU16::new(0);

/// A cgroup, the host hook on it, and the tracepoint programs.
struct Observed {
    filter: Filter,
    cgroup: Cgroup,
}

impl Observed {
    fn new() -> Observed {
        Observed::with(&FilterSettings::default())
    }

    fn with(settings: &FilterSettings) -> Observed {
        harness::require().unwrap();
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = format!("{PREFIX}-{}-inside{number}", std::process::id());
        let cgroup = Cgroup::create(&name).unwrap();
        let mut filter = Filter::load_host(settings).unwrap();
        filter.attach(&File::open(cgroup.path()).unwrap()).unwrap();
        filter.attach_tracepoints(false);
        Observed { filter, cgroup }
    }

    fn owners(&self, socket: u64) -> BTreeMap<u64, Owner> {
        let owners = self.filter.tracepoints().unwrap().owners().expect("owners");
        owners.refresh(&BTreeSet::from([socket])).unwrap()
    }

    /// Returns the records of a writer that arrive within the given time.
    fn records(&mut self, writer: Guid, within: Duration) -> Vec<Record> {
        let deadline = Instant::now() + within;
        let mut found = Vec::new();
        loop {
            while let Some(record) = self.filter.next_record() {
                if record.writer() == writer {
                    found.push(record);
                }
            }
            if Instant::now() >= deadline {
                return found;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Returns the records of a writer once this number of reports on lost datagrams has arrived,
    /// with those that arrive shortly after.
    fn records_of_lost(&mut self, writer: Guid, number: usize) -> Vec<Record> {
        let begun = Instant::now();
        let mut found = Vec::new();
        let is_lost = |record: &&Record| record.flags & flag::NOT_REASSEMBLED != 0;
        while found.iter().filter(is_lost).count() < number && begun.elapsed() < PATIENCE {
            found.extend(self.records(writer, Duration::from_millis(50)));
        }
        found.extend(self.records(writer, SETTLED));
        found
    }

    fn counted(&self, counter: Counter) -> u64 {
        let counters = self.filter.counters().unwrap();
        counters
            .iter()
            .find(|(each, _)| *each == counter)
            .unwrap()
            .1
    }

    /// Opens a socket of the cgroup in a host's network.
    fn socket(&self, host: &Namespace, address: &str) -> UdpSocket {
        let address: SocketAddr = address.parse().unwrap();
        let path = host.network();
        let open = || netns::within(&path, || shared_socket(address));
        self.cgroup.hold(open).unwrap().unwrap()
    }
}

/// Opens a bound socket that can share its address.
fn shared_socket(address: SocketAddr) -> UdpSocket {
    let domain = if address.is_ipv4() {
        libc::AF_INET
    } else {
        libc::AF_INET6
    };
    // SAFETY: the call takes no pointers.
    let descriptor = unsafe { libc::socket(domain, libc::SOCK_DGRAM | libc::SOCK_CLOEXEC, 0) };
    assert!(descriptor >= 0);
    // SAFETY: the descriptor is new and has no other owner.
    let socket = unsafe { UdpSocket::from_raw_fd(descriptor) };
    set(&socket, libc::SO_REUSEADDR, 1);
    let (storage, len) = raw(address);
    // SAFETY: the address has the given length.
    let bound = unsafe { libc::bind(descriptor, storage.as_ptr().cast(), len) };
    assert_eq!(bound, 0, "{address}: {}", std::io::Error::last_os_error());
    socket
}

/// `struct sockaddr_in` or `sockaddr_in6`.
fn raw(address: SocketAddr) -> (Vec<u8>, libc::socklen_t) {
    let family = if address.is_ipv4() {
        libc::AF_INET
    } else {
        libc::AF_INET6
    };
    let family = u16::try_from(family).unwrap().to_ne_bytes();
    let port = address.port().to_be_bytes();
    let bytes = match address.ip() {
        IpAddr::V4(ip) => [&family[..], &port, &ip.octets(), &[0; 8]].concat(),
        IpAddr::V6(ip) => [&family[..], &port, &[0; 4], &ip.octets(), &[0; 4]].concat(),
    };
    let len = libc::socklen_t::try_from(bytes.len()).unwrap();
    (bytes, len)
}

fn set(socket: &UdpSocket, option: libc::c_int, value: libc::c_int) {
    // SAFETY: both pointers refer to an int, the option's type, and outlive the call.
    let result = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            option,
            (&raw const value).cast(),
            size_of_val(&value) as libc::socklen_t,
        )
    };
    assert_eq!(result, 0);
}

/// Returns SO_COOKIE: the kernel assigns a socket this number on the first query.
fn cookie(socket: &UdpSocket) -> u64 {
    let mut cookie = 0_u64;
    let mut len = libc::socklen_t::try_from(size_of_val(&cookie)).unwrap();
    // SAFETY: both pointers refer to 8 bytes, the option's size, and outlive the call.
    let result = unsafe {
        libc::getsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_COOKIE,
            (&raw mut cookie).cast(),
            &raw mut len,
        )
    };
    assert_eq!(result, 0, "SO_COOKIE");
    cookie
}

#[test]
fn a_socket_has_a_process_name_an_inode_and_a_drop_count() {
    let observed = Observed::new();
    let abilities = observed.filter.tracepoints().unwrap().abilities();
    assert!(abilities.owners.is_ok(), "{abilities:?}");
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let cookie = cookie(&socket);
    let found = observed.owners(cookie);
    let owner = &found[&cookie];
    assert_eq!(owner.process_id, std::process::id());
    assert_eq!(owner.own_process_id, std::process::id());
    let link = std::fs::read_link(format!("/proc/self/fd/{}", socket.as_raw_fd())).unwrap();
    assert_eq!(link.to_str().unwrap(), format!("socket:[{}]", owner.inode));
    let name = std::fs::read_to_string("/proc/self/comm").unwrap();
    assert_eq!(owner.process_name, name.trim_end());
    assert_eq!(owner.drops, Some(0));
}

#[test]
fn a_socket_of_a_container_has_the_process_ids_of_both_pid_namespaces() {
    let observed = Observed::new();
    let host = Namespace::isolated().unwrap();
    let bind = || UdpSocket::bind("127.0.0.1:0").unwrap();
    let socket = netns::within(&host.network(), bind).unwrap();
    let cookie = cookie(&socket);
    // A thread's children belong to the PID namespace that it has created.
    let contained = std::thread::spawn(|| {
        // SAFETY: the call takes no pointers.
        assert_eq!(unsafe { libc::unshare(libc::CLONE_NEWPID) }, 0);
        let mut sleep = Command::new("sleep");
        sleep
            .arg("60")
            .stdin(OwnedFd::from(socket))
            .spawn()
            .unwrap()
    });
    let mut child = contained.join().unwrap();
    // The name changes only after the parent has learned that exec succeeded.
    let name = format!("/proc/{}/comm", child.id());
    while std::fs::read_to_string(&name).unwrap() != "sleep\n" {
        std::thread::yield_now();
    }
    let other = UdpSocket::bind("127.0.0.1:0").unwrap();
    let unwanted = self::cookie(&other);
    let found = observed.owners(cookie);
    let again = observed.owners(cookie);
    child.kill().unwrap();
    child.wait().unwrap();
    let gone = observed.owners(cookie);
    let owner = &found[&cookie];
    assert_eq!((owner.process_id, owner.own_process_id), (child.id(), 1));
    assert_eq!(owner.process_name, "sleep");
    assert!(!found.contains_key(&unwanted));
    assert_eq!(found, again);
    assert!(gone.is_empty());
}

fn talker(number: u32) -> (Talker, Guid) {
    let talker = Talker::new(std::process::id() << 4 | number, "/points");
    let guid = Guid {
        prefix: GuidPrefix(talker.prefix),
        entity: EntityId(SAMPLES_WRITER),
    };
    (talker, guid)
}

/// Received and missing samples of a socket, by sequence number and first fragment.
type FragmentNumbers = BTreeSet<(u64, u32)>;

fn fragment_numbers<'a>(records: impl IntoIterator<Item = &'a Record>) -> FragmentNumbers {
    let all = records.into_iter();
    all.map(|record| (record.sequence_number, record.fragment_start))
        .collect()
}

/// Maximum wait for the reports on lost datagrams.
const PATIENCE: Duration = Duration::from_secs(20);
/// Time until everything sent has arrived.
const SETTLED: Duration = Duration::from_millis(200);

fn observed_link(number: u32, verdict: Verdict) -> (Observed, Link, Talker, Guid) {
    let mut observed = Observed::new();
    let abilities = observed.filter.tracepoints().unwrap().abilities();
    assert!(abilities.socket_losses.is_ok(), "{abilities:?}");
    let link = Link::new().unwrap();
    for (host, address) in [(&link.robot, "fd99::1"), (&link.monitor, "fd99::2")] {
        let name = host.name();
        run(&format!(
            "ip -n {name} addr add {address}/64 dev {INTERFACE} nodad"
        ))
        .unwrap();
    }
    for (from, to) in [
        (
            link.robot.address().to_string(),
            link.monitor.address().to_string(),
        ),
        ("[fd99::1]".to_owned(), "[fd99::2]".to_owned()),
    ] {
        wait_for_link(&link, &from, &to);
    }
    let (talker, writer) = talker(number);
    observed.filter.set_interest(writer, Some(verdict)).unwrap();
    (observed, link, talker, writer)
}

/// Waits until a datagram arrives: the kernel notices a new carrier later, and until the link
/// address is resolved, datagrams wait in a short queue of the sender.
fn wait_for_link(link: &Link, from: &str, to: &str) {
    let bind = |host: &Namespace, address: &str| {
        let bind = || UdpSocket::bind(format!("{address}:0")).unwrap();
        netns::within(&host.network(), bind).unwrap()
    };
    let (sender, receiver) = (bind(&link.robot, from), bind(&link.monitor, to));
    let interval = Duration::from_millis(100);
    receiver.set_read_timeout(Some(interval)).unwrap();
    let is_received = (0..600).any(|_| {
        // Fails while the link has no carrier.
        let _ = sender.send_to(&[0], receiver.local_addr().unwrap());
        receiver.recv(&mut [0]).is_ok()
    });
    assert!(is_received, "{to}");
}
