//! Detects processes that map a library, when they map it.
//!
//! The kernel writes a record for each executable mapping of every process into a ring for each CPU
//! (`PERF_RECORD_MMAP`, perf_event_open(2)). The broker opens the events, which needs CAP_PERFMON;
//! reading them needs no privilege, and changes nothing in the processes. Processes are identified
//! as in the broker's PID namespace.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs;
use std::io;
use std::os::fd::{AsFd, AsRawFd as _, BorrowedFd, OwnedFd};
use std::os::unix::fs::MetadataExt as _;
use std::ptr::{self, NonNull};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use ros2probe_attach::client::{Broker, BrokerError};

use crate::error_chain::Reason;
use crate::system::monotonic;

/// Pause after mappings of other files. It bounds the cost on a machine that starts many programs.
pub const UNRELATED_DELAY: Duration = Duration::from_millis(2);

/// Pages of records in each ring, a power of two: some 250 mappings, about two starts of a node.
const RING_PAGES: usize = 8;
/// Offsets in the ring's first page, `struct perf_event_mmap_page`.
const HEAD_OFFSET: usize = 1024;
const TAIL_OFFSET: usize = 1032;
/// Types of records.
const MAPPING_RECORD: u32 = 1;
const LOST_RECORD: u32 = 2;
/// Bytes of a record before the name of the mapped file: the header, two ids, three numbers.
const BEFORE_NAME: usize = 40;
/// Maximum size of a record, in bytes: its length field has 16 bits.
const MAX_RECORD: usize = u16::MAX as usize;

/// File that lists the CPUs in use.
const ONLINE_PATH: &str = "/sys/devices/system/cpu/online";
/// Directory of all CPUs, with a directory `topology` for each one in use.
const CPUS_PATH: &str = "/sys/devices/system/cpu";
/// Time since the start of the machine, with its suspensions.
const UPTIME_PATH: &str = "/proc/uptime";
/// Pause between two comparisons of the CPUs.
const CPU_CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// Time between two readings of clocks above which they are not compared.
const MAX_READING: Duration = Duration::from_millis(50);
/// Minimum of a noticed suspension, above the errors of the readings.
const MIN_SUSPENSION: Duration = Duration::from_millis(100);

/// The rings of all CPUs.
pub struct MappingEvents {
    rings: Vec<Ring>,
    record: Vec<u8>,
    opened: Cpus,
    checked: Instant,
}

/// What ends the events of a CPU for good: it goes offline, also during a suspension.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Cpus {
    /// Text of [`ONLINE_PATH`].
    online: String,
    /// Time for which the machine was suspended; `None` if it is not known.
    suspended: Option<Duration>,
    /// Inode of a directory that the kernel creates again whenever the CPU comes, for each CPU.
    arrivals: BTreeMap<OsString, u64>,
}

impl Cpus {
    fn read() -> Self {
        Self {
            online: fs::read_to_string(ONLINE_PATH).unwrap_or_default(),
            suspended: suspended(),
            arrivals: arrivals(),
        }
    }

    /// Returns whether events that were opened at `self` still report all mappings at `now`.
    fn are_same(&self, now: &Self) -> bool {
        let times = self.suspended.zip(now.suspended);
        let was_suspended = times.is_some_and(|(then, now)| now >= then + MIN_SUSPENSION);
        (&self.online, &self.arrivals) == (&now.online, &now.arrivals) && !was_suspended
    }
}

/// Why mappings cannot be detected.
#[derive(Debug, thiserror::Error)]
pub enum MappingError {
    /// The broker does not open the events.
    #[error(transparent)]
    Broker(#[from] BrokerError),
    /// The rings cannot be mapped.
    #[error("the rings of mapped files cannot be mapped")]
    Ring(#[from] io::Error),
}

/// Processes that mapped a library since the last call.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct NewMappings {
    /// Ids of the processes.
    pub processes: BTreeSet<u32>,
    /// Whether the kernel lost records because a ring was full, so that processes may be missing.
    pub is_incomplete: bool,
}

impl MappingEvents {
    /// Maps the ring of each event that the broker opens.
    ///
    /// # Errors
    /// Fails if the broker refuses, or if the kernel has no such events.
    pub fn open(broker: &mut Broker) -> Result<Self, MappingError> {
        // A CPU that changes from now on is noticed.
        let opened = Cpus::read();
        let rings = broker.mappings()?.into_iter().map(Ring::new);
        Ok(Self {
            rings: rings.collect::<io::Result<_>>()?,
            record: Vec::new(),
            opened,
            checked: Instant::now(),
        })
    }

    /// Drops events that miss mappings since a CPU came or went, or since the machine was
    /// suspended. Returns whether there were any: new events have to be opened. Looks once a
    /// second.
    pub fn drop_stale(events: &mut Option<Self>) -> bool {
        events.take_if(Self::is_stale).is_some()
    }

