//! The host hook on real sockets: traffic is seen whole, each copy with its socket, nothing is
//! dropped, and nothing stays behind. The tests need root.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::os::fd::{AsRawFd as _, FromRawFd as _, OwnedFd};
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use ros2probe_capture::filter::{Filter, FilterSettings};
use ros2probe_capture::netns;
use ros2probe_capture::sockets::Sockets;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::harness::cgroup::Cgroup;
use ros2probe_testing::harness::network::{Link, Namespace};
use ros2probe_testing::harness::{PREFIX, run};
use ros2probe_testing::program_run;
use ros2probe_wire::filter::Counter;
use ros2probe_wire::host::{Piece, SOCKET_CAPACITY};
use ros2probe_wire::record::{Record, Verdict, flag, kind};
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Timestamp};

const WRITER: Guid = Guid::new(GuidPrefix(*b"\x01\x0fhosthookho"), EntityId([0, 0, 1, 3]));
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);

static NEXT: AtomicU16 = AtomicU16::new(0);

/// Sizes of UDP payloads: in one frame of MTU 1500, in several, in the largest number, and around
/// the size of a piece.
const SIZES: [usize; 8] = [64, 1_400, 1_500, 16_384, 16_385, 60_000, 65_000, 65_507];

/// A cgroup and the host hook on it.
struct Observed {
    cgroup: Cgroup,
    filter: Filter,
}

impl Observed {
    fn new(verdict: Verdict) -> Result<Observed> {
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let cgroup = Cgroup::create(&format!("{PREFIX}-{}-hook{number}", std::process::id()))?;
        let mut filter = Filter::load_host(&FilterSettings::default())?;
        filter.set_interest(WRITER, Some(verdict))?;
        filter.attach(&File::open(cgroup.path())?)?;
        Ok(Observed { cgroup, filter })
    }

    fn records(&mut self) -> Vec<Record> {
        std::iter::from_fn(|| self.filter.next_record()).collect()
    }

    /// Returns captured datagrams, reassembled, with their first piece.
    fn captured(&mut self) -> Vec<(Piece, Vec<u8>)> {
        let mut whole: BTreeMap<u32, (Piece, Vec<u8>)> = BTreeMap::new();
        while let Some(captured) = self.filter.next_piece() {
            let (piece, bytes) = captured.read().unwrap();
            let (_, so_far) = whole.entry(piece.datagram).or_insert((piece, Vec::new()));
            assert_eq!(piece.offset as usize, so_far.len(), "pieces come in order");
            so_far.extend_from_slice(bytes);
        }
        whole.into_values().collect()
    }

    fn counter(&self, which: Counter) -> Result<u64> {
        let counters = self.filter.counters()?;
        Ok(counters
            .iter()
            .find(|(counter, _)| *counter == which)
            .unwrap()
            .1)
    }

    /// Opens a socket of this cgroup on a host.
    fn socket(&self, host: &Namespace, address: &str) -> Result<UdpSocket> {
        let address: SocketAddr = address.parse()?;
        let socket = self
            .make(host, || UdpSocket::bind(address))?
            .with_context(|| format!("cannot bind {address}"))?;
        socket.set_read_timeout(Some(Duration::from_secs(60)))?;
        Ok(socket)
    }

    /// Runs `make` in this cgroup on a host.
    fn make<T: Send>(&self, host: &Namespace, make: impl FnOnce() -> T + Send) -> Result<T> {
        Ok(self
            .cgroup
            .hold(|| netns::within(&host.network(), make))??)
    }
}

/// Opens a socket of the cgroup in a multicast group of the host's interface.
fn member(observed: &Observed, host: &Namespace, port: u16) -> Result<UdpSocket> {
    let socket = observed.make(host, || shared(port))??;
    socket.join_multicast_v4(&GROUP, &host.address())?;
    socket.set_read_timeout(Some(Duration::from_secs(60)))?;
    Ok(socket)
}

