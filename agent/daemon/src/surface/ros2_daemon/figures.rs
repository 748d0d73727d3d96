//! Ports and requests of the ros2 daemon, as metrics, `/health` and `rp doctor` show them.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use super::function::{ALL, FUNCTION_COUNT, Function, UNKNOWN_LABEL};

/// Port of domain 0.
pub const BASE_PORT: u16 = 11_511;

/// Port states and counters of the ros2 daemon.
#[derive(Debug)]
pub struct Ros2DaemonFigures {
    ports: Mutex<BTreeMap<u32, PortState>>,
    /// Number of requests by function, in the order of [`ALL`]. The last number counts requests for
    /// other functions.
    requests: [AtomicU64; FUNCTION_COUNT + 1],
    refused: [AtomicU64; Refused::ALL.len()],
    clients: AtomicUsize,
}

/// State of the port of a domain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PortState {
    /// The agent answers.
    Listening,
    /// Another process has the port, usually a real daemon.
    Occupied,
    /// Released by `ros2 daemon stop`, for a minute.
    Released,
    /// The port cannot be bound for another reason.
    Failed(String),
    /// More domains are in use than the agent has ports.
    Limit,
}

/// Why a request or connection was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refused {
    /// All connections are in use.
    Full,
    /// The Host header does not name this host.
    Host,
    /// A web page may have sent the request: it has an Origin header, or a media type other than
    /// XML.
    Origin,
    /// The path is not the daemon's path, or the method is not POST.
    Path,
    /// The body is too large.
    Size,
    /// The body is not a call.
    Malformed,
    /// Memory for answers is used up by slow readers.
    Memory,
}

impl PortState {
    /// All states as labels.
    pub const LABELS: [&'static str; 5] = ["listening", "occupied", "released", "failed", "limit"];

    /// Returns the label.
    #[must_use]
    pub const fn label(&self) -> &'static str {
        match self {
            Self::Listening => "listening",
            Self::Occupied => "occupied",
            Self::Released => "released",
            Self::Failed(_) => "failed",
            Self::Limit => "limit",
        }
    }
}

impl Refused {
    const ALL: [Self; 7] = [
        Self::Full,
        Self::Host,
        Self::Origin,
        Self::Path,
        Self::Size,
        Self::Malformed,
        Self::Memory,
    ];

    const fn label(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Host => "host",
            Self::Origin => "origin",
            Self::Path => "path",
            Self::Size => "size",
            Self::Malformed => "malformed",
            Self::Memory => "memory",
        }
    }
}

impl Default for Ros2DaemonFigures {
    fn default() -> Self {
        Self {
            ports: Mutex::default(),
            requests: std::array::from_fn(|_| AtomicU64::new(0)),
            refused: std::array::from_fn(|_| AtomicU64::new(0)),
            clients: AtomicUsize::new(0),
        }
    }
}

impl Ros2DaemonFigures {
    /// Returns the state of each domain's port; empty if the agent does not act as the daemon.
    #[must_use]
    pub fn ports(&self) -> BTreeMap<u32, PortState> {
        self.ports
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    /// Returns the number of requests by function.
    pub fn requests(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let names = ALL
            .iter()
            .map(|function| function.name)
            .chain([UNKNOWN_LABEL]);
        names
            .zip(&self.requests)
            .map(|(name, count)| (name, count.load(Ordering::Relaxed)))
    }

    /// Returns the number of refused requests and connections by reason.
    pub fn refused(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let reasons = Refused::ALL.into_iter().zip(&self.refused);
        reasons.map(|(reason, count)| (reason.label(), count.load(Ordering::Relaxed)))
    }

    /// Returns the number of connected clients.
    #[must_use]
    pub fn clients(&self) -> usize {
        self.clients.load(Ordering::Relaxed)
    }

    /// Counts a request.
    pub(super) fn request(&self, method: &str) {
        let index = Function::index(method).unwrap_or(FUNCTION_COUNT);
        if let Some(count) = self.requests.get(index) {
            count.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Counts a refusal.
    pub(super) fn count_refusal(&self, reason: Refused) {
        if let Some(count) = self.refused.get(reason as usize) {
            count.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Records the state of a port; returns whether it changed.
    pub fn set_port(&self, domain_id: u32, state: PortState) -> bool {
        let mut ports = self.ports.lock().unwrap_or_else(PoisonError::into_inner);
        ports.insert(domain_id, state.clone()) != Some(state)
    }

    /// Counts a client until the returned value is dropped.
    pub(super) fn join(self: &Arc<Self>) -> ClientCount {
        self.clients.fetch_add(1, Ordering::Relaxed);
        ClientCount(Arc::clone(self))
    }
}

/// A connected client.
#[derive(Debug)]
pub(super) struct ClientCount(Arc<Ros2DaemonFigures>);

impl Drop for ClientCount {
    fn drop(&mut self) {
        self.0.clients.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Returns the port of a domain; `None` for a domain that ROS does not allow.
#[must_use]
pub fn port(domain_id: u32) -> Option<u16> {
    let offset = u16::try_from(domain_id)
        .ok()
        .filter(|offset| *offset <= 232)?;
    BASE_PORT.checked_add(offset)
}
