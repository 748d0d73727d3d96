//! Relays TCP connections of this machine to a host's loopback. A unix socket joins the two, since
//! network namespaces share the file system; no interface or route is added.

use std::io;
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, Result};

use super::network::Namespace;
use super::process::Process;

/// The relay's end on this machine; its other end runs on the host and ends with it.
pub struct Relay {
    address: SocketAddr,
    _remote: Process,
}

impl Relay {
    /// Listens on `port` of this machine, or on any free port if `port` is in use. The other end is
    /// this program, started again with `--relay` and `--port` ([`serve`]).
    pub fn start(host: &Namespace, directory: &Path, port: u16) -> Result<Relay> {
        let socket = directory.join(format!("relay-{port}"));
        let program = std::env::current_exe().context("cannot tell where this program is")?;
        let number = port.to_string();
        let words = [
            "--relay".as_ref(),
            socket.as_os_str(),
            "--port".as_ref(),
            number.as_ref(),
        ];
        let mut remote = Process::start(&host.on_network(), program, words)?;
        remote.wait_for("ready", Duration::from_secs(60))?;
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port))
            .or_else(|_| TcpListener::bind((Ipv4Addr::LOCALHOST, 0)))
            .context("cannot listen on 127.0.0.1")?;
        let address = listener.local_addr()?;
        std::thread::spawn(move || {
            for near in listener.incoming().flatten() {
                if let Ok(far) = UnixStream::connect(&socket) {
                    std::thread::spawn(move || carry(&near, &far));
                }
            }
        });
        Ok(Relay {
            address,
            _remote: remote,
        })
    }

    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

/// Runs the relay's end on the host: what a program does that is given `--relay` and `--port`.
pub fn serve(socket: &Path, port: u16) -> Result<()> {
    let listener = UnixListener::bind(socket)
        .with_context(|| format!("cannot listen on {}", socket.display()))?;
    println!("ready");
    for near in listener.incoming().flatten() {
        std::thread::spawn(move || {
            TcpStream::connect((Ipv4Addr::LOCALHOST, port)).map(|far| carry(&far, &near))
        });
    }
    Ok(())
}

/// Copies in both directions until both sides have closed. An error only ends the connection.
fn carry(tcp: &TcpStream, unix: &UnixStream) {
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let _ = io::copy(&mut &*tcp, &mut &*unix);
            let _ = unix.shutdown(Shutdown::Write);
        });
        let _ = io::copy(&mut &*unix, &mut &*tcp);
        let _ = tcp.shutdown(Shutdown::Write);
    });
}
