//! Accepts connections, and answers requests.
//!
//! Each connection has a separate process, and each of its requests has a child process with a
//! deadline. Descriptors of a client, files and memory can block any of these processes, which
//! delays only that client. A child that never ends, because the kernel waits in it, becomes a
//! child of the broker.
//!
//! None of these processes has a second thread.

pub(crate) mod answer;

use std::io;
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};
use std::os::unix::ffi::OsStrExt as _;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::net::{SendFlags, SocketFlags, accept_with};
use rustix::process::{
    Pid, PidfdFlags, Signal, WaitOptions, kill_process, pidfd_open,
    set_parent_process_death_signal, wait, waitpid,
};

use crate::kernel;
use crate::message::{receive, send};
use crate::request::{Answer, Numbered, Request};

/// Maximum number of connections. The sources of one agent need two, and further connections wait.
pub const MAX_CONNECTIONS: usize = 8;
/// Maximum number of requests of a connection per second. Further requests wait in the socket.
pub const RATE: f64 = 1000.0;
/// Maximum burst of requests: the domain of each process of a starting robot is one request.
pub const BURST: f64 = 1000.0;
/// Maximum number per second of requests whose answers have descriptors, which the client keeps.
pub const ATTACHMENT_RATE: f64 = 5.0;
/// Maximum burst of such requests: a client may attach to all libraries of a host together.
pub const ATTACHMENT_BURST: f64 = 250.0;
/// Maximum number of requests of a connection that never end. Until one of them ends, further
/// requests are refused.
pub const MAX_STUCK: usize = 4;
/// Pause after the kernel refused a connection or a process.
const RETRY_DELAY: Duration = Duration::from_millis(200);
/// Maximum wait of the broker, which then counts its children.
const MAX_WAIT: Duration = Duration::from_secs(1);

/// The peer of a connection (SO_PEERCRED, unix(7)).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Peer {
    /// Process id of the peer; 0 in another PID namespace.
    pub process: u32,
    /// User id of the peer.
    pub user: u32,
}

/// Answers connections of root and of `users` to a listening socket. With `idle`, something else
/// starts the broker on demand. Then this function returns after `idle` without a child process, and
/// at a connection after the broker's program was replaced: the new program accepts it. The calling
/// process should adopt its descendants (PR_SET_CHILD_SUBREAPER).
///
/// # Errors
/// Fails if the kernel refuses to wait.
pub fn serve(listener: OwnedFd, users: &[u32], idle: Option<Duration>) -> io::Result<()> {
    let mut listener = Some(listener);
    let mut connections = Vec::new();
    let mut used = Instant::now();
    while let Some(listening) = &listener {
        // Children of connections that have ended are children, too.
        if reap(&mut connections) {
            used = Instant::now();
        }
        let rest = idle.map_or(MAX_WAIT, |idle| idle.saturating_sub(used.elapsed()));
        if rest.is_zero() {
            break;
        }
        let has_room = connections.len() < MAX_CONNECTIONS;
        let source = has_room.then(|| listening.as_fd());
        if !ready(source, rest.min(MAX_WAIT))? {
            continue;
        }
        if idle.is_some() && is_replaced() {
            tracing::info!("ends: its program was replaced");
            break;
        }
        if let Some(socket) = accept(listening) {
            connections.extend(begin(socket, users, &mut listener));
        }
    }
    Ok(())
}

/// Returns whether the file of this program was removed, as by an upgrade (proc_pid_exe(5)).
fn is_replaced() -> bool {
    let path = std::fs::read_link("/proc/self/exe");
    path.is_ok_and(|path| path.as_os_str().as_bytes().ends_with(b" (deleted)"))
}

/// Reaps children that have ended, and returns whether other children are left.
fn reap(connections: &mut Vec<Pid>) -> bool {
    loop {
        match wait(WaitOptions::NOHANG) {
            Ok(Some((ended, _))) => connections.retain(|connection| *connection != ended),
            Ok(None) => return true,
            Err(_) => return false,
        }
    }
}

/// Accepts a connection. Failures are transient: a client that has gone, or too many open files.
fn accept(listener: &OwnedFd) -> Option<OwnedFd> {
    match accept_with(listener, SocketFlags::CLOEXEC) {
        Ok(socket) => Some(socket),
        Err(error) => {
            tracing::warn!(%error, "accept failed");
            std::thread::sleep(RETRY_DELAY);
            None
        }
    }
}

