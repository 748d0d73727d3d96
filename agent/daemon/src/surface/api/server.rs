//! The API's listeners: bound before privileges are dropped, and served until the agent stops.
//!
//! Each listener has its own limits of connections and requests. Mode and group of the unix
//! socket's file decide which users may connect; the file is removed when the agent stops.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io;
use std::net::{SocketAddr, TcpListener};
use std::os::unix::fs::{FileTypeExt as _, OpenOptionsExt as _, PermissionsExt as _};
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use axum::serve::Listener;
use tokio::task::JoinSet;

use super::problem::{Code, MEDIA_TYPE, Problem, ProblemBody};
use super::security::{AccessRules, Kind, Rights, Token, TokenError};
use super::{Context, router};
use crate::config::{Access, Limit};
use crate::surface::limited_listener::{LimitedListener, Refusal};
use crate::surface::listen::listen;
use crate::surface::serving::{self, Plain};

/// Read and write permission for owner and group.
const SOCKET_MODE: u32 = 0o660;
/// Group that may use the socket of an agent started as root.
const SOCKET_GROUP: &str = "ros2probe";

/// Why the API cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The token cannot be loaded.
    #[error(transparent)]
    Token(#[from] TokenError),
    /// Other hosts can reach the address, and no token is configured.
    #[error(
        "{address} is reachable from other hosts: serving the control API there needs \
         `api.token_file`"
    )]
    Unprotected {
        /// The address.
        address: SocketAddr,
    },
    /// The address is in use, or is a local one that this host does not have.
    #[error("cannot listen on {address}: change `api.listen` in the configuration or pass `--api`")]
    Address {
        /// The address.
        address: SocketAddr,
        /// Error of the operating system.
        source: io::Error,
    },
    /// Another agent serves the socket.
    #[error("another agent serves the socket {}: change `api.socket`", path.display())]
    InUse {
        /// Path of the socket.
        path: PathBuf,
    },
    /// A file exists at the path that is not a socket.
    #[error("{} exists and is not a socket: change `api.socket`", path.display())]
    NoSocket {
        /// Path of the file.
        path: PathBuf,
    },
    /// The directory is missing or not writable.
    #[error("cannot serve the socket {}: change `api.socket`", path.display())]
    Socket {
        /// Path of the socket.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
}

/// Bound listeners that are not served yet.
#[derive(Debug, Default)]
pub struct Server {
    token: Option<Token>,
    loopback: Access,
    addresses: Vec<TcpListener>,
    sockets: Vec<Socket>,
}

/// A unix socket and its file.
#[derive(Debug)]
struct Socket {
    listener: UnixListener,
    file: SocketFile,
}

/// Removes the socket's file when dropped.
#[derive(Debug)]
struct SocketFile {
    path: PathBuf,
    /// Prevents other agents from treating the socket as stale.
    _lock: File,
}

impl Server {
    /// Creates a server without listeners. Clients in the network need the token in the file
    /// `token`. Loopback clients without the token have the rights `loopback`.
    ///
    /// # Errors
    /// Fails if the file does not contain a valid token.
    pub fn new(token: Option<&Path>, loopback: Access) -> Result<Self, OpenError> {
        Ok(Self {
            token: token.map(Token::load).transpose()?,
            loopback,
            ..Self::default()
        })
    }

    /// Binds an address. Without a token, it must be a loopback address.
    ///
    /// # Errors
    /// Fails if the address needs a token or cannot be bound.
    pub fn bind(&mut self, address: SocketAddr) -> Result<(), OpenError> {
        if !address.ip().is_loopback() && self.token.is_none() {
            return Err(OpenError::Unprotected { address });
        }
        let listener = listen(address).map_err(|source| OpenError::Address { address, source })?;
        self.addresses.push(listener);
        Ok(())
    }

