//! The agent's side of the broker.

use std::io;
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use rustix::net::sockopt::{Timeout, set_socket_timeout};
use rustix::net::{
    AddressFamily, SendFlags, SocketAddrUnix, SocketFlags, SocketType, connect, socket_with,
    socketpair,
};
use tracing::level_filters::LevelFilter;

use crate::functions::{Calls, Library};
use crate::mapped::Use;
use crate::message::{receive, send};
use crate::request::{
    Activity, Answer, AttachMethod, MAX_PROCESSES, Numbered, Place, REQUEST_TIMEOUT, Request,
};
use crate::server::Peer;
use crate::server::answer::answer;

/// Name of the command that runs the broker. The connection is its standard input.
pub const COMMAND: &str = "attach";
/// Whether this program has [`COMMAND`].
static HAS_COMMAND: AtomicBool = AtomicBool::new(false);
/// Level of the log of a broker that this process starts; `None`: the broker has its own default.
static LOG_LEVEL: Mutex<Option<LevelFilter>> = Mutex::new(None);
/// Maximum time to wait for an answer. The broker itself gives up earlier.
const RESPONSE_TIMEOUT: Duration = REQUEST_TIMEOUT.saturating_add(Duration::from_secs(1));
/// Pause before another attempt to connect.
const RETRY: Duration = Duration::from_secs(5);

/// Declares that this program runs the broker with [`COMMAND`]. Any other program would start a
/// copy of itself that does something else.
pub fn declare_command() {
    HAS_COMMAND.store(true, Ordering::Relaxed);
}

/// Sets the level of the log of brokers that this process starts from now on. Without it, they read
/// `RUST_LOG` of this process.
pub fn set_log_level(level: LevelFilter) {
    *LOG_LEVEL.lock().unwrap_or_else(PoisonError::into_inner) = Some(level);
}

/// Why the broker did not answer.
#[derive(Debug, thiserror::Error)]
pub enum BrokerError {
    /// Nothing listens at the broker's socket.
    #[error(
        "cannot connect to the broker at {} (systemctl start ros2probe-attach.socket, unless it is \
         masked, or start the agent as root)", path.display()
    )]
    Unreachable {
        /// Path of the socket.
        path: PathBuf,
        /// Cause of the failure.
        #[source]
        source: io::Error,
    },
    /// The broker was started with the agent, and has ended.
    #[error("the broker has ended: restart the agent")]
    Ended,
    /// The broker closed the connection.
    #[error("the broker closed the connection: it accepts the user of its option --user, and root")]
    Closed,
    /// The broker did not answer in time, or not in this protocol.
    #[error("the broker did not answer")]
    Answer(#[source] io::Error),
    /// The broker refuses the request, for this reason.
    #[error("{0}")]
    Refused(String),
}

/// A connection to the broker, which is opened again when the broker restarts.
#[derive(Debug)]
pub struct Broker {
    reach: Reach,
    socket: Option<OwnedFd>,
    /// When the last attempt to connect failed, and the code of the error.
    failed: Option<(Instant, Option<i32>)>,
    number: u64,
}

#[derive(Debug)]
enum Reach {
    Socket(PathBuf),
    Child(Child),
    /// No broker: the calling process has the rights itself.
    Here,
}

/// Processes that use a library.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Users {
    /// Processes with their use of the library.
    pub used: Vec<(u32, Use)>,
    /// Processes that the broker may not read.
    pub closed: Vec<u32>,
}

impl Broker {
    /// Returns a client of the broker that listens at a socket. It connects with the first request.
    #[must_use]
    pub fn at(path: &Path) -> Self {
        Self {
            reach: Reach::Socket(path.to_path_buf()),
            socket: None,
            failed: None,
            number: 0,
        }
    }

    /// Starts a broker with the privileges of the calling thread: this program with [`COMMAND`].
    /// The broker ends with the client.
    ///
    /// # Errors
    /// Fails if no process can be started, or if this program has not [declared](declare_command)
    /// the command.
    pub fn start() -> io::Result<Self> {
        if !HAS_COMMAND.load(Ordering::Relaxed) {
            let reason = "this program does not contain the broker";
            return Err(io::Error::new(io::ErrorKind::Unsupported, reason));
        }
        let (own, other) = pair()?;
        let child = command().stdin(Stdio::from(other)).spawn()?;
        Ok(Self {
            reach: Reach::Child(child),
            socket: Some(own),
            failed: None,
            number: 0,
        })
    }

    /// Returns a client that answers requests with the rights of the calling process, without a
    /// broker, deadlines or forks: for tests and examples.
    #[must_use]
    pub const fn here() -> Self {
        Self {
            reach: Reach::Here,
            socket: None,
            failed: None,
            number: 0,
        }
    }