/// Opens a socket on a shared port.
fn shared(port: u16) -> io::Result<UdpSocket> {
    // SAFETY: the call has no preconditions.
    let socket = unsafe { libc::socket(libc::AF_INET, libc::SOCK_DGRAM | libc::SOCK_CLOEXEC, 0) };
    assert!(socket >= 0, "socket: {}", io::Error::last_os_error());
    // SAFETY: the descriptor is new and has no other owner.
    let socket = unsafe { OwnedFd::from_raw_fd(socket) };
    let on = 1_u32;
    let address = libc::sockaddr_in {
        sin_family: 2,
        sin_port: port.to_be(),
        sin_addr: libc::in_addr { s_addr: 0 },
        sin_zero: [0; 8],
    };
    // SAFETY: the option has the given size.
    let set = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_REUSEADDR,
            (&raw const on).cast(),
            4,
        )
    };
    // SAFETY: the address has the given size.
    let bound = unsafe { libc::bind(socket.as_raw_fd(), (&raw const address).cast(), 16) };
    if (set, bound) != (0, 0) {
        return Err(io::Error::last_os_error());
    }
    Ok(socket.into())
}

fn cookie(socket: &UdpSocket) -> u64 {
    let (mut cookie, mut size) = (0_u64, 8);
    // SAFETY: the value has the given size.
    let result = unsafe {
        libc::getsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_COOKIE,
            (&raw mut cookie).cast(),
            &raw mut size,
        )
    };
    assert_eq!(result, 0);
    cookie
}

/// Returns two hosts with an IPv6 address each.
fn link() -> Result<Link> {
    let link = Link::new()?;
    for (host, address) in [(&link.robot, "fd99::1/64"), (&link.monitor, "fd99::2/64")] {
        run(&format!(
            "ip -n {} addr add {address} dev eth0 nodad",
            host.name()
        ))?;
    }
    Ok(link)
}

/// Returns a DATA in a datagram of `size` varying bytes.
fn payload(number: u32, size: usize) -> Vec<u8> {
    let mut bytes = program_run::message(WRITER, number..=number, size - 44);
    for (at, byte) in bytes.iter_mut().enumerate().skip(44) {
        *byte = (at * 31 + at / 256) as u8;
    }
    bytes
}

/// Returns the addresses of sender and receiver on a veth pair and on loopback.
fn address_pairs(link: &Link) -> [(&Namespace, String, &Namespace, String); 4] {
    let (robot, monitor) = (&link.robot, &link.monitor);
    [
        (
            robot,
            format!("{}:0", robot.address()),
            monitor,
            format!("{}:0", monitor.address()),
        ),
        (robot, "[fd99::1]:0".into(), monitor, "[fd99::2]:0".into()),
        (robot, "127.0.0.1:0".into(), robot, "127.0.0.1:0".into()),
        (robot, "[::1]:0".into(), robot, "[::1]:0".into()),
    ]
}

#[test]
fn a_datagram_is_one_record_at_its_sender_and_one_at_its_receiver() -> Result<()> {
    let link = link()?;
    for (host, from, other, to) in address_pairs(&link) {
        let (mut out, mut into) = (
            Observed::new(Verdict::Meter)?,
            Observed::new(Verdict::Meter)?,
        );
        let (sender, receiver) = (out.socket(host, &from)?, into.socket(other, &to)?);
        let (from, to) = (sender.local_addr()?, receiver.local_addr()?);
        let mut buffer = vec![0; 65_536];
        for (number, size) in (1..).zip(SIZES) {
            let sent = payload(number, size);
            sender.send_to(&sent, to)?;
            assert_eq!(receiver.recv(&mut buffer)?, size);
            let seen = [
                (out.records(), &sender, flag::OUTGOING),
                (into.records(), &receiver, 0),
            ];
            for (records, socket, direction) in seen {
                let case = format!("{from} to {to}, {size} bytes, direction {direction}");
                assert_eq!(records.len(), 1, "{case}");
                let record = records[0];
                assert_eq!(record.kind, kind::DATA, "{case}");
                assert_eq!(record.sequence_number, u64::from(number), "{case}");
                assert_eq!(usize::from(record.datagram_len), size, "{case}");
                assert_eq!(record.socket, cookie(socket), "{case}");
                assert_ne!(record.datagram, 0, "{case}");
                assert_eq!(record.source_port, from.port(), "{case}");
                assert_eq!(record.destination_port, to.port(), "{case}");
                let ipv6 = if to.is_ipv6() { flag::IPV6 } else { 0 };
                assert_eq!(
                    record.flags,
                    flag::HOST | flag::STAMP | ipv6 | direction,
                    "{case}"
                );
            }
        }
        assert_eq!(out.counter(Counter::Fragments)?, 0);
        assert_eq!(into.counter(Counter::Fragments)?, 0);
        assert_eq!(
            into.filter.socket(cookie(&receiver))?.unwrap().cgroup,
            fs::metadata(into.cgroup.path())?.ino()
        );
        assert_eq!(into.filter.sockets().count(), 1);
    }
    Ok(())
}

