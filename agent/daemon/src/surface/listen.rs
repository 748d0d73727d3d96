//! TCP listeners with bounded kernel memory per connection. Unread data of a slow client counts
//! against the agent's `MemoryMax`, by default up to 4 MB per connection.

use std::io;
use std::net::{IpAddr, SocketAddr, TcpListener};

use rustix::net::sockopt;
use rustix::net::{AddressFamily, SocketFlags, SocketType, bind, socket_with};

/// Send buffer per connection in bytes; the kernel doubles this value.
const SEND_BUFFER: usize = 128 << 10;
/// Connections that wait to be accepted, as the standard library has them.
const BACKLOG: i32 = 128;

/// Binds a listener, which a runtime can take over. The address of an interface may appear later,
/// as that of a VPN or of DHCP does.
pub(super) fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let listener = match TcpListener::bind(address) {
        Err(error)
            if error.kind() == io::ErrorKind::AddrNotAvailable && may_appear(address.ip()) =>
        {
            let listener = bind_absent(address)?;
            tracing::warn!(%address, "listening on an address that this host does not have yet");
            listener
        }
        bound => bound?,
    };
    listener.set_nonblocking(true)?;
    // Connections inherit the size from their listener.
    sockopt::set_socket_send_buffer_size(&listener, SEND_BUFFER)?;
    Ok(listener)
}

fn may_appear(address: IpAddr) -> bool {
    let address = address.to_canonical();
    !address.is_loopback() && !address.is_unspecified()
}

/// Binds a listener to an address that no interface has.
fn bind_absent(address: SocketAddr) -> io::Result<TcpListener> {
    let family = match address {
        SocketAddr::V4(_) => AddressFamily::INET,
        SocketAddr::V6(_) => AddressFamily::INET6,
    };
    let socket = socket_with(family, SocketType::STREAM, SocketFlags::CLOEXEC, None)?;
    sockopt::set_socket_reuseaddr(&socket, true)?;
    match address {
        SocketAddr::V4(_) => sockopt::set_ip_freebind(&socket, true)?,
        SocketAddr::V6(_) => sockopt::set_ipv6_freebind(&socket, true)?,
    }
    bind(&socket, &address)?;
    rustix::net::listen(&socket, BACKLOG)?;
    Ok(socket.into())
}

#[cfg(test)]
mod tests {
    use std::net::TcpStream;
    use std::time::Duration;

    use super::*;

    #[test]
    fn an_address_that_the_host_does_not_have_yet_can_be_listened_on() {
        // Addresses for documentation (RFC 5737 and RFC 3849).
        for address in ["192.0.2.1:0", "[2001:db8::1]:0"] {
            let address: SocketAddr = address.parse().unwrap();
            let listener = match listen(address) {
                // A host may have no IPv6.
                Err(_) if address.is_ipv6() && TcpListener::bind("[::1]:0").is_err() => continue,
                listener => listener.unwrap(),
            };
            let bound = listener.local_addr().unwrap();
            assert_eq!(bound.ip(), address.ip());
            assert_ne!(bound.port(), 0);
            // Its port is in use like any other.
            let second = listen(bound).unwrap_err();
            assert_eq!(second.kind(), io::ErrorKind::AddrInUse);
        }
    }

    #[test]
    fn only_addresses_of_interfaces_may_appear() {
        for (address, expected) in [
            ("10.8.0.2", true),
            ("fd00::2", true),
            ("127.0.0.1", false),
            ("::ffff:127.0.0.1", false),
            ("0.0.0.0", false),
            ("::", false),
        ] {
            assert_eq!(may_appear(address.parse().unwrap()), expected, "{address}");
        }
    }

    #[test]
    fn the_send_buffer_does_not_grow_for_a_client_that_does_not_read() {
        let listener = listen(([127, 0, 0, 1], 0).into()).unwrap();
        let client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        listener.set_nonblocking(false).unwrap();
        let (server, _) = listener.accept().unwrap();
        let room = sockopt::socket_send_buffer_size(&server).unwrap();
        assert_eq!(room, 2 * SEND_BUFFER);
        // A buffer without a fixed size would grow while data is sent.
        server
            .set_write_timeout(Some(Duration::from_millis(100)))
            .unwrap();
        let sent = io::copy(&mut io::repeat(7), &mut &server);
        assert!(sent.is_err());
        let room = sockopt::socket_send_buffer_size(&server).unwrap();
        assert_eq!(room, 2 * SEND_BUFFER);
        drop(client);
    }
}
