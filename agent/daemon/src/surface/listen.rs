//! TCP listeners with bounded kernel memory per connection. Unread data of a slow client counts
//! against the agent's `MemoryMax`, by default up to 4 MB per connection.

use std::io;
use std::net::{SocketAddr, TcpListener};

use rustix::net::sockopt;

/// Send buffer per connection in bytes; the kernel doubles this value.
const SEND_BUFFER: usize = 128 << 10;

/// Binds a listener, which a runtime can take over.
pub(super) fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let listener = TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    // Connections inherit the size from their listener.
    sockopt::set_socket_send_buffer_size(&listener, SEND_BUFFER)?;
    Ok(listener)
}

#[cfg(test)]
mod tests {
    use std::net::TcpStream;
    use std::time::Duration;

    use super::*;

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