#[test]
fn captured_datagrams_of_all_sizes_arrive_byte_for_byte() -> Result<()> {
    let link = link()?;
    for (host, from, other, to) in address_pairs(&link) {
        let mut out = Observed::new(Verdict::Capture)?;
        let mut into = Observed::new(Verdict::Capture)?;
        let (sender, receiver) = (out.socket(host, &from)?, into.socket(other, &to)?);
        let (from, to) = (sender.local_addr()?, receiver.local_addr()?);
        let mut buffer = vec![0; 65_536];
        for (number, size) in (1..).zip(SIZES) {
            let sent = payload(number, size);
            sender.send_to(&sent, to)?;
            assert_eq!(receiver.recv(&mut buffer)?, size);
            for (observed, socket, direction) in [
                (&mut out, &sender, flag::OUTGOING),
                (&mut into, &receiver, 0),
            ] {
                let case = format!("{from} to {to}, {size} bytes, direction {direction}");
                assert!(observed.records().is_empty(), "{case}");
                let captured = observed.captured();
                assert_eq!(captured.len(), 1, "{case}");
                let (piece, bytes) = &captured[0];
                assert!(*bytes == sent, "{case}: other bytes than were sent");
                assert_eq!(piece.datagram_len as usize, size, "{case}");
                assert_eq!(piece.socket, cookie(socket), "{case}");
                assert_eq!(piece.source_port, from.port(), "{case}");
                assert_eq!(piece.destination_port, to.port(), "{case}");
                let ipv6 = if to.is_ipv6() { flag::IPV6 } else { 0 };
                assert_eq!(piece.flags, flag::HOST | ipv6 | direction, "{case}");
            }
        }
        let all: usize = SIZES.iter().sum();
        assert_eq!(into.counter(Counter::CapturedBytes)?, all as u64);
    }
    Ok(())
}

#[test]
fn two_sockets_in_a_multicast_group_yield_two_records_or_one_capture() -> Result<()> {
    let host = Namespace::isolated()?;
    let mut observed = Observed::new(Verdict::Meter)?;
    let members = [
        member(&observed, &host, 7400)?,
        member(&observed, &host, 7400)?,
    ];
    let sender = observed.socket(&host, &format!("{}:0", host.address()))?;
    let mut buffer = vec![0; 65_536];
    for (number, size) in (1..).zip([320, 60_000]) {
        sender.send_to(&payload(number, size), (GROUP, 7400))?;
        for member in &members {
            assert_eq!(member.recv(&mut buffer)?, size);
        }
        let records = observed.records();
        let (sent, received): (Vec<Record>, Vec<Record>) = records
            .into_iter()
            .partition(|record| record.flags & flag::OUTGOING != 0);
        let sockets: BTreeSet<_> = received.iter().map(|record| record.socket).collect();
        assert_eq!(sockets, members.iter().map(cookie).collect());
        assert_eq!(received.len(), 2, "one record for each: {received:?}");
        assert_eq!(sent.len(), 1, "it is sent once: {sent:?}");
        assert_eq!(sent[0].socket, cookie(&sender));
    }

    observed
        .filter
        .set_interest(WRITER, Some(Verdict::Capture))?;
    let sent = payload(9, 60_000);
    sender.send_to(&sent, (GROUP, 7400))?;
    for member in &members {
        assert_eq!(member.recv(&mut buffer)?, sent.len());
    }
    let captured = observed.captured();
    assert_eq!(captured.len(), 1, "of all copies");
    assert!(captured[0].1 == sent);
    // Each socket has the capture or a record: for a group, the kernel delivers locally before it
    // sends.
    let metered = observed.records();
    let seen: BTreeSet<_> = metered
        .iter()
        .map(|record| (record.socket, record.flags & flag::OUTGOING))
        .chain([(captured[0].0.socket, captured[0].0.flags & flag::OUTGOING)])
        .collect();
    let wanted = members
        .iter()
        .map(|member| (cookie(member), 0))
        .chain([(cookie(&sender), flag::OUTGOING)])
        .collect();
    assert_eq!(seen, wanted);
    assert_eq!(metered.len(), 2);
    assert_eq!(observed.counter(Counter::CopiesNotCaptured)?, 2);
    Ok(())
}

