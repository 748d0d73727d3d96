//! The host hook on real sockets: what passes is seen whole, each copy with its socket, nothing is
//! dropped, and nothing stays behind. Needs root.

#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "test code says what must hold by failing"
)]

mod forged;
mod harness;
mod program_run;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::net::{SocketAddr, UdpSocket};
use std::os::fd::AsRawFd as _;
use std::os::unix::fs::MetadataExt as _;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::Duration;

use anyhow::{Context as _, Result};
use harness::cgroup::Cgroup;
use harness::network::{Link, Namespace};
use harness::{PREFIX, run};
use ros2probe::capture::filter::{Filter, FilterSettings};
use ros2probe::capture::netns;
use ros2probe_wire::filter::Counter;
use ros2probe_wire::host::Piece;
use ros2probe_wire::record::{Record, Verdict, flag, kind};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const WRITER: Guid = Guid::new(GuidPrefix(*b"\x01\x0fhosthookho"), EntityId([0, 0, 1, 3]));
static NEXT: AtomicU16 = AtomicU16::new(0);

/// Payloads of UDP datagrams: in one frame of MTU 1500, in a few, in as many as there can be, and
/// around the size of a piece.
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

    /// Captured datagrams with their first piece, put together.
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

    /// A socket of this cgroup on a host.
    fn socket(&self, host: &Namespace, address: &str) -> Result<UdpSocket> {
        let address: SocketAddr = address.parse()?;
        let socket = self
            .cgroup
            .hold(|| netns::within(&forged::path(host), || UdpSocket::bind(address)))??
            .with_context(|| format!("cannot bind {address}"))?;
        socket.set_read_timeout(Some(Duration::from_secs(5)))?;
        Ok(socket)
    }
}

fn cookie(socket: &UdpSocket) -> u64 {
    let (mut cookie, mut size) = (0_u64, 8);
    // SAFETY: the value has the size given.
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

/// Two hosts with an IPv6 address each.
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

/// A DATA in a datagram of `size` bytes, whose bytes differ.
fn payload(number: u32, size: usize) -> Vec<u8> {
    let mut bytes = program_run::message(WRITER, number..=number, size - 44);
    for (at, byte) in bytes.iter_mut().enumerate().skip(44) {
        *byte = (at * 31 + at / 256) as u8;
    }
    bytes
}

/// Sender's and receiver's addresses on a veth pair and on loopback.
fn ways(link: &Link) -> [(&Namespace, String, &Namespace, String); 4] {
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
fn every_datagram_is_one_record_on_its_way_out_and_one_on_its_way_in() -> Result<()> {
    let link = link()?;
    for (host, from, other, to) in ways(&link) {
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
fn captured_datagrams_arrive_to_the_byte_up_to_the_longest() -> Result<()> {
    let link = link()?;
    for (host, from, other, to) in ways(&link) {
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
