//! `rp discover --router`: requests the liveliness tokens of all nodes from a Zenoh router.
//!
//! The command opens a client session over one TCP connection for a few milliseconds. The session
//! declares nothing and subscribes to nothing, so no node appears and other sessions receive
//! nothing.

pub mod address;
pub mod error;
pub mod graph;
pub mod message;
pub mod session;

use std::fs::File;
use std::io::{self, Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use ros2probe_wire::zenoh::Batch;

use self::address::RouterAddress;
use self::error::RouterError;
use self::session::{Session, Step};

/// Maximum wait for the connection, for each answer, and between two parts of the last answer.
const TIMEOUT: Duration = Duration::from_secs(3);
/// Maximum wait for all tokens.
const MAX_DURATION: Duration = Duration::from_secs(30);
/// Wait for the router to close the connection after the goodbye. If this side closed it first,
/// bytes of the router in flight would reset it.
const LINGER_TIME: Duration = Duration::from_millis(200);
/// Maximum number of bytes per read.
const READ_BYTES: usize = 64 << 10;

/// Number of batches, and their bytes including the lengths before them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Number of batches.
    pub batches: u32,
    /// Bytes of TCP payload.
    pub bytes: u64,
}

/// A conversation that ended, perhaps at a cap.
#[derive(Debug)]
pub struct Answer {
    /// The session with the announcements of the router.
    pub session: Session,
    /// Sent traffic.
    pub sent: Traffic,
    /// Received traffic.
    pub received: Traffic,
    /// Time from the introduction to the goodbye.
    pub took: Duration,
}

/// A message that [`run_conversation`] sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Planned {
    /// Purpose, for people.
    pub what: &'static str,
    /// Bytes with the default configuration of routers.
    pub bytes: usize,
    /// How the number of bytes depends on the router.
    pub note: &'static str,
}

/// Returns what [`run_conversation`] sends to a router that answers.
#[must_use]
pub fn plan(domain_id: Option<u32>) -> [Planned; 4] {
    let planned = |what, bytes: Vec<u8>, note| Planned {
        what,
        bytes: bytes.len(),
        note,
    };
    let request = message::request(&session::key(domain_id), true);
    let (cookie, priorities) = (" and the router's cookie", ", 2 less without priorities");
    [
        planned("introduction (INIT)", message::introduction([0; 16]), ""),
        planned("opening (OPEN)", message::opening(&[]), cookie),
        planned("request (INTEREST)", request, priorities),
        planned("goodbye (CLOSE)", message::goodbye(), ""),
    ]
}

/// Connects to the router. Sends nothing beyond the handshake of TCP and the look-up of a name.
///
/// # Errors
///
/// Fails if nothing listens at the address, or if the address cannot be reached.
pub fn connect(address: &RouterAddress) -> Result<(TcpStream, SocketAddr), RouterError> {
    let resolved = address.resolve().map_err(|source| RouterError::Resolve {
        address: address.clone(),
        source,
    })?;
    let mut is_refused = false;
    let mut failure = io::Error::from(io::ErrorKind::AddrNotAvailable);
    for peer in resolved {
        match TcpStream::connect_timeout(&peer, TIMEOUT) {
            Ok(stream) => return Ok((stream, peer)),
            Err(error) => {
                is_refused |= error.kind() == io::ErrorKind::ConnectionRefused;
                failure = error;
            }
        }
    }
    let address = address.clone();
    Err(if is_refused {
        RouterError::Refused { address }
    } else {
        RouterError::Connect {
            address,
            source: failure,
        }
    })
}

/// Runs the conversation up to its goodbye.
///
/// # Errors
///
/// Fails if the router breaks, ends or refuses the conversation, or is silent.
pub fn run_conversation(
    stream: TcpStream,
    peer: SocketAddr,
    domain_id: Option<u32>,
) -> Result<Answer, RouterError> {
    let began = Instant::now();
    let mut conversation = Conversation {
        stream,
        peer,
        after: "connection",
        limit: TIMEOUT,
        deadline: began,
        buffer: Vec::new(),
        sent: Traffic::default(),
        received: Traffic::default(),
    };
    let introduction = message::introduction(random_id().map_err(RouterError::Random)?);
    conversation.send("introduction (INIT)", &introduction)?;
    let mut session = Session::new(domain_id);
    let ended = conversation.listen(&mut session);
    // A peer that is not a router receives nothing more.
    if session.router().is_some() {
        let sent = conversation.send("goodbye (CLOSE)", &message::goodbye());
        if ended.is_ok() {
            sent?;
        }
    }
    ended?;
    let took = began.elapsed();
    conversation.linger();
    Ok(Answer {
        session,
        sent: conversation.sent,
        received: conversation.received,
        took,
    })
}