#[test]
fn a_full_ring_loses_only_captures() -> Result<()> {
    let host = Namespace::isolated()?;
    let mut observed = Observed::new(Verdict::Capture)?;
    let sender = observed.socket(&host, "127.0.0.1:0")?;
    let receiver = observed.socket(&host, "127.0.0.1:0")?;
    let mut buffer = vec![0; 65_536];
    for number in 1..=40 {
        sender.send_to(&payload(number, 60_000), receiver.local_addr()?)?;
        assert_eq!(receiver.recv(&mut buffer)?, 60_000);
    }
    let lost = observed.counter(Counter::PiecesLost)?;
    let whole = observed
        .captured()
        .into_iter()
        .filter(|(piece, bytes)| bytes.len() == piece.datagram_len as usize)
        .count();
    assert_eq!(whole, 17, "as many as a ring of a megabyte holds");
    let attempts = observed.counter(Counter::Captured)?;
    assert_eq!(attempts, whole as u64 + lost, "each is reported");
    Ok(())
}

#[test]
fn a_socket_in_use_is_never_evicted_by_sockets_beyond_the_cap() -> Result<()> {
    const BURST_LEN: usize = 500;
    use ros2probe_wire::time::SECOND;
    let cpus = std::thread::available_parallelism()?.get();
    ensure!(
        cpus >= 2,
        "others are not met on another CPU: run this on two"
    );
    let host = Namespace::isolated()?;
    let mut observed = Observed::new(Verdict::Meter)?;
    let bind = || UdpSocket::bind("127.0.0.1:0");
    let sender = netns::within(&host.network(), bind)??;
    let used = observed.socket(&host, "127.0.0.1:0")?;
    let mut numbers = 1..;
    let mut arrives = |observed: &mut Observed, cpu, socket: &UdpSocket| -> Result<()> {
        // The hook caches the socket that a CPU delivers to.
        program_run::go_to_cpu(cpu);
        sender.send_to(&payload(numbers.next().unwrap(), 64), socket.local_addr()?)?;
        socket.recv(&mut [0; 64])?;
        let records = observed.records();
        assert_eq!(records.len(), 1, "what arrives counts as before");
        assert_eq!(records[0].socket, cookie(socket));
        Ok(())
    };
    let mut sockets = Sockets::new(observed.cgroup.path().to_owned());
    let mut observer = Observer::new(Settings::default());
    let (mut met, mut now) = (1, 0);
    let mut forgotten = |observed: &Observed| {
        now += 3 * SECOND;
        sockets.follow(&observed.filter, now, &mut observer);
        let snapshot = observer.snapshot(Timestamp(now));
        let table = snapshot
            .tables
            .iter()
            .find(|table| table.table == "sockets");
        table.unwrap().evictions
    };
    arrives(&mut observed, 0, &used)?;
    assert_eq!(forgotten(&observed), 0);
    while met < 2 * SOCKET_CAPACITY as usize {
        let make = || {
            (0..BURST_LEN)
                .map(|_| bind())
                .collect::<io::Result<Vec<_>>>()
        };
        let others = observed.make(&host, make)??;
        for other in &others {
            arrives(&mut observed, 1, other)?;
        }
        met += others.len();
        arrives(&mut observed, 0, &used)?;
        let count = observed.filter.sockets().count();
        assert!(
            count <= met.min(SOCKET_CAPACITY as usize),
            "{count} of {met}"
        );
        forgotten(&observed);
    }
    let reported = forgotten(&observed) as usize;
    println!("{reported} of {met} forgotten");
    let room = SOCKET_CAPACITY as usize;
    assert!(
        (met - room..=met - room * 3 / 4).contains(&reported),
        "{reported} of {met}"
    );
    let deadline = Instant::now() + Duration::from_secs(60);
    while observed.filter.socket(cookie(&used))?.is_none() {
        ensure!(Instant::now() < deadline, "a socket in use is not met anew");
        arrives(&mut observed, 0, &used)?;
    }
    Ok(())
}

/// Returns the numbers of programs on a cgroup, in both directions (BPF_PROG_QUERY). The hook has
/// two in each direction: for UDP and for TCP.
fn attached(cgroup: &Path) -> Result<[usize; 2]> {
    let directory = File::open(cgroup)?;
    let count = |direction| {
        CgroupSkbPrograms::query(&directory, direction).context("cannot ask for the programs")
    };
    Ok([count(0)?, count(1)?])
}

