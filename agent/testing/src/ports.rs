//! Free ports for programs that need a port number as an argument, such as Prometheus.
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr as UnixAddress, UnixListener};

/// Ports below Linux's ephemeral ports (`ip_local_port_range`), so that no other program gets one
/// by chance between its choice and its use.
const PORTS: std::ops::Range<u16> = 20_000..30_000;

/// Returns a loopback address whose port is free and stays reserved for this process until it ends.
/// An abstract socket named after the port reserves it among tests.
///
/// # Panics
///
/// Panics if all ports of the range are taken.
#[must_use]
pub fn free_address() -> SocketAddr {
    let count = u32::from(PORTS.end - PORTS.start);
    let start = std::process::id().wrapping_mul(97) % count;
    let mut ports = PORTS.cycle().skip(start as usize).take(count as usize);
    let port = ports.find(|port| is_reserved(*port) && is_free(*port));
    let port = port.unwrap_or_else(|| panic!("no free port in {PORTS:?}"));
    SocketAddr::from((Ipv4Addr::LOCALHOST, port))
}

/// Returns whether this process has reserved the port.
fn is_reserved(port: u16) -> bool {
    let name = format!("ros2probe-tests-port-{port}");
    let listener =
        UnixAddress::from_abstract_name(name).and_then(|name| UnixListener::bind_addr(&name));
    // The socket lives as long as the process.
    listener.map(std::mem::forget).is_ok()
}

fn is_free(port: u16) -> bool {
    TcpListener::bind((Ipv4Addr::LOCALHOST, port)).is_ok()
}