    /// Binds a unix socket, replacing the stale file of an agent that was killed.
    ///
    /// # Errors
    /// Fails if another agent serves the socket, the path is not a socket, or the directory cannot
    /// be used.
    pub fn bind_socket(&mut self, path: &Path) -> Result<(), OpenError> {
        let failed = |source| OpenError::Socket {
            path: path.to_path_buf(),
            source,
        };
        let lock = lock(path)?;
        match fs::symlink_metadata(path) {
            Ok(metadata) if metadata.file_type().is_socket() => {
                fs::remove_file(path).map_err(failed)?;
            }
            Ok(_) => {
                let path = path.to_path_buf();
                return Err(OpenError::NoSocket { path });
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(failed(error)),
        }
        let bind = || {
            let listener = UnixListener::bind(path)?;
            let file = SocketFile {
                path: path.to_path_buf(),
                _lock: lock,
            };
            give_to_group(path);
            fs::set_permissions(path, fs::Permissions::from_mode(SOCKET_MODE))?;
            listener.set_nonblocking(true)?;
            Ok(Socket { listener, file })
        };
        self.sockets.push(bind().map_err(failed)?);
        Ok(())
    }

    /// Returns whether no listener is bound.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.addresses.is_empty() && self.sockets.is_empty()
    }

    /// Returns the addresses and paths of all listeners, with the port that the kernel chose for
    /// port 0.
    pub fn listener_addresses(&self) -> impl Iterator<Item = String> {
        let addresses = self.addresses.iter().map(TcpListener::local_addr);
        let sockets = self.sockets.iter();
        let sockets = sockets.map(|socket| format!("unix:{}", socket.file.path.display()));
        let addresses = addresses.filter_map(Result::ok).map(|it| it.to_string());
        addresses.chain(sockets)
    }

    /// Returns the addresses of the listeners.
    pub fn addresses(&self) -> impl Iterator<Item = SocketAddr> {
        let addresses = self.addresses.iter().map(TcpListener::local_addr);
        addresses.filter_map(Result::ok)
    }

    /// Serves all listeners until `context` stops, then completes the answers in progress.
    ///
    /// # Errors
    /// Fails if the runtime cannot take over a listener.
    pub fn serve(self, context: &Context, tasks: &mut JoinSet<io::Result<()>>) -> io::Result<()> {
        let socket = self.sockets.first();
        let socket = socket.map(|socket| Arc::from(socket.file.path.as_path()));
        let door = |kind: Kind| {
            let granted = Rights::new(kind.access(self.loopback), socket.clone());
            Arc::new(AccessRules::new(kind, granted).with(Arc::clone(&context.page)))
        };
        for listener in self.addresses {
            let is_local = listener.local_addr()?.ip().is_loopback();
            let kind = match self.token.clone() {
                Some(token) if !is_local => Kind::Network(token),
                token => Kind::Loopback(token),
            };
            let listener = tokio::net::TcpListener::from_std(listener)?;
            tasks.spawn(serve(listener, door(kind), context.clone()));
        }
        for Socket { listener, file } in self.sockets {
            let listener = tokio::net::UnixListener::from_std(listener)?;
            let serving = serve(listener, door(Kind::Socket), context.clone());
            tasks.spawn(async move {
                let served = serving.await;
                drop(file);
                served
            });
        }
        Ok(())
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        // If the file cannot be removed, the next agent replaces it as stale.
        let _ = fs::remove_file(&self.path);
    }
}

async fn serve<L>(listener: L, door: Arc<AccessRules>, context: Context) -> io::Result<()>
where
    L: Listener,
    L::Io: Unpin,
{
    let router = router(&context, door);
    let limit = Limit::ApiClients;
    let full = too_many_connections(context.limits.caps().get(limit));
    let listener = LimitedListener::new(listener, Arc::clone(&context.limits), limit, Some(full));
    serving::serve(listener, Plain, router, |_| (), context.stop).await;
    Ok(())
}

