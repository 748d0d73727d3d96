//! Attaches the programs for tcx to the interfaces of a network namespace (Linux 6.6).
//!
//! Links hold the programs: the kernel removes them with the last descriptor, so nothing stays on an
//! interface however the process ends. The programs stand in front of others at tcx, and always
//! continue with the next one.
//!
//! Loading the programs takes `CAP_NET_ADMIN`, attaching them takes no privilege. So a thread
//! without capabilities attaches them to interfaces that appear later. It runs in the namespace of
//! the interfaces, because a link is created in the namespace of the calling thread.

use std::collections::BTreeMap;
use std::io;
use std::os::fd::{AsFd as _, BorrowedFd, OwnedFd};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{Builder, JoinHandle};

use super::bpf;
use super::filter::FilterError;
use super::netns::{self, NetnsError};
use crate::tables::KnownInterfaces;
use crate::threads::{Spawn, Task};
use crate::tracepoints::release;

/// Attach types of linux/bpf.h.
pub const BPF_TCX_INGRESS: u32 = 46;
/// As [`BPF_TCX_INGRESS`], for sent packets.
pub const BPF_TCX_EGRESS: u32 = 47;
/// The first Linux with tcx.
const FIRST_RELEASE: (u32, u32) = (6, 6);
/// Index of the loopback interface in every network namespace.
const LOOPBACK: u32 = 1;

