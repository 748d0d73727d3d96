//! TCP connections of exports.

use std::time::Duration;

use hyper_util::client::legacy::connect::HttpConnector;

/// Returns a connector for requests with this timeout.
///
/// A receiver that cannot be reached fails the request before the timeout, as an error of the
/// connection. A timeout therefore means a slow answer, and a smaller request may succeed.
pub(crate) fn connector(timeout: Duration) -> HttpConnector {
    let mut connector = HttpConnector::new();
    connector.enforce_http(false);
    connector.set_nodelay(true);
    connector.set_connect_timeout(Some(connect_timeout(timeout)));
    connector
}

/// Returns the maximum wait for a connection, of a request with this timeout.
pub(crate) fn connect_timeout(timeout: Duration) -> Duration {
    timeout * 2 / 3
}

#[cfg(test)]
pub(crate) mod tests {
    use std::net::{SocketAddr, TcpStream};

    use tokio::net::{TcpListener, TcpSocket};

    use super::*;

    /// A listener that accepts nothing, with connections that fill its queue: the kernel ignores
    /// further ones, as a dead link does.
    pub(crate) struct Unreachable {
        pub(crate) address: SocketAddr,
        _listener: TcpListener,
        _waiting: Vec<TcpStream>,
    }

    impl Unreachable {
        pub(crate) fn new() -> Self {
            let socket = TcpSocket::new_v4().unwrap();
            socket.bind("127.0.0.1:0".parse().unwrap()).unwrap();
            let listener = socket.listen(1).unwrap();
            let address = listener.local_addr().unwrap();
            let connect = || TcpStream::connect_timeout(&address, Duration::from_millis(300)).ok();
            let waiting: Vec<_> = std::iter::from_fn(connect).take(100).collect();
            assert!(waiting.len() < 100, "the queue is full");
            Self {
                address,
                _listener: listener,
                _waiting: waiting,
            }
        }
    }
}