/// Returns the answer to a client beyond the limit of connections.
fn too_many_connections(connections: usize) -> Refusal {
    let detail =
        format!("{connections} connections are open, which is the limit (limits.api_clients)");
    let problem = ProblemBody::from(Problem::new(Code::TooManyClients, detail));
    // A problem can always be serialized.
    Refusal::new(
        MEDIA_TYPE,
        &serde_json::to_string(&problem).unwrap_or_default(),
    )
}

/// Locks a file beside the socket. The lock file is never removed, because agents could otherwise
/// lock different files.
fn lock(path: &Path) -> Result<File, OpenError> {
    let mut name = path.as_os_str().to_owned();
    name.push(".lock");
    let mut options = OpenOptions::new();
    let options = options.write(true).create(true).truncate(false).mode(0o600);
    let failed = |source| OpenError::Socket {
        path: path.to_path_buf(),
        source,
    };
    let file = options.open(&name).map_err(failed)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(OpenError::InUse {
            path: path.to_path_buf(),
        }),
        Err(TryLockError::Error(source)) => Err(failed(source)),
    }
}

/// Changes the group of the socket to [`SOCKET_GROUP`] if the agent runs as root and the group
/// exists. Under the service manager, the agent already has that group. Otherwise the socket keeps
/// the agent's own group.
fn give_to_group(path: &Path) {
    let groups = fs::read_to_string("/etc/group").unwrap_or_default();
    let group = groups.lines().find_map(|line| {
        let mut fields = line.split(':');
        let is_ours = fields.next() == Some(SOCKET_GROUP);
        fields.nth(1)?.parse().ok().filter(|_| is_ours)
    });
    if let Some(group) = group {
        let _ = std::os::unix::fs::chown(path, None, Some(group));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one_line(error: &OpenError) -> String {
        let text = format!("{:#}", anyhow::anyhow!(error.to_string()));
        assert!(!text.contains('\n'), "{text}");
        text
    }

    #[test]
    fn an_address_beyond_this_host_needs_a_token() {
        let mut server = Server::new(None, Access::Watch).unwrap();
        let error = server.bind(([0, 0, 0, 0], 0).into()).unwrap_err();
        assert!(one_line(&error).contains("needs `api.token_file`"));
        assert!(server.is_empty());

        let directory = tempfile::tempdir().unwrap();
        let token = directory.path().join("token");
        fs::write(&token, "0123456789abcdef\n").unwrap();
        let mut server = Server::new(Some(&token), Access::Watch).unwrap();
        server.bind(([0, 0, 0, 0], 0).into()).unwrap();
        assert_eq!(server.listener_addresses().count(), 1);
    }

    #[test]
    fn a_busy_port_is_reported_in_one_line() {
        let other = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = other.local_addr().unwrap();
        let error = Server::new(None, Access::Watch)
            .unwrap()
            .bind(address)
            .unwrap_err();
        assert!(one_line(&error).contains("`api.listen`"));
    }

    #[test]
    fn a_stale_socket_is_replaced_but_not_a_socket_in_use_or_another_file() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("api.sock");
        // The file of the socket stays, as after an agent was killed.
        drop(UnixListener::bind(&path).unwrap());
        let mut server = Server::new(None, Access::Watch).unwrap();
        server.bind_socket(&path).unwrap();
        let mode = fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, SOCKET_MODE);

        let error = Server::new(None, Access::Watch)
            .unwrap()
            .bind_socket(&path)
            .unwrap_err();
        assert!(one_line(&error).contains("another agent serves the socket"));
        assert!(std::os::unix::net::UnixStream::connect(&path).is_ok());

        drop(server);
        assert!(!path.exists());
        fs::write(&path, "").unwrap();
        let error = Server::new(None, Access::Watch)
            .unwrap()
            .bind_socket(&path)
            .unwrap_err();
        assert!(one_line(&error).contains("is not a socket"));
        assert!(path.exists());

        let missing = directory.path().join("missing/api.sock");
        let error = Server::new(None, Access::Watch)
            .unwrap()
            .bind_socket(&missing)
            .unwrap_err();
        assert!(one_line(&error).contains("missing/api.sock"));
    }
}