/// Starts the process of a connection, which closes the listening socket.
fn begin(socket: OwnedFd, users: &[u32], listener: &mut Option<OwnedFd>) -> Option<Pid> {
    let peer = match peer(&socket) {
        Ok(peer) => peer,
        Err(error) => {
            tracing::warn!(%error, "SO_PEERCRED failed");
            return None;
        }
    };
    let Peer {
        process: peer_pid,
        user: peer_uid,
    } = peer;
    if peer_uid != 0 && !users.contains(&peer_uid) {
        tracing::warn!(
            peer_pid,
            peer_uid,
            "refused a connection: not the agent's user"
        );
        return None;
    }
    // SAFETY: the broker has one thread.
    match unsafe { kernel::fork() } {
        Ok(None) => in_child(|| {
            drop(listener.take());
            Connection::new(socket, peer).serve()
        }),
        Ok(child) => child,
        Err(error) => {
            tracing::error!(%error, "fork failed");
            std::thread::sleep(RETRY_DELAY);
            None
        }
    }
}

/// Answers one connection until it is closed.
///
/// # Errors
/// Fails if the kernel refuses to wait.
pub fn serve_one(socket: OwnedFd) -> io::Result<()> {
    // Without a name, this process has that of its file: `exe`.
    let _ = rustix::thread::set_name(c"rp-attach");
    let peer = peer(&socket)?;
    Connection::new(socket, peer).serve()
}

/// Runs `work` in a child process, and ends the process, also after a panic.
fn in_child(work: impl FnOnce() -> io::Result<()>) -> ! {
    struct End;
    impl Drop for End {
        fn drop(&mut self) {
            kernel::end_fork(1);
        }
    }
    let _end = End;
    // The child must not outlive its parent.
    let bound = set_parent_process_death_signal(Some(Signal::KILL));
    let done = bound.map_err(io::Error::from).and_then(|()| work());
    kernel::end_fork(i32::from(done.is_err()))
}

fn peer(socket: &OwnedFd) -> io::Result<Peer> {
    let (process, user) = kernel::peer(socket.as_fd())?;
    Ok(Peer { process, user })
}

/// Waits until the source is readable, at most `limit`, and returns whether it is.
fn ready(source: Option<BorrowedFd<'_>>, limit: Duration) -> io::Result<bool> {
    let source = source.map(|source| PollFd::from_borrowed_fd(source, PollFlags::IN));
    let mut polled: Vec<_> = source.into_iter().collect();
    let limit = Timespec::try_from(limit).unwrap_or_default();
    match poll(&mut polled, Some(&limit)) {
        Ok(_) | Err(Errno::INTR) => {}
        Err(error) => return Err(error.into()),
    }
    Ok(polled.iter().any(|each| !each.revents().is_empty()))
}

/// A token bucket with a rate per second and a maximum burst.
struct Tokens {
    left: f64,
    rate: f64,
    capacity: f64,
    last_refill: Instant,
}

impl Tokens {
    fn new(rate: f64, most: f64) -> Self {
        Self {
            left: most,
            rate,
            capacity: most,
            last_refill: Instant::now(),
        }
    }

    /// Takes a token, or waits for the next one.
    fn take(&mut self) {
        let now = Instant::now();
        let new = (now - self.last_refill).as_secs_f64() * self.rate;
        (self.left, self.last_refill) = ((self.left + new).min(self.capacity), now);
        self.left -= 1.0;
        if self.left < 0.0 {
            std::thread::sleep(Duration::from_secs_f64(-self.left / self.rate));
        }
    }
}

/// A connection with its requests, in a separate process.
struct Connection {
    socket: OwnedFd,
    peer: Peer,
    tokens: Tokens,
    attachments: Tokens,
    /// Requests that were aborted, and whose processes have not ended.
    stuck: Vec<(Request, Pid)>,
}

impl Connection {
    fn new(socket: OwnedFd, peer: Peer) -> Self {
        Self {
            socket,
            peer,
            tokens: Tokens::new(RATE, BURST),
            attachments: Tokens::new(ATTACHMENT_RATE, ATTACHMENT_BURST),
            stuck: Vec::new(),
        }
    }

    /// Answers requests until the client closes the connection.
    fn serve(&mut self) -> io::Result<()> {
        loop {
            self.tokens.take();
            let Peer {
                process: peer_pid,
                user: peer_uid,
            } = self.peer;
            match receive::<Numbered<Request>>(self.socket.as_fd()) {
                Ok(Some((request, given))) => self.handle(request, &given)?,
                Ok(None) => return Ok(()),
                Err(error) => {
                    tracing::warn!(peer_pid, peer_uid, %error, "closed a connection: malformed request");
                    return Ok(());
                }
            }
        }
    }

    fn handle(&mut self, request: Numbered<Request>, given: &[OwnedFd]) -> io::Result<()> {
        let number = request.number;
        if matches!(request.content, Request::Attach { .. } | Request::Mappings) {
            self.attachments.take();
        }
        self.stuck.retain(|(_, child)| is_running(*child));
        let is_stuck = |known: &(Request, Pid)| known.0 == request.content;
        if self.stuck.iter().any(is_stuck) {
            return self.refuse(number, "the same request is stuck in the kernel".to_owned());
        }
        if self.stuck.len() >= MAX_STUCK {
            let count = self.stuck.len();
            return self.refuse(
                number,
                format!("{count} earlier requests are stuck in the kernel"),
            );
        }
        // SAFETY: the process of a connection has one thread.
        let child = match unsafe { kernel::fork() } {
            Ok(None) => in_child(|| self.answer(request, given)),
            Ok(Some(child)) => child,
            Err(error) => return self.refuse(number, format!("fork failed: {error}")),
        };
        self.finish(child, request)
    }

