//! Sends a capture again: each datagram whole, from its source to its destination, between sockets
//! of one host. The arrival of every datagram is checked.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::os::fd::AsRawFd as _;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ros2probe_capture::netns;
use ros2probe_capture::pcap::PcapReader;
use ros2probe_capture::reassembly::{FlowKey, Limits, Reassembly};
use ros2probe_wire::Expansion;
use ros2probe_wire::frame::{self, PacketType, Payload};

use ros2probe_testing::harness::cgroup::Cgroup;
use ros2probe_testing::harness::network::Namespace;
use ros2probe_testing::harness::run;

/// MTU of a cable, so that datagrams are fragmented as on one.
const MTU: u32 = 1500;
const LOOPBACK: &str = "lo";
const PATIENCE: Duration = Duration::from_secs(60);

/// One datagram of a capture.
struct Datagram {
    /// Time since the capture's beginning.
    at: Duration,
    source: SocketAddr,
    destination: SocketAddr,
    payload: Vec<u8>,
}

/// A capture ready to be sent again.
pub(crate) struct Injection {
    datagrams: Vec<Datagram>,
    sockets: BTreeMap<SocketAddr, UdpSocket>,
}

impl Injection {
    /// Prepares a capture; `None` if it holds less than what was on the wire.
    pub(crate) fn of(capture: &Path, host: &Namespace, cgroup: &Cgroup) -> Result<Option<Self>> {
        let Some(datagrams) = datagrams(capture)? else {
            return Ok(None);
        };
        let name = host.name();
        run(&format!("ip -n {name} link set {LOOPBACK} mtu {MTU}"))?;
        let ends = datagrams
            .iter()
            .flat_map(|each| [each.source, each.destination]);
        let mut sockets = BTreeMap::new();
        let network = format!("/run/netns/{name}");
        for end in ends {
            if sockets.contains_key(&end) {
                continue;
            }
            let IpAddr::V4(address) = end.ip() else {
                bail!("{end} in {}", capture.display());
            };
            let known = sockets
                .keys()
                .any(|known: &SocketAddr| known.ip() == end.ip());
            if !known && !address.is_loopback() && !address.is_multicast() {
                run(&format!(
                    "ip -n {name} addr add {address}/32 dev {LOOPBACK}"
                ))?;
            }
            let open = || netns::within(Path::new(&network), || socket(end));
            sockets.insert(end, cgroup.hold(open)??.with_context(|| end.to_string())?);
        }
        Ok(Some(Self { datagrams, sockets }))
    }

    /// Returns the duration of the capture.
    pub(crate) fn duration(&self) -> Duration {
        self.datagrams.last().map_or(Duration::ZERO, |last| last.at)
    }

    /// Sends all packets at this multiple of the captured speed. Returns their number.
    pub(crate) fn run(&self, speed: u32) -> Result<usize> {
        let began = Instant::now();
        let mut received = vec![0; usize::from(u16::MAX)];
        for each in &self.datagrams {
            std::thread::sleep((each.at / speed).saturating_sub(began.elapsed()));
            let (source, destination) = (self.socket(each.source)?, self.socket(each.destination)?);
            source.send_to(&each.payload, each.destination)?;
            let (length, from) = destination.recv_from(&mut received).with_context(|| {
                format!(
                    "{} bytes from {} to {}",
                    each.payload.len(),
                    each.source,
                    each.destination
                )
            })?;
            ensure!(
                from == each.source && received.get(..length) == Some(&each.payload[..]),
                "{length} other bytes from {from} at {}",
                each.destination
            );
        }
        Ok(self.datagrams.len())
    }

    fn socket(&self, address: SocketAddr) -> Result<&UdpSocket> {
        self.sockets.get(&address).context("no socket")
    }
}

/// Opens the socket of a datagram's source or destination, as a member of a multicast group.
fn socket(end: SocketAddr) -> Result<UdpSocket> {
    let socket = UdpSocket::bind(end)?;
    socket.set_read_timeout(Some(PATIENCE))?;
    if let IpAddr::V4(address) = end.ip()
        && address.is_multicast()
    {
        socket.join_multicast_v4(&address, &Ipv4Addr::LOCALHOST)?;
    }
    send_multicasts_to_loopback(&socket)?;
    Ok(socket)
}

fn send_multicasts_to_loopback(socket: &UdpSocket) -> Result<()> {
    let interface = libc::in_addr {
        s_addr: u32::from_ne_bytes(Ipv4Addr::LOCALHOST.octets()),
    };
    // SAFETY: the value has the given size.
    let result = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::IPPROTO_IP,
            libc::IP_MULTICAST_IF,
            (&raw const interface).cast(),
            size_of::<libc::in_addr>() as libc::socklen_t,
        )
    };
    ensure!(result == 0, std::io::Error::last_os_error());
    Ok(())
}

/// Returns all whole datagrams in the order of their completion.
fn datagrams(capture: &Path) -> Result<Option<Vec<Datagram>>> {
    let mut reader = PcapReader::open(capture, Expansion::Limited)?;
    let mut reassembly = Reassembly::new(Limits::default());
    let mut datagrams = Vec::new();
    let mut first = None;
    while let Some(captured) = reader.next_packet()? {
        let first = *first.get_or_insert(captured.time.0);
        let at = Duration::from_nanos(captured.time.0.saturating_sub(first));
        let parsed = frame::parse(captured.link, captured.bytes, captured.length)?;
        let Some(packet) = parsed.packet else {
            continue;
        };
        let interface = parsed.interface.unwrap_or(captured.interface);
        let outgoing = parsed.packet_type == PacketType::OUTGOING;
        let address = |ip: [u8; 16], port| SocketAddr::new(Ipv6Addr::from(ip).to_canonical(), port);
        let mut found = |ports: (u16, u16), payload: &[u8]| {
            datagrams.push(Datagram {
                at,
                source: address(packet.source, ports.0),
                destination: address(packet.destination, ports.1),
                payload: payload.to_vec(),
            });
        };
        match packet.payload {
            Payload::Datagram(udp) if (udp.payload.len() as u64) < u64::from(udp.length) => {
                return Ok(None);
            }
            Payload::Datagram(udp) => {
                found((udp.source_port, udp.destination_port), udp.payload);
            }
            Payload::Fragment(part) => {
                if (part.bytes.len() as u64) < u64::from(part.length) {
                    return Ok(None);
                }
                let key = FlowKey::new(0, interface, outgoing, &packet, &part);
                if let Some(whole) = reassembly.fragment(captured.time, key, &part) {
                    found((whole.source_port, whole.destination_port), whole.payload());
                }
            }
            Payload::Segment(_) | Payload::Other(_) => {}
        }
    }
    Ok(Some(datagrams))
}