    fn is_stale(&mut self) -> bool {
        if self.checked.elapsed() < CPU_CHECK_INTERVAL {
            return false;
        }
        self.checked = Instant::now();
        let now = Cpus::read();
        self.opened.suspended = self.opened.suspended.or(now.suspended);
        !self.opened.are_same(&now)
    }

    /// Opens the rings for the configuration key `key`. Without them, the thread of that key finds
    /// a library only in its next round. A failure is logged unless it has the reason `logged` of
    /// the failure before.
    #[must_use]
    pub fn open_or_warn(
        key: &str,
        broker: &mut Broker,
        logged: &mut Option<Reason>,
    ) -> Option<Self> {
        let error = match Self::open(broker) {
            Ok(opened) => return Some(opened),
            Err(error) => Some(Reason::of(&error)),
        };
        if *logged != error {
            let reason = error.as_ref().map(Reason::as_str);
            tracing::warn!(
                reason,
                "{key}: a library outside of the usual places is attached up to a second late"
            );
            *logged = error;
        }
        None
    }

    /// Returns descriptors that are readable when a process has mapped a file.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.rings.iter().map(|ring| ring.event.as_fd())
    }

    /// Takes all records. `is_library` decides by its name whether a file is of interest.
    pub fn take(&mut self, is_library: impl Fn(&str) -> bool) -> NewMappings {
        let mut new = NewMappings::default();
        for ring in &self.rings {
            ring.take(&mut self.record, |kind, record| match kind {
                MAPPING_RECORD => new.processes.extend(process(record, &is_library)),
                LOST_RECORD => new.is_incomplete = true,
                _ => {}
            });
        }
        new
    }
}

/// The ring of one CPU.
struct Ring {
    event: OwnedFd,
    start: NonNull<u8>,
    /// Sizes in bytes of a page, and of all pages of records.
    page: usize,
    size: usize,
}

// SAFETY: the mapping is owned, and accessed only through this value; it belongs to no thread.
unsafe impl Send for Ring {}

impl Ring {
    fn new(event: OwnedFd) -> io::Result<Self> {
        // SAFETY: sysconf accesses no memory of this process.
        let page = unsafe { libc::sysconf(libc::_SC_PAGESIZE) };
        let page = usize::try_from(page).map_err(io::Error::other)?;
        // SAFETY: a new mapping at an address of the kernel's choice touches no memory in use.
        let start = unsafe {
            libc::mmap(
                ptr::null_mut(),
                page * (1 + RING_PAGES),
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_SHARED,
                event.as_raw_fd(),
                0,
            )
        };
        if start == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        let start = NonNull::new(start.cast()).ok_or(io::ErrorKind::InvalidData)?;
        Ok(Self {
            event,
            start,
            page,
            size: page * RING_PAGES,
        })
    }

    /// Passes the type and the bytes of each new record to `with`, and frees the space of the
    /// record.
    fn take(&self, record: &mut Vec<u8>, mut with: impl FnMut(u32, &[u8])) {
        let head = self.position(HEAD_OFFSET).load(Ordering::Acquire);
        let mut tail = self.position(TAIL_OFFSET).load(Ordering::Relaxed);
        while tail < head {
            let mut header = [0; 8];
            self.copy(tail, &mut header);
            let [a, b, c, d, _, _, e, f] = header;
            let (kind, length) = (u32::from_ne_bytes([a, b, c, d]), u16::from_ne_bytes([e, f]));
            record.resize(usize::from(length).min(MAX_RECORD), 0);
            self.copy(tail, record);
            with(kind, record);
            // A record of length 0 would cause an endless loop.
            tail += u64::from(length).max(8);
        }
        self.position(TAIL_OFFSET).store(tail, Ordering::Release);
    }

    /// Copies bytes that the kernel has written and that have not been freed yet.
    fn copy(&self, from: u64, into: &mut [u8]) {
        let size = self.size as u64;
        for (offset, byte) in (from..).zip(into) {
            let place = self.page + usize::try_from(offset % size).unwrap_or(0);
            let place = self.start.as_ptr().wrapping_add(place);
            // SAFETY: the address is in the mapping, after its first page. The kernel writes only
            // after the head.
            *byte = unsafe { place.read() };
        }
    }

    /// Returns one of the positions in the first page.
    fn position(&self, offset: usize) -> &AtomicU64 {
        let place = self.start.as_ptr().wrapping_add(offset).cast();
        // SAFETY: both positions are in the first page, and aligned to eight bytes. Only the kernel
        // and this value change them, as the protocol prescribes.
        unsafe { AtomicU64::from_ptr(place) }
    }
}

impl Drop for Ring {
    fn drop(&mut self) {
        // SAFETY: `new` mapped this length, and no borrow of the mapping is left.
        unsafe { libc::munmap(self.start.as_ptr().cast(), self.page + self.size) };
    }
}

