//! Sends raw frames and packets: through a packet socket or a tun device, and as IP fragments in
//! any order.

use std::fs::File;
use std::io::{self, Write as _};
use std::os::fd::{AsRawFd as _, FromRawFd as _, OwnedFd};
use std::sync::atomic::{AtomicU16, Ordering};

use anyhow::{Context as _, Result};
use ros2probe_capture::netns;

use super::{Carrier, DISCOVERY_PORT};
use crate::harness::network::Namespace;

const IPV4: [u8; 2] = [0x08, 0x00];
const UDP: u8 = 17;

/// Reorders or changes the IP packets of a datagram before they are sent.
pub type Shuffle = fn(&mut Vec<Vec<u8>>);

/// Sends Ethernet frames on an interface of a host, including fragments in an order that no kernel
/// sends.
pub struct Wire {
    socket: File,
    from: [u8; 4],
    to: [u8; 4],
    pub shuffle: Shuffle,
    pub port: u16,
    /// 802.1Q or 802.1ad tags, outermost first.
    pub tags: Vec<[u8; 4]>,
}

impl Wire {
    pub fn new(host: &Namespace, other: &Namespace, interface: &str) -> Result<Wire> {
        let socket = netns::within(&host.network(), || packet_socket(interface))?
            .with_context(|| format!("no packet socket on {interface}"))?;
        Ok(Wire {
            socket: File::from(socket),
            from: host.address().octets(),
            to: other.address().octets(),
            shuffle: |_| {},
            port: DISCOVERY_PORT,
            tags: Vec::new(),
        })
    }
}

impl Carrier for Wire {
    fn send(&mut self, payload: &[u8]) -> Result<()> {
        let mut packets = fragments(payload, self.from, self.to, self.port);
        (self.shuffle)(&mut packets);
        for packet in packets {
            let link = [
                &[0xff; 6][..],
                &[2, 0, 0, 0, 0, 1],
                &self.tags.concat(),
                &IPV4,
            ];
            let frame = [&link.concat()[..], &packet].concat();
            self.socket
                .write_all(&frame)
                .context("cannot send a frame")?;
        }
        Ok(())
    }
}

/// A tun device: bytes written to it arrive at its host as IP packets without a link layer.
pub struct Tun {
    device: File,
    from: [u8; 4],
    to: [u8; 4],
}

impl Tun {
    pub fn new(host: &Namespace, name: &str, from: [u8; 4], to: [u8; 4]) -> Result<Tun> {
        let device = netns::within(&host.network(), || tun_device(name))?
            .with_context(|| format!("no tun device {name}"))?;
        Ok(Tun { device, from, to })
    }
}

impl Carrier for Tun {
    fn send(&mut self, payload: &[u8]) -> Result<()> {
        for packet in fragments(payload, self.from, self.to, DISCOVERY_PORT) {
            self.device
                .write_all(&packet)
                .context("cannot write to tun")?;
        }
        Ok(())
    }
}

/// Returns a UDP payload as IPv4 packets that leave room for tags.
fn fragments(payload: &[u8], from: [u8; 4], to: [u8; 4], port: u16) -> Vec<Vec<u8>> {
    const STEP: usize = 1464;
    // Unique, as for a real host, so that no datagram looks like a duplicate.
    static IDENTIFICATION: AtomicU16 = AtomicU16::new(0);
    let identification = IDENTIFICATION.fetch_add(1, Ordering::Relaxed);
    let length = u16::try_from(payload.len() + 8).unwrap_or(u16::MAX);
    let port = port.to_be_bytes();
    let udp = [&port[..], &port, &length.to_be_bytes(), &[0; 2], payload].concat();
    let count = udp.len().div_ceil(STEP);
    let mut packets = Vec::with_capacity(count);
    for (index, piece) in udp.chunks(STEP).enumerate() {
        let more = u16::from(index + 1 < count) << 13;
        let place = u16::try_from(index * STEP / 8).unwrap_or(0) | more;
        let total = u16::try_from(piece.len() + 20).unwrap_or(u16::MAX);
        let mut packet = vec![0x45, 0];
        for word in [total, identification, place] {
            packet.extend_from_slice(&word.to_be_bytes());
        }
        packet.extend_from_slice(&[64, UDP, 0, 0]);
        packet.extend_from_slice(&from);
        packet.extend_from_slice(&to);
        let sum = checksum(&packet);
        packet[10..12].copy_from_slice(&sum.to_be_bytes());
        packet.extend_from_slice(piece);
        packets.push(packet);
    }
    packets
}

/// Computes the checksum of RFC 1071.
fn checksum(header: &[u8]) -> u16 {
    let words = header.chunks_exact(2);
    let sum: u32 = words
        .map(|word| u32::from(u16::from_be_bytes([word[0], word[1]])))
        .sum();
    let folded = (sum & 0xffff) + (sum >> 16);
    !u16::try_from((folded & 0xffff) + (folded >> 16)).unwrap_or(u16::MAX)
}

fn packet_socket(interface: &str) -> io::Result<OwnedFd> {
    let name = std::ffi::CString::new(interface)?;
    // SAFETY: a string that ends in zero and outlives the call.
    let index = unsafe { libc::if_nametoindex(name.as_ptr()) };
    // SAFETY: takes no pointers. Protocol 0: it only sends.
    let descriptor =
        unsafe { libc::socket(libc::AF_PACKET, libc::SOCK_RAW | libc::SOCK_CLOEXEC, 0) };
    if index == 0 || descriptor < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: a new descriptor without another owner.
    let socket = unsafe { OwnedFd::from_raw_fd(descriptor) };
    let address = libc::sockaddr_ll {
        sll_family: libc::AF_PACKET as libc::c_ushort,
        sll_protocol: 0,
        sll_ifindex: index.cast_signed(),
        sll_hatype: 0,
        sll_pkttype: 0,
        sll_halen: 0,
        sll_addr: [0; 8],
    };
    let length = size_of_val(&address) as libc::socklen_t;
    // SAFETY: the address is a sockaddr_ll of the length given.
    let bound = unsafe { libc::bind(socket.as_raw_fd(), (&raw const address).cast(), length) };
    if bound != 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(socket)
}

fn tun_device(name: &str) -> io::Result<File> {
    const IFF_TUN: u16 = 1;
    const IFF_NO_PI: u16 = 0x1000;
    let device = File::options()
        .read(true)
        .write(true)
        .open("/dev/net/tun")?;
    // struct ifreq: 16 bytes of name, flags, and padding.
    let mut request = [0_u8; 40];
    request[..name.len()].copy_from_slice(name.as_bytes());
    request[16..18].copy_from_slice(&(IFF_TUN | IFF_NO_PI).to_ne_bytes());
    // SAFETY: the request has the size of struct ifreq, which TUNSETIFF reads and writes.
    let made = unsafe { libc::ioctl(device.as_raw_fd(), libc::TUNSETIFF, request.as_mut_ptr()) };
    if made != 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(device)
}
