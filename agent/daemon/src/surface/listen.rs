//! TCP listeners whose clients cannot make the kernel hold much for them: what waits to be read by a
//! slow one counts for the agent's `MemoryMax`, up to 4 MB a connection by default.

use std::io;
use std::net::{SocketAddr, TcpListener};

use rustix::net::sockopt;

/// What the kernel doubles, and each connection takes at most.
const SEND_BUFFER: usize = 128 << 10;

/// Listens there; for a runtime to take over.
pub(super) fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let listener = TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    // Connections have it from their listener.
    sockopt::set_socket_send_buffer_size(&listener, SEND_BUFFER)?;
    Ok(listener)
}

#[cfg(test)]
mod tests {
    use std::net::TcpStream;
    use std::time::Duration;

    use super::*;

    #[test]
    fn the_kernel_holds_little_for_a_client_that_does_not_read() {
        let listener = listen(([127, 0, 0, 1], 0).into()).unwrap();
        let client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        listener.set_nonblocking(false).unwrap();
        let (server, _) = listener.accept().unwrap();
        let room = sockopt::socket_send_buffer_size(&server).unwrap();
        assert_eq!(room, 2 * SEND_BUFFER);
        // As it grows while something is sent.
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