/// Returns for how long the machine was suspended since its start; `None` if this thread lost its
/// CPU between the readings of the two clocks.
fn suspended() -> Option<Duration> {
    let before = monotonic();
    let uptime = fs::read_to_string(UPTIME_PATH).ok()?;
    let spent = Duration::from_nanos(monotonic().saturating_sub(before));
    let seconds = uptime.split_ascii_whitespace().next()?.parse().ok()?;
    let uptime = Duration::try_from_secs_f64(seconds).ok()?;
    (spent < MAX_READING).then(|| uptime.saturating_sub(Duration::from_nanos(before)))
}

fn arrivals() -> BTreeMap<OsString, u64> {
    let entries = fs::read_dir(CPUS_PATH).into_iter().flatten().flatten();
    let arrivals = entries.filter_map(|entry| {
        let topology = fs::metadata(entry.path().join("topology")).ok()?;
        Some((entry.file_name(), topology.ino()))
    });
    arrivals.collect()
}

/// Returns the process of a record, if the mapped file is of interest.
fn process(record: &[u8], is_library: impl Fn(&str) -> bool) -> Option<u32> {
    let process = record.get(8..12)?.try_into().ok().map(u32::from_ne_bytes)?;
    let path = record.get(BEFORE_NAME..)?.split(|byte| *byte == 0).next()?;
    let name = path.rsplit(|byte| *byte == b'/').next()?;
    // A record has no id for a process outside of the broker's PID namespace.
    let is_known = process != 0 && process != u32::MAX;
    (is_known && is_library(std::str::from_utf8(name).ok()?)).then_some(process)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::system::wait;

    #[test]
    fn a_truncated_record_yields_no_process() {
        let mut record = [0; 64];
        record[8..12].copy_from_slice(&7_u32.to_ne_bytes());
        record[BEFORE_NAME..BEFORE_NAME + 9].copy_from_slice(b"/l/lib.so");
        let is_library = |name: &str| name == "lib.so";
        assert_eq!(process(&record, is_library), Some(7));
        for end in 0..BEFORE_NAME + 9 {
            assert_eq!(process(&record[..end], is_library), None);
        }
        record[8..12].copy_from_slice(&[0; 4]);
        assert_eq!(process(&record, is_library), None);
    }

    #[test]
    fn events_are_stale_once_a_cpu_came_or_went_or_the_machine_was_suspended() {
        let now = Cpus::read();
        assert!(!now.online.is_empty());
        let at = |online: &str, suspended: Option<Duration>| Cpus {
            online: online.to_owned(),
            suspended,
            arrivals: BTreeMap::from([("cpu3".into(), 7)]),
        };
        let known = Some(Duration::from_secs(7));
        let opened = at("0-3\n", known);
        assert!(opened.are_same(&at("0-3\n", known)));
        assert!(opened.are_same(&at("0-3\n", None)));
        assert!(opened.are_same(&at("0-3\n", Some(Duration::from_millis(7_020)))));
        assert!(!opened.are_same(&at("0-2\n", known)));
        assert!(!opened.are_same(&at("0-3\n", Some(Duration::from_secs(8)))));
        // The CPU went and came again since the last look.
        let mut again = opened.clone();
        again.arrivals.insert("cpu3".into(), 8);
        assert!(!opened.are_same(&again));
        assert!(!now.arrivals.is_empty());

        let events = |opened: &Cpus| {
            Some(MappingEvents {
                rings: Vec::new(),
                record: Vec::new(),
                opened: opened.clone(),
                checked: Instant::now() - CPU_CHECK_INTERVAL,
            })
        };
        let other = Cpus {
            online: "none\n".to_owned(),
            ..now.clone()
        };
        let mut absent = events(&other);
        assert!(MappingEvents::drop_stale(&mut absent) && absent.is_none());
        assert!(!MappingEvents::drop_stale(&mut absent));
        let mut current = events(&now);
        assert!(!MappingEvents::drop_stale(&mut current) && current.is_some());
    }

    #[test]
    fn a_process_that_maps_a_library_is_reported_and_others_are_not() {
        let mut events = MappingEvents::open(&mut Broker::here())
            .expect("records of all processes need root: run the tests with sudo");
        let is_library = |name: &str| name.starts_with("libc.so") || name.starts_with("libc-");
        events.take(is_library);
        // These are more starts than fit a ring.
        for _ in 0..50 {
            let began = Instant::now();
            let mut found = false;
            while !found {
                let mut child = std::process::Command::new("true").spawn().unwrap();
                // A reader that a busy machine delays reports that it has lost records.
                let mut is_incomplete = false;
                while !found && !is_incomplete {
                    assert!(began.elapsed() < Duration::from_secs(60), "{}", child.id());
                    let descriptors: Vec<_> = events.descriptors().collect();
                    wait(&descriptors, Duration::from_millis(100)).unwrap();
                    let new = events.take(is_library);
                    found = new.processes.contains(&child.id());
                    is_incomplete = new.is_incomplete;
                }
                child.wait().unwrap();
            }
        }
        assert_eq!(events.take(|_| false).processes, BTreeSet::new());
    }
}