/// `union bpf_attr` for BPF_PROG_QUERY (linux/bpf.h).
#[repr(C)]
struct CgroupSkbPrograms {
    target: u32,
    attach_type: u32,
    query_flags: u32,
    attach_flags: u32,
    ids: u64,
    count: u32,
    unused: u32,
    more: [u64; 3],
}

impl CgroupSkbPrograms {
    /// Returns the number of programs of an `enum bpf_attach_type`: 0 is ingress, 1 is egress.
    fn query(directory: &File, attach_type: u32) -> io::Result<usize> {
        const BPF_PROG_QUERY: libc::c_int = 16;
        let mut ids = [0_u32; 64];
        let mut query = Self {
            target: directory.as_raw_fd().cast_unsigned(),
            attach_type,
            query_flags: 0,
            attach_flags: 0,
            ids: ids.as_mut_ptr() as u64,
            count: 64,
            unused: 0,
            more: [0; 3],
        };
        // SAFETY: the attribute has the given size, and its array has the given number of entries.
        let result = unsafe {
            libc::syscall(
                libc::SYS_bpf,
                BPF_PROG_QUERY,
                &raw mut query,
                size_of::<Self>(),
            )
        };
        if result < 0 {
            return Err(io::Error::last_os_error());
        }
        Ok(query.count as usize)
    }
}

/// Sends datagrams of all sizes and returns how many arrive.
fn delivered(sender: &UdpSocket, receiver: &UdpSocket) -> Result<usize> {
    receiver.set_read_timeout(Some(Duration::from_secs(30)))?;
    let (mut buffer, mut arrived) = (vec![0; 65_536], 0);
    for number in 1..=20 {
        for size in SIZES {
            sender.send_to(&payload(number, size), receiver.local_addr()?)?;
            arrived += usize::from(receiver.recv(&mut buffer).is_ok_and(|len| len == size));
        }
    }
    Ok(arrived)
}

#[test]
fn other_programs_stay_attached_and_every_datagram_is_delivered() -> Result<()> {
    let link = link()?;
    let mut other = Observed::new(Verdict::Meter)?;
    let sender = other.socket(&link.robot, "[fd99::1]:0")?;
    let receiver = other.socket(&link.monitor, "[fd99::2]:0")?;
    let sent = 20 * SIZES.len();
    let path = other.cgroup.path().to_owned();

    assert_eq!(attached(&path)?, [2, 2]);
    assert_eq!(delivered(&sender, &receiver)?, sent);
    assert_eq!(other.records().len(), 2 * sent);

    // The filter of this test is attached second, and a third one after it.
    let mut ours = Filter::load_host(&FilterSettings::default())?;
    ours.set_interest(WRITER, Some(Verdict::Meter))?;
    ours.attach(&File::open(&path)?)?;
    let mut third = Filter::load_host(&FilterSettings::default())?;
    third.set_interest(WRITER, Some(Verdict::Capture))?;
    third.attach(&File::open(&path)?)?;
    assert_eq!(attached(&path)?, [6, 6]);
    assert_eq!(delivered(&sender, &receiver)?, sent);
    assert_eq!(other.records().len(), 2 * sent);
    assert_eq!(records_of(&mut ours), 2 * sent);

    drop(ours);
    wait_attached(&path, [4, 4])?;
    assert_eq!(delivered(&sender, &receiver)?, sent);
    assert_eq!(other.records().len(), 2 * sent);

    drop(third);
    let Observed { cgroup, filter } = other;
    drop(filter);
    wait_attached(cgroup.path(), [0, 0])?;
    assert_eq!(delivered(&sender, &receiver)?, sent);
    Ok(())
}

/// Waits for the number of programs: the kernel removes links shortly after their last descriptor
/// is closed.
fn wait_attached(cgroup: &Path, programs: [usize; 2]) -> Result<()> {
    let deadline = Instant::now() + Duration::from_secs(60);
    while attached(cgroup)? != programs {
        ensure!(Instant::now() < deadline, "programs stay behind");
        std::thread::sleep(Duration::from_millis(10));
    }
    Ok(())
}

fn records_of(filter: &mut Filter) -> usize {
    std::iter::from_fn(|| filter.next_record()).count()
}