/// Why tcx is not used.
#[derive(Debug, thiserror::Error)]
pub enum TcxError {
    /// The kernel has no such hooks.
    #[error("the kernel has no tcx (Linux 6.6)")]
    Unsupported,
    /// The process may not use them.
    #[error("CAP_NET_ADMIN is missing")]
    NetAdmin,
    /// The kernel does not answer whether it has them.
    #[error("cannot query the programs at tcx")]
    Query(#[source] io::Error),
    /// The programs cannot be loaded.
    #[error(transparent)]
    Filter(#[from] FilterError),
    /// The programs cannot be attached.
    #[error("cannot attach programs to the interface with index {interface}")]
    Attach {
        /// Index of the interface.
        interface: u32,
        /// Error of the system call.
        source: io::Error,
    },
}

/// Why interfaces that appear later are not observed.
#[derive(Debug, thiserror::Error)]
pub enum FollowError {
    /// The namespace cannot be entered.
    #[error(transparent)]
    Namespace(#[from] NetnsError),
    /// The thread cannot be started.
    #[error("failed to spawn a thread")]
    Thread(#[from] io::Error),
}

/// Checks whether this kernel has tcx, and whether the calling thread may use it.
///
/// # Errors
/// Returns [`TcxError::Unsupported`] before Linux 6.6, and [`TcxError::NetAdmin`] without the
/// capability.
pub fn check() -> Result<(), TcxError> {
    match bpf::count_programs(LOOPBACK, BPF_TCX_INGRESS) {
        Ok(_) => Ok(()),
        Err(error) => Err(match error.raw_os_error() {
            Some(libc::EINVAL | libc::ENOSYS) => TcxError::Unsupported,
            Some(libc::EPERM | libc::EACCES) => TcxError::NetAdmin,
            _ => TcxError::Query(error),
        }),
    }
}

/// Returns whether this kernel has tcx. Without `CAP_NET_ADMIN` the kernel does not answer; its
/// release then decides.
#[must_use]
pub fn is_supported() -> bool {
    match check() {
        Ok(()) => true,
        Err(TcxError::NetAdmin) => release().is_some_and(|release| release >= FIRST_RELEASE),
        Err(_) => false,
    }
}

/// The programs at the interfaces of one network namespace. Dropping the value detaches them.
pub struct Tcx {
    worker: Worker,
    /// Number of interfaces to which the kernel has refused to attach the programs.
    refused: Arc<AtomicU64>,
}

/// What attaches the programs.
enum Worker {
    /// The calling thread, which has to be in the namespace.
    Caller(Links),
    /// A thread in the namespace.
    Thread {
        /// Closed to end the thread.
        requests: Option<SyncSender<Request>>,
        thread: Option<JoinHandle<()>>,
    },
}

/// Work of the thread.
enum Request {
    /// Holds the links that exist.
    Adopt(BTreeMap<u32, Vec<OwnedFd>>),
    /// Attaches the programs to the interface with this index.
    Attach(u32),
    /// Detaches them.
    Detach(u32),
}

/// The links, by interface index. Interfaces that are gone have none.
struct Links {
    /// For received and for sent packets.
    programs: [OwnedFd; 2],
    held: BTreeMap<u32, Vec<OwnedFd>>,
}

impl Tcx {
    /// Creates a value without links, for programs for received and sent packets.
    ///
    /// # Errors
    /// Fails if no more descriptors are available.
    pub fn new(programs: [BorrowedFd<'_>; 2]) -> io::Result<Self> {
        let [ingress, egress] = programs;
        let programs = [ingress.try_clone_to_owned()?, egress.try_clone_to_owned()?];
        Ok(Self {
            worker: Worker::Caller(Links {
                programs,
                held: BTreeMap::new(),
            }),
            refused: Arc::default(),
        })
    }

    /// Starts the thread that attaches the programs from now on, in the namespace at `path` or, without a
    /// path, in that of the calling thread.
    ///
    /// # Errors
    /// Fails if the thread cannot be started. The calling thread then attaches programs as before.
    pub fn start(&mut self, path: Option<&Path>, spawn: Spawn) -> Result<(), FollowError> {
        let Worker::Caller(links) = &mut self.worker else {
            return Ok(());
        };
        let [ingress, egress] = &links.programs;
        let mut of_thread = Links {
            programs: [ingress.try_clone()?, egress.try_clone()?],
            held: BTreeMap::new(),
        };
        let refused = Arc::clone(&self.refused);
        let (requests, incoming) = sync_channel(KnownInterfaces::CAP);
        let thread = Builder::new().name("tcx".to_owned()).stack_size(256 << 10);
        let work = Box::new(move || of_thread.serve(&incoming, &refused));
        // A thread begins in the namespace of its creator.
        let thread = match path {
            Some(path) => netns::within(path, || spawn(Task::Tcx, thread, work))??,
            None => spawn(Task::Tcx, thread, work)?,
        };
        // The queue is empty, and the thread waits for it.
        let _ = requests.try_send(Request::Adopt(std::mem::take(&mut links.held)));
        self.worker = Worker::Thread {
            requests: Some(requests),
            thread: Some(thread),
        };
        Ok(())
    }

    /// Attaches the programs to an interface that has none yet.
    ///
    /// # Errors
    /// Fails if the kernel refuses, unless a thread attaches the programs: it counts the failure.
    pub fn attach(&mut self, interface: u32) -> Result<(), TcxError> {
        match &mut self.worker {
            Worker::Caller(links) => links
                .attach(interface)
                .map_err(|source| TcxError::Attach { interface, source }),
            Worker::Thread { .. } => {
                self.request(Request::Attach(interface));
                Ok(())
            }
        }
    }

    /// Detaches the programs from an interface, or closes the links to one that is gone.
    pub fn detach(&mut self, interface: u32) {
        match &mut self.worker {
            Worker::Caller(links) => links.detach(interface),
            Worker::Thread { .. } => self.request(Request::Detach(interface)),
        }
    }

    /// Returns the number of interfaces to which the thread could not attach the programs.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    fn request(&self, request: Request) {
        if let Worker::Thread {
            requests: Some(requests),
            ..
        } = &self.worker
            && requests.try_send(request).is_err()
        {
            self.refused.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        if let Self::Thread { requests, thread } = self {
            *requests = None;
            if let Some(thread) = thread.take() {
                // The result of the thread is not needed.
                let _ = thread.join();
            }
        }
    }
}

impl Links {
    /// Handles requests until the other side is dropped.
    fn serve(&mut self, requests: &Receiver<Request>, refused: &AtomicU64) {
        for request in requests {
            match request {
                Request::Adopt(held) => self.held = held,
                Request::Attach(interface) => {
                    if let Err(source) = self.attach(interface) {
                        refused.fetch_add(1, Ordering::Relaxed);
                        tracing::warn!(interface, %source, "the interface is not observed");
                    }
                }
                Request::Detach(interface) => self.detach(interface),
            }
        }
    }

    fn attach(&mut self, interface: u32) -> io::Result<()> {
        if self.held.contains_key(&interface) {
            return Ok(());
        }
        let [ingress, egress] = &self.programs;
        let mut wanted = vec![(ingress, BPF_TCX_INGRESS)];
        if interface != LOOPBACK {
            // A packet that is sent to the loopback interface is received there too, and counts once.
            wanted.push((egress, BPF_TCX_EGRESS));
        }
        let links = wanted.into_iter().map(|(program, attach_type)| {
            bpf::create_first_link(program.as_fd(), interface, attach_type)
        });
        match links.collect::<io::Result<_>>() {
            Ok(links) => {
                self.held.insert(interface, links);
                Ok(())
            }
            // The interface is gone.
            Err(error) if error.raw_os_error() == Some(libc::ENODEV) => Ok(()),
            Err(error) => Err(error),
        }
    }

    fn detach(&mut self, interface: u32) {
        self.held.remove(&interface);
    }
}
