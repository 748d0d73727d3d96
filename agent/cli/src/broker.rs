//! The broker's process: its socket, its users, and its privileges.

use std::fs::Permissions;
use std::io;
use std::os::fd::{AsFd as _, OwnedFd};
use std::os::unix::fs::{FileTypeExt as _, PermissionsExt as _};
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use ros2probe_attach::server::{serve, serve_one};
use ros2probe_capture::system::hide_memory;
use ros2probe_daemon::config::Level;
use ros2probe_daemon::logging::Log;
use ros2probe_daemon::privilege::{self, Role, user_id};
use rustix::io::Errno;
use rustix::net::sockopt::socket_acceptconn;
use rustix::net::{
    AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, socket_with,
};
use rustix::process::{getpid, set_child_subreaper};

/// Time without a connection after which a broker exits if systemd started it on demand.
const IDLE_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum number of connections that wait to be accepted.
const MAX_WAITING_CONNECTIONS: i32 = 8;
const NO_SOCKET: &str =
    "standard input is not a socket: start ros2probe-attach.socket, or pass --listen PATH";
/// Permissions of the socket. The broker itself accepts one user only.
const SOCKET_MODE: u32 = 0o666;

/// Answers requests of agents for breakpoints and for facts of other processes. `path` is a new
/// socket. Without it, standard input is the listening socket of systemd, or the connection of the
/// agent that started the broker. `user` is the agents' user.
///
/// # Errors
/// Fails without a socket, or if the process cannot be confined.
pub(crate) fn run(path: Option<&Path>, user: &str) -> Result<()> {
    let _log = Log::start(Level::Info, None);
    hide_memory().context("cannot protect the memory of this process")?;
    let (listener, idle) = match path {
        Some(path) => (bound(path)?, None),
        None => {
            let input = io::stdin().as_fd().try_clone_to_owned()?;
            if !socket_acceptconn(&input).context(NO_SOCKET)? {
                confine()?;
                return serve_one(input).context("cannot answer the agent");
            }
            (input, Some(IDLE_TIMEOUT))
        }
    };
    let id = user_id(user);
    if id.is_none() {
        tracing::warn!(user, "the user does not exist: only root may connect");
    }
    // Adopts the processes of requests that outlive their parents, so that the broker can reap
    // them.
    set_child_subreaper(Some(getpid())).context("cannot adopt child processes")?;
    confine()?;
    tracing::info!(user, "listening");
    let users: Vec<_> = id.into_iter().collect();
    serve(listener, &users, idle).context("cannot answer agents")
}

fn confine() -> Result<()> {
    privilege::confine(Role::Broker)?;
    if let Some(reason) = privilege::sandbox().reason() {
        tracing::warn!(reason, "system calls are not filtered");
    }
    Ok(())
}

fn is_socket(path: &Path) -> bool {
    std::fs::symlink_metadata(path).is_ok_and(|file| file.file_type().is_socket())
}

/// Listens at a new socket. Replaces an old socket without a listener.
fn bound(path: &Path) -> Result<OwnedFd> {
    let kind = SocketType::SEQPACKET;
    let socket = socket_with(AddressFamily::UNIX, kind, SocketFlags::CLOEXEC, None)?;
    let address = SocketAddrUnix::new(path)?;
    let probe = socket_with(AddressFamily::UNIX, kind, SocketFlags::CLOEXEC, None)?;
    let shown = path.display();
    match connect(&probe, &address) {
        Ok(()) => bail!("another broker listens at {shown}"),
        // A file that is not a socket also refuses connections.
        Err(Errno::CONNREFUSED) if is_socket(path) => std::fs::remove_file(path)
            .with_context(|| format!("cannot replace the socket {shown}"))?,
        Err(_) => {}
    }
    bind(&socket, &address).with_context(|| format!("cannot listen at {shown}"))?;
    std::fs::set_permissions(path, Permissions::from_mode(SOCKET_MODE))?;
    listen(&socket, MAX_WAITING_CONNECTIONS)?;
    Ok(socket)
}