    /// Waits for the answer of a child process, which is killed at its deadline.
    fn finish(&mut self, child: Pid, request: Numbered<Request>) -> io::Result<()> {
        let (number, patience) = (request.number, request.content.timeout());
        let end = pidfd_open(child, PidfdFlags::empty());
        let has_ended = end.is_ok_and(|end| ready(Some(end.as_fd()), patience).unwrap_or(false));
        if has_ended {
            let status = waitpid(Some(child), WaitOptions::empty())?;
            let is_done = status.is_some_and(|(_, status)| status.exit_status() == Some(0));
            return match is_done {
                true => Ok(()),
                false => self.refuse(
                    number,
                    "the request failed: see the broker's log".to_owned(),
                ),
            };
        }
        let _ = kill_process(child, Signal::KILL);
        let reason = format!("aborted after {patience:?}: reading a file or a process blocked");
        let request = request.content;
        tracing::warn!(
            peer_pid = self.peer.process,
            ?request,
            reason,
            "request aborted"
        );
        if is_running(child) {
            self.stuck.push((request, child));
        }
        self.refuse(number, reason)
    }

    /// Answers a request in the child process.
    fn answer(&self, request: Numbered<Request>, given: &[OwnedFd]) -> io::Result<()> {
        let number = request.number;
        let answered = answer::answer(self.peer, request.content, given, &mut |content, owned| {
            let descriptors: Vec<_> = owned.iter().map(OwnedFd::as_fd).collect();
            let message = Numbered { number, content };
            send(
                self.socket.as_fd(),
                &message,
                &descriptors,
                SendFlags::empty(),
            )
        });
        if let Err(error) = &answered {
            tracing::warn!(peer_pid = self.peer.process, %error, "cannot answer");
        }
        answered
    }

    fn refuse(&self, number: u64, reason: String) -> io::Result<()> {
        let content = Answer::Refused(reason);
        let answer = Numbered { number, content };
        // A client that reads nothing does not need the refusal.
        match send(self.socket.as_fd(), &answer, &[], SendFlags::DONTWAIT) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => Ok(()),
            sent => sent,
        }
    }
}

/// Returns whether a child process has not ended; reaps one that has.
fn is_running(child: Pid) -> bool {
    matches!(waitpid(Some(child), WaitOptions::NOHANG), Ok(None))
}

#[cfg(test)]
mod tests {
    use rustix::net::{AddressFamily, SocketType, socketpair};

    use super::*;

    #[test]
    fn requests_are_refused_while_too_many_earlier_ones_never_end() {
        let kind = SocketType::SEQPACKET;
        let pair = socketpair(AddressFamily::UNIX, kind, SocketFlags::CLOEXEC, None);
        let (own, other) = pair.unwrap();
        let peer = peer(&own).unwrap();
        assert_eq!(peer.process, std::process::id());
        let mut connection = Connection::new(own, peer);
        // These running children stand for processes that the kernel does not end.
        let mut children: Vec<_> = (0..MAX_STUCK)
            .map(|_| {
                std::process::Command::new("sleep")
                    .arg("60")
                    .spawn()
                    .unwrap()
            })
            .collect();
        let domain = |process: usize| Request::Domain {
            process: process as u32,
        };
        let running = children.iter().enumerate().map(|(number, child)| {
            (
                domain(number),
                Pid::from_raw(child.id().cast_signed()).unwrap(),
            )
        });
        connection.stuck = running.collect();
        let mut refused = |content| {
            let request = Numbered { number: 7, content };
            connection.handle(request, &[]).unwrap();
            let (answer, _) = receive::<Numbered<Answer>>(other.as_fd()).unwrap().unwrap();
            assert_eq!(answer.number, 7);
            let Answer::Refused(reason) = answer.content else {
                panic!("{answer:?}");
            };
            reason
        };
        assert_eq!(
            refused(domain(0)),
            "the same request is stuck in the kernel"
        );
        let reason = refused(Request::Processes);
        assert_eq!(reason, "4 earlier requests are stuck in the kernel");
        for child in &mut children {
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }

    #[test]
    fn tokens_beyond_a_burst_are_granted_at_the_rate() {
        let mut tokens = Tokens::new(100.0, 5.0);
        let began = Instant::now();
        for _ in 0..15 {
            tokens.take();
        }
        assert!(
            began.elapsed() >= Duration::from_millis(90),
            "{:?}",
            began.elapsed()
        );
    }
}