    /// Closes the connection. The packaged broker ends some time after its last connection has
    /// closed.
    pub fn disconnect(&mut self) {
        if matches!(self.reach, Reach::Socket(_)) {
            self.socket = None;
        }
    }

    /// Returns the ids of all processes of the host.
    ///
    /// # Errors
    /// Fails if the broker refuses, or cannot be reached.
    pub fn processes(&mut self) -> Result<Vec<u32>, BrokerError> {
        let mut all = Vec::new();
        self.request(Request::Processes, &[], |answer, _| {
            if let Answer::Processes(mut part) = answer {
                all.append(&mut part);
            }
        })?;
        Ok(all)
    }

    /// Returns which of these processes use a library.
    ///
    /// # Errors
    /// Fails if the broker refuses, or cannot be reached.
    pub fn users(&mut self, library: Library, processes: &[u32]) -> Result<Users, BrokerError> {
        let mut users = Users::default();
        for part in processes.chunks(MAX_PROCESSES) {
            let processes = part.to_vec();
            self.request(Request::Uses { library, processes }, &[], |answer, _| {
                if let Answer::Uses { used, closed } = answer {
                    for (process, part) in used {
                        users.add(process, part);
                    }
                    users.closed.extend(closed);
                }
            })?;
        }
        Ok(users)
    }

    /// Returns the state of these processes; those that ended are left out.
    ///
    /// # Errors
    /// Fails if the broker refuses, or cannot be reached.
    pub fn activities(&mut self, processes: &[u32]) -> Result<Vec<Activity>, BrokerError> {
        let mut all = Vec::new();
        for part in processes.chunks(MAX_PROCESSES) {
            let processes = part.to_vec();
            self.request(Request::Activities { processes }, &[], |answer, _| {
                if let Answer::Activities(mut part) = answer {
                    all.append(&mut part);
                }
            })?;
        }
        Ok(all)
    }

    /// Returns the domain in the environment of a process, 0 without one; `None` if it cannot be
    /// read.
    ///
    /// # Errors
    /// Fails if the broker refuses, or cannot be reached.
    pub fn domain(&mut self, process: u32) -> Result<Option<u32>, BrokerError> {
        let mut found = None;
        self.request(Request::Domain { process }, &[], |answer, _| {
            if let Answer::Domain(domain) = answer {
                found = domain;
            }
        })?;
        Ok(found)
    }