/// Returns an id of 16 bytes. The last byte is not zero, so that Zenoh writes all of them.
fn random_id() -> io::Result<[u8; 16]> {
    let mut id = [0; 16];
    File::open("/dev/urandom")?.read_exact(&mut id)?;
    let [.., last] = &mut id;
    *last |= 0x80;
    Ok(id)
}

struct Conversation {
    stream: TcpStream,
    peer: SocketAddr,
    /// The last message that was sent.
    after: &'static str,
    /// Maximum wait for the answer, and its deadline.
    limit: Duration,
    deadline: Instant,
    /// Received bytes after the last complete batch: less than one batch and one read.
    buffer: Vec<u8>,
    sent: Traffic,
    received: Traffic,
}

impl Conversation {
    fn send(&mut self, what: &'static str, bytes: &[u8]) -> Result<(), RouterError> {
        let sent = self.stream.set_write_timeout(Some(TIMEOUT));
        let sent = sent.and_then(|()| self.stream.write_all(bytes));
        sent.map_err(|source| self.broken(source))?;
        self.sent.add(bytes.len());
        self.after = what;
        self.set_timeout(TIMEOUT);
        Ok(())
    }

    /// Sets the maximum wait for the next answer.
    fn set_timeout(&mut self, limit: Duration) {
        self.limit = limit;
        self.deadline = Instant::now() + limit;
    }

    /// Receives and answers until the session is over.
    fn listen(&mut self, session: &mut Session) -> Result<(), RouterError> {
        let mut chunk = vec![0; READ_BYTES];
        let peer = self.peer;
        let unusable = |why| RouterError::Unusable { peer, why };
        while !session.is_over() {
            let length = self.read(&mut chunk)?;
            self.buffer
                .extend_from_slice(chunk.get(..length).unwrap_or_default());
            session.beginning(&self.buffer).map_err(unusable)?;
            let mut stream = std::mem::take(&mut self.buffer);
            let mut rest = &stream[..];
            while let Some((batch, behind)) = Batch::split(rest) {
                rest = behind;
                self.received.add(batch.len() + 2);
                for outgoing in session.receive(batch).map_err(unusable)? {
                    self.send(outgoing.what, &outgoing.bytes)?;
                    if session.step() == Step::Request {
                        self.set_timeout(MAX_DURATION);
                    }
                }
                if session.is_over() {
                    break;
                }
            }
            let read = stream.len() - rest.len();
            stream.drain(..read);
            self.buffer = stream;
        }
        Ok(())
    }

    /// Reads at least one byte.
    fn read(&mut self, chunk: &mut [u8]) -> Result<usize, RouterError> {
        let silent = |limit| RouterError::Silent {
            peer: self.peer,
            after: self.after,
            limit,
        };
        loop {
            let left = self.deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(silent(self.limit));
            }
            let timeout = self.stream.set_read_timeout(Some(left.min(TIMEOUT)));
            timeout.map_err(|source| self.broken(source))?;
            match self.stream.read(chunk) {
                Ok(0) => return Err(self.broken(io::ErrorKind::ConnectionReset.into())),
                Ok(length) => return Ok(length),
                Err(error) => match error.kind() {
                    io::ErrorKind::Interrupted => {}
                    io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => {
                        return Err(silent(TIMEOUT));
                    }
                    _ => return Err(self.broken(error)),
                },
            }
        }
    }

    /// Waits for the router to end the connection.
    fn linger(&mut self) {
        let _ = self.stream.shutdown(Shutdown::Write);
        let end = Instant::now() + LINGER_TIME;
        let mut chunk = [0; 1024];
        loop {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() || self.stream.set_read_timeout(Some(left)).is_err() {
                return;
            }
            match self.stream.read(&mut chunk) {
                Ok(1..) => {}
                Ok(0) | Err(_) => return,
            }
        }
    }

    fn broken(&self, source: io::Error) -> RouterError {
        use io::ErrorKind::{BrokenPipe, ConnectionReset};
        let (peer, after) = (self.peer, self.after);
        match source.kind() {
            BrokenPipe | ConnectionReset => RouterError::Ended { peer, after },
            _ => RouterError::Broken {
                peer,
                after,
                source,
            },
        }
    }
}

impl Traffic {
    fn add(&mut self, length: usize) {
        self.batches += 1;
        self.bytes += length as u64;
    }
}
