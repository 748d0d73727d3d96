//! Where datagrams die inside this host, told by name: in full receive buffers and in reassembly;
//! and who holds a socket. Needs root.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::os::fd::{AsRawFd as _, FromRawFd as _, OwnedFd};
use std::process::Command;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};

use ros2probe::capture::filter::{Filter, FilterSettings};
use ros2probe::capture::netns;
use ros2probe::capture::owners::Owner;
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

/// A cgroup, the host hook on it, and what looks further inside.
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

    /// The records of a writer that come within the time given.
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

    fn counted(&self, counter: Counter) -> u64 {
        let counters = self.filter.counters().unwrap();
        counters
            .iter()
            .find(|(each, _)| *each == counter)
            .unwrap()
            .1
    }

    /// A socket of the cgroup in a host's network.
    fn socket(&self, host: &Namespace, address: &str) -> UdpSocket {
        let address: SocketAddr = address.parse().unwrap();
        let path = forged::path(host);
        let open = || netns::within(&path, || shared_socket(address));
        self.cgroup.hold(open).unwrap().unwrap()
    }
}

/// A bound socket that others may share the address with.
fn shared_socket(address: SocketAddr) -> UdpSocket {
    let domain = if address.is_ipv4() {
        libc::AF_INET
    } else {
        libc::AF_INET6
    };
    // SAFETY: takes no pointers.
    let descriptor = unsafe { libc::socket(domain, libc::SOCK_DGRAM | libc::SOCK_CLOEXEC, 0) };
    assert!(descriptor >= 0);
    // SAFETY: a descriptor that was just made and that nobody else has.
    let socket = unsafe { UdpSocket::from_raw_fd(descriptor) };
    set(&socket, libc::SO_REUSEADDR, 1);
    let (storage, len) = raw(address);
    // SAFETY: a socket address of the length given.
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
    // SAFETY: the option's value is an int, which both pointers say and which outlive the call.
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

/// SO_COOKIE: the number that the kernel gives a socket when it is asked for it.
fn cookie(socket: &UdpSocket) -> u64 {
    let mut cookie = 0_u64;
    let mut len = libc::socklen_t::try_from(size_of_val(&cookie)).unwrap();
    // SAFETY: the option's value is 8 bytes, which both pointers say and which outlive the call.
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
fn a_socket_is_known_by_process_name_inode_and_drops() {
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
fn a_socket_of_another_network_and_process_id_namespace_is_known_by_both_its_process_ids() {
    let observed = Observed::new();
    let host = Namespace::alone().unwrap();
    let bind = || UdpSocket::bind("127.0.0.1:0").unwrap();
    let socket = netns::within(&forged::path(&host), bind).unwrap();
    let cookie = cookie(&socket);
    // A thread's children are born in the process id namespace that it has made.
    let contained = std::thread::spawn(|| {
        // SAFETY: takes no pointers.
        assert_eq!(unsafe { libc::unshare(libc::CLONE_NEWPID) }, 0);
        let mut sleep = Command::new("sleep");
        sleep
            .arg("60")
            .stdin(OwnedFd::from(socket))
            .spawn()
            .unwrap()
    });
    let mut child = contained.join().unwrap();
    // The name changes only after the parent has heard that all is well.
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

/// Makes the kernel of a host give up on fragments after a second.
fn hurry(host: &Namespace) {
    netns::within(&forged::path(host), || {
        for path in ["ipv4/ipfrag_time", "ipv6/ip6frag_time"] {
            std::fs::write(format!("/proc/sys/net/{path}"), "1").unwrap();
        }
    })
    .unwrap();
}

fn talker(number: u32) -> (Talker, Guid) {
    let talker = Talker::new(std::process::id() << 4 | number, "/points");
    let guid = Guid {
        prefix: GuidPrefix(talker.prefix),
        entity: EntityId(SAMPLES_WRITER),
    };
    (talker, guid)
}

/// Long enough for a kernel in a hurry to give up.
const GIVEN_UP: Duration = Duration::from_millis(2500);

#[test]
fn a_datagram_that_lacks_its_last_fragment_is_named() {
    let mut observed = Observed::new();
    let link = Link::new().unwrap();
    hurry(&link.monitor);
    let (mut talker, writer) = talker(1);
    observed
        .filter
        .set_interest(writer, Some(Verdict::Meter))
        .unwrap();
    let mut wire = Wire::new(&link.robot, &link.monitor, INTERFACE).unwrap();
    let before = observed.counted(Counter::NotReassembled);
    wire.carry(&talker.sample(30_000)).unwrap();
    wire.shuffle = |packets| drop(packets.pop());
    for _ in 2..=4 {
        wire.carry(&talker.sample(30_000)).unwrap();
    }
    wire.shuffle = |packets| drop(packets.remove(3));
    wire.carry(&talker.sample(5_000)).unwrap();
    wire.shuffle = |_| {};
    wire.carry(&talker.sample(30_000)).unwrap();
    let found = observed.records(writer, GIVEN_UP);
    let mut numbers: Vec<_> = found.iter().map(|record| record.sequence_number).collect();
    numbers.sort_unstable();
    assert_eq!(numbers, [2, 3, 4, 5]);
    for record in found {
        assert_eq!(record.kind, kind::DATA);
        assert_eq!(
            record.flags & !flag::STAMP,
            flag::FRAGMENTED | flag::NOT_REASSEMBLED
        );
        assert_eq!(record.destination_port, forged::DISCOVERY_PORT);
        let destination: [u8; 16] = zerocopy::transmute!(record.destination);
        assert_eq!(destination[12..], link.monitor.address().octets());
        assert_eq!(record.socket, 0);
        let payload = if record.sequence_number == 5 {
            5_000
        } else {
            30_000
        };
        assert_eq!(record.payload_len, payload);
    }
    assert!(observed.counted(Counter::NotReassembled) >= before + 4);
}

#[test]
fn without_its_first_fragment_a_datagram_is_counted_once_and_cannot_be_named() {
    let mut observed = Observed::new();
    let link = Link::new().unwrap();
    hurry(&link.monitor);
    let (mut talker, writer) = talker(2);
    observed
        .filter
        .set_interest(writer, Some(Verdict::Meter))
        .unwrap();
    let mut wire = Wire::new(&link.robot, &link.monitor, INTERFACE).unwrap();
    let before = observed.counted(Counter::NotReassembledUnnamed);
    wire.shuffle = |packets| drop(packets.remove(0));
    for _ in 0..5 {
        wire.carry(&talker.sample(30_000)).unwrap();
    }
    assert_eq!(observed.records(writer, GIVEN_UP), []);
    // Other tests may lose some at the same time, but not one per fragment.
    let unnamed = observed.counted(Counter::NotReassembledUnnamed) - before;
    assert!((5..20).contains(&unnamed), "{unnamed}");
}

#[test]
fn one_that_too_many_others_have_overtaken_is_named_when_it_is_given_up() {
    static HELD: Mutex<Vec<Vec<u8>>> = Mutex::new(Vec::new());
    let mut observed = Observed::new();
    let link = Link::new().unwrap();
    hurry(&link.monitor);
    let limit = || std::fs::write("/proc/sys/net/ipv4/ipfrag_max_dist", "2").unwrap();
    netns::within(&forged::path(&link.monitor), limit).unwrap();
    let (mut talker, writer) = talker(8);
    observed
        .filter
        .set_interest(writer, Some(Verdict::Meter))
        .unwrap();
    let mut wire = Wire::new(&link.robot, &link.monitor, INTERFACE).unwrap();
    wire.shuffle = |packets| *HELD.lock().unwrap() = packets.split_off(2);
    wire.carry(&talker.sample(20_000)).unwrap();
    wire.shuffle = |packets| packets.truncate(1);
    for _ in 2..=6 {
        wire.carry(&talker.sample(20_000)).unwrap();
    }
    wire.shuffle = |packets| *packets = HELD.lock().unwrap().drain(..).collect();
    wire.carry(&talker.sample(20_000)).unwrap();
    let at_once = observed.records(writer, SETTLED);
    assert_eq!(fragment_numbers(&at_once), FragmentNumbers::from([(1, 0)]));
    let later = observed.records(writer, GIVEN_UP);
    assert_eq!(
        fragment_numbers(&later),
        (2..=6).map(|number| (number, 0)).collect()
    );
    assert_eq!(at_once.len() + later.len(), 6);
}

#[test]
fn fragments_that_the_kernel_has_no_memory_for_are_named_at_once() {
    let (mut observed, link, mut talker, writer) = observed_link(12, Verdict::Meter);
    let monitor = link.monitor.address();
    for (family, from, to) in [
        (
            "ipv4/ipfrag",
            format!("{}:0", link.robot.address()),
            format!("{monitor}:7411"),
        ),
        (
            "ipv6/ip6frag",
            "[fd99::1]:0".to_owned(),
            "[fd99::2]:7411".to_owned(),
        ),
    ] {
        let _receiver = observed.socket(&link.monitor, &to);
        let mut sender = forged::Sender::new(&link.robot, &from, &to).unwrap();
        // The receiver's link address has to be found first.
        sender.carry(&talker.sample(100)).unwrap();
        std::thread::sleep(SETTLED);
        observed.records(writer, Duration::ZERO);
        // Half of the first datagram takes all there is, and keeps it.
        let limit = |bytes: &str| {
            std::fs::write(format!("/proc/sys/net/{family}_low_thresh"), "1").unwrap();
            std::fs::write(format!("/proc/sys/net/{family}_high_thresh"), bytes).unwrap();
        };
        netns::within(&forged::path(&link.monitor), || limit("40000")).unwrap();
        let some = talker.sent() + 1;
        for _ in 0..5 {
            sender.carry(&talker.sample(60_000)).unwrap();
            std::thread::sleep(Duration::from_millis(5));
        }
        let found = observed.records(writer, SETTLED);
        let lost: Vec<_> = found
            .iter()
            .filter(|record| record.flags & flag::NOT_REASSEMBLED != 0)
            .collect();
        // The first one is waited for; the others have found no room.
        let expected: FragmentNumbers = (some + 1..some + 5)
            .map(|number| (number.into(), 0))
            .collect();
        assert_eq!(
            (fragment_numbers(lost.iter().copied()), lost.len()),
            (expected, 4),
            "{family}"
        );
        netns::within(&forged::path(&link.monitor), || limit("4000000")).unwrap();
    }
}

#[test]
fn over_ipv6_and_multicast_it_is_named_likewise() {
    let group = Ipv4Addr::new(239, 255, 0, 8);
    let (mut observed, link, mut talker, writer) = observed_link(3, Verdict::Meter);
    hurry(&link.monitor);
    let member = observed.socket(&link.monitor, &format!("{group}:7411"));
    member
        .join_multicast_v4(&group, &link.monitor.address())
        .unwrap();
    let last_v6 = "meta protocol ip6 frag more-fragments 0 frag frag-off > 0";
    let last_v4 = "ip frag-off & 0x2000 == 0 ip frag-off & 0x1fff != 0";
    let ways = [
        (
            "[fd99::1]:0".to_owned(),
            "[fd99::2]:7411".to_owned(),
            last_v6,
            flag::IPV6,
        ),
        (
            format!("{}:0", link.robot.address()),
            format!("{group}:7411"),
            last_v4,
            0,
        ),
    ];
    for (from, to, last_fragment, family) in ways {
        let mut sender = forged::Sender::new(&link.robot, &from, &to).unwrap();
        // The receiver's link address has to be found first.
        sender.carry(&talker.sample(100)).unwrap();
        std::thread::sleep(SETTLED);
        observed.records(writer, Duration::ZERO);
        let lossy = Loss::of(&link.robot, last_fragment, 1000).unwrap();
        let before = talker.sent();
        for _ in 0..3 {
            sender.carry(&talker.sample(60_000)).unwrap();
        }
        drop(lossy);
        sender.carry(&talker.sample(60_000)).unwrap();
        let mut found = observed.records(writer, GIVEN_UP);
        found.retain(|record| record.flags & flag::NOT_REASSEMBLED != 0);
        let expected: FragmentNumbers = (before + 1..before + 4)
            .map(|number| (number.into(), 0))
            .collect();
        assert_eq!(
            (fragment_numbers(&found), found.len()),
            (expected, 3),
            "{to}"
        );
        for record in found {
            let flags = flag::FRAGMENTED | flag::NOT_REASSEMBLED | family;
            assert_eq!(record.flags & !flag::STAMP, flags);
            let destination: [u8; 16] = zerocopy::transmute!(record.destination);
            let to: SocketAddr = to.parse().unwrap();
            let expected = match to.ip() {
                IpAddr::V4(address) => address.to_ipv6_mapped(),
                IpAddr::V6(address) => address,
            };
            assert_eq!(destination, expected.octets());
            assert_eq!(record.payload_len, 60_000);
        }
    }
}

/// What of `sent` a socket that reads afterwards has got, and what is missing; samples by sequence
/// number and first fragment.
type FragmentNumbers = BTreeSet<(u64, u32)>;

fn read_all(socket: &UdpSocket) -> FragmentNumbers {
    socket.set_nonblocking(true).unwrap();
    let mut buffer = vec![0; 65_536];
    let mut got = FragmentNumbers::new();
    while let Ok(len) = socket.recv(&mut buffer) {
        got.extend(samples(&buffer[..len]));
    }
    got
}

fn samples(payload: &[u8]) -> FragmentNumbers {
    let mut found = FragmentNumbers::new();
    walk::datagram(payload, &Envelope::default(), None, |each| {
        found.insert((each.record.sequence_number, each.record.fragment_start));
    });
    found
}

fn fragment_numbers<'a>(records: impl IntoIterator<Item = &'a Record>) -> FragmentNumbers {
    let all = records.into_iter();
    all.map(|record| (record.sequence_number, record.fragment_start))
        .collect()
}

/// A message with one DATA_FRAG: one fragment of `size` bytes.
fn fragment(talker: &Talker, number: u32, start: u32, size: u16) -> Vec<u8> {
    let mut bytes = talker.header();
    bytes.extend_from_slice(&[0x16, 1]);
    // The last submessage of a message may leave its length open (RTPS 2.5, 9.4.5.1.3).
    bytes.extend_from_slice(&[0, 0, 0, 0, 28, 0, 0, 0, 0, 0]);
    bytes.extend_from_slice(&SAMPLES_WRITER);
    for word in [0, number, start] {
        bytes.extend_from_slice(&word.to_le_bytes());
    }
    bytes.extend_from_slice(&1_u16.to_le_bytes());
    bytes.extend_from_slice(&size.to_le_bytes());
    bytes.extend_from_slice(&(u32::from(size) * 4).to_le_bytes());
    bytes.resize(bytes.len() + usize::from(size), 0x33);
    bytes
}

/// The receive buffer errors of a host: over IPv4 and over IPv6.
fn full_buffers(host: &Namespace) -> (u64, u64) {
    let read = |path: &str| std::fs::read_to_string(format!("/proc/thread-self/net/{path}"));
    let (v4, v6) = netns::within(&forged::path(host), || {
        (read("snmp").unwrap(), read("snmp6").unwrap())
    })
    .unwrap();
    let mut udp = v4.lines().filter_map(|line| line.strip_prefix("Udp: "));
    let names = udp.next().unwrap().split(' ');
    let mut values = names.zip(udp.next().unwrap().split(' '));
    let v4 = values.find(|(name, _)| *name == "RcvbufErrors").unwrap().1;
    let v6 = v6.lines().find(|line| line.starts_with("Udp6RcvbufErrors"));
    let v6 = v6.unwrap().split_whitespace().last().unwrap();
    (v4.parse().unwrap(), v6.parse().unwrap())
}

/// Time for what was sent to have come through.
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
    let (talker, writer) = talker(number);
    observed.filter.set_interest(writer, Some(verdict)).unwrap();
    (observed, link, talker, writer)
}

#[test]
fn what_a_socket_has_no_room_for_is_named_and_nothing_else() {
    let (mut observed, link, mut talker, writer) = observed_link(4, Verdict::Meter);
    let robot = link.robot.address();
    let monitor = link.monitor.address();
    for (from, to) in [
        (format!("{robot}:0"), format!("{monitor}:7411")),
        ("[fd99::1]:0".to_owned(), "[fd99::2]:7411".to_owned()),
    ] {
        let receiver = observed.socket(&link.monitor, &to);
        set(&receiver, libc::SO_RCVBUF, 32 * 1024);
        let mut sender = forged::Sender::new(&link.robot, &from, &to).unwrap();
        let before = full_buffers(&link.monitor);
        let mut sent = FragmentNumbers::new();
        // Half of them find some room again.
        let mut got = FragmentNumbers::new();
        for round in 0..2 {
            for _ in 0..150 {
                let message = talker.sample(1_000 + 4 * round);
                sent.extend(samples(&message));
                sender.carry(&message).unwrap();
            }
            std::thread::sleep(SETTLED);
            got.extend(read_all(&receiver));
        }
        let missing: FragmentNumbers = sent.difference(&got).copied().collect();
        assert!(
            missing.len() > 100 && got.len() > 20,
            "{} of {}",
            got.len(),
            sent.len()
        );
        let records = observed.records(writer, SETTLED);
        let (refused, seen): (Vec<_>, Vec<_>) = records
            .iter()
            .partition(|record| record.flags & flag::NO_ROOM != 0);
        assert_eq!(fragment_numbers(refused.iter().copied()), missing);
        assert_eq!(refused.len(), missing.len());
        assert_eq!(fragment_numbers(seen.iter().copied()), sent);
        for record in &refused {
            // Each cancels one arrival: the same record but for the flag.
            let arrival = Record {
                flags: record.flags & !flag::NO_ROOM,
                ..**record
            };
            assert!(seen.contains(&&arrival), "{record:?}");
            assert_eq!(record.socket, cookie(&receiver));
        }
        let after = full_buffers(&link.monitor);
        let errors = after.0 + after.1 - before.0 - before.1;
        assert_eq!(errors, missing.len() as u64);
        let socket = observed.filter.socket(cookie(&receiver)).unwrap().unwrap();
        assert_eq!(socket.no_room, errors);
        let owner = &observed.owners(cookie(&receiver))[&cookie(&receiver)];
        assert_eq!(owner.drops.map(u64::from), Some(errors));
    }
}

#[test]
fn without_the_kernels_types_full_sockets_are_told_as_long_as_every_socket_is_seen() {
    let settings = FilterSettings {
        kernel_types: false,
        ..FilterSettings::default()
    };
    let one_cgroup = Observed::with(&settings);
    let abilities = one_cgroup.filter.tracepoints().unwrap().abilities();
    let reason = abilities.socket_losses.clone().unwrap_err();
    assert!(reason.contains("limited to one cgroup"), "{reason}");
    assert!(abilities.owners.is_err() && abilities.reassembly_losses.is_err());

    let mut filter = Filter::load_host(&settings).unwrap();
    let all = File::open(cgroup::hierarchy().unwrap()).unwrap();
    filter.attach(&all).unwrap();
    filter.attach_tracepoints(true);
    let (mut talker, writer) = talker(9);
    filter.set_interest(writer, Some(Verdict::Meter)).unwrap();
    let host = Namespace::alone().unwrap();
    let receiver = one_cgroup.socket(&host, "127.0.0.1:7411");
    set(&receiver, libc::SO_RCVBUF, 32 * 1024);
    let mut sender = forged::Sender::new(&host, "127.0.0.1:0", "127.0.0.1:7411").unwrap();
    let mut sent = FragmentNumbers::new();
    for _ in 0..100 {
        let message = talker.sample(1_000);
        sent.extend(samples(&message));
        sender.carry(&message).unwrap();
    }
    std::thread::sleep(SETTLED);
    let missing: FragmentNumbers = sent.difference(&read_all(&receiver)).copied().collect();
    assert!(!missing.is_empty() && missing.len() < sent.len());
    let records = std::iter::from_fn(|| filter.next_record());
    let refused: Vec<_> = records
        .filter(|record| record.writer() == writer && record.flags & flag::NO_ROOM != 0)
        .collect();
    assert_eq!(
        (fragment_numbers(&refused), refused.len()),
        (missing.clone(), missing.len())
    );
}

#[test]
fn of_two_sockets_in_one_group_only_the_full_one_is_reported() {
    let (mut observed, link, mut talker, writer) = observed_link(5, Verdict::Meter);
    let group = Ipv4Addr::new(239, 255, 0, 7);
    let join = |socket: &UdpSocket| {
        socket
            .join_multicast_v4(&group, &link.monitor.address())
            .unwrap();
    };
    let slow = observed.socket(&link.monitor, &format!("{group}:7411"));
    let quick = observed.socket(&link.monitor, &format!("{group}:7411"));
    set(&slow, libc::SO_RCVBUF, 32 * 1024);
    join(&slow);
    join(&quick);
    let from = format!("{}:0", link.robot.address());
    let mut sender = forged::Sender::new(&link.robot, &from, &format!("{group}:7411")).unwrap();
    let (mut sent, mut got) = (FragmentNumbers::new(), FragmentNumbers::new());
    for _ in 0..200 {
        let message = talker.sample(2_000);
        sent.extend(samples(&message));
        sender.carry(&message).unwrap();
        std::thread::sleep(Duration::from_micros(200));
        got.extend(read_all(&quick));
    }
    std::thread::sleep(SETTLED);
    got.extend(read_all(&quick));
    assert_eq!(got, sent);
    let missing: FragmentNumbers = sent.difference(&read_all(&slow)).copied().collect();
    assert!(!missing.is_empty() && missing.len() < sent.len());
    let records = observed.records(writer, SETTLED);
    let refused: Vec<_> = records
        .iter()
        .filter(|record| record.flags & flag::NO_ROOM != 0)
        .collect();
    assert!(refused.iter().all(|record| record.socket == cookie(&slow)));
    assert_eq!(fragment_numbers(refused.iter().copied()), missing);
    assert_eq!(refused.len(), missing.len());
    let no_room = |socket| {
        observed
            .filter
            .socket(cookie(socket))
            .unwrap()
            .unwrap()
            .no_room
    };
    assert_eq!((no_room(&slow), no_room(&quick)), (missing.len() as u64, 0));
}

#[test]
fn of_samples_in_pieces_the_lost_fragments_are_named() {
    let (mut observed, link, talker, writer) = observed_link(6, Verdict::Meter);
    let to = format!("{}:7411", link.monitor.address());
    let receiver = observed.socket(&link.monitor, &to);
    set(&receiver, libc::SO_RCVBUF, 200 * 1024);
    let from = format!("{}:0", link.robot.address());
    let mut sender = forged::Sender::new(&link.robot, &from, &to).unwrap();
    let mut sent = FragmentNumbers::new();
    for number in 1..=10 {
        for start in 1..=4 {
            let message = fragment(&talker, number, start, 60_000);
            sent.extend(samples(&message));
            sender.carry(&message).unwrap();
        }
    }
    std::thread::sleep(SETTLED);
    let missing: FragmentNumbers = sent.difference(&read_all(&receiver)).copied().collect();
    assert!(
        !missing.is_empty() && missing.len() < sent.len(),
        "{missing:?}"
    );
    let records = observed.records(writer, SETTLED);
    let refused = || {
        let refused = |record: &&Record| record.flags & flag::NO_ROOM != 0;
        records.iter().filter(refused)
    };
    assert_eq!(
        (fragment_numbers(refused()), refused().count()),
        (missing.clone(), missing.len())
    );
    assert!(refused().all(|record| record.kind == kind::DATA_FRAG));
    assert!(refused().all(|record| record.payload_len == 60_000));
}

#[test]
fn a_captured_datagram_that_found_no_room_is_told_by_its_token() {
    let (mut observed, link, mut talker, _) = observed_link(7, Verdict::Capture);
    let to = format!("{}:7411", link.monitor.address());
    let receiver = observed.socket(&link.monitor, &to);
    set(&receiver, libc::SO_RCVBUF, 32 * 1024);
    let from = format!("{}:0", link.robot.address());
    let mut sender = forged::Sender::new(&link.robot, &from, &to).unwrap();
    let mut sent = FragmentNumbers::new();
    for _ in 0..150 {
        let message = talker.sample(2_000);
        sent.extend(samples(&message));
        sender.carry(&message).unwrap();
    }
    std::thread::sleep(SETTLED);
    let missing: FragmentNumbers = sent.difference(&read_all(&receiver)).copied().collect();
    assert!(!missing.is_empty() && missing.len() < sent.len());
    let mut captured = BTreeMap::new();
    while let Some(piece) = observed.filter.next_piece() {
        let (piece, bytes) = piece.read().unwrap();
        captured.insert((piece.datagram, piece.socket), samples(bytes));
    }
    assert_eq!(captured.len(), sent.len());
    let mut refused = FragmentNumbers::new();
    while let Some(record) = observed.filter.next_record() {
        if record.socket == cookie(&receiver) {
            assert_eq!(record.kind, kind::UNDELIVERED);
            refused.extend(&captured[&(record.datagram, record.socket)]);
        }
    }
    assert_eq!(refused, missing);
}

#[test]
fn losses_on_several_cpus_at_once_beside_other_full_sockets_stay_apart() {
    const SAMPLES: usize = 2_000;
    let mut observed = Observed::with(&FilterSettings {
        record_ring_bytes: 8 << 20,
        ..FilterSettings::default()
    });
    let host = Namespace::alone().unwrap();
    let receiver = observed.socket(&host, "127.0.0.1:7411");
    let other = observed.socket(&host, "127.0.0.1:7500");
    for socket in [&receiver, &other] {
        set(socket, libc::SO_RCVBUF, 32 * 1024);
    }
    let talkers = [talker(10), talker(11)];
    for (_, writer) in &talkers {
        let verdict = Some(Verdict::Meter);
        observed.filter.set_interest(*writer, verdict).unwrap();
    }
    let mut got = BTreeSet::new();
    let mut sent = BTreeSet::new();
    std::thread::scope(|scope| {
        let path = forged::path(&host);
        let mut senders = Vec::new();
        for (mut talker, writer) in talkers {
            let noise = netns::within(&path, || UdpSocket::bind("127.0.0.1:0").unwrap()).unwrap();
            let mut sender = forged::Sender::new(&host, "127.0.0.1:0", "127.0.0.1:7411").unwrap();
            senders.push(scope.spawn(move || {
                let mut sent = BTreeSet::new();
                for _ in 0..SAMPLES {
                    noise.send_to(&[7; 500], "127.0.0.1:7500").unwrap();
                    let message = talker.sample(1_000);
                    sent.extend(
                        samples(&message)
                            .iter()
                            .map(|(number, _)| (writer, *number)),
                    );
                    sender.carry(&message).unwrap();
                }
                sent
            }));
        }
        let writers: Vec<_> = senders;
        let mut buffer = vec![0; 65_536];
        let mut read = || {
            while let Ok(len) = receiver.recv(&mut buffer) {
                walk::datagram(&buffer[..len], &Envelope::default(), None, |each| {
                    got.insert((each.record.writer(), each.record.sequence_number));
                });
            }
        };
        receiver.set_nonblocking(true).unwrap();
        while !writers
            .iter()
            .all(std::thread::ScopedJoinHandle::is_finished)
        {
            read();
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(SETTLED);
        read();
        for writer in writers {
            sent.extend(writer.join().unwrap());
        }
    });
    assert_eq!(sent.len(), 2 * SAMPLES);
    let missing: BTreeSet<_> = sent.difference(&got).copied().collect();
    assert!(missing.len() > 100 && got.len() > 100, "{}", missing.len());
    let mut refused = Vec::new();
    let mut arrived = 0;
    while let Some(record) = observed.filter.next_record() {
        if record.socket != cookie(&receiver) {
            continue;
        }
        if record.flags & flag::NO_ROOM == 0 {
            arrived += 1;
        } else {
            refused.push((record.writer(), record.sequence_number));
        }
    }
    assert_eq!(observed.counted(Counter::RecordsLost), 0);
    assert_eq!(arrived, sent.len());
    assert_eq!(refused.len(), missing.len());
    assert_eq!(refused.into_iter().collect::<BTreeSet<_>>(), missing);
    let (errors, _) = full_buffers(&host);
    let others = observed.owners(cookie(&other))[&cookie(&other)]
        .drops
        .unwrap();
    assert_eq!(errors, missing.len() as u64 + u64::from(others));
}