    /// Attaches programs to functions of a library. Returns the descriptors of the breakpoints and
    /// the functions that the library has.
    ///
    /// # Errors
    /// Fails if the broker refuses, or cannot be reached.
    pub fn attach(
        &mut self,
        (calls, place, means): (Calls, Place, AttachMethod),
        programs: &[BorrowedFd<'_>],
    ) -> Result<(Vec<OwnedFd>, Vec<String>), BrokerError> {
        let mut attached = None;
        let request = Request::Attach {
            calls,
            place,
            means,
        };
        self.request(request, programs, |answer, descriptors| {
            if let Answer::Attached { functions } = answer {
                attached = Some((descriptors, functions));
            }
        })?;
        attached.ok_or_else(unexpected)
    }

    /// Returns perf events that report which process maps a file, one for each CPU.
    ///
    /// # Errors
    /// Fails if the broker refuses, or cannot be reached.
    pub fn mappings(&mut self) -> Result<Vec<OwnedFd>, BrokerError> {
        let mut events = Vec::new();
        self.request(Request::Mappings, &[], |_, descriptors| {
            events = descriptors;
        })?;
        Ok(events)
    }

    /// Sends a request, and passes each part of the answer with its descriptors to `with`.
    fn request(
        &mut self,
        request: Request,
        descriptors: &[BorrowedFd<'_>],
        mut with: impl FnMut(Answer, Vec<OwnedFd>),
    ) -> Result<(), BrokerError> {
        if let Reach::Here = self.reach {
            return here(request, descriptors, with);
        }
        let number = self.send(&request, descriptors)?;
        loop {
            let (answer, descriptors) = self.receive(number)?;
            let is_last = answer.is_last();
            with(answer, descriptors);
            if is_last {
                return Ok(());
            }
        }
    }

    fn send(
        &mut self,
        request: &Request,
        descriptors: &[BorrowedFd<'_>],
    ) -> Result<u64, BrokerError> {
        self.number += 1;
        let number = self.number;
        let message = Numbered {
            number,
            content: request,
        };
        // The packaged broker may have ended since the last request, for lack of requests.
        let is_connected = self.socket.is_some();
        let sent = send(self.connected()?, &message, descriptors, SendFlags::empty());
        let sent = match sent {
            Err(_) if is_connected && matches!(self.reach, Reach::Socket(_)) => {
                self.socket = None;
                send(self.connected()?, &message, descriptors, SendFlags::empty())
            }
            sent => sent,
        };
        match sent {
            Ok(()) => Ok(number),
            Err(error) => Err(self.lost(error)),
        }
    }

    fn receive(&mut self, number: u64) -> Result<(Answer, Vec<OwnedFd>), BrokerError> {
        loop {
            let socket = self.socket.as_ref().ok_or(BrokerError::Ended)?;
            let received = receive::<Numbered<Answer>>(socket.as_fd());
            let (answer, descriptors) = match received {
                Ok(Some(received)) => received,
                Ok(None) => return Err(self.lost(io::ErrorKind::UnexpectedEof.into())),
                Err(error) => return Err(self.lost(error)),
            };
            // This is a late answer to an earlier request, which the broker had given up.
            if answer.number < number {
                continue;
            }
            return match answer.content {
                Answer::Refused(reason) => Err(BrokerError::Refused(reason)),
                content => Ok((content, descriptors)),
            };
        }
    }

    /// Drops a connection that has failed, and returns the error. A child has only one connection,
    /// which therefore stays after a timeout: later requests skip the late answer.
    fn lost(&mut self, error: io::Error) -> BrokerError {
        if matches!(self.reach, Reach::Child(_)) && error.kind() == io::ErrorKind::WouldBlock {
            return BrokerError::Answer(error);
        }
        self.socket = None;
        match self.reach {
            Reach::Child(_) => BrokerError::Ended,
            Reach::Socket(_) if is_closed(&error) => BrokerError::Closed,
            Reach::Socket(_) | Reach::Here => BrokerError::Answer(error),
        }
    }

    fn connected(&mut self) -> Result<BorrowedFd<'_>, BrokerError> {
        if self.socket.is_none() {
            let Reach::Socket(path) = &self.reach else {
                return Err(BrokerError::Ended);
            };
            let unreachable = |source| BrokerError::Unreachable {
                path: path.clone(),
                source,
            };
            if let Some((_, code)) = self.failed.filter(|(at, _)| at.elapsed() < RETRY) {
                let same = code.map_or(
                    io::ErrorKind::NotConnected.into(),
                    io::Error::from_raw_os_error,
                );
                return Err(unreachable(same));
            }
            let opened = open(path);
            let failed = opened.as_ref().err().map(io::Error::raw_os_error);
            self.failed = failed.map(|code| (Instant::now(), code));
            self.socket = Some(opened.map_err(unreachable)?);
        }
        self.socket
            .as_ref()
            .map(|socket| socket.as_fd())
            .ok_or(BrokerError::Ended)
    }
}

impl Users {
    fn add(&mut self, process: u32, part: Use) {
        match self.used.last_mut() {
            // The libraries of one process come in parts.
            Some((last, used)) if *last == process => used.libraries.extend(part.libraries),
            _ => self.used.push((process, part)),
        }
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        // The child ends when its socket closes. It never waits for files itself.
        self.socket = None;
        if let Reach::Child(child) = &mut self.reach {
            let _ = child.wait();
        }
    }
}

/// Returns whether a broker may listen at a socket. Only a refusal proves that none does: the file of
/// a broker that was killed stays.
#[must_use]
pub fn is_listening(path: &Path) -> bool {
    let absent = [
        io::ErrorKind::NotFound,
        io::ErrorKind::NotADirectory,
        io::ErrorKind::ConnectionRefused,
    ];
    open(path).map_or_else(|error| !absent.contains(&error.kind()), |_| true)
}

/// Returns the command of a broker whose log has the level of this process.
fn command() -> Command {
    let mut command = Command::new("/proc/self/exe");
    command.arg(COMMAND).stdout(Stdio::null());
    let level = LOG_LEVEL.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(level) = *level {
        command.env("RUST_LOG", level.to_string());
    }
    command
}

fn is_closed(error: &io::Error) -> bool {
    let kinds = [
        io::ErrorKind::UnexpectedEof,
        io::ErrorKind::BrokenPipe,
        io::ErrorKind::ConnectionReset,
    ];
    kinds.contains(&error.kind())
}

/// Answers a request in this process.
fn here(
    request: Request,
    given: &[BorrowedFd<'_>],
    mut with: impl FnMut(Answer, Vec<OwnedFd>),
) -> Result<(), BrokerError> {
    let own = Peer {
        process: std::process::id(),
        user: rustix::process::geteuid().as_raw(),
    };
    let given = given.iter().map(BorrowedFd::try_clone_to_owned);
    let given: Vec<_> = given
        .collect::<io::Result<_>>()
        .map_err(BrokerError::Answer)?;
    let mut refused = None;
    let answered = answer(own, request, &given, &mut |answer, descriptors| {
        match answer {
            Answer::Refused(reason) => refused = Some(reason),
            answer => with(answer, descriptors),
        }
        Ok(())
    });
    answered.map_err(BrokerError::Answer)?;
    refused.map_or(Ok(()), |reason| Err(BrokerError::Refused(reason)))
}

fn unexpected() -> BrokerError {
    BrokerError::Answer(io::ErrorKind::InvalidData.into())
}

fn pair() -> io::Result<(OwnedFd, OwnedFd)> {
    let (own, other) = socketpair(
        AddressFamily::UNIX,
        SocketType::SEQPACKET,
        SocketFlags::CLOEXEC,
        None,
    )?;
    bounded(&own)?;
    Ok((own, other))
}

fn open(path: &Path) -> io::Result<OwnedFd> {
    let flags = SocketFlags::CLOEXEC;
    let socket = socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, flags, None)?;
    // The timeouts also bound the connect: a broker with too many connections accepts later.
    bounded(&socket)?;
    connect(&socket, &SocketAddrUnix::new(path)?)?;
    Ok(socket)
}

fn bounded(socket: &OwnedFd) -> io::Result<()> {
    for timeout in [Timeout::Recv, Timeout::Send] {
        set_socket_timeout(socket, timeout, Some(RESPONSE_TIMEOUT))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::thread;

    use rustix::net::{bind, listen};

    use super::*;

    /// Returns a client of a child that answers nothing, and the child's end of the connection.
    fn child() -> (Broker, OwnedFd) {
        let (own, other) = pair().unwrap();
        let short = Some(Duration::from_millis(200));
        set_socket_timeout(&own, Timeout::Recv, short).unwrap();
        let child = Command::new("true").spawn().unwrap();
        let broker = Broker {
            reach: Reach::Child(child),
            socket: Some(own),
            failed: None,
            number: 0,
        };
        (broker, other)
    }

    fn reply(socket: &OwnedFd, number: u64, content: Answer) {
        let answer = Numbered { number, content };
        send(socket.as_fd(), &answer, &[], SendFlags::empty()).unwrap();
    }

    #[test]
    fn nobody_listens_at_the_file_of_a_socket_that_was_closed() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("attach.sock");
        assert!(!is_listening(&path));
        let (family, kind) = (AddressFamily::UNIX, SocketType::SEQPACKET);
        let listener = socket_with(family, kind, SocketFlags::CLOEXEC, None).unwrap();
        bind(&listener, &SocketAddrUnix::new(&path).unwrap()).unwrap();
        listen(&listener, 1).unwrap();
        assert!(is_listening(&path));
        drop(listener);
        assert!(path.exists());
        assert!(!is_listening(&path));
        assert!(!is_listening(&path.join("below")));
    }

    #[test]
    fn a_broker_that_answers_too_late_once_is_asked_again() {
        let (mut broker, other) = child();
        let late = broker.processes();
        assert!(matches!(late, Err(BrokerError::Answer(_))), "{late:?}");
        reply(&other, 1, Answer::Processes(vec![1]));
        reply(&other, 1, Answer::End);
        reply(&other, 2, Answer::Processes(vec![2]));
        reply(&other, 2, Answer::End);
        assert_eq!(broker.processes().unwrap(), [2]);
        drop(other);
        let ended = broker.processes();
        assert!(matches!(ended, Err(BrokerError::Ended)), "{ended:?}");
    }

    #[test]
    fn a_broker_logs_at_the_level_of_the_process_that_starts_it() {
        set_log_level(LevelFilter::WARN);
        let command = command();
        let level = command.get_envs().find(|(name, _)| *name == "RUST_LOG");
        assert_eq!(level.unwrap().1.unwrap(), "warn");
    }

    #[test]
    fn a_signal_does_not_end_the_wait_for_an_answer() {
        extern "C" fn ignore(_: libc::c_int) {}
        let handler = ignore as extern "C" fn(libc::c_int);
        // SAFETY: zeros are an action without flags.
        let mut action: libc::sigaction = unsafe { std::mem::zeroed() };
        action.sa_sigaction = handler as libc::sighandler_t;
        let before = std::ptr::null_mut();
        // SAFETY: the handler does nothing.
        let set = unsafe { libc::sigaction(libc::SIGUSR1, &raw const action, before) };
        assert_eq!(set, 0);
        let (mut broker, other) = child();
        // A busy machine sends the signals late.
        let long = Some(Duration::from_secs(60));
        let socket = broker.socket.as_ref().unwrap();
        set_socket_timeout(socket, Timeout::Recv, long).unwrap();
        // SAFETY: no preconditions.
        let waiting = unsafe { libc::pthread_self() };
        let interrupter = thread::spawn(move || {
            for _ in 0..10 {
                thread::sleep(Duration::from_millis(10));
                // SAFETY: the thread waits for this one below.
                unsafe { libc::pthread_kill(waiting, libc::SIGUSR1) };
            }
            reply(&other, 1, Answer::End);
            other
        });
        assert!(broker.processes().unwrap().is_empty());
        drop(interrupter.join());
    }
}
